//! Rows that are in a lake are derived again only if a revision is raised: these tests fail if the numbers of rows
//! change and their revision does not.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _};
use arrow::compute::concat_batches;
use arrow::datatypes::{DataType, Float32Type, Float64Type};
use bytes::Bytes;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::messages::SweepRecording;
use echolake_schema::samples::decode_samples;
use echolake_schema::tables::{Source, Table, UNIT};
use echolake_schema::{RunId, topics};
use echolake_testing::{NumberLine, RevisionFixture, read_attachment, read_messages, simulate_run};
use object_store::memory::InMemory;

use crate::crash_tests::{ingest_pending, open_lake, with_inbox};
use crate::ingest::RESPONSES_REVISION;
use crate::read_back;
use crate::references::ROWS_REVISION;

/// The surface whose rows are compared: a relief, so that no number follows from another.
const RELIEF: &str = "stretcher_bond";
/// Difference that is no change in a column with a unit: errors of arrivals and clocks are near 0.
const UNIT_TOLERANCE: f64 = 1e-3;

fn simulate_surfaces(folder: &Path, surfaces: &[&str], keep: RecordingMode) -> Vec<PathBuf> {
    let simulate = |(number, surface): (usize, &&str)| simulate_run(folder, number, surface, surface, keep);
    surfaces.iter().enumerate().map(simulate).collect()
}

/// A lake that these runs were ingested into.
async fn ingest_files(files: &[PathBuf]) -> (Lake, LakeSnapshot) {
    let read = |path: &PathBuf| {
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        (name, Bytes::from(std::fs::read(path).expect("read")))
    };
    let runs: Vec<_> = files.iter().map(read).collect();
    let store: Arc<InMemory> = with_inbox(&runs).await;
    ingest_pending(store.clone()).await.expect("ingested");
    let lake = open_lake(store).await.expect("a lake");
    let snapshot = lake.snapshot().await.expect("a snapshot");
    (lake, snapshot)
}

fn run_of_file(file: &Path) -> RunId {
    file.file_stem().expect("a name").to_string_lossy().parse().expect("a run's name")
}

/// Numbers of all columns of floats of a run's rows in a table.
async fn table_numbers(lake: &Lake, snapshot: &LakeSnapshot, table: Table, run: &RunId) -> Vec<NumberLine> {
    let schema = table.schema(lake.rig());
    let mut batches = Vec::new();
    for file in snapshot.files_of(table, run) {
        batches.extend(read_back::rows_of_run(lake, table, file, run, &[]).await.expect("readable"));
    }
    let rows = concat_batches(&schema, &batches).expect("rows of one table");
    assert!(rows.num_rows() > 0, "{}", table.name());
    let summarise = |(at, column): (usize, &ArrayRef)| {
        let field = schema.field(at);
        let is_pure = matches!(field.metadata()[UNIT].as_str(), "1" | "ms" | "1/ms");
        let least_tolerance = if is_pure { 0.0 } else { UNIT_TOLERANCE };
        let name = format!("{}.{}", table.name(), field.name());
        column_floats(column).map(|values| NumberLine::summarise_values(name, &values, least_tolerance))
    };
    rows.columns().iter().enumerate().filter_map(summarise).collect()
}

// None for columns of other types.
fn column_floats(column: &ArrayRef) -> Option<Vec<f64>> {
    match column.data_type() {
        DataType::Float64 => Some(column.as_primitive::<Float64Type>().iter().flatten().collect()),
        DataType::Float32 => Some(column.as_primitive::<Float32Type>().iter().flatten().map(f64::from).collect()),
        DataType::List(_) => column_floats(column.as_list::<i32>().values()),
        _ => None,
    }
}

fn microphone_samples(sweep: &SweepRecording) -> Vec<f64> {
    let mut samples = vec![0.0; sweep.sample_count as usize];
    decode_samples(sweep.format(), &sweep.microphone, &mut samples).expect("samples");
    samples.into_iter().map(f64::from).collect()
}

fn summarise_samples(name: &str, samples: &[f64]) -> NumberLine {
    NumberLine::summarise_values(name, samples, 0.0).into_input()
}

/// E33: responses, and what else follows from a run alone, of sweeps whose samples the fixture has, too.
#[tokio::test(flavor = "multi_thread")]
async fn changed_responses_need_a_raised_revision() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = simulate_surfaces(folder.path(), &[RELIEF], RecordingMode::Sweeps);
    let [file] = &files[..] else { panic!("{files:?}") };
    let sweeps: Vec<SweepRecording> = read_messages(file, topics::SWEEP);
    let samples: Vec<f64> = sweeps.iter().flat_map(microphone_samples).collect();
    let heights = read_attachment(file, topics::HEIGHTS_ATTACHMENT);
    let heights: Vec<f64> = heights.as_chunks().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect();
    let mut numbers = vec![summarise_samples("sweeps", &samples), summarise_samples("heights", &heights)];
    let (lake, snapshot) = ingest_files(&files).await;
    let run = run_of_file(file);
    for table in Table::ALL.into_iter().filter(|table| table.source() == Source::Run && *table != Table::Events) {
        numbers.extend(table_numbers(&lake, &snapshot, table, &run).await);
    }
    let fixture = RevisionFixture {
        path: "tests/fixtures/responses.txt",
        constant: "RESPONSES_REVISION",
        revision: RESPONSES_REVISION.parse().expect("a number"),
        test: "changed_responses_need_a_raised_revision",
    };
    fixture.check_numbers(&numbers);
}

/// E33: rows that follow from references. If responses change, these rows are derived again with them, so those of all
/// three runs are what the numbers are computed from.
#[tokio::test(flavor = "multi_thread")]
async fn changed_rows_need_a_raised_revision() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = simulate_surfaces(folder.path(), &["flat", "foam", RELIEF], RecordingMode::ResponsesOnly);
    let (lake, snapshot) = ingest_files(&files).await;
    let runs: Vec<RunId> = files.iter().map(|file| run_of_file(file)).collect();
    let mut numbers = Vec::new();
    for run in &runs {
        let responses = read_back::read_responses(&lake, &snapshot, run).await.expect("responses");
        let samples: Vec<f64> = responses.irs.iter().map(|sample| f64::from(*sample)).collect();
        numbers.push(summarise_samples(run.surface_name(), &samples));
    }
    let relief = runs.last().expect("three runs");
    for table in Table::ALL.into_iter().filter(|table| table.source() == Source::References) {
        numbers.extend(table_numbers(&lake, &snapshot, table, relief).await);
    }
    let fixture = RevisionFixture {
        path: "tests/fixtures/rows.txt",
        constant: "ROWS_REVISION",
        revision: ROWS_REVISION.parse().expect("a number"),
        test: "changed_rows_need_a_raised_revision",
    };
    fixture.check_numbers(&numbers);
}
