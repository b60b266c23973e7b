//! Heavy queries over workers, as processes of their own: answers, refusals, and workers that are killed. Short form of the
//! campaign `workers`.

use std::process::Command;

use super::attacks::workers::WorkerProcesses;
use super::{TestFolder, get, json, lake, served, sql, wait_until};
use crate::child::ChildProcess;

const TOKEN: &str = "0123456789abcdef0123456789abcdef";

/// A worker of the lake of a folder; returns its URL, too.
fn worker(place: &TestFolder, more: &[&str]) -> (ChildProcess, String) {
    let mut command: Command = place.command(&[&["serve", "--worker", "127.0.0.1:0"], more].concat());
    let mut child = ChildProcess::start(&mut command).expect("it starts");
    let line = child.wait_for_line("  worker http");
    (child, line.trim().trim_start_matches("worker ").to_owned())
}

/// Reads all responses.
const HEAVY: &str = "select surface_id, count(*) from measurements where ir[1] <> 7 group by surface_id";

fn explained(place: &TestFolder, workers: &str, more: &[&str]) -> String {
    let server = served(place, &[&["--workers", workers, "--spread-from", "0"], more].concat());
    let plan = json(&sql(&server, &format!("explain {HEAVY}"))).to_string();
    let count = json(&sql(&server, HEAVY));
    assert!(count[0]["surface_id"] == "flat", "{count}");
    plan
}

const CERTIFIED: [&str; 8] = [
    "--certificate",
    "tls/certificate.pem",
    "--key",
    "tls/key.pem",
    "--worker-ca",
    "tls/certificate.pem",
    "--worker-token",
    "worker.token",
];

mod slow {
    use std::path::Path;

    use super::*;
    use crate::ECHOLAKE;

    #[test]
    fn killed_workers_cost_no_answer_and_shorten_none() {
        let mut cluster = WorkerProcesses::start(Path::new(ECHOLAKE), None, 2).expect("processes");
        cluster.cancel_to_idle().expect("workers that end their work");
        let report = cluster.check(6, 1).expect("answers");
        assert!(report.is_goal_reached(), "{report:?}");
        assert!(report.right > 0, "{report:?}");
    }

    #[test]
    fn workers_tell_what_they_did() {
        let place = lake();
        let (_first, one) = worker(&place, &[]);
        let (_second, two) = worker(&place, &[]);
        let server = served(&place, &["--workers", &format!("{one},{two},http://127.0.0.1:1"), "--spread-from", "0"]);
        let figures = || json(&sql(&server, "select * from system.workers order by state desc, address"));
        assert_eq!(json(&sql(&server, HEAVY))[0]["surface_id"], "flat");
        // Tasks are over when their engine says so, and workers are asked every five seconds at most.
        wait_until("tasks that read", || {
            let rows = figures();
            (0..2).map(|n| rows[n]["read_bytes"].as_u64().unwrap_or(0)).sum::<u64>() > 0
        });
        let rows = figures();
        assert_eq!(rows.as_array().map(Vec::len), Some(3), "{rows}");
        assert_eq!((rows[0]["state"].as_str(), rows[2]["state"].as_str()), (Some("used"), Some("not used")), "{rows}");
        assert!(rows[2]["problem"].as_str().is_some_and(|reason| reason.contains("refused")), "{rows}");
        assert!(rows[2]["last_seen"].is_null() && rows[0]["build"].is_string(), "{rows}");
        let metrics = get(&server, "/metrics").text();
        let read = metrics.lines().filter(|line| line.starts_with("echolake_worker_read_bytes{")).count();
        assert_eq!(read, 2, "{metrics}");
        assert!(metrics.contains("echolake_worker_imbalance "), "{metrics}");
    }

