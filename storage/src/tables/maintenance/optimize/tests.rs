//! Merges of files of made-up rows: what readers see before and after, and what others do meanwhile.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use arrow::array::{
    ArrayRef, BooleanArray, Float32Array, Float64Array, Int32Array, Int64Array, ListArray, StringArray,
    TimestampMicrosecondArray,
};
use arrow::buffer::OffsetBuffer;
use arrow::compute::concat_batches;
use arrow::datatypes::{DataType, Field};
use arrow::record_batch::RecordBatch;
use echolake_schema::Rig;
use object_store::ObjectStore;
use object_store::memory::InMemory;
use object_store::throttle::{ThrottleConfig, ThrottledStore};
use parquet::basic::Encoding;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaDataReader};

use super::*;
use crate::{ReferenceSurfaces, VisibleRun, encode_batches};

pub(crate) const TABLE: Table = Table::Nce;
pub(crate) const ROWS: usize = 20;

pub(crate) async fn open_lake(store: &Arc<InMemory>) -> Lake {
    let store: Arc<dyn ObjectStore> = store.clone();
    Lake::open_or_create_in(store, "a lake under test", &Rig::paper(), &ReferenceSurfaces::default())
        .await
        .expect("a lake")
}

pub(crate) fn made_up_column(field: &Field, surface: &str, run: &str, value: usize) -> ArrayRef {
    let numbers = || (0..ROWS).map(|row| (row * 1000 + value) as f32 * 0.37);
    match (field.name().as_str(), field.data_type()) {
        ("surface_id", _) => Arc::new(StringArray::from(vec![surface; ROWS])),
        ("run_id", _) => Arc::new(StringArray::from(vec![run; ROWS])),
        // A surface `a-wall` belongs to project `a`, and a run `r1-b` to project `b`.
        ("project", _) => {
            let project = run.split_once('-').map(|(_, project)| project);
            let project = project.or_else(|| surface.split_once('-').map(|(project, _)| project));
            Arc::new(StringArray::from(vec![project; ROWS]))
        }
        ("flat_reference" | "foam_reference", _) => Arc::new(StringArray::from(vec!["flat"; ROWS])),
        (_, DataType::Utf8) => Arc::new(StringArray::from(vec![value.to_string(); ROWS])),
        (_, DataType::Int32) => Arc::new((0..ROWS as i32).collect::<Int32Array>()),
        (_, DataType::Int64) => Arc::new((0..ROWS as i64).collect::<Int64Array>()),
        (_, DataType::Float32) => Arc::new(numbers().collect::<Float32Array>()),
        (_, DataType::Float64) => Arc::new(numbers().map(f64::from).collect::<Float64Array>()),
        (_, DataType::Boolean) => Arc::new(BooleanArray::from(vec![true; ROWS])),
        (_, DataType::Timestamp(..)) => Arc::new(TimestampMicrosecondArray::from(vec![0; ROWS]).with_timezone("UTC")),
        (_, DataType::List(child)) => {
            let items = numbers().flat_map(|x| (0..384).map(move |i| x + i as f32)).collect::<Float32Array>();
            let offsets = OffsetBuffer::from_lengths(vec![384; ROWS]);
            Arc::new(ListArray::new(child.clone(), offsets, Arc::new(items), None))
        }
        (name, kind) => panic!("{name} is {kind}"),
    }
}

pub(crate) fn visible_run(surface: &str, run: &str, derivation: &str) -> VisibleRun {
    VisibleRun {
        surface: surface.parse().expect("an id"),
        run: run.parse().expect("an id"),
        run_derivation: "ab".into(),
        reference_derivation: Some(derivation.into()),
        verdicts: None,
    }
}

