//! Short forms of the campaigns `attacks`, `hostile-clients`, `engine-kills` and `cancels`. How soon others are
//! answered depends on what else the machine does, so that it is measured there and not here.

#![allow(clippy::module_inception, reason = "the campaign has the name of its tests")]

#[allow(dead_code, reason = "the campaign, of which this wants a part")]
#[path = "../../stress/src/attacks/mod.rs"]
mod attacks;
#[allow(dead_code, reason = "the campaign, of which this wants a part")]
#[path = "../../stress/src/cancels.rs"]
mod cancels;
#[allow(dead_code, reason = "the campaign, of which this wants a part")]
#[path = "../../stress/src/engine_kills.rs"]
mod engine_kills;
#[allow(dead_code, reason = "the campaign, of which this wants a part")]
#[path = "../../stress/src/hostile_clients.rs"]
mod hostile_clients;
#[allow(dead_code, reason = "the campaigns' helper, of which this wants a part")]
#[path = "../../stress/src/observed_server/mod.rs"]
mod observed_server;
#[path = "../../stress/src/percentile.rs"]
mod percentile;

use std::path::PathBuf;

// What the campaigns' own main offers them.
fn echolake_path() -> anyhow::Result<PathBuf> {
    Ok(PathBuf::from(crate::ECHOLAKE))
}

mod slow {
    use std::path::Path;
    use std::time::Duration;

    use super::attacks::{all_cases, run_cases};
    use super::cancels::{QueryEnd, run_cancels};
    use super::engine_kills::run_kills;
    use super::hostile_clients::run_clients;
    use super::observed_server::QueryProtocol;
    use crate::ECHOLAKE;

    /// Attacks that end a process or take its memory, each another way.
    const ATTACKS: [&str; 6] = [
        "chain of plus postgres-simple",
        "position in position http",
        "array_repeat of a range in a list flight-sql",
        "folded levenshtein http",
        "query of 1 GiB before log-in postgres",
        "lz4 body declared 2^62 bytes flight-sql",
    ];

    /// Goals that a busy machine may miss.
    const MACHINE_GOALS: [&str; 3] = ["light queries within 300 ms", "/health within 100 ms", "idle again"];

    #[test]
    fn attacks_harm_nobody_else() {
        let mut cases = all_cases();
        cases.retain(|case| ATTACKS.contains(&case.title().as_str()));
        assert_eq!(cases.len(), ATTACKS.len());
        let rows = run_cases(Path::new(ECHOLAKE), &cases, 2.0, &mut |_| ()).expect("a lake");
        for row in rows {
            let mut harms = row.missed_goals();
            harms.retain(|goal| !MACHINE_GOALS.contains(goal));
            assert!(harms.is_empty(), "{harms:?}: {row:?}");
        }
    }

    #[test]
    fn answers_beside_hostile_clients_are_right() {
        let quiet = Duration::from_secs(1);
        let report = run_clients(Path::new(ECHOLAKE), quiet, Duration::from_secs(8), 1).expect("a lake");
        assert!(report.is_right(), "{report:?}");
    }

    #[test]
    fn a_killed_engine_leaves_no_short_answer() {
        let tally = run_kills(Path::new(ECHOLAKE), 10, 1).expect("a lake and engines");
        assert!(tally.is_honest() && !tally.times.is_empty(), "{tally:?}");
    }

    #[test]
    fn a_query_that_is_ended_leaves_the_server_idle() {
        let ends = [QueryEnd::CancelRequest, QueryEnd::ClosedConnection(QueryProtocol::Http)];
        for query in ["planning", "one call that"] {
            let rows = run_cancels(Path::new(ECHOLAKE), &ends, 1, Some(query), &mut |_| ()).expect("a lake");
            assert!(rows.len() == ends.len() && rows.iter().all(|row| row.failures == 0), "{rows:?}");
        }
    }
}
