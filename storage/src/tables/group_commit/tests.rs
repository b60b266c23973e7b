//! Groups of made-up rows: what readers see of them, and what becomes of them if a commit is cut off or overtaken.

use std::collections::BTreeSet;

use arrow::record_batch::RecordBatch;
use object_store::memory::InMemory;

use super::*;
use crate::encode_run_rows;
use crate::tables::maintenance::merge_tests::{
    ROWS, TABLE, list_files, made_up_column, open_lake, put_run, read_seen_rows, visible_run,
};

/// The rows of a run in three tables, its row in `runs` last.
fn stage(lake: &Lake, snapshot: &LakeSnapshot, surface: &str, run: &str, derivation: &str, value: usize) -> RowsOfRun {
    let pointer = visible_run(surface, run, derivation);
    let project = surface.split_once('-').map(|(project, _)| project.parse().expect("a project"));
    let defaults = &lake.config().references;
    let references = ReferenceNames { flat: defaults.flat.clone(), foam: defaults.foam.clone() };
    let group = FileGroup::new(&pointer.surface, project.as_ref(), references, defaults);
    let encode = |table: Table| {
        let schema = table.schema(lake.rig());
        let columns = schema.fields().iter().map(|field| made_up_column(field, surface, run, value)).collect();
        let rows = RecordBatch::try_new(schema.clone(), columns).expect("rows");
        encode_run_rows(table, &schema, &[rows]).expect("encoded")
    };
    let keys = || (pointer.surface.clone(), pointer.run.clone());
    let of_table = |table, derivation: &str| {
        StagedRows::new(table, keys(), derivation.to_owned(), encode(table), &group).made_from(snapshot)
    };
    let old = snapshot.files_of(Table::Runs, &pointer.run);
    let row = StagedRows::of_pointer(&pointer, encode(Table::Runs), &group).made_from(snapshot);
    [
        of_table(TABLE, derivation),
        of_table(Table::Surfaces, &pointer.run_derivation),
        row.with_replaced_rows(&pointer, old),
    ]
}

type RowsOfRun = [StagedRows; 3];

async fn snapshot_of(lake: &Lake) -> LakeSnapshot {
    lake.snapshot().await.expect("a view")
}

async fn commit(lake: &Lake, rows: impl IntoIterator<Item = StagedRows>) -> Vec<CommitOutcome> {
    lake.commit_rows(rows.into_iter().collect()).await.expect("committed")
}

/// A lake with these runs of one group, named by their places.
async fn lake_of(surfaces: &[&str]) -> Lake {
    let lake = open_lake(&Arc::new(InMemory::new())).await;
    lake.ensure_tables().await.expect("made");
    let snapshot = snapshot_of(&lake).await;
    let rows = surfaces
        .iter()
        .enumerate()
        .flat_map(|(number, surface)| stage(&lake, &snapshot, surface, &format!("r{number}"), "d1", number));
    let outcomes = commit(&lake, rows).await;
    assert!(outcomes.iter().all(|outcome| *outcome == CommitOutcome::Now), "{outcomes:?}");
    lake
}

/// The runs of each file of a table, and the derivations of the runs that readers see.
async fn parts_of(lake: &Lake, table: Table) -> BTreeSet<Vec<String>> {
    let files = lake.commit_log().list_files(table).await.expect("a log");
    let runs = |file: &Arc<DataFile>| file.shown_runs().iter().map(ToString::to_string).collect();
    files.iter().map(runs).collect()
}

async fn derivations(lake: &Lake) -> Vec<String> {
    let snapshot = snapshot_of(lake).await;
    [TABLE, Table::Surfaces, Table::Runs].iter().for_each(|table| snapshot.check_table(*table).expect("whole"));
    snapshot.runs().map(|run| run.reference_derivation.clone().expect("derived")).collect()
}

fn lists(parts: &[&[&str]]) -> BTreeSet<Vec<String>> {
    parts.iter().map(|runs| runs.iter().map(|run| (*run).to_owned()).collect()).collect()
}

const SURFACES: [&str; 5] = ["wood", "flat", "prd", "foam", "brick"];

