//! `optimize` and `vacuum`: nothing changes for readers, whatever is ingested before and after.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::TestFolder;
use super::kills::table_queries;

fn tables(place: &TestFolder) -> BTreeMap<&'static str, String> {
    table_queries().map(|(table, query)| (table, place.ok(&["sql", "--format", "csv", &query]))).collect()
}

fn same(actual: &BTreeMap<&'static str, String>, expected: &BTreeMap<&'static str, String>, when: &str) {
    for (table, rows) in expected {
        assert!(actual[table] == *rows, "{when}: table {table} has other rows");
    }
}

fn parquet_files(folder: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(folder).expect("listed").map(|e| e.expect("an entry").path());
    files.filter(|p| p.extension().is_some_and(|e| e == "parquet")).collect()
}

fn age(file: &Path, hours: u64) {
    let then = SystemTime::now() - Duration::from_secs(hours * 3600);
    let file = std::fs::File::options().write(true).open(file).expect("opened");
    file.set_modified(then).expect("a time");
}

#[test]
fn one_maintains_at_a_time_and_the_second_is_told_who() {
    let place = TestFolder::new();
    place.acquire("flat", &["--ir-only"]);
    place.ok(&["ingest"]);
    let leases = place.path("lake/tables/_maintenance");
    std::fs::create_dir(&leases).expect("made");
    let lease = leases.join(format!("{:020}.json", 7));
    let held = |expires: &str| {
        let text = format!(r#"{{"holder": "x", "host": "far-away", "pid": 4711, "expires": "{expires}"}}"#);
        std::fs::write(&lease, text).expect("written");
    };
    held("2999-01-01T00:00:00Z");
    for command in ["optimize", "vacuum"] {
        place.fails(1, &[command], "is being maintained by process 4711 on far-away");
    }
    place.ok(&["vacuum", "--dry-run"]);
    // Ingest does not ask for it.
    place.acquire("foam", &["--ir-only"]);
    place.ok(&["ingest"]);
    held("2020-01-01T00:00:00Z");
    place.ok(&["optimize"]);
    assert!(!lease.exists(), "given back");
    place.ok(&["vacuum"]);
}

mod slow {
    use super::*;

    #[test]
    fn readers_see_the_same_before_and_after() {
        let place = TestFolder::new();
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("flat_b", "3"), ("wood", "4"), ("prd", "5")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        // Its rows do not change when the others' Flat does, and stay in merged files of which the rest goes. Flat and
        // Foam share files, and so do the surfaces that are no references and rest on them.
        place.acquire("wavy", &["--seed", "6", "--ir-only", "--flat", "flat_b"]);
        place.ok(&["ingest"]);
        let before = tables(&place);
        // On a busy machine a group has fewer runs.
        let files = "select count(*) between 4 and 6 and sum(runs) = 6 and sum(rows) = 270 as is_right \
                     from system.files where \"table\" = 'nce'";
        assert_eq!(place.sql(files)[0]["is_right"], true);
        let ingests = place.sql("select * from system.ingests order by run_id");
        let report: serde_json::Value = serde_json::from_str(&place.ok(&["optimize", "--json"])).expect("JSON");
        let merged: Vec<_> =
            report["tables"].as_array().expect("a list").iter().map(|t| (&t["table"], &t["merged"])).collect();
        assert_eq!(merged.len(), 10, "{report}");
        // The row of `wavy` in `surfaces` has another reference.
        let least = |table: &serde_json::Value| if table == "surfaces" { 3 } else { 4 };
        assert!(merged.iter().all(|(table, count)| count.as_u64() >= Some(least(table))), "{report}");
        same(&tables(&place), &before, "after optimize");
        assert_eq!(place.sql("select * from system.ingests order by run_id"), ingests);
        assert_eq!(place.number("select count(*) from tnce_d4"), 6.0 * 45.0 * 8.0);
        assert_eq!(place.number("select count(*) from nce where surface_id = 'wavy'"), 45.0);
        place.fails(0, &["optimize"], "nothing to merge");
        let doctor: serde_json::Value = serde_json::from_str(&place.ok(&["doctor", "--json"])).expect("JSON");
        let findings = doctor["findings"].as_array().expect("a list");
        assert!(findings.iter().all(|f| f["severity"] == "note"), "{findings:?}");

        // The responses of merged runs are read back, and derived with two Flats now.
        place.acquire("flat", &["--seed", "9", "--ir-only"]);
        place.ok(&["ingest"]);
        let versions = place.sql("select distinct flat_version from tnce where surface_id <> 'wavy'");
        assert_eq!(versions.len(), 1, "{versions:?}");
        assert!(versions[0]["flat_version"].as_str().expect("text").starts_with("flat:2:"), "{versions:?}");
        let replaced = tables(&place);
        place.ok(&["optimize"]);
        same(&tables(&place), &replaced, "after the second optimize");
        let kept = parquet_files(&place.path("lake/tables/nce")).len();
        assert!(place.ok(&["vacuum"]).starts_with("0 files"), "readers may hold what was merged today");
        let freed = place.ok(&["vacuum", "--keep-hours", "0"]);
        assert!(!freed.starts_with("0 files") && freed.contains("freed"), "{freed}");
        assert!(kept > 1 && parquet_files(&place.path("lake/tables/nce")).len() == 1);
        same(&tables(&place), &replaced, "after vacuum");

        // The runs are the truth: an ingest of them into no tables at all has the same rows.
        std::fs::remove_dir_all(place.path("lake/tables")).expect("removed");
        place.ok(&["ingest"]);
        same(&tables(&place), &replaced, "made anew from the runs");
    }

    #[test]
    fn a_tag_keeps_its_version() {
        let place = TestFolder::new();
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("wood", "4")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        place.ok(&["ingest"]);
        let levels =
            "select pair_id, tnce_total from tnce timestamp as of 'first.1' where surface_id = 'wood' order by 1";
        place.fails(1, &["sql", levels], "no tag `first.1`: it has none");
        assert!(place.ok(&["tag", "first.1"]).starts_with("first.1  version "));
        place.fails(1, &["tag", "first.1"], "has a tag `first.1`");
        place.fails(2, &["tag", "1st"], "beginning with a letter");
        let before = place.sql(levels);
        // Wood's levels are derived with two Flats from now on.
        place.acquire("flat", &["--seed", "9", "--ir-only"]);
        place.ok(&["ingest"]);
        place.ok(&["vacuum", "--keep-hours", "0"]);
        assert_eq!(place.sql(levels), before);
        assert_ne!(place.sql(&levels.replace(" timestamp as of 'first.1'", "")), before);
        place.fails(1, &["tag", "second", "--at", "third"], "there are `first.1`");

        place.fails(0, &["tag", "--delete", "first.1"], "is deleted");
        let freed = place.ok(&["vacuum", "--keep-hours", "0"]);
        assert!(!freed.starts_with("0 files"), "{freed}");
        place.ok(&["tag", "second"]);
        std::fs::remove_dir_all(place.path("lake/tables")).expect("removed");
        place.ok(&["ingest"]);
        assert!(place.ok(&["tag"]).contains("second  version") && place.ok(&["tag"]).contains("gone"));
        place.fails(1, &["sql", &levels.replace("first.1", "second")], "tables that are made again");
    }

    #[test]
    fn vacuum_takes_what_crashes_left_and_nothing_else() {
        let place = TestFolder::new();
        place.acquire("flat", &["--ir-only"]);
        place.ok(&["ingest"]);
        let before = tables(&place);
        let old = [
            "tables/nce/flat.r.ab.parquet",
            "tables/nce/x.parquet#12000001",
            "tables/nce/_delta_log/00.json#1",
            "inbox/r.mcap.copying",
        ];
        let new =
            ["tables/nce/foam.r.ab.parquet", "inbox/s.mcap.copying", "tables/nce/notes.txt", "runs/flat/r.mcap#3"];
        for file in old.iter().chain(&new) {
            std::fs::write(place.path("lake").join(file), "half").expect("written");
        }
        let ancient = [&old[..], &new[2..]].concat();
        ancient.iter().for_each(|file| age(&place.path("lake").join(file), 24 * 8));
        let there = |file: &str| place.path("lake").join(file).exists();

        let told = place.ok(&["vacuum", "--dry-run"]);
        assert!(old.iter().all(|file| told.contains(file) && there(file)), "{told}");
        assert!(told.ends_with("4 files, 0.0 kB would be freed\n"), "{told}");
        let report: serde_json::Value = serde_json::from_str(&place.ok(&["vacuum", "--json"])).expect("JSON");
        assert_eq!((report["files"].as_array().map(Vec::len), &report["bytes"]), (Some(4), &16.into()), "{report}");
        assert!(!old.iter().any(|file| there(file)));
        place.ok(&["vacuum", "--keep-hours", "0"]);
        assert!(new.iter().all(|file| there(file)), "young, foreign, or a run's");
        same(&tables(&place), &before, "after vacuum");
        place.fails(2, &["vacuum", "--keep-hours", "169"], "0..=168");
    }
}
