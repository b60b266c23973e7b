//! Tables that lose rows: queries of them are refused, `doctor` says which rows are missing, and its hint brings them
//! back.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use super::kills::table_queries;
use super::{TestFolder, TestFolderTemplate, stderr};

/// Three runs, two of them references.
pub(crate) fn lake() -> TestFolder {
    static THREE_RUNS: TestFolderTemplate = TestFolderTemplate::new();
    THREE_RUNS.place(|place| {
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("wood", "3")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        place.ok(&["ingest"]);
    })
}

fn rows(place: &TestFolder) -> BTreeMap<&'static str, String> {
    table_queries().map(|(table, query)| (table, place.ok(&["sql", "--format", "csv", &query]))).collect()
}

fn commits(lake: &Path, table: &str) -> Vec<PathBuf> {
    let log = fs::read_dir(lake.join("tables").join(table).join("_delta_log")).expect("listed");
    let mut commits: Vec<_> = log.map(|entry| entry.expect("an entry").path()).collect();
    commits.retain(|path| path.extension().is_some_and(|extension| extension == "json"));
    commits.sort();
    commits
}

fn parquet_file(lake: &Path, table: &str) -> PathBuf {
    let files = fs::read_dir(lake.join("tables").join(table)).expect("listed");
    let mut files: Vec<_> = files.map(|entry| entry.expect("an entry").path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "parquet"));
    // The file of most runs: those that it replaced stay for a while.
    files.sort_by_key(|path| {
        let is_shared = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"merged."));
        (is_shared, fs::metadata(path).expect("its size").len())
    });
    files.pop().expect("a file")
}

fn cut_last_commit(lake: &Path, table: &str, lines: usize) {
    let last = commits(lake, table).pop().expect("a commit");
    let text = fs::read_to_string(&last).expect("read");
    assert!(text.lines().count() > lines);
    fs::write(last, text.lines().take(lines).map(|line| format!("{line}\n")).collect::<String>()).expect("written");
}

/// A commit as deltalake writes it: all files of a table go, and one of another name may come.
fn change_as_deltalake(lake: &Path, table: &str, added: Option<&str>) {
    let there = commits(lake, table);
    let text: String = there.iter().map(|path| fs::read_to_string(path).expect("read")).collect();
    let mut files = BTreeMap::new();
    for line in text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("JSON")) {
        if let Some(path) = line["add"]["path"].as_str() {
            files.insert(path.to_owned(), line["add"].clone());
        }
        line["remove"]["path"].as_str().map(|path| files.remove(path));
    }
    let mut lines = vec![
        r#"{"commitInfo":{"timestamp":1795743516405,"operation":"OPTIMIZE","engineInfo":"delta-rs:py-1.5.0"}}"#
            .to_owned(),
    ];
    for path in files.keys() {
        let remove =
            serde_json::json!({ "path": path, "dataChange": false, "deletionTimestamp": 1_795_743_516_405_i64 });
        lines.push(serde_json::json!({ "remove": remove }).to_string());
    }
    if let (Some(name), Some(mut add)) = (added, files.into_values().next()) {
        add["path"] = name.into();
        add.as_object_mut().expect("an object").remove("tags");
        lines.push(serde_json::json!({ "add": add }).to_string());
    }
    let next = lake.join(format!("tables/{table}/_delta_log/{:020}.json", there.len()));
    fs::write(next, lines.join("\n")).expect("written");
}

