//! Heavy queries over workers, as processes of their own: answers, refusals, and workers that are killed. Short form of
//! the campaign `workers`.

#[allow(dead_code, reason = "the campaign, of which this wants a part")]
#[path = "../../stress/src/workers.rs"]
mod campaign;

use std::path::PathBuf;

use echolake_testing::ChildProcess;

use super::{TestFolder, get, json, lake, served, sql, wait_until};

const TOKEN: &str = "0123456789abcdef0123456789abcdef";
/// Reads all responses.
const HEAVY: &str = "select surface_id, count(*) from measurements where ir[1] <> 7 group by surface_id";

// What the campaigns' own main offers them.
fn echolake_path() -> anyhow::Result<PathBuf> {
    Ok(PathBuf::from(crate::ECHOLAKE))
}

/// A worker of the lake of a folder; returns its URL, too.
fn start_worker(place: &TestFolder, more: &[&str]) -> (ChildProcess, String) {
    let mut command = place.command(&[&["serve", "--worker", "127.0.0.1:0"], more].concat());
    let mut child = ChildProcess::start(&mut command).expect("it starts");
    let line = child.wait_for_line("  worker http");
    (child, line.trim().trim_start_matches("worker ").to_owned())
}

fn explain_over(place: &TestFolder, workers: &str, more: &[&str]) -> String {
    let server = served(place, &[&["--workers", workers, "--spread-from", "0"], more].concat());
    let plan = json(&sql(&server, &format!("explain {HEAVY}"))).to_string();
    let count = json(&sql(&server, HEAVY));
    assert!(count[0]["surface_id"] == "flat", "{count}");
    plan
}

mod slow {
    use super::campaign::WorkerMachines;
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn three_workers_answer_as_one_process_and_killed_ones_shorten_nothing() {
        let program = echolake_path().expect("a path");
        let starting = WorkerMachines::start(&program, None, 3, None);
        let mut machines = starting.await.expect("processes");
        let report = machines.compare_answers(20, 1).await.expect("equal answers");
        assert!(report.spread > 5, "{report:?}");
        let kills = machines.kill_workers(4, 1).await.expect("whole answers, or errors");
        assert!(kills.whole > 0, "{kills:?}");
    }

    #[test]
    fn workers_are_listed_with_their_figures() {
        let place = lake();
        let (_first, one) = start_worker(&place, &[]);
        let (_second, two) = start_worker(&place, &[]);
        let server = served(&place, &["--workers", &format!("{one},{two},http://127.0.0.1:1"), "--spread-from", "0"]);
        let list = || json(&sql(&server, "select * from system.workers order by state desc, address"));
        let plan = json(&sql(&server, &format!("explain {HEAVY}"))).to_string();
        assert!(plan.contains("spread over 2 of 3 workers"), "{plan}");
        assert_eq!(json(&sql(&server, HEAVY))[0]["surface_id"], "flat");
        // Tasks are over when their engine closes their calls, and workers are asked every five seconds at most.
        wait_until("tasks that read", || {
            let rows = list();
            (0..2).map(|n| rows[n]["read_bytes"].as_u64().unwrap_or(0)).sum::<u64>() > 0
        });
        let rows = list();
        assert_eq!(rows.as_array().map(Vec::len), Some(3), "{rows}");
        assert_eq!((rows[0]["state"].as_str(), rows[2]["state"].as_str()), (Some("used"), Some("not used")), "{rows}");
        assert!(rows[2]["problem"].as_str().is_some_and(|reason| reason.contains("refused")), "{rows}");
        assert!(rows[2]["last_seen"].is_null() && rows[0]["build"].is_string(), "{rows}");
        wait_until("figures of both", || {
            let metrics = get(&server, "/metrics").text();
            metrics.lines().filter(|line| line.starts_with("echolake_worker_read_bytes{")).count() == 2
        });
        let metrics = get(&server, "/metrics").text();
        assert!(!metrics.contains("echolake_spread_queries_total{event=\"begun\"} 0"), "{metrics}");
    }

    #[test]
    fn a_worker_is_of_the_same_lake_and_token_and_encrypted() {
        let place = lake();
        std::fs::write(place.path("worker.token"), TOKEN).expect("written");
        std::fs::write(place.path("short.token"), "short").expect("written");
        let token = ["--worker-token", "worker.token"];
        place.fails(1, &["serve", "--worker", "0.0.0.0:0"], "workers have no token");
        place.fails(1, &[&["serve", "--worker", "0.0.0.0:0"], &token[..]].concat(), "not encrypted");
        place.fails(1, &["serve", "--worker", "127.0.0.1:0", "--worker-token", "short.token"], "32 letters and digits");
        place.fails(1, &["serve", "--workers", "http://10.0.0.7:7070"], "workers have no token");
        place.fails(1, &["serve", "--workers", "10.0.0.7:7070"], "is no address of a worker");
        place.fails(1, &["serve", "--workers", "https://127.0.0.1:1", "--worker-ca", "none.pem"], "none.pem");
        place.fails(2, &["serve", "--worker", "127.0.0.1:0", "--workers", "http://127.0.0.1:1"], "cannot be used with");

        place.ok(&["certificate", "127.0.0.1", "-o", "tls"]);
        place.ok(&["certificate", "127.0.0.1", "-o", "other"]);
        let trusting = ["--worker-token", "worker.token", "--worker-ca", "tls/certificate.pem"];
        let certified = [&["--certificate", "tls/certificate.pem", "--key", "tls/key.pem"], &trusting[..]].concat();
        let (_first, one) = start_worker(&place, &certified);
        let (_second, two) = start_worker(&place, &certified);
        assert!(one.starts_with("https://127.0.0.1:"), "{one}");
        let plan = explain_over(&place, &format!("{one},{two}"), &trusting);
        assert!(plan.contains("spread over 2 of 2 workers"), "{plan}");

        // A certificate that is not known, and no token: the server says why, and answers by itself.
        for (more, reason) in [
            ([&token[..], &["--worker-ca", "other/certificate.pem"]].concat(), "invalid peer certificate"),
            (trusting[2..].to_vec(), "this worker needs a token"),
        ] {
            let mut server = served(&place, &[&["--workers", &one, "--spread-from", "0"], &more[..]].concat());
            assert_eq!(json(&sql(&server, HEAVY))[0]["surface_id"], "flat");
            server.wait_for_line(reason);
        }
        let elsewhere = TestFolder::new();
        elsewhere.acquire("flat", &["--ir-only"]);
        elsewhere.ok(&["ingest"]);
        let (_other, url) = start_worker(&elsewhere, &[]);
        let plan = explain_over(&place, &url, &[]);
        assert!(plan.contains("not spread over workers: none of 1 answers"), "{plan}");
    }
}