/// Adds a run's derived rows, or replaces them, and its row in `runs`.
pub(crate) async fn put_run(lake: &Lake, surface: &str, run: &str, derivation: &str, value: usize) {
    let pointer = visible_run(surface, run, derivation);
    let part = FileName::Rows {
        surface: pointer.surface.clone(),
        run: pointer.run.clone(),
        derivation: derivation.to_owned(),
    };
    let old: Vec<_> = lake.snapshot().await.expect("a view").files_of(Table::Runs, &pointer.run).cloned().collect();
    let described = FileName::Rows {
        surface: pointer.surface.clone(),
        run: pointer.run.clone(),
        derivation: pointer.run_derivation.clone(),
    };
    let mut staged = Vec::new();
    let row = FileName::Pointer(pointer.clone());
    for (table, name) in [(TABLE, part), (Table::Surfaces, described), (Table::Runs, row)] {
        let schema = table.schema(lake.rig());
        let columns = schema.fields().iter().map(|f| made_up_column(f, surface, run, value)).collect();
        let rows = RecordBatch::try_new(schema.clone(), columns).expect("rows");
        let file = encode_batches(table, &schema, &[rows]).expect("encoded");
        staged.push(lake.stage_file(table, &name, file).await.expect("staged"));
    }
    let row = staged.pop().expect("the run's row").with_replaced_rows(&pointer, &old);
    staged.push(row);
    lake.commit_staged(&staged).await.expect("committed");
}

/// The rows that readers see, sorted by surface and run.
pub(crate) async fn read_seen_rows(lake: &Lake) -> RecordBatch {
    let snapshot = lake.snapshot().await.expect("a view");
    let mut slices: Vec<_> = snapshot.files(TABLE).iter().flat_map(|file| run_slices(file)).collect();
    slices.sort_by(|a, b| part_key(&a.part).cmp(&part_key(&b.part)));
    let mut batches = Vec::new();
    for slice in slices {
        let rows = lake.read_rows(TABLE, slice.file, &[], slice.rows).await.expect("a stream");
        batches.extend(rows.try_collect::<Vec<_>>().await.expect("rows"));
    }
    concat_batches(&TABLE.schema(lake.rig()), &batches).expect("rows of one schema")
}

pub(crate) async fn list_files(lake: &Lake) -> Vec<Arc<DataFile>> {
    lake.commit_log().list_files(TABLE).await.expect("a log")
}

async fn optimize(lake: &Lake) -> OptimizeReport {
    lake.optimize(TARGET_BYTES, &AtomicBool::new(false), &mut |_| {}).await.expect("merged")
}

/// Five runs, of surfaces and in an order that are not sorted.
async fn five() -> (Arc<InMemory>, Lake) {
    let store = Arc::new(InMemory::new());
    let lake = open_lake(&store).await;
    for (number, surface) in ["wood", "flat", "prd", "foam", "brick"].iter().enumerate() {
        put_run(&lake, surface, &format!("r{number}"), "d1", number).await;
    }
    (store, lake)
}

#[tokio::test]
async fn readers_see_the_same_rows_in_the_same_layout() {
    let (store, lake) = five().await;
    let (before, singles) = (read_seen_rows(&lake).await, list_files(&lake).await);
    let report = optimize(&lake).await;
    let merged: Vec<_> = report.tables.iter().map(|table| (table.table, table.merged, table.files)).collect();
    assert_eq!(merged, [("surfaces", 5, 1), ("runs", 5, 1), ("nce", 5, 1)]);
    let merged = list_files(&lake).await;
    assert_eq!(merged.len(), 1, "nothing else is left in the log");
    let surfaces: Vec<_> = merged[0].parts.iter().map(|p| (p.surface.as_str(), p.rows)).collect();
    assert_eq!(surfaces, ["brick", "flat", "foam", "prd", "wood"].map(|s| (s, ROWS as u64)));
    assert!(read_seen_rows(&lake).await == before, "other rows");
    assert_eq!(merged[0].stats.as_ref().expect("statistics").max["surface_id"], "wood");

    let layout = |bytes: bytes::Bytes| {
        let mut reader = ParquetMetaDataReader::new().with_page_index_policy(PageIndexPolicy::Required);
        reader.try_parse(&bytes).expect("metadata");
        let metadata = reader.finish().expect("metadata");
        let columns = metadata.row_group(0).columns().iter();
        let layout: Vec<_> = columns
            .map(|c| {
                (
                    c.column_path().string(),
                    c.compression(),
                    c.encodings_mask().is_set(Encoding::BYTE_STREAM_SPLIT),
                    c.statistics().is_some(),
                )
            })
            .collect();
        (layout, metadata.file_metadata().key_value_metadata().cloned())
    };
    let mut layouts = Vec::new();
    for file in [&singles[0], &merged[0]] {
        let found = object_store::ObjectStoreExt::get(store.as_ref(), &file.path).await.expect("kept");
        layouts.push(layout(found.bytes().await.expect("bytes")));
    }
    assert_eq!(layouts[0], layouts[1]);
    assert!(layouts[1].0.iter().any(|c| c.0 == "reflected_ir.list.element" && c.2 && !c.3), "{:?}", layouts[1]);

    // What is new is merged with what is merged.
    assert!(optimize(&lake).await.tables.is_empty());
    put_run(&lake, "cube", "r9", "d1", 9).await;
    let before = read_seen_rows(&lake).await;
    optimize(&lake).await;
    assert_eq!(list_files(&lake).await.len(), 1);
    assert!(read_seen_rows(&lake).await == before, "other rows");
}

