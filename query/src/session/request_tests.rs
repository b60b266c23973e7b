//! Requests that queries send to an object store, on files as large as those of the paper's rig.

use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, Float32Array, Int64Array, ListArray, StringArray};
use arrow::buffer::OffsetBuffer;
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field};
use arrow::record_batch::RecordBatch;
use echolake_lake::{FileName, Lake, ReferenceSurfaces, VisibleRun, encode_batches};
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use echolake_testing::StoreDouble;
use object_store::ObjectStoreExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;

use crate::Session;

const RUNS: usize = 7;
/// Pairs of the paper's rig, and samples of its responses.
const PAIRS: usize = 2951;
const SAMPLES: usize = 384;

// Numbers that do not compress.
fn noise(count: usize) -> Float32Array {
    let mut state = 1_u32;
    let next = |_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state as f32 / u32::MAX as f32
    };
    (0..count).map(next).collect()
}

fn column(field: &Field, rows: usize, run: &VisibleRun, file_bytes: usize) -> ArrayRef {
    let counted: Int64Array = (0..rows as i64).collect();
    match (field.name().as_str(), field.data_type()) {
        ("surface_id", _) => Arc::new(StringArray::from(vec![run.surface.as_str(); rows])),
        ("run_id", _) => Arc::new(StringArray::from(vec![run.run.as_str(); rows])),
        ("file", _) => Arc::new(StringArray::from(vec![Lake::run_path(&run.surface, &run.run).to_string(); rows])),
        ("file_bytes", _) => Arc::new(Int64Array::from(vec![file_bytes as i64; rows])),
        (_, DataType::Utf8) => Arc::new(StringArray::from(vec!["text"; rows])),
        (_, DataType::Boolean) => Arc::new(arrow::array::BooleanArray::from(vec![true; rows])),
        (_, DataType::List(child)) => {
            let offsets = OffsetBuffer::from_lengths(vec![SAMPLES; rows]);
            Arc::new(ListArray::new(child.clone(), offsets, Arc::new(noise(rows * SAMPLES)), None))
        }
        (_, kind @ (DataType::Float32 | DataType::Float64)) => cast(&noise(rows), kind).expect("numbers"),
        (_, kind) => cast(&counted, kind).expect("numbers"),
    }
}

fn run_file() -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let mut writer = mcap::Writer::new(&mut file).expect("a writer");
    let layout = br#"{"type":"object","properties":{"x":{"type":"number"}}}"#;
    let schema = writer.add_schema("Point", "jsonschema", layout).expect("added");
    let channel_id = writer.add_channel(schema, "/x", "json", &Default::default()).expect("added");
    for sequence in 0..10 {
        let header = mcap::records::MessageHeader { channel_id, sequence, log_time: 1, publish_time: 1 };
        writer.write_to_known_channel(&header, br#"{"x":1}"#).expect("written");
    }
    writer.finish().expect("finished");
    drop(writer);
    file.into_inner()
}

async fn put_run(lake: &Lake, number: usize) {
    let run = VisibleRun {
        surface: format!("000{number}_0").parse().expect("an id"),
        run: format!("r{number}").parse().expect("an id"),
        run_derivation: "ab".into(),
        reference_derivation: Some("ab".into()),
        verdicts: None,
    };
    let recording = run_file();
    let file_bytes = recording.len();
    lake.store().put(&Lake::run_path(&run.surface, &run.run), recording.into()).await.expect("written");
    let rows = FileName::Rows { surface: run.surface.clone(), run: run.run.clone(), derivation: "ab".into() };
    let mut staged = Vec::new();
    for table in [Table::Surfaces, Table::Measurements, Table::Tnce, Table::Runs] {
        let schema = table.schema(lake.rig());
        let count = if matches!(table, Table::Surfaces | Table::Runs) { 1 } else { PAIRS };
        let columns = schema.fields().iter().map(|f| column(f, count, &run, file_bytes)).collect();
        let file = encode_batches(table, &schema, &[RecordBatch::try_new(schema.clone(), columns).expect("rows")]);
        let name = if table == Table::Runs { FileName::Pointer(run.clone()) } else { rows.clone() };
        staged.push(lake.stage_file(table, &name, file.expect("encoded")).await.expect("staged"));
    }
    lake.commit_staged(&staged).await.expect("committed");
}

async fn lake() -> (Arc<StoreDouble<()>>, Lake) {
    let store = StoreDouble::new(Arc::new(InMemory::new()), ());
    let (rig, references) = (Rig::paper(), ReferenceSurfaces::default());
    let lake = Lake::open_or_create_in(store.clone(), "s3://bucket/lake", &rig, &references).await.expect("a lake");
    for number in 0..RUNS {
        put_run(&lake, number).await;
    }
    (store, lake)
}

