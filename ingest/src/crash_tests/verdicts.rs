//! Verdicts of users on runs and measurements: what rests on them follows with the next ingest, whatever dies on the
//! way.

use std::collections::BTreeMap;
use std::sync::Arc;

use arrow::array::AsArray as _;
use arrow::datatypes::{Float64Type, Int32Type};
use bytes::Bytes;
use chrono::Utc;
use echolake_lake::{ContributedFile, annotation_rows};
use echolake_schema::RunId;
use echolake_schema::annotations::{Annotation, AnnotationKind};
use echolake_schema::tables::Table;
use object_store::ObjectStore;
use object_store::memory::InMemory;

use super::{each_death, ingest_pending, open_lake, read_rows, read_tables, simulate_runs, tidy_lake, with_inbox};
use crate::read_back::rows_of_run;

/// Tables with a row per surface, or few.
const OF_SURFACES: [Table; 3] = [Table::Surfaces, Table::Heightmaps, Table::SurfaceStats];

fn run_of(file: &str) -> RunId {
    file.trim_end_matches(".mcap").parse().expect("a run")
}

/// Stores a verdict, as a server does.
async fn judge(store: &Arc<InMemory>, file: &str, pairs: Option<&[u32]>, value: &str) {
    let table = Table::Annotations;
    let lake = open_lake(store.clone()).await.expect("a lake");
    lake.prepare_contributions(table).await.expect("prepared");
    let snapshot = lake.snapshot().await.expect("a view");
    let seen = snapshot.log_version(table).expect("a log");
    let annotation = Annotation {
        annotation_id: seen.to_string(),
        run_id: run_of(file),
        pair_ids: pairs.map(<[u32]>::to_vec),
        kind: AnnotationKind::Verdict,
        value: value.to_owned(),
        comment: String::new(),
        author: "a test".to_owned(),
        time: Utc::now(),
        lake_version: None,
    };
    let rows = annotation_rows(&lake, &snapshot, &[annotation]).expect("rows");
    let files = ContributedFile::encode_rows(&lake, table, &rows).expect("files");
    lake.add_contribution(table, seen, files).await.expect("added").expect("the newest");
}

fn is_of_users(path: &str) -> bool {
    Table::OF_USERS.into_iter().any(|table| path.starts_with(&format!("tables/{}/", table.name())))
}

/// As [`read_tables`], without what users add.
async fn read_measured_tables(store: Arc<InMemory>) -> (BTreeMap<String, Bytes>, Vec<String>) {
    let (mut seen, mut logged) = read_tables(store).await;
    seen.retain(|path, _| !is_of_users(path));
    logged.retain(|path| !is_of_users(path));
    (seen, logged)
}

/// As [`read_rows`], without what users add.
async fn read_measured_rows(store: Arc<InMemory>) -> BTreeMap<&'static str, Vec<Vec<u8>>> {
    let mut rows = read_rows(store).await;
    for table in Table::OF_USERS {
        rows.remove(table.name());
    }
    rows
}

/// Rows of a run's file in a table: pair, if it has one, and a number.
async fn read_numbers(store: &Arc<InMemory>, table: Table, file: &str, column: &str) -> BTreeMap<i32, f64> {
    let lake = open_lake(store.clone()).await.expect("a lake");
    let snapshot = lake.snapshot().await.expect("a view");
    let mut numbers = BTreeMap::new();
    let run = run_of(file);
    for file in snapshot.files_of(table, &run) {
        for batch in rows_of_run(&lake, table, file, &run, &["pair_id", column]).await.expect("rows") {
            let values = batch.column_by_name(column).expect("the column").as_primitive::<Float64Type>();
            let pairs = batch.column_by_name("pair_id").expect("pairs").as_primitive::<Int32Type>();
            numbers.extend(pairs.values().iter().copied().zip(values.values().iter().copied()));
        }
    }
    numbers
}

/// A run's statistics of the total: measurements, and the greatest level.
async fn read_total(store: &Arc<InMemory>, file: &str) -> (i32, Option<f64>) {
    let lake = open_lake(store.clone()).await.expect("a lake");
    let snapshot = lake.snapshot().await.expect("a view");
    let run = run_of(file);
    let file = snapshot.files_of(Table::SurfaceStats, &run).next().expect("statistics");
    let batches = rows_of_run(&lake, Table::SurfaceStats, file, &run, &[]).await.expect("rows");
    let column = |name: &str| batches[0].column_by_name(name).expect("the column").clone();
    let last = batches[0].num_rows() - 1;
    let greatest = column("max_db").as_primitive::<Float64Type>().iter().nth(last).flatten();
    (column("measurements").as_primitive::<Int32Type>().value(last), greatest)
}

async fn is_whole(store: Arc<dyn ObjectStore>) -> bool {
    open_lake(store).await.expect("a lake").snapshot().await.expect("a view").is_whole()
}