#[tokio::test]
async fn a_group_shows_the_rows_of_files_of_one_run() {
    let grouped = lake_of(&SURFACES).await;
    let single = open_lake(&Arc::new(InMemory::new())).await;
    single.ensure_tables().await.expect("made");
    for (number, surface) in SURFACES.iter().enumerate() {
        put_run(&single, surface, &format!("r{number}"), "d1", number).await;
    }
    assert!(read_seen_rows(&grouped).await == read_seen_rows(&single).await, "other rows");
    // References have a file of their own, because readers of all projects see them.
    let expected = lists(&[&["r1", "r3"], &["r4", "r2", "r0"]]);
    for table in [TABLE, Table::Surfaces, Table::Runs] {
        assert_eq!(parts_of(&grouped, table).await, expected, "{}", table.name());
        let stats = |lake: Lake| async move {
            let files = lake.commit_log().list_files(table).await.expect("a log");
            let stats = files.iter().map(|file| file.stats.clone().expect("statistics"));
            let column =
                |values: &serde_json::Map<String, serde_json::Value>| values["surface_id"].as_str().map(str::to_owned);
            let spans = stats.map(|stats| (column(&stats.min), column(&stats.max)));
            spans.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))).expect("files")
        };
        assert_eq!(stats(grouped.clone()).await, stats(single.clone()).await);
    }
    let snapshot = snapshot_of(&grouped).await;
    let version = snapshot.log_version(Table::Runs).expect("a log");
    assert!(snapshot.runs().all(|run| snapshot.row_version(&run.run) == Some(version)), "all came with one commit");
    assert_eq!(snapshot.files(TABLE).iter().map(|file| file.visible_rows()).sum::<u64>() as usize, 5 * ROWS);
}

/// A process ended between the commits of two tables; the next one forms other groups.
#[tokio::test]
async fn rows_that_the_log_has_are_not_added_again() {
    let lake = open_lake(&Arc::new(InMemory::new())).await;
    lake.ensure_tables().await.expect("made");
    let view = snapshot_of(&lake).await;
    let stage_run = |number: usize| stage(&lake, &view, SURFACES[number], &format!("r{number}"), "d1", number);
    let of_nce = [0, 2, 4].into_iter().flat_map(stage_run).filter(|rows| rows.table() == TABLE);
    assert_eq!(commit(&lake, of_nce).await, [CommitOutcome::Now; 3]);
    let named = list_files(&lake).await;
    assert!(snapshot_of(&lake).await.files(TABLE).is_empty(), "nobody sees them");
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(list_files(&lake).await, named, "their author may be about to name them");
    let view = snapshot_of(&lake).await;
    let stage_run = |number: usize| stage(&lake, &view, SURFACES[number], &format!("r{number}"), "d1", number);
    let (now, before) = (CommitOutcome::Now, CommitOutcome::Before);
    assert_eq!(commit(&lake, [0, 1].into_iter().flat_map(stage_run)).await, [before, now, now, now, now, now]);
    assert_eq!(commit(&lake, [2, 3, 4].into_iter().flat_map(stage_run)).await[..3], [before, now, now]);
    assert_eq!(parts_of(&lake, TABLE).await, lists(&[&["r1"], &["r3"], &["r4", "r2", "r0"]]));
    assert_eq!(derivations(&lake).await.len(), 5);
    // Once more, as if the last answer had been lost.
    let again = commit(&lake, [2, 3, 4].into_iter().flat_map(stage_run)).await;
    assert!(again.iter().all(|outcome| *outcome == before), "{again:?}");
    assert_eq!(read_seen_rows(&lake).await.num_rows(), 5 * ROWS);
}

