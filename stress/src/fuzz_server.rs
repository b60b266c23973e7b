//! Throws changed SQL, changed bytes of each protocol, changed run files or changed bodies at `echolake serve`, and
//! ends with an error at the first that harms it.

use std::io::Write as _;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::fuzz::{FuzzCampaign, FuzzTarget};
use crate::serve::server::ServedLake;

/// Between two lines about how far it is.
const TELL_EVERY: Duration = Duration::from_secs(30);

#[derive(Debug, clap::Args)]
pub(crate) struct FuzzArgs {
    /// Kind of input that is changed: sql, wire, mcap or bodies.
    #[arg(value_parser = parse_target)]
    target: FuzzTarget,
    /// Duration in seconds.
    #[arg(default_value_t = 60)]
    seconds: u64,
    /// Seed of the changes.
    #[arg(default_value_t = 1)]
    seed: u64,
}

fn parse_target(name: &str) -> Result<FuzzTarget, String> {
    let known = FuzzTarget::ALL.into_iter().find(|target| target.name() == name);
    known.ok_or_else(|| "hint: sql, wire, mcap or bodies".to_owned())
}

pub(crate) fn run_fuzz_server(args: &FuzzArgs) -> Result<()> {
    let FuzzArgs { target, seconds, seed } = *args;
    let binary = super::echolake_path()?;
    let begun = Instant::now();
    let mut told = Instant::now();
    let outcome = FuzzCampaign::new(&binary, seed, ServedLake::start).throw(target, &mut |so_far| {
        if told.elapsed() > TELL_EVERY {
            told = Instant::now();
            // Progress is not worth an error.
            let _ = writeln!(std::io::stderr(), "{} rounds in {:.0?}", so_far.rounds, begun.elapsed());
        }
        begun.elapsed() < Duration::from_secs(seconds)
    });
    writeln!(
        std::io::stdout(),
        "{}, seed {seed}: {} rounds in {:.0?}, {} answered, {} broke their own connection's decoder, at most {} MiB, \
         an engine {} MiB; the server is well",
        target.name(),
        outcome.rounds,
        begun.elapsed(),
        outcome.answered,
        outcome.broken,
        outcome.resident_kib >> 10,
        outcome.engine_kib >> 10
    )?;
    Ok(())
}