/// E13: a rejected pair is left out of its surface's statistics, and of the reference that it is of.
#[tokio::test(flavor = "multi_thread")]
async fn statistics_and_references_leave_out_rejected_pairs() {
    let runs = simulate_runs(&["flat", "foam", "wood"]);
    let store = with_inbox(&runs).await;
    ingest_pending(store.clone()).await.expect("ingested");
    let [flat, wood] = [0, 2].map(|number: usize| runs[number].0.as_str());
    let before = read_measured_tables(store.clone()).await;
    let levels = read_numbers(&store, Table::Tnce, wood, "tnce_total").await;
    let (loudest, _) = levels.iter().max_by(|a, b| a.1.total_cmp(b.1)).expect("levels");
    let others = levels.iter().filter(|(pair, _)| *pair != loudest).map(|(_, level)| *level);
    let second_db = 10.0 * others.fold(0.0, f64::max).log10();
    judge(&store, wood, Some(&[loudest.cast_unsigned()]), "rejected").await;
    ingest_pending(store.clone()).await.expect("ingested");
    let (measurements, greatest_db) = read_total(&store, wood).await;
    assert_eq!((levels.len(), measurements), (45, 44));
    assert!((greatest_db.expect("a level") - second_db).abs() < 1e-9, "{greatest_db:?}, expected {second_db}");
    assert_eq!(read_numbers(&store, Table::Tnce, wood, "tnce_total").await, levels, "tables keep every row");
    assert_eq!(read_total(&store, flat).await.0, 45, "no other run changes");
    // Without Flat's pair, no surface has a level of it.
    judge(&store, flat, Some(&[7]), "rejected").await;
    ingest_pending(store.clone()).await.expect("ingested");
    let normalised = read_numbers(&store, Table::Tnce, wood, "tnce_total").await;
    assert!(normalised.len() == 44 && !normalised.contains_key(&7), "{:?}", normalised.keys());
    // What is accepted again is as it was, byte for byte.
    judge(&store, flat, None, "accepted").await;
    judge(&store, wood, Some(&[loudest.cast_unsigned()]), "accepted").await;
    ingest_pending(store.clone()).await.expect("ingested");
    assert!(read_measured_tables(store).await == before, "other files");
}

/// E13: a rejected run of Flat normalises nothing: all levels are those of a lake without it. If it is the only one,
/// surfaces wait for a reference.
#[tokio::test(flavor = "multi_thread")]
async fn a_rejected_reference_normalises_nothing() {
    let runs = simulate_runs(&["flat", "foam", "wood", "flat"]);
    let without = with_inbox(&runs[..3]).await;
    ingest_pending(without.clone()).await.expect("ingested");
    let store = with_inbox(&runs).await;
    ingest_pending(store.clone()).await.expect("ingested");
    judge(&store, &runs[3].0, None, "rejected").await;
    ingest_pending(store.clone()).await.expect("ingested");
    let (expected, actual) = (read_measured_rows(without).await, read_measured_rows(store.clone()).await);
    for (table, rows) in &expected {
        let is_there = |row: &Vec<u8>| actual[table].binary_search(row).is_ok();
        assert!(rows.iter().all(is_there), "other rows of {table} than in a lake without the run");
    }
    judge(&store, &runs[0].0, None, "rejected").await;
    ingest_pending(store.clone()).await.expect("ingested");
    let rows = read_measured_rows(store.clone()).await;
    assert_eq!((rows.contains_key("tnce"), rows["measurements"].len()), (false, 4 * 45));
    assert!(is_whole(store).await);
}

mod slow {
    use super::*;

    /// E13: run 1 good, run 2 of the surface rejected: run 1 describes the surface to all readers, those of the log,
    /// too; a second ingest changes nothing, and an acceptance brings run 2 back. Readers miss no row meanwhile.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_rejected_run_does_not_replace_an_accepted_one_whatever_dies_on_the_way() {
        let runs = simulate_runs(&["flat", "foam", "wood", "wood"]);
        let first = with_inbox(&runs[..3]).await;
        ingest_pending(first.clone()).await.expect("ingested");
        let expected = read_measured_rows(first).await;
        for is_merged in [false, true] {
            let start = with_inbox(&runs).await;
            ingest_pending(start.clone()).await.expect("ingested");
            let both = read_measured_rows(start.clone()).await;
            if is_merged {
                tidy_lake(start.clone()).await.expect("merged");
            }
            judge(&start, &runs[3].0, None, "rejected").await;
            let deaths = each_death(&start, ingest_pending, async |inner, death| {
                assert!(is_whole(inner.clone()).await, "{death}: rows are missing");
                ingest_pending(inner.clone()).await.unwrap_or_else(|e| panic!("{death}: {e}"));
                let actual = read_measured_rows(inner.clone()).await;
                for table in OF_SURFACES.map(Table::name) {
                    assert!(actual.get(table) == expected.get(table), "{death}: other rows of {table}");
                }
                let (seen, logged) = read_measured_tables(inner.clone()).await;
                let in_logs: Vec<_> = seen.keys().cloned().collect();
                assert_eq!(in_logs, logged, "{death}: readers of the logs see what readers of the lake see");
                ingest_pending(inner.clone()).await.expect("ingested");
                assert!(
                    read_measured_tables(inner).await == (seen, logged),
                    "{death}: the second ingest changes files"
                );
            })
            .await;
            assert!(deaths > 10, "{deaths} deaths");
            ingest_pending(start.clone()).await.expect("ingested");
            judge(&start, &runs[3].0, None, "accepted").await;
            each_death(&start, ingest_pending, async |inner, death| {
                assert!(is_whole(inner.clone()).await, "{death}: rows are missing");
                ingest_pending(inner.clone()).await.unwrap_or_else(|e| panic!("{death}: {e}"));
                assert!(read_measured_rows(inner).await == both, "{death}: other rows");
            })
            .await;
        }
    }
}
