//! Does what people do to a lake, in random sequences, and compares what was acknowledged with answers.

use std::io::Write as _;
use std::path::PathBuf;

use anyhow::{Result, ensure};

use super::operators::{OperatorCampaign, RoundFailure};

#[derive(Debug, clap::Args)]
pub(crate) struct OperatorArgs {
    /// Rounds, of two to five actions each.
    #[arg(default_value_t = 200)]
    rounds: u64,
    /// Seed of the first round; each further one has the next.
    #[arg(default_value_t = 1)]
    seed: u64,
    /// Python that has the package deltalake.
    #[arg(long, default_value = "python3")]
    python: PathBuf,
    /// The command; by default the one that is built beside this program.
    #[arg(long)]
    binary: Option<PathBuf>,
}

pub(crate) fn run(args: &OperatorArgs) -> Result<()> {
    let binary = args.binary.clone().map_or_else(super::echolake_path, |path| Ok(path.canonicalize()?))?;
    let campaign = OperatorCampaign::new(&binary, args.seed, Some(args.python.clone()));
    let mut number = 0;
    let failures = campaign.rounds(args.rounds, &mut |seed, failure: Option<&RoundFailure>| {
        number += 1;
        // Progress is not worth an error.
        let _ = match failure {
            Some(failure) => writeln!(std::io::stderr(), "{failure}"),
            None if number % 10 == 0 => writeln!(std::io::stderr(), "{number} of {} rounds, seed {seed}", args.rounds),
            None => Ok(()),
        };
    });
    ensure!(failures.is_empty(), "{} of {} rounds failed", failures.len(), args.rounds);
    writeln!(
        std::io::stdout(),
        "{} rounds, seed {}: all that was acknowledged was there, or an exit code said that it was not",
        args.rounds,
        args.seed
    )?;
    Ok(())
}