#[tokio::test]
async fn a_replaced_run_is_left_out_at_once_and_written_out_by_the_clean_up() {
    let (_, lake) = five().await;
    optimize(&lake).await;
    put_run(&lake, "flat", "r1", "d2", 77).await;
    let expected = read_seen_rows(&lake).await;
    assert_eq!(expected.num_rows(), 5 * ROWS);
    let logged = |files: &[Arc<DataFile>]| files.iter().map(|f| f.rows).sum::<u64>() as usize;
    assert_eq!(logged(&list_files(&lake).await), 6 * ROWS, "other Delta readers still see the old rows");
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(logged(&list_files(&lake).await), 5 * ROWS);
    assert!(read_seen_rows(&lake).await == expected, "other rows");
    optimize(&lake).await;
    assert_eq!(list_files(&lake).await.len(), 1);
    assert!(read_seen_rows(&lake).await == expected, "other rows");
    for (number, surface) in ["wood", "flat", "prd", "foam", "brick"].iter().enumerate() {
        put_run(&lake, surface, &format!("r{number}"), "d3", number).await;
    }
    lake.remove_superseded().await.expect("cleaned up");
    assert!(list_files(&lake).await.iter().all(|f| f.parts.is_empty()), "all of its parts are replaced");
}

#[tokio::test]
async fn a_merge_of_what_is_replaced_meanwhile_changes_nothing() {
    let (_, lake) = five().await;
    let planned = lake.snapshot().await.expect("a view").files(TABLE).to_vec();
    put_run(&lake, "flat", "r1", "d2", 77).await;
    lake.remove_superseded().await.expect("cleaned up");
    let (before, named) = (read_seen_rows(&lake).await, list_files(&lake).await);
    let (outcome, _) = lake.merge_files(TABLE, &planned, CommitEffect::Layout.into(), None).await.expect("no error");
    assert_eq!(outcome, CommitOutcome::Outdated);
    assert_eq!(list_files(&lake).await, named);
    assert!(read_seen_rows(&lake).await == before, "other rows");
}

// Delta itself lets both through: their Removes change no data.
#[tokio::test(flavor = "multi_thread")]
async fn of_two_merges_at_once_one_is_made() {
    for _ in 0..10 {
        let (store, lakes) = five().await;
        let before = read_seen_rows(&lakes).await;
        let planned = lakes.snapshot().await.expect("a view").files(TABLE).to_vec();
        let merge = |range: std::ops::Range<usize>| {
            let (store, planned) = (store.clone(), planned.clone());
            tokio::spawn(async move {
                let lake = open_lake(&store).await;
                lake.merge_files(TABLE, &planned[range], CommitEffect::Layout.into(), None).await.expect("no error").0
            })
        };
        let (a, b) = tokio::join!(merge(0..4), merge(1..5));
        let mut outcomes = [a.expect("done"), b.expect("done")].map(|o| o == CommitOutcome::Now);
        outcomes.sort();
        assert_eq!(outcomes, [false, true]);
        assert_eq!(list_files(&lakes).await.iter().map(|f| f.rows).sum::<u64>() as usize, 5 * ROWS);
        assert!(read_seen_rows(&lakes).await == before, "other rows");
    }
}

// Delta's log is condensed every twenty commits.
#[tokio::test]
async fn parts_outlive_a_checkpoint() {
    let (store, first) = five().await;
    optimize(&first).await;
    let parts = list_files(&first).await[0].parts.clone();
    for number in 0..100 {
        put_run(&first, "cube", "r9", &format!("e{number}"), 9).await;
    }
    let checkpoint = object_store::path::Path::from("tables/nce/_delta_log/_last_checkpoint");
    object_store::ObjectStoreExt::head(store.as_ref(), &checkpoint).await.expect("a checkpoint");
    let anew = open_lake(&store).await;
    let merged: Vec<_> = list_files(&anew).await.into_iter().filter(|f| !f.parts.is_empty()).collect();
    assert_eq!(merged.len(), 1);
    assert_eq!(merged[0].parts, parts);
}