/// Damage, the table whose queries it ends, and one that still answers.
type Damage = (&'static str, fn(&Path), &'static str, Option<&'static str>);

const COMPACTED: &str = "part-00000-c528e720-3f3a-4c32-8820-79c19bca5f51-c000.zstd.parquet";
const DAMAGES: [Damage; 16] = [
    ("a table's folder", |lake| fs::remove_dir_all(lake.join("tables/nce")).expect("removed"), "nce", Some("tnce")),
    ("responses", |lake| fs::remove_dir_all(lake.join("tables/measurements")).expect("removed"), "ir", Some("nce")),
    ("surfaces", |lake| fs::remove_dir_all(lake.join("tables/surfaces")).expect("removed"), "surfaces", Some("nce")),
    ("the rig's rows", |lake| fs::remove_dir_all(lake.join("tables/points")).expect("removed"), "points", Some("nce")),
    ("the table runs", |lake| fs::remove_dir_all(lake.join("tables/runs")).expect("removed"), "nce", Some("pairs")),
    ("all tables", |lake| fs::remove_dir_all(lake.join("tables")).expect("removed"), "runs", None),
    ("a commit emptied", |lake| cut_last_commit(lake, "nce", 0), "nce", Some("tnce")),
    ("a commit cut", |lake| cut_last_commit(lake, "measurements", 1), "measurements", Some("nce")),
    ("a commit of runs emptied", |lake| cut_last_commit(lake, "runs", 0), "runs", None),
    (
        "a commit gone",
        |lake| fs::remove_file(commits(lake, "tnce").pop().expect("one")).expect("gone"),
        "tnce",
        Some("nce"),
    ),
    ("a data file gone", |lake| fs::remove_file(parquet_file(lake, "nce")).expect("gone"), "nce", Some("tnce")),
    (
        "a data file cut",
        |lake| {
            fs::File::options().write(true).open(parquet_file(lake, "nce")).and_then(|f| f.set_len(999)).expect("cut")
        },
        "nce",
        Some("tnce"),
    ),
    ("compacted", |lake| change_as_deltalake(lake, "nce", Some(COMPACTED)), "nce", Some("tnce")),
    ("emptied by deltalake", |lake| change_as_deltalake(lake, "tnce", None), "tnce_db", Some("nce")),
    ("runs compacted", |lake| change_as_deltalake(lake, "runs", Some(COMPACTED)), "nce", Some("pairs")),
    ("runs emptied by deltalake", |lake| change_as_deltalake(lake, "runs", None), "runs", None),
];

mod slow {
    use super::*;

    #[test]
    fn what_is_lost_is_refused_and_doctors_hint_brings_it_back() {
        let whole = rows(&lake());
        for (name, damage, refused, answered) in DAMAGES {
            let place = lake();
            damage(&place.path("lake"));
            let said = if name == "a data file cut" { "error: " } else { "hint: `echolake " };
            place.fails(1, &["sql", &format!("select * from {refused}")], said);
            if let Some(answered) = answered {
                place.ok(&["sql", &format!("select * from {answered}")]);
            }
            let found = place.run(&["doctor"]);
            let found = (found.status.code(), String::from_utf8(found.stdout).expect("text"));
            assert_eq!(found.0, Some(3), "{name}: {}", found.1);
            let damaged = found.1.lines().filter(|line| line.starts_with("damaged"));
            let hints = damaged.filter_map(|line| line.split_once("hint: `echolake ")?.1.split_once('`'));
            let hints: std::collections::BTreeSet<_> = hints.map(|(command, _)| command).collect();
            assert!(!hints.is_empty(), "{name}: {}", found.1);
            for hint in hints {
                place.ok(&hint.split(' ').collect::<Vec<_>>());
            }
            place.ok(&["doctor"]);
            for (table, rows) in rows(&place) {
                assert!(rows == whole[table], "{name}: {table} has other rows");
            }
        }
    }

    #[test]
    fn doctor_names_table_run_and_rows() {
        let place = lake();
        let run = place.sql("select run_id from runs where surface_id = 'wood'")[0]["run_id"].clone();
        let run = run.as_str().expect("a name");
        // The last commit has the rows of this run alone.
        change_as_deltalake(&place.path("lake"), "tnce_d4", None);
        let found = place.run(&["doctor"]);
        let found = String::from_utf8(found.stdout).expect("text");
        let expected =
            format!("damaged: tables/tnce_d4: run `{run}` has 0 rows, expected 360; hint: `echolake ingest`");
        assert!(found.contains(&expected), "{found}");
    }

    // All rows that are there are those of runs that the table names again.
    #[test]
    fn a_rebuild_that_is_not_finished_is_no_smaller_lake() {
        let place = lake();
        let whole = rows(&place);
        let run = place.sql("select run_id from runs where surface_id = 'wood'")[0]["run_id"].clone();
        fs::remove_dir_all(place.path("lake/tables")).expect("removed");
        place.ok(&["ingest", run.as_str().expect("a name")]);
        for table in ["runs", "nce", "surfaces", "ir"] {
            place.fails(1, &["sql", &format!("select count(*) from {table}")], "not all run files are in it again");
        }
        place.ok(&["ingest"]);
        for (table, rows) in rows(&place) {
            assert!(rows == whole[table], "{table} has other rows");
        }
        // What only the tables hold is not thrown away.
        let file = place.sql("select file from runs where surface_id = 'wood'")[0]["file"].clone();
        let file = place.path("lake").join(file.as_str().expect("a path"));
        fs::rename(&file, place.path("away")).expect("moved");
        place.fails(1, &["rebuild"], "bring them back from a copy");
        fs::rename(place.path("away"), &file).expect("moved");
        place.ok(&["rebuild"]);
        for (table, rows) in rows(&place) {
            assert!(rows == whole[table], "{table} has other rows");
        }
        let told = place.run(&["ingest"]);
        assert!(stderr(&told).contains("nothing to ingest"), "{}", stderr(&told));
    }

    // Merged files, too.
    #[test]
    fn a_merged_table_is_rebuilt() {
        let place = lake();
        let whole = rows(&place);
        place.ok(&["optimize"]);
        fs::remove_dir_all(place.path("lake/tables/tnce")).expect("removed");
        place.fails(1, &["sql", "select count(*) from tnce"], "expected 45");
        place.ok(&["ingest"]);
        let merged = parquet_file(&place.path("lake"), "measurements");
        fs::write(&merged, "half").expect("written");
        place.fails(3, &["doctor"], "");
        place.ok(&["rebuild", "measurements"]);
        place.ok(&["doctor"]);
        for (table, rows) in rows(&place) {
            assert!(rows == whole[table], "{table} has other rows");
        }
    }
}
