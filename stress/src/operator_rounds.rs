//! Does what people do to a lake, in random sequences, and compares what was acknowledged with answers.

use std::io::Write as _;
use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use echolake_testing::run_long_command;

use super::operators::{OperatorCampaign, RoundFailure};

const DELTALAKE: &str = "deltalake==1.6.6";
/// With this variable a missing package is a failure.
const NO_SKIP: &str = "ECHOLAKE_NO_SKIP";

#[derive(Debug, clap::Args)]
pub(crate) struct OperatorArgs {
    /// Rounds, of two to five actions each.
    #[arg(default_value_t = 200)]
    rounds: u64,
    /// Seed of the first round; each further one has the next.
    #[arg(default_value_t = 1)]
    seed: u64,
    /// Python that has the package deltalake; by default it is installed beside this program.
    #[arg(long)]
    python: Option<PathBuf>,
    /// The command; by default the one that is built beside this program.
    #[arg(long)]
    binary: Option<PathBuf>,
}

pub(crate) fn run_operator_rounds(args: &OperatorArgs) -> Result<()> {
    let binary = args.binary.clone().map_or_else(super::echolake_path, |path| Ok(path.canonicalize()?))?;
    let python = match args.python.clone().map_or_else(install_deltalake, Ok) {
        Err(why) if std::env::var_os(NO_SKIP).is_none() => {
            writeln!(std::io::stderr(), "SKIPPED deltalake's maintenance: {why:#}")?;
            None
        }
        python => Some(python?),
    };
    let campaign = OperatorCampaign::new(&binary, args.seed, python);
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

// Returns a Python that has the package, in a folder beside this program.
fn install_deltalake() -> Result<PathBuf> {
    let folder = super::echolake_path()?.with_file_name("operators-python");
    let python = folder.join("bin/python");
    let has_package = || run_program(Command::new(&python).args(["-c", "import deltalake"]));
    if has_package().is_err() {
        run_program(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
        run_program(Command::new(folder.join("bin/pip")).args(["install", "--quiet", DELTALAKE]))?;
        has_package()?;
    }
    Ok(python)
}

fn run_program(command: &mut Command) -> Result<()> {
    let output = run_long_command(command).with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}