/// Rows that replace others are in their log, and another writer cleans up and replaces one of the runs itself.
#[tokio::test]
async fn a_part_waits_for_its_name_and_falls_alone() {
    let lake = lake_of(&["wood", "prd", "brick"]).await;
    let before = read_seen_rows(&lake).await;
    let view = snapshot_of(&lake).await;
    let mut staged: Vec<_> = ["wood", "prd", "brick"]
        .iter()
        .enumerate()
        .flat_map(|(number, surface)| stage(&lake, &view, surface, &format!("r{number}"), "d2", 70 + number))
        .collect();
    let rows: Vec<_> = staged.extract_if(.., |rows| rows.table() == TABLE).collect();
    commit(&lake, rows).await;
    lake.remove_superseded().await.expect("cleaned up");
    assert!(read_seen_rows(&lake).await == before, "nothing is named yet");
    assert_eq!(list_files(&lake).await.iter().map(|file| file.parts.len()).collect::<Vec<_>>(), [3, 3]);
    // Another writer is faster with one of them.
    put_run(&lake, "prd", "r1", "d3", 99).await;
    lake.remove_superseded().await.expect("cleaned up");
    let parts: Vec<_> = list_files(&lake).await.iter().map(|file| file.parts.len()).collect();
    assert_eq!(parts.iter().filter(|parts| **parts == 2).count(), 2, "both files lost a part: {parts:?}");
    assert_eq!(derivations(&lake).await, ["d1", "d3", "d1"]);
    // The rows of `runs` came with one file, of which a clean-up has taken a row out: all are tried again later.
    let pointers: Vec<_> = staged.extract_if(.., |rows| rows.table() == Table::Runs).collect();
    assert_eq!(commit(&lake, pointers).await, [CommitOutcome::Outdated; 3]);
    let view = snapshot_of(&lake).await;
    let again = ["wood", "brick"].iter().zip([0, 2]);
    let again =
        again.flat_map(|(surface, number)| stage(&lake, &view, surface, &format!("r{number}"), "d2", 70 + number));
    let outcomes = commit(&lake, again).await;
    assert_eq!(outcomes.iter().filter(|outcome| **outcome == CommitOutcome::Outdated).count(), 0, "{outcomes:?}");
    assert_eq!(derivations(&lake).await, ["d2", "d3", "d2"]);
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(derivations(&lake).await, ["d2", "d3", "d2"]);
    assert_eq!(read_seen_rows(&lake).await.num_rows(), 3 * ROWS);
    assert_eq!(
        list_files(&lake).await.iter().map(|file| file.rows).sum::<u64>() as usize,
        3 * ROWS,
        "nothing else is left"
    );
}

/// Of a group of rows of `runs`, one is overtaken, and the others are not.
#[tokio::test]
async fn an_overtaken_row_takes_no_other_with_it() {
    let lake = lake_of(&["wood"]).await;
    let view = snapshot_of(&lake).await;
    put_run(&lake, "wood", "r0", "d3", 99).await;
    let runs = [("wood", "r0"), ("prd", "r1"), ("brick", "r2")];
    let staged = runs.iter().flat_map(|(surface, run)| stage(&lake, &view, surface, run, "d2", 7));
    let outcomes: Vec<_> = commit(&lake, staged).await.chunks(3).map(|of_run| of_run[2]).collect();
    assert_eq!(outcomes, [CommitOutcome::Outdated, CommitOutcome::Now, CommitOutcome::Now]);
    assert_eq!(derivations(&lake).await, ["d3", "d2", "d2"]);
}

/// A run file that came under two names, of which one was changed.
#[tokio::test]
async fn a_run_that_comes_twice_in_a_group_has_one_row() {
    let lake = open_lake(&Arc::new(InMemory::new())).await;
    lake.ensure_tables().await.expect("made");
    let view = snapshot_of(&lake).await;
    let runs = [("wood", "d1"), ("wood", "d1"), ("wood", "d2"), ("prd", "d1")];
    let staged = runs.iter().flat_map(|(surface, derivation)| {
        stage(&lake, &view, surface, if *surface == "wood" { "r0" } else { "r1" }, derivation, 7)
    });
    let (now, before, outdated) = (CommitOutcome::Now, CommitOutcome::Before, CommitOutcome::Outdated);
    let outcomes = commit(&lake, staged).await;
    assert_eq!(outcomes, [now, now, now, before, before, before, now, before, outdated, now, now, now]);
    assert_eq!(derivations(&lake).await, ["d1", "d1"]);
    assert_eq!(read_seen_rows(&lake).await.num_rows(), 2 * ROWS);
    assert!(list_files(&lake).await.iter().all(|file| {
        let runs: BTreeSet<_> = file.parts.iter().map(|part| &part.run).collect();
        runs.len() == file.parts.len()
    }));
}

