//! Kills `echolake acquire` at random moments, many times, recovers and resumes, and compares what was acknowledged
//! with what is there.

use std::io::Write as _;

use anyhow::{Context as _, Result};

use super::acquire_kills::AcquireKillCampaign;

#[derive(Debug, clap::Args)]
pub(crate) struct KillAcquireArgs {
    /// Kills, in as many runs as they take.
    #[arg(default_value_t = 200)]
    kills: usize,
    /// Seed of the moments.
    #[arg(default_value_t = 1)]
    seed: u64,
    /// Part that is killed.
    #[arg(value_enum, default_value_t = KilledPart::Process)]
    part: KilledPart,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum KilledPart {
    /// The process.
    Process,
    /// The power: a file system forgets at each kill what was not synced.
    Power,
}

pub(crate) fn run_kill_acquire(args: &KillAcquireArgs) -> Result<()> {
    let KillAcquireArgs { kills, seed, part } = *args;
    let binary = super::echolake_path()?;
    let campaign = match part {
        KilledPart::Power => AcquireKillCampaign::with_power_cuts(&binary, seed),
        KilledPart::Process => Some(AcquireKillCampaign::new(&binary, seed)),
    };
    let mut campaign = campaign.context("no file system can be mounted here")?;
    let outcome = campaign.kills(kills, &mut |so_far| {
        // Progress is not worth an error.
        let _ = writeln!(std::io::stderr(), "{} of {kills} kills, {} runs whole", so_far.killed, so_far.runs);
    });
    writeln!(
        std::io::stdout(),
        "{} {}, seed {seed}: {} before the file's head, {} runs brought to their end, {} attempts acknowledged; \
         0 lost, 0 doubled, every file whole",
        outcome.killed,
        if part == KilledPart::Power { "power cuts" } else { "kills" },
        outcome.before_the_file,
        outcome.runs,
        outcome.acknowledged
    )?;
    Ok(())
}