#[tokio::test]
async fn vacuum_deletes_what_is_merged_and_nothing_that_is_named() {
    let (store, lake) = five().await;
    let mut singles = Vec::new();
    for table in [TABLE, Table::Runs, Table::Surfaces] {
        singles.extend(lake.commit_log().list_files(table).await.expect("a log"));
    }
    optimize(&lake).await;
    let before = read_seen_rows(&lake).await;
    let vacuum = |hours, deletion| {
        let lake = lake.clone();
        async move { lake.vacuum(chrono::TimeDelta::hours(hours), deletion, &mut |_, _| {}).await.expect("no error") }
    };
    assert!(vacuum(1, crate::DeletionMode::Real).await.files.is_empty(), "readers may hold them");
    let told = vacuum(0, crate::DeletionMode::Pretended).await;
    let names: Vec<_> = told.files.iter().map(|f| f.path.clone()).collect();
    assert_eq!(names, singles.iter().map(|f| f.path.to_string()).collect::<Vec<_>>());
    assert_eq!(told.bytes, singles.iter().map(|f| f.bytes).sum::<u64>());
    object_store::ObjectStoreExt::head(store.as_ref(), &singles[0].path).await.expect("only told");
    assert_eq!(vacuum(0, crate::DeletionMode::Real).await.files, told.files);
    object_store::ObjectStoreExt::head(store.as_ref(), &singles[0].path).await.expect_err("deleted");
    assert!(read_seen_rows(&lake).await == before, "other rows");
    assert!(vacuum(0, crate::DeletionMode::Real).await.files.is_empty());
}

/// Runs of two projects, of references and of none.
async fn of_projects() -> Lake {
    let lake = open_lake(&Arc::new(InMemory::new())).await;
    for (number, surface) in ["flat", "foam", "a-wall", "a-hall", "b-wall", "b-hall", "old", "older"].iter().enumerate()
    {
        put_run(&lake, surface, &format!("r{number}"), "d1", number).await;
    }
    lake
}

fn reader_of(lake: &Lake, projects: &[&str]) -> Lake {
    lake.restricted_to(projects.iter().map(|project| project.parse().expect("a name")).collect())
}

async fn seen_runs(lake: &Lake) -> Vec<String> {
    let snapshot = lake.snapshot().await.expect("a view");
    let mut rows: Vec<_> =
        snapshot.files(TABLE).iter().flat_map(|file| run_slices(file)).map(|s| s.part.run.to_string()).collect();
    rows.sort();
    assert_eq!(rows, snapshot.runs().map(|run| run.run.to_string()).collect::<Vec<_>>());
    rows
}

#[tokio::test]
async fn readers_of_projects_see_their_runs_and_the_references() {
    let lake = of_projects().await;
    let check = async |projects: &[&str], expected: &[&str]| {
        let reader = reader_of(&lake, projects);
        assert_eq!(seen_runs(&reader).await, expected, "{projects:?}");
        let newest: u64 = expected.last().map_or(0, |run| run[1..].parse().expect("a number"));
        let versions = reader.list_versions().await.expect("versions");
        assert_eq!(versions.last().map(|version| version.version), Some(newest + 1), "{projects:?}");
        for version in versions.iter().map(|version| version.version) {
            let then = reader.snapshot_at(version, TABLE).await.expect("held");
            let runs: Vec<_> = then.runs().map(|run| run.run.to_string()).collect();
            let expected = expected.iter().filter(|run| run[1..].parse::<u64>().expect("a number") < version);
            assert_eq!(runs, expected.copied().collect::<Vec<_>>(), "{projects:?} {version}");
        }
        let changes = reader.commit_log().list_changes(TABLE).await.expect("changes");
        assert_eq!(changes.iter().map(|change| change.files_added).sum::<u64>(), expected.len() as u64);
    };
    check(&["a"], &["r0", "r1", "r2", "r3"]).await;
    check(&["b"], &["r0", "r1", "r4", "r5"]).await;
    check(&["a", "b"], &["r0", "r1", "r2", "r3", "r4", "r5"]).await;
    check(&["c"], &["r0", "r1"]).await;
    assert_eq!(seen_runs(&lake).await.len(), 8, "all is seen without projects");
}

