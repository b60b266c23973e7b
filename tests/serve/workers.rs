//! Heavy queries over workers, as processes of their own: answers, refusals, and workers that are killed. Short form of the
//! campaign `workers`.

use std::process::Command;

use super::attacks::workers::WorkerProcesses;
use super::{TestFolder, json, lake, served, sql};
use crate::child::ChildProcess;

const TOKEN: &str = "0123456789abcdef0123456789abcdef";

/// A worker of the lake of a folder; returns its URL, too.
fn worker(place: &TestFolder, more: &[&str]) -> (ChildProcess, String) {
    let mut command: Command = place.command(&[&["serve", "--worker", "127.0.0.1:0"], more].concat());
    let mut child = ChildProcess::start(&mut command).expect("it starts");
    let line = child.wait_for_line("  worker http://");
    (child, line.trim().trim_start_matches("worker ").to_owned())
}

fn explained(place: &TestFolder, workers: &str, more: &[&str]) -> String {
    let server = served(place, &[&["--workers", workers, "--spread-from", "0"], more].concat());
    let query = "select surface_id, count(*) from measurements where ir[1] <> 7 group by surface_id";
    let plan = json(&sql(&server, &format!("explain {query}"))).to_string();
    let count = json(&sql(&server, query));
    assert!(count[0]["surface_id"] == "flat", "{count}");
    plan
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
    for (more, reason) in
        [(&["--worker-token", "other.token"][..], "the token is not this worker's"), (&[], "this worker needs a token")]
    {
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

mod slow {
    use std::path::Path;

    use super::WorkerProcesses;
    use crate::ECHOLAKE;

    #[test]
    fn killed_workers_cost_no_answer_and_shorten_none() {
        let mut cluster = WorkerProcesses::start(Path::new(ECHOLAKE), None, 2).expect("processes");
        cluster.cancel_to_idle().expect("workers that end their work");
        let report = cluster.check(6, 1).expect("answers");
        assert!(report.is_goal_reached(), "{report:?}");
        assert!(report.right > 0, "{report:?}");
    }
}