/// A verdict is taken back: the run gets the row of `runs` again that a file with other runs still has.
#[tokio::test]
async fn a_row_that_returns_is_a_new_row() {
    let lake = lake_of(&["wood", "prd", "brick"]).await;
    for derivation in ["d2", "d1", "d2"] {
        let view = snapshot_of(&lake).await;
        let staged = stage(&lake, &view, "prd", "r1", derivation, 7);
        assert_eq!(commit(&lake, staged).await[2], CommitOutcome::Now, "{derivation}");
        assert_eq!(derivations(&lake).await, ["d1", derivation, "d1"]);
    }
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(derivations(&lake).await, ["d1", "d2", "d1"]);
    // All of them, to what a file that nobody has cleaned up yet has.
    for derivation in ["d4", "d5", "d4", "d5"] {
        let view = snapshot_of(&lake).await;
        let runs = [("wood", "r0"), ("prd", "r1"), ("brick", "r2")];
        let staged = runs.iter().flat_map(|(surface, run)| stage(&lake, &view, surface, run, derivation, 7));
        let outcomes: Vec<_> = commit(&lake, staged).await.chunks(3).map(|of_run| of_run[2]).collect();
        assert_eq!(outcomes, [CommitOutcome::Now; 3], "{derivation}");
        assert_eq!(derivations(&lake).await, [derivation; 3]);
    }
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(derivations(&lake).await, ["d5"; 3]);
    assert_eq!(read_seen_rows(&lake).await.num_rows(), 3 * ROWS);
}

#[tokio::test]
async fn readers_of_a_project_have_whole_files() {
    let lake = lake_of(&["flat", "foam", "a-wall", "a-hall", "b-wall", "b-hall", "old", "older"]).await;
    let expected = lists(&[&["r0", "r1"], &["r3", "r2"], &["r5", "r4"], &["r6", "r7"]]);
    for table in [TABLE, Table::Surfaces, Table::Runs] {
        assert_eq!(parts_of(&lake, table).await, expected, "{}", table.name());
    }
    let reader = lake.restricted_to(["a".parse().expect("a project")].into());
    let snapshot = snapshot_of(&reader).await;
    assert_eq!(snapshot.runs().count(), 4);
    assert_eq!((snapshot.files(TABLE).len(), snapshot.readable_files(TABLE).count()), (2, 2));
}

/// Lists end a row group with their run; other rows share one, unless they are many.
#[test]
fn rows_without_lists_share_a_row_group() {
    let rig = echolake_schema::Rig::paper();
    let row_groups = |table: Table, rows: usize| {
        let schema = table.schema(&rig);
        let mut encoder = FileEncoder::new(table, schema.clone());
        let one = |run: &str| {
            let columns = schema.fields().iter().map(|field| made_up_column(field, "wood", run, 1)).collect();
            let batch = RecordBatch::try_new(schema.clone(), columns).expect("rows");
            encode_run_rows(table, &schema, &vec![batch; rows / ROWS]).expect("encoded")
        };
        ["r1", "r2", "r3"].iter().try_for_each(|run| encoder.append_run(one(run))).expect("appended");
        let file = encoder.finish().expect("a file");
        let bytes = bytes::Bytes::from(file.blocks.concat());
        let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(bytes).expect("a file");
        let groups = reader.metadata().row_groups().iter().map(|group| group.num_rows()).collect::<Vec<_>>();
        assert_eq!(groups.iter().sum::<i64>() as u64, file.rows);
        groups
    };
    assert_eq!(row_groups(Table::Nce, 2 * ROWS), [40; 3]);
    assert_eq!(row_groups(Table::Tnce, 2 * ROWS), [120]);
    assert_eq!(row_groups(Table::Tnce, 700 * ROWS), [14_000; 3]);
    let other = Table::Tnce.schema(&rig);
    let mut encoder = FileEncoder::new(Table::Nce, Table::Nce.schema(&rig));
    let refused = encoder.write_batch(&RecordBatch::new_empty(other)).expect_err("other columns").to_string();
    assert!(refused.contains("other columns"), "{refused}");
}