#[tokio::test]
async fn projects_are_not_merged_and_readers_see_parts_of_files_that_were() {
    let lake = of_projects().await;
    let pairs = [["r0", "r1"], ["r2", "r3"], ["r4", "r5"], ["r6", "r7"]].map(|pair| pair.map(str::to_owned));
    optimize(&lake).await;
    let merged = list_files(&lake).await;
    let mut parts: Vec<_> = merged.iter().map(|f| f.parts.iter().map(|p| p.run.to_string()).collect()).collect();
    parts.iter_mut().for_each(|runs: &mut Vec<String>| runs.sort());
    parts.sort();
    assert_eq!(parts, pairs);
    let whole = |lake: &Lake| {
        let lake = lake.clone();
        async move { lake.snapshot().await.expect("a view").readable_files(TABLE).count() }
    };
    assert_eq!((seen_runs(&reader_of(&lake, &["a"])).await.len(), whole(&reader_of(&lake, &["a"])).await), (4, 2));
    // As a version without projects merged them.
    lake.merge_files(TABLE, &merged, CommitEffect::Layout.into(), None).await.expect("merged");
    assert_eq!(list_files(&lake).await.len(), 1);
    let reader = reader_of(&lake, &["a"]);
    assert_eq!(
        (seen_runs(&reader).await, whole(&reader).await),
        (["r0", "r1", "r2", "r3"].map(str::to_owned).to_vec(), 0)
    );
    assert_eq!((seen_runs(&lake).await.len(), whole(&lake).await), (8, 1));
}

/// Runs of a lake's snapshot: name, derivation of the derived rows, version that added the row.
async fn rows_of_runs(lake: &Lake) -> Vec<(String, String, u64)> {
    let snapshot = lake.snapshot().await.expect("a view");
    let row = |run: &VisibleRun| {
        let derivation = run.reference_derivation.clone().expect("derived");
        (run.run.to_string(), derivation, snapshot.row_version(&run.run).expect("seen"))
    };
    let rows: Vec<_> = snapshot.runs().map(row).collect();
    for table in [Table::Runs, Table::Surfaces, TABLE] {
        let mut shown: Vec<_> = snapshot.files(table).iter().flat_map(|file| file.shown_runs()).collect();
        shown.sort();
        assert_eq!(shown.len(), rows.len(), "{table:?} shows {shown:?}");
    }
    rows
}

async fn only_merged(lake: &Lake, table: Table) -> Arc<DataFile> {
    let mut merged = lake.commit_log().list_files(table).await.expect("a log");
    merged.retain(|file| !file.parts.is_empty());
    assert_eq!(merged.len(), 1, "{table:?}");
    merged.remove(0)
}

#[tokio::test]
async fn a_merged_row_of_a_run_keeps_its_version_and_its_newer_one_counts() {
    let (store, lake) = five().await;
    let before = rows_of_runs(&lake).await;
    optimize(&lake).await;
    assert_eq!(rows_of_runs(&lake).await, before);
    assert_eq!(lake.commit_log().list_files(Table::Runs).await.expect("a log").len(), 1);
    put_run(&lake, "flat", "r1", "d2", 77).await;
    let then = lake.snapshot().await.expect("a view");
    put_run(&lake, "wood", "r0", "d2", 78).await;
    put_run(&lake, "cube", "r9", "d1", 9).await;
    let row = |run: &str, derivation: &str, version| (run.to_owned(), derivation.to_owned(), version);
    let mut expected = before.clone();
    (expected[0], expected[1]) = (row("r0", "d2", 8), row("r1", "d2", 7));
    expected.push(row("r9", "d1", 9));
    assert_eq!(rows_of_runs(&lake).await, expected);
    // A clean-up that began before the second one puts the older row of r0 into a newer file.
    lake.rewrite_file(Table::Runs, &then.outgrown_files(Table::Runs)[0]).await.expect("written anew");
    let merged = only_merged(&lake, Table::Runs).await;
    assert_eq!((merged.log_version, merged.parts.len()), (10, 4));
    assert_eq!(rows_of_runs(&lake).await, expected);
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(only_merged(&lake, Table::Runs).await.parts.len(), 3);
    assert_eq!(rows_of_runs(&lake).await, expected);
    optimize(&lake).await;
    assert_eq!(only_merged(&lake, Table::Runs).await.parts.len(), 6);
    assert_eq!(rows_of_runs(&lake).await, expected);
    drop(lake);
    assert_eq!(rows_of_runs(&open_lake(&store).await).await, expected);
}