    #[test]
    fn workers_are_encrypted() {
        let place = lake();
        std::fs::write(place.path("worker.token"), TOKEN).expect("written");
        for folder in ["tls", "next"] {
            place.ok(&["certificate", "127.0.0.1", "localhost", "-o", folder]);
        }
        place.fails(1, &["serve", "--workers", "https://127.0.0.1:7070", "--worker-ca", "none.pem"], "none.pem");
        let (_first, one) = worker(&place, &CERTIFIED);
        let (_second, two) = worker(&place, &CERTIFIED);
        assert!(one.starts_with("https://127.0.0.1:"), "{one}");
        let urls = format!("{one},{two}");
        let trusting =
            |authority: &str| explained(&place, &urls, &["--worker-token", "worker.token", "--worker-ca", authority]);
        let plan = trusting("tls/certificate.pem");
        assert!(plan.contains("spread over 2 of 2 workers"), "{plan}");

        // A certificate that is not known, and plain text.
        let strange = ["--workers", &one, "--spread-from", "0", "--worker-token", "worker.token", "--worker-ca"];
        let mut server = served(&place, &[&strange[..], &["next/certificate.pem"]].concat());
        assert_eq!(json(&sql(&server, HEAVY))[0]["surface_id"], "flat");
        server.wait_for_line("invalid peer certificate");
        let plan = explained(&place, &one.replace("https", "http"), &["--worker-token", "worker.token"]);
        assert!(plan.contains("not spread over workers: none of 1 answers"), "{plan}");

        // Renewed files are taken while the workers run.
        for file in ["certificate.pem", "key.pem"] {
            std::fs::rename(place.path("next").join(file), place.path("tls").join(file)).expect("renamed");
        }
        wait_until("the renewed certificate", || {
            trusting("tls/certificate.pem").contains("spread over 2 of 2 workers")
        });
    }

    #[test]
    fn a_worker_is_of_the_same_lake_and_token() {
        let place = lake();
        std::fs::write(place.path("worker.token"), TOKEN).expect("written");
        std::fs::write(place.path("other.token"), TOKEN.replace('0', "x")).expect("written");
        std::fs::write(place.path("short.token"), "short").expect("written");
        place.fails(1, &["serve", "--worker", "0.0.0.0:0"], "workers have no token");
        place.fails(1, &["serve", "--worker", "0.0.0.0:0", "--worker-token", "worker.token"], "is not encrypted");
        place.fails(1, &["serve", "--worker", "127.0.0.1:0", "--worker-token", "short.token"], "32 letters and digits");
        place.fails(1, &["serve", "--workers", "http://10.0.0.7:7070"], "workers have no token");
        place.fails(1, &["serve", "--workers", "10.0.0.7:7070"], "is no address of a worker");
        place.fails(2, &["serve", "--worker", "127.0.0.1:0", "--workers", "http://127.0.0.1:1"], "cannot be used with");

        let (_own, url) = worker(&place, &["--worker-token", "worker.token"]);
        let plan = explained(&place, &url, &["--worker-token", "worker.token"]);
        assert!(plan.contains("spread over 1 of 1 workers") || plan.contains("no part of it can run apart"), "{plan}");
        // A wrong token, none, and a worker of another lake: the server says why, and answers by itself.
        for (more, reason) in [
            (&["--worker-token", "other.token"][..], "the token is not this worker's"),
            (&[], "this worker needs a token"),
        ] {
            let mut server = served(&place, &[&["--workers", &url, "--spread-from", "0"], more].concat());
            let query = "select count(*) as n from measurements where ir[1] <> 7";
            assert!(json(&sql(&server, query))[0]["n"].as_u64() > Some(0));
            server.wait_for_line(reason);
        }
        let elsewhere = TestFolder::new();
        elsewhere.acquire("flat", &["--ir-only"]);
        elsewhere.ok(&["ingest"]);
        let (_other, url) = worker(&elsewhere, &[]);
        let plan = explained(&place, &url, &[]);
        assert!(plan.contains("not spread over workers: none of 1 answers"), "{plan}");
    }
}
