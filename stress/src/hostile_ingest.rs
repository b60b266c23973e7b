//! Puts hostile and mutated run files into the inbox of `ingest --watch`, and checks that all others are taken in, in
//! bounded memory.

use std::io::Write as _;
use std::time::Duration;

use anyhow::{Result, ensure};

use super::hostile_files::{HostileCampaign, HostileSizes};

/// Mutated files of a round. Each round has an inbox of its own.
const MUTANTS_PER_ROUND: u64 = 1000;
const MOST_MIB: u64 = 600;
/// Files as large as those that once ended an ingest, and chunks that are just small enough to be read.
const SIZES: HostileSizes = HostileSizes { false_records: 36_000_000, bomb: 250 << 20, sparse: 12 << 30 };

#[derive(Debug, clap::Args)]
pub(crate) struct HostileFilesArgs {
    /// Mutated run files, beside those that are crafted.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(0..=40_000))]
    count: u64,
    /// Seed of the mutations.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Longest time of a round, seconds.
    #[arg(long, default_value_t = 3600)]
    limit_secs: u64,
}

pub(crate) fn run_hostile_ingest(args: &HostileFilesArgs) -> Result<()> {
    let HostileFilesArgs { count, seed, limit_secs } = *args;
    let campaign = HostileCampaign::new(&super::echolake_path()?, seed);
    let mut out = std::io::stdout().lock();
    let mut first = 0;
    let mut is_bad = false;
    let mut crafted = Some(SIZES);
    while first < count || crafted.is_some() {
        // The crafted ones have a round of their own.
        let last = if crafted.is_some() { first } else { count.min(first + MUTANTS_PER_ROUND) };
        let kind = if crafted.is_some() { "crafted".to_owned() } else { format!("mutants {first} to {last}") };
        let outcome = campaign.round(crafted.take(), first..last, Duration::from_secs(limit_secs));
        first = last;
        is_bad |= outcome.good < outcome.good_expected || outcome.peak_mib > MOST_MIB;
        writeln!(
            out,
            "{kind}: {} files, {} of {} good runs taken in, {} files quarantined, {} restarts, peak {} MiB, {:.0?}",
            outcome.files,
            outcome.good,
            outcome.good_expected,
            outcome.quarantined,
            outcome.deaths.len(),
            outcome.peak_mib,
            outcome.elapsed
        )?;
        for death in outcome.deaths {
            writeln!(out, "  ended by {death}")?;
        }
    }
    ensure!(!is_bad, "good runs were not taken in, or ingest took more than {MOST_MIB} MiB");
    Ok(())
}