async fn rows(session: &Session, sql: &str) -> Vec<RecordBatch> {
    let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await.unwrap_or_else(|e| panic!("{sql}: {e}")) {
        batches.push(batch);
    }
    batches
}

// The requests of a query that returns so many rows, but for the look at what is new, which all queries of a second
// share.
async fn requests(session: &Session, store: &StoreDouble<()>, sql: &str, expected: usize) -> Vec<String> {
    store.take_requests();
    let count = rows(session, sql).await.iter().map(RecordBatch::num_rows).sum::<usize>();
    assert_eq!(count, expected, "{sql}");
    let mut requests = store.take_requests();
    requests.retain(|request| !request.contains("/_delta_log/"));
    requests
}

fn response(surface: usize, pair: usize) -> String {
    format!("select ir from measurements where surface_id = '000{surface}_0' and pair_id = {pair}")
}

const ALL_TNCE: &str = "select avg(tnce_total) from tnce";

#[tokio::test(flavor = "multi_thread")]
async fn queries_stay_within_their_budgets_of_requests() {
    let (store, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    rows(&session, "select count(*) from pairs").await;
    let cold = requests(&session, &store, &response(1, 7), 1).await;
    // Footer, page index, the columns of the predicate, the response.
    assert!(cold.len() <= 4 && cold.iter().all(|r| r.starts_with("GET")), "{cold:?}");
    let warm = requests(&session, &store, &response(1, 2000), 1).await;
    // The cache, which `serve` and `sql` read through, spares the first two.
    assert!(warm.len() <= 3, "{warm:?}");
    let cold = requests(&session, &store, ALL_TNCE, 1).await;
    assert!(cold.len() <= 2 * RUNS && cold.iter().all(|r| r.starts_with("GET")), "{cold:?}");
    assert_eq!(requests(&session, &store, ALL_TNCE, 1).await, [""; 0], "its column is kept");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cache_spares_requests_and_tells_explain_analyze() {
    let (store, lake) = lake().await;
    let lake = lake.with_cache(None).await.expect("a cache");
    let session = Session::new(&lake).expect("a session");
    rows(&session, "select count(*) from pairs").await;
    let cold = requests(&session, &store, ALL_TNCE, 1).await;
    assert_eq!(cold.len(), RUNS, "a file is one block: {cold:?}");
    assert_eq!(requests(&session, &store, ALL_TNCE, 1).await, [""; 0]);
    requests(&session, &store, &response(1, 7), 1).await;
    let warm = requests(&session, &store, &response(1, 2000), 1).await;
    assert!(warm.len() <= 1, "{warm:?}");
    assert_eq!(requests(&session, &store, &response(1, 2000), 1).await, [""; 0]);

    let plan = rows(&session, &format!("explain analyze {}", response(2, 2000))).await;
    let plan = plan[0].column(1).as_string::<i32>().iter().flatten().collect::<String>();
    let value = |name: &str| -> usize {
        let (_, from) = plan.split_once(&format!("{name}=")).unwrap_or_else(|| panic!("{name}: {plan}"));
        from.split(|c: char| !c.is_ascii_digit()).next().expect("a number").parse().expect("a number")
    };
    assert!(value("cache_misses") >= 1 && value("store_requests") >= 1, "{plan}");
    assert_eq!(value("cache_disk_hits"), 0, "{plan}");
    let counts = lake.cache_counts().expect("a cache");
    assert!(counts.memory_hits > 0 && counts.misses >= counts.requests && counts.requests > 0, "{counts:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn run_files_are_not_asked_for_their_sizes() {
    let (store, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    rows(&session, "select run_id from runs").await;
    let messages = "select x from mcap('*', '/x')";
    let cold = requests(&session, &store, messages, 10 * RUNS).await;
    assert!(cold.len() <= 3 * RUNS && cold.iter().all(|r| r.starts_with("GET")), "{cold:?}");
    let warm = requests(&session, &store, messages, 10 * RUNS).await;
    assert!(warm.len() <= RUNS, "chunks alone: {warm:?}");
    // Of a file that is no run of the lake nothing is known.
    lake.store().put(&Path::from("inbox/y.mcap"), run_file().into()).await.expect("written");
    let foreign = requests(&session, &store, "select x from mcap('inbox/y.mcap', '/x')", 10).await;
    assert!(foreign.iter().any(|request| request == "HEAD inbox/y.mcap"), "{foreign:?}");
}