#[tokio::test]
async fn of_two_who_replace_a_merged_row_one_does() {
    let (_, lake) = five().await;
    optimize(&lake).await;
    let view = lake.snapshot().await.expect("a view");
    let run = |name: &str| view.run(&name.parse().expect("an id")).expect("seen").clone();
    let (flat, wood) = (run("r1"), run("r0"));
    let replace = async |run: &VisibleRun, derivation: &str| {
        let pointer = VisibleRun { reference_derivation: Some(derivation.to_owned()), ..run.clone() };
        let file = encode_batches(Table::Runs, &Table::Runs.schema(lake.rig()), &[]).expect("encoded");
        let staged = lake.stage_file(Table::Runs, &FileName::Pointer(pointer.clone()), file).await.expect("staged");
        let staged = staged.made_from(&view).with_replaced_rows(&pointer, view.files_of(Table::Runs, &run.run));
        lake.commit_staged(&[staged]).await.expect("no error")[0]
    };
    assert_eq!(replace(&flat, "d2").await, CommitOutcome::Now);
    assert_eq!(replace(&flat, "d3").await, CommitOutcome::Outdated, "another one's row is there");
    assert_eq!(replace(&wood, "d2").await, CommitOutcome::Now, "a row of the same file");
    lake.remove_superseded().await.expect("cleaned up");
    assert_eq!(replace(&flat, "d3").await, CommitOutcome::Outdated);
    let seen = lake.snapshot().await.expect("a view");
    let derivations = ["r0", "r1", "r2"].map(|run| {
        let run: echolake_schema::RunId = run.parse().expect("an id");
        seen.run(&run).expect("seen").reference_derivation.clone().expect("derived")
    });
    assert_eq!(derivations, ["d2", "d2", "d1"]);
}

#[tokio::test]
async fn a_past_version_of_runs_is_seen_once_its_files_are_merged_and_deleted() {
    let (_, lake) = five().await;
    let version = lake.snapshot().await.expect("a view").log_version(Table::Runs).expect("a log");
    optimize(&lake).await;
    put_run(&lake, "cube", "r9", "d1", 9).await;
    optimize(&lake).await;
    lake.vacuum(chrono::TimeDelta::zero(), crate::DeletionMode::Real, &mut |_, _| {}).await.expect("deleted");
    let then = lake.snapshot_at(version, Table::Runs).await.expect("held");
    assert_eq!(then.files(Table::Runs).iter().map(|file| file.visible_rows()).sum::<u64>() as usize, 5 * ROWS);
    put_run(&lake, "flat", "r1", "d2", 77).await;
    optimize(&lake).await;
    lake.vacuum(chrono::TimeDelta::zero(), crate::DeletionMode::Real, &mut |_, _| {}).await.expect("deleted");
    let gone = lake.snapshot_at(version, Table::Runs).await;
    assert!(matches!(gone, Err(Error::Vacuumed { .. })), "the older row of r1: {gone:?}");
}

// What tells a surface to readers of one project may not be what tells it to others.
#[tokio::test]
async fn a_surface_that_two_projects_measured_is_described_to_both() {
    let lake = of_projects().await;
    let check = async |expected: [&[&str]; 3]| {
        for (reader, expected) in
            [reader_of(&lake, &["a"]), reader_of(&lake, &["b"]), lake.clone()].iter().zip(expected)
        {
            let snapshot = reader.snapshot().await.expect("a view");
            let files = snapshot.files(Table::Surfaces).iter();
            let mut shown: Vec<_> = files.flat_map(|file| file.shown_runs()).map(|run| run.to_string()).collect();
            shown.sort();
            assert_eq!(shown, expected);
        }
    };
    let all = ["r0", "r1", "r2", "r3", "r4", "r5", "r6", "r7"];
    check([&["r0", "r1", "r2", "r3"], &["r0", "r1", "r4", "r5"], &all]).await;
    optimize(&lake).await;
    check([&["r0", "r1", "r2", "r3"], &["r0", "r1", "r4", "r5"], &all]).await;
    // Project b measures one of project a's surfaces, and a row of the same merged file is superseded.
    put_run(&lake, "a-wall", "r8-b", "d1", 8).await;
    put_run(&lake, "a-hall", "r9", "d1", 9).await;
    put_run(&lake, "a-hall", "r3", "d2", 3).await;
    let expected: [&[&str]; 3] = [
        &["r0", "r1", "r2", "r9"],
        &["r0", "r1", "r4", "r5", "r8-b"],
        &["r0", "r1", "r4", "r5", "r6", "r7", "r8-b", "r9"],
    ];
    check(expected).await;
    lake.remove_superseded().await.expect("cleaned up");
    optimize(&lake).await;
    check(expected).await;
}

