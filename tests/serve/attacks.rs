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
    use super::observed_server::{ClientGroup, ObservedServer, QueryOutcome, QueryProtocol};
    use crate::ECHOLAKE;

    /// Clients of whom each asks one query.
    const MANY_CLIENTS: ClientGroup =
        ClientGroup { name: "light", count: 50, limits: "seconds = 60\nmemory_mb = 400\nconcurrent = 4\n" };
    /// Memory of the server with all of its engines then, KiB.
    const MANY_CLIENTS_KIB: u64 = 1 << 20;

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
    fn fifty_clients_share_two_engines_and_a_spare() {
        let server = ObservedServer::start(Path::new(ECHOLAKE), &[MANY_CLIENTS]).expect("a lake");
        for number in 0..MANY_CLIENTS.count {
            let client = server.client(MANY_CLIENTS.name, number);
            let answer = client.query(QueryProtocol::ALL[number % 4], "select avg(tnce_total) from tnce");
            assert!(matches!(answer, QueryOutcome::Answer(_)), "{answer}");
            assert!(matches!(client.get_page("/api/v1/runs"), QueryOutcome::Answer(_)));
        }
        let processes = server.process_tree();
        assert_eq!(processes.children().len(), 3);
        let memory = processes.memory();
        assert!(memory.total_kib <= MANY_CLIENTS_KIB, "{memory:?}");
    }

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
