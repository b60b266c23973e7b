//! Kills `echolake ingest` at random moments, many times, and compares its tables with those of an undisturbed one.

use std::io::Write as _;

use anyhow::Result;

use super::kills::{KillCampaign, KillCounts};

/// Runs of the lake that two processes ingest at once.
const SHARED_RUNS: usize = 40;

#[derive(Debug, clap::Args)]
pub(crate) struct KillIngestArgs {
    /// Rounds, with up to three kills each.
    #[arg(default_value_t = 200)]
    rounds: usize,
    /// Seed of the moments.
    #[arg(default_value_t = 1)]
    seed: u64,
    /// Kind of disturbance of ingest.
    #[arg(value_enum, default_value_t = IngestDisturbance::Kills)]
    disturbance: IngestDisturbance,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum IngestDisturbance {
    /// It is killed.
    Kills,
    /// Two processes ingest half of 40 runs each; one of them is killed in every second round.
    Halves,
}

pub(crate) fn run_kill_ingest(args: &KillIngestArgs) -> Result<()> {
    let KillIngestArgs { rounds, seed, disturbance } = *args;
    let binary = super::echolake_path()?;
    let mut tell = |round: usize, so_far: &KillCounts| {
        if round.is_multiple_of(10) {
            // Progress is not worth an error.
            let _ = writeln!(std::io::stderr(), "{round} of {rounds} rounds, {} killed", so_far.killed);
        }
    };
    let outcome = match disturbance {
        IngestDisturbance::Kills => KillCampaign::new(&binary, seed).rounds(rounds, &mut tell),
        IngestDisturbance::Halves => KillCampaign::of(&binary, seed, SHARED_RUNS).halves(rounds, &mut tell),
    };
    writeln!(
        std::io::stdout(),
        "{rounds} rounds, seed {seed}: {} kills while ingest worked, {} after its end; all tables equal",
        outcome.killed,
        outcome.ended
    )?;
    Ok(())
}