#[tokio::test]
async fn projects_have_rows_of_runs_of_their_own() {
    let lake = of_projects().await;
    let before = [rows_of_runs(&reader_of(&lake, &["a"])).await, rows_of_runs(&reader_of(&lake, &["b"])).await];
    optimize(&lake).await;
    let merged = lake.commit_log().list_files(Table::Runs).await.expect("a log");
    assert_eq!(merged.iter().map(|file| file.parts.len().max(1)).sum::<usize>(), 8);
    assert_eq!(merged.len(), 4, "references, of a, of b, and of none: {merged:?}");
    let after = [rows_of_runs(&reader_of(&lake, &["a"])).await, rows_of_runs(&reader_of(&lake, &["b"])).await];
    assert_eq!(after, before);
}

#[tokio::test]
async fn references_are_seen_in_a_file_that_was_merged_before_there_were_projects() {
    let (_, lake) = five().await;
    optimize(&lake).await;
    put_run(&lake, "a-wall", "r5", "d1", 5).await;
    let reader = reader_of(&lake, &["a"]);
    let runs: Vec<_> = rows_of_runs(&reader).await.into_iter().map(|(run, _, version)| (run, version)).collect();
    assert_eq!(runs, [("r1".to_owned(), 2), ("r3".to_owned(), 4), ("r5".to_owned(), 7)]);
    let versions = reader.list_versions().await.expect("versions");
    assert_eq!(versions.last().map(|version| version.version), Some(7));
    let snapshot = reader.snapshot().await.expect("a view");
    let partly: Vec<_> = snapshot.files(Table::Runs).iter().filter(|file| !file.hidden.is_empty()).collect();
    assert_eq!((partly.len(), partly[0].visible_parts().count(), partly[0].parts.len()), (1, 2, 5));
    put_run(&lake, "cube", "r6", "d1", 6).await;
    optimize(&lake).await;
    assert_eq!((rows_of_runs(&lake).await.len(), rows_of_runs(&reader).await.len()), (7, 3));
}

#[tokio::test(flavor = "multi_thread")]
async fn whoever_looks_while_runs_come_sees_all_rows_of_each() {
    const RUNS: usize = 30;
    let store = Arc::new(InMemory::new());
    let lake = open_lake(&store).await;
    // Requests that are made at once are answered in any order.
    let config = ThrottleConfig { wait_get_per_call: Duration::from_millis(1), ..ThrottleConfig::default() };
    let slow: Arc<dyn ObjectStore> = Arc::new(ThrottledStore::new(store, config));
    let (rig, references) = (Rig::paper(), ReferenceSurfaces::default());
    let reader = Lake::open_or_create_in(slow, "a slow lake", &rig, &references).await.expect("a lake");
    let finished_looks = Arc::new(AtomicUsize::new(0));
    let seen_looks = finished_looks.clone();
    let writing = tokio::spawn(async move {
        for number in 0..RUNS {
            let before = seen_looks.load(Ordering::SeqCst);
            put_run(&lake, "wood", &format!("r{number}"), "d1", number).await;
            // A look at a lake whose other tables lack rows is repeated while runs come.
            while seen_looks.load(Ordering::SeqCst) == before {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        }
    });
    let mut looks = BTreeSet::new();
    while looks.last() != Some(&RUNS) {
        let snapshot = reader.snapshot().await.expect("a view");
        for run in snapshot.runs() {
            assert_eq!(snapshot.files_of(TABLE, &run.run).count(), 1, "rows of {} of {looks:?}", run.run);
        }
        looks.insert(snapshot.runs().count());
        finished_looks.fetch_add(1, Ordering::SeqCst);
    }
    assert!(looks.len() > 2, "it looked while runs came: {looks:?}");
    writing.await.expect("written");
}
