//! Attacks a server in every known way, and watches what other clients notice of it, what memory it takes, and whether
//! it is idle soon after the attacker is gone.
//!
//! One row per attack and protocol. The server may die by any of them; it is started again then.

mod attack_case;
mod attack_report;
mod attack_trial;
mod sql;
mod wire;

use std::path::Path;
use std::time::Duration;

use anyhow::{Result, ensure};

use super::observed_server::{ClientGroup, LightLoad, ObservedServer};
pub(crate) use attack_case::{AttackCase, all_cases, quick_cases};
pub(crate) use attack_report::AttackRow;
use attack_report::{print_quiet, print_row, print_summary};
use attack_trial::AttackTrial;

/// Time for which the server is watched before it is attacked.
const QUIET_TIME: Duration = Duration::from_secs(5);
/// Megabytes that a hostile client's queries may hold; those of its limits below.
const HOSTILE_MEMORY_MB: u64 = 1000;
/// The attacking clients. There are many, so that the server's memory of one does not weaken the next attack.
pub(crate) const HOSTILE_CLIENTS: ClientGroup = ClientGroup {
    name: "hostile",
    count: 40,
    limits: "seconds = 10\nmemory_mb = 1000\nrows = 10_000_000\nconcurrent = 4\n",
};
/// The clients that must not notice the attacks.
pub(crate) const LIGHT_CLIENTS: ClientGroup =
    ClientGroup { name: "light", count: 4, limits: "seconds = 30\nmemory_mb = 200\nconcurrent = 4\n" };

#[derive(Debug, clap::Args)]
pub(crate) struct AttackArgs {
    /// Only attacks with this text in `NAME PROTOCOL`.
    #[arg(long, value_name = "SUBSTRING")]
    only: Option<String>,
    /// Duration of an attack, in seconds.
    #[arg(long, value_name = "SECS", default_value_t = 15.0)]
    seconds: f64,
    /// A short selection: two attacks of each family, over one protocol each.
    #[arg(long)]
    quick: bool,
}

pub(crate) fn run_attacks(args: &AttackArgs) -> Result<()> {
    let mut cases = if args.quick { quick_cases() } else { all_cases() };
    cases.retain(|case| args.only.as_ref().is_none_or(|part| case.title().contains(part.as_str())));
    ensure!(!cases.is_empty(), "no attack has this in `NAME PROTOCOL`");
    let rows = run_cases(&super::echolake_path()?, &cases, args.seconds, &mut print_row)?;
    ensure!(print_summary(&rows), "goals are missed");
    Ok(())
}

/// Tries the attacks one after the other; `progress` sees each row.
///
/// # Errors
/// The lake cannot be made.
pub(crate) fn run_cases(
    binary: &Path,
    cases: &[AttackCase],
    seconds: f64,
    progress: &mut dyn FnMut(&AttackRow),
) -> Result<Vec<AttackRow>> {
    let mut server = ObservedServer::start(binary, &[HOSTILE_CLIENTS, LIGHT_CLIENTS])?;
    let quiet = LightLoad::start(&server);
    std::thread::sleep(QUIET_TIME);
    print_quiet(&quiet.stop());
    let mut rows = Vec::new();
    for (number, case) in cases.iter().enumerate() {
        let row = AttackTrial::new(&mut server, number).run(case, seconds);
        progress(&row);
        rows.push(row);
    }
    Ok(rows)
}
