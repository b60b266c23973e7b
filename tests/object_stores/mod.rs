//! Lakes on an object store: what is ingested there is what a folder would hold, whatever answers are lost; and a store
//! that overwrites is not written to.

mod ceph;
mod exports;
mod requests;
mod s3_double;
mod uploads;

use std::collections::BTreeMap;
use std::process::{Command, Output};

use echolake_testing::run_command;
use s3_double::{S3Double, StoreBehaviour};

use super::kills::table_queries;
use super::{ECHOLAKE, TestFolder, stderr};

/// Location of the lakes under test.
const LAKE: &str = "s3://bucket/a/lake";

/// A command on a lake in a store, from a folder with recordings.
fn command(place: &TestFolder, store: &S3Double, args: &[&str]) -> Command {
    let mut command = Command::new(ECHOLAKE);
    command.args(["--lake", LAKE]).args(args).current_dir(place.folder.path());
    command.envs(store.environment()).env_remove("ECHOLAKE_LAKE");
    command
}

fn run(place: &TestFolder, store: &S3Double, args: &[&str]) -> Output {
    run_command(&mut command(place, store, args)).expect("the command starts")
}

fn ok(place: &TestFolder, store: &S3Double, args: &[&str]) -> String {
    let output = run(place, store, args);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", stderr(&output));
    String::from_utf8(output.stdout).expect("text")
}

/// All rows of all tables, as CSV.
fn tables(sql: impl Fn(&str) -> String) -> BTreeMap<&'static str, String> {
    table_queries().map(|(table, query)| (table, sql(&query))).collect()
}

/// Run files of these surfaces.
fn recordings(place: &TestFolder, surfaces: &[&str]) -> Vec<String> {
    let record = |(number, surface): (usize, &&str)| {
        let seed = number.to_string();
        place.acquire(surface, &["--seed", &seed, "--ir-only"]).display().to_string()
    };
    surfaces.iter().enumerate().map(record).collect()
}

#[test]
fn a_store_that_overwrites_is_refused_by_all_that_writes_before_it_writes() {
    let place = TestFolder::new();
    let runs = recordings(&place, &["flat"]);
    let store = S3Double::start(StoreBehaviour::Overwrites);
    let refused = |args: &[&str]| {
        let output = run(&place, &store, args);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{args:?}: {said}");
        assert!(said.contains("cannot hold a lake") && said.contains(LAKE), "{args:?}: {said}");
    };
    refused(&["ingest", &runs[0]]);
    assert!(store.keys().is_empty(), "{:?}", store.keys());
    let config = std::fs::read(place.path("lake/lake.toml")).expect("read");
    store.put("a/lake/lake.toml", config);
    for args in [&["ingest"][..], &["ingest", &runs[0]], &["optimize"], &["vacuum"]] {
        refused(args);
        assert_eq!(store.keys(), ["a/lake/lake.toml"], "{args:?}");
    }
}

#[test]
fn a_location_without_a_lake_or_with_plain_http_is_refused_in_words() {
    let place = TestFolder::new();
    let store = S3Double::start(StoreBehaviour::Faultless);
    let said = stderr(&run(&place, &store, &["sql", "select 1"]));
    assert!(said.contains("no lake at `s3://bucket/a/lake`"), "{said}");
    let output = run_command(command(&place, &store, &["sql", "select 1"]).env_remove("AWS_ALLOW_HTTP"));
    let said = stderr(&output.expect("the command starts"));
    assert!(said.contains("is not encrypted") && said.contains("AWS_ALLOW_HTTP=true"), "{said}");
}

mod slow {
    use super::*;
    use echolake_testing::ChildProcess;

    // Two machines take in the same runs, one by copying them, the other from the bucket's inbox.
    #[test]
    fn two_ingests_on_an_unreliable_store_end_as_one_in_a_folder() {
        let place = TestFolder::new();
        let copies = place.path("copies");
        std::fs::create_dir(&copies).expect("made");
        let copy = |run: &String| {
            let copy = copies.join(run.rsplit('/').next().expect("a name"));
            std::fs::copy(run, &copy).expect("copied");
            copy.display().to_string()
        };
        let runs: Vec<_> = recordings(&place, &["flat", "foam", "wood", "prd"]).iter().map(copy).collect();
        place.ok(&["ingest"]);
        let expected = tables(|query| place.ok(&["sql", "--format", "csv", query]));
        for seed in [1, 2] {
            let store = S3Double::start(StoreBehaviour::Unreliable(seed));
            ok(&place, &store, &["ingest", &runs[0]]);
            for run in &runs[2..] {
                let name = run.rsplit('/').next().expect("a name");
                store.put(&format!("a/lake/inbox/{name}"), std::fs::read(run).expect("read"));
            }
            let ingests = [&["ingest", &runs[1], &runs[3]][..], &["ingest"]].map(|args| {
                let mut command = command(&place, &store, args);
                ChildProcess::start(&mut command).expect("the command starts")
            });
            for mut ingest in ingests {
                let output = ingest.wait();
                assert_eq!(output.status.code(), Some(0), "seed {seed}: {}", stderr(&output));
            }
            // Each completes what it saw; the last one to end has seen everything.
            ok(&place, &store, &["ingest"]);
            let sql = |query: &str| ok(&place, &store, &["sql", "--format", "csv", query]);
            assert!(tables(sql) == expected, "seed {seed}: other rows than in a folder");
            ok(&place, &store, &["optimize"]);
            ok(&place, &store, &["vacuum", "--keep-hours", "1"]);
            assert!(tables(sql) == expected, "seed {seed}: other rows after upkeep");
            let (requests, faults) = store.counts();
            assert!(faults > 20, "seed {seed}: {faults} faults in {requests} requests");
            let left: Vec<_> = store.keys().into_iter().filter(|key| key.contains("/inbox/")).collect();
            assert!(left.is_empty(), "{left:?}");
        }
    }
}
