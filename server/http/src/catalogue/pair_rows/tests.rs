//! Rows of pairs are those that SQL answers, whoever reads and however files lie.

use std::sync::atomic::AtomicBool;

use arrow::array::{Float32Array, Float64Array, Int32Array, Int64Array, ListArray, StringArray};
use arrow::buffer::{NullBuffer, OffsetBuffer};
use arrow::datatypes::Field;
use arrow::util::pretty::pretty_format_batches;
use echolake_lake::{
    ContributedFile, FileName, Lake, ReferenceSurfaces, RunRowCounts, VisibleRun, annotation_rows, encode_batches,
};
use echolake_query::{EngineClient, Error as QueryError, QueryEngine, QueryQuota};
use echolake_schema::Rig;
use echolake_schema::annotations::{Annotation, AnnotationKind};
use serde::Deserialize;

use super::super::environment::AirSeries;
use super::*;

/// Samples of a response.
const SAMPLES: usize = 40;
/// Tables with rows of each run; the last one names them.
const TABLES: [Table; 7] =
    [Table::Surfaces, Table::Measurements, Table::Nce, Table::Tnce, Table::Events, Table::Environment, Table::Runs];

/// A run of the tests' lake. Its surface's name begins with its project's, if it has one.
struct TestRun {
    surface: &'static str,
    run: &'static str,
    /// Distinguishes the values of runs.
    seed: usize,
    pairs: Vec<i32>,
}

fn test_run(surface: &'static str, run: &'static str, seed: usize, pairs: impl IntoIterator<Item = i32>) -> TestRun {
    TestRun { surface, run, seed, pairs: pairs.into_iter().collect() }
}

impl TestRun {
    fn row_count(&self, table: Table) -> usize {
        match table {
            Table::Runs | Table::Surfaces => 1,
            Table::Events => 900,
            Table::Environment => 3000,
            _ => self.pairs.len(),
        }
    }

    // Between -1 and 1; some values are -0.
    fn number(&self, row: usize, column: usize) -> f64 {
        let mixed = (row * 7919 + column * 104_729 + self.seed * 1_299_709) % 100_003;
        if mixed.is_multiple_of(17) { -0.0 } else { mixed as f64 / 50_001.5 - 1.0 }
    }

    fn column(&self, table: Table, place: usize, field: &Field) -> ArrayRef {
        let rows = self.row_count(table);
        let known = |row: usize| !field.is_nullable() || !row.is_multiple_of(5);
        let texts = |text: &dyn Fn(usize) -> String| -> ArrayRef {
            Arc::new((0..rows).map(|row| known(row).then(|| text(row))).collect::<StringArray>())
        };
        match (field.name().as_str(), field.data_type()) {
            ("surface_id", _) => Arc::new(StringArray::from(vec![self.surface; rows])),
            ("flat_reference", _) => Arc::new(StringArray::from(vec!["flat"; rows])),
            ("run_id", _) => Arc::new(StringArray::from(vec![self.run; rows])),
            ("pair_id", _) => Arc::new(Int32Array::from(self.pairs.clone())),
            ("project", _) => {
                let project = self.surface.split_once('-').map(|(project, _)| project);
                Arc::new(StringArray::from(vec![project; rows]))
            }
            ("message", _) => texts(&|row| match row % 3 {
                0 => format!("pair {}, attempt {row}", row % 31),
                1 => format!("Pair {}, attempt {row}", row % 31),
                _ => format!("the pair {}", row % 31),
            }),
            // Seconds, in no order; each time is there once.
            ("log_time_ns", _) => {
                Arc::new((0..rows as i64).map(|row| row * 7919 % rows as i64 * 1_000_000_000).collect::<Int64Array>())
            }
            (name, DataType::Utf8) => texts(&|row| format!("{name} {row}")),
            (_, DataType::List(child)) => {
                let values = (0..rows * SAMPLES).map(|i| self.number(i, place) as f32).collect::<Float32Array>();
                let nulls = NullBuffer::from_iter((0..rows).map(known));
                let offsets = OffsetBuffer::from_lengths(vec![SAMPLES; rows]);
                Arc::new(ListArray::new(child.clone(), offsets, Arc::new(values), Some(nulls)))
            }
            (_, kind) if kind.is_floating() => {
                let numbers = (0..rows).map(|row| known(row).then(|| self.number(row, place)));
                cast(&numbers.collect::<Float64Array>(), kind).expect("numbers")
            }
            (_, kind) => {
                let numbers = (0..rows as i64).map(|row| known(row as usize).then_some(row));
                let numbers: ArrayRef = match kind {
                    DataType::Boolean => Arc::new(numbers.map(|_| Some(true)).collect::<arrow::array::BooleanArray>()),
                    _ => Arc::new(numbers.collect::<Int64Array>()),
                };
                cast(&numbers, kind).expect("numbers")
            }
        }
    }

    /// Adds the run to a lake, as ingest does.
    async fn put(&self, lake: &Lake) {
        let pointer = VisibleRun {
            surface: self.surface.parse().expect("an id"),
            run: self.run.parse().expect("an id"),
            run_derivation: "ab".into(),
            reference_derivation: Some("ab".into()),
            verdicts: None,
        };
        let rows =
            FileName::Rows { surface: pointer.surface.clone(), run: pointer.run.clone(), derivation: "ab".into() };
        let mut staged = Vec::new();
        for table in TABLES {
            let schema = table.schema(lake.rig());
            let columns = schema.fields().iter().enumerate().map(|(place, field)| self.column(table, place, field));
            let batch = RecordBatch::try_new(schema.clone(), columns.collect()).expect("rows");
            let file = encode_batches(table, &schema, &[batch]).expect("encoded");
            let name = if table == Table::Runs { FileName::Pointer(pointer.clone()) } else { rows.clone() };
            let file = lake.stage_file(table, &name, file).await.expect("staged");
            let is_last = table == Table::Runs;
            staged.push(if is_last { file.with_row_counts(RunRowCounts::default(), &staged) } else { file });
        }
        lake.commit_staged(&staged).await.expect("committed");
    }
}

async fn reject(lake: &Lake, run: &str, pairs: Option<Vec<u32>>) {
    let annotation = Annotation {
        annotation_id: format!("verdict-on-{run}"),
        run_id: run.parse().expect("an id"),
        pair_ids: pairs,
        kind: AnnotationKind::Verdict,
        value: "rejected".to_owned(),
        comment: "because".to_owned(),
        author: "ann".to_owned(),
        time: std::time::SystemTime::UNIX_EPOCH.into(),
        lake_version: None,
    };
    lake.prepare_contributions(Table::Annotations).await.expect("prepared");
    let snapshot = lake.snapshot().await.expect("a view");
    let seen = snapshot.log_version(Table::Annotations).expect("a log");
    let rows = annotation_rows(lake, &snapshot, &[annotation]).expect("rows");
    let files = ContributedFile::encode_rows(lake, Table::Annotations, &rows).expect("files");
    lake.add_contribution(Table::Annotations, seen, files).await.expect("added").expect("the newest");
}

/// A lake with several runs of a surface, a rejected pair and a rejected run, and surfaces of two projects.
async fn test_lake() -> (tempfile::TempDir, Lake) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    for run in [
        test_run("flat", "r1", 1, 0..2951),
        test_run("wall", "r2", 2, 0..300),
        test_run("wall", "r3", 3, (0..300).filter(|pair| pair % 4 > 0)),
        test_run("ours-hall", "r4", 4, 100..200),
        test_run("theirs-hall", "r5", 5, 0..2951),
    ] {
        run.put(&lake).await;
    }
    reject(&lake, "r2", Some(vec![7])).await;
    reject(&lake, "r4", None).await;
    (folder, lake)
}

/// A reader of a lake, with what it sees.
struct TestReader {
    session: Arc<Session>,
    snapshot: Arc<LakeSnapshot>,
    rig: Rig,
}

#[derive(Deserialize)]
struct SqlResponses {
    surface_id: String,
    reflected: Option<Vec<f32>>,
    pairs: i64,
    bands: Vec<Option<Vec<f32>>>,
}

#[derive(Deserialize)]
struct SqlEnergies {
    pair_id: i32,
    values: Vec<Option<f64>>,
}

impl TestReader {
    async fn new(lake: &Lake) -> Self {
        let engine = QueryEngine::new(lake, None).expect("an engine");
        let session = Arc::new(engine.open_session(&Arc::new(EngineClient::new("reader", QueryQuota::default()))));
        let snapshot = session.current_snapshot().await.expect("a snapshot");
        Self { session, snapshot, rig: lake.rig().clone() }
    }

    fn rows_of(&self, surface: &str, pair: i32) -> PairRows {
        let (surface, flat) = (surface.to_owned(), "flat".to_owned());
        PairRows { session: self.session.clone(), snapshot: self.snapshot.clone(), surface, flat, pair }
    }

    async fn answer(&self, sql: &str) -> Result<Vec<RecordBatch>, QueryError> {
        let mut answer = self.session.query(sql).await?;
        let mut batches = vec![RecordBatch::new_empty(answer.schema.clone())];
        while let Some(batch) = answer.next().await? {
            batches.push(batch);
        }
        Ok(batches)
    }

    async fn decoded<T: DeserializeOwned>(&self, sql: &str) -> Vec<T> {
        let batches = self.answer(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        let decoded = batches.iter().map(|batch| decode_rows(sql, batch).expect(sql));
        decoded.flatten().collect::<Vec<T>>()
    }

    /// Compares what a page shows of a pair with the answers of SQL.
    async fn check_pair(&self, surface: &str, pair: i32) {
        let what = format!("pair {pair} of {surface}");
        let rows = self.rows_of(surface, pair);
        let columns = MEASUREMENT.join(", ");
        let sql = format!(
            "select {columns} from measurements where surface_id = '{surface}' and pair_id = {pair} \
             order by run_id desc limit 1"
        );
        let expected: Option<PairMeasurement> = self.decoded(&sql).await.pop();
        let found = rows.read_measurement().await.expect("a measurement");
        let json = |measurement: &Option<PairMeasurement>| serde_json::to_string(measurement).expect("JSON");
        assert_eq!(json(&found), json(&expected), "{what}");
        let bits = |samples: &[f32]| samples.iter().map(|sample| sample.to_bits()).collect::<Vec<_>>();
        let samples = expected.as_ref().map(|measurement| bits(&measurement.ir));
        assert_eq!(found.as_ref().map(|measurement| bits(&measurement.ir)), samples, "{what}");
        assert_eq!(rows.read_measured().await.expect("samples").as_deref().map(bits), samples, "{what}");

        let bands = self.rig.band_names();
        let curves: Vec<_> = bands.iter().map(|band| format!("nce_{band}")).collect();
        let means: Vec<_> = curves.iter().map(|column| format!("avg_list({column})")).collect();
        let sql = format!(
            "select surface_id, avg_list(reflected_ir) as reflected, count(*) as pairs, make_array({}) as bands \
             from nce where surface_id in ('{surface}', 'flat') and pair_id = {pair} group by surface_id",
            means.join(", ")
        );
        let expected: Vec<SqlResponses> = self.decoded(&sql).await;
        let found = rows.read_responses(&curves).await.expect("responses");
        let own = rows.read_own_reflected().await.expect("a response");
        assert_eq!(own.is_some(), samples.is_some(), "{what}");
        if let Some(own) = own {
            assert_eq!(own, found[0].as_ref().and_then(|found| found.reflected.clone()), "{what}");
        }
        for (name, found) in [surface, "flat"].into_iter().zip(found) {
            let expected = expected.iter().find(|row| row.surface_id == name);
            let bits_of = |lists: &[Option<Vec<f32>>]| -> Vec<_> {
                lists.iter().map(|samples| samples.as_deref().map(bits)).collect()
            };
            let expected =
                expected.map(|row| (bits_of(std::slice::from_ref(&row.reflected)), row.pairs, bits_of(&row.bands)));
            let found = found.map(|row| (bits_of(&[row.reflected]), row.pairs, bits_of(&row.bands)));
            assert_eq!(found, expected, "{what}, {name}");
        }

        let Some(measurement) = rows.read_measurement().await.expect("a measurement") else { return };
        let run_text = serde_json::to_value(&measurement).expect("JSON")["run_id"].as_str().expect("a run").to_owned();
        let run: RunId = run_text.parse().expect("an id");
        let pairs = [pair, pair + 1, 290, 9_999];
        let columns: Vec<_> = bands.iter().flat_map(|b| [format!("tnce_{b}"), format!("tnce_{b}_u_db")]).collect();
        let cast_columns: Vec<_> = columns.iter().map(|column| format!("cast({column} as double)")).collect();
        let sql = format!(
            "select pair_id, make_array({}) as values from tnce where surface_id = '{surface}' and run_id = '{run}' \
             and pair_id in ({pair}, {}, 290, 9999)",
            cast_columns.join(", "),
            pair + 1
        );
        let expected: Vec<SqlEnergies> = self.decoded(&sql).await;
        let found = rows.read_energies(&run, &pairs, [&columns, &columns[..1], &[], &[]]).await.expect("energies");
        for pair in pairs {
            let expected = expected.iter().find(|row| row.pair_id == pair);
            assert_eq!(found.has_pair(pair), expected.is_some(), "{what}, {pair}");
            let none = vec![None; columns.len()];
            let values = found.find_values(pair, &columns).expect("values");
            assert_eq!(values, expected.map_or(none, |row| row.values.clone()), "{what}, {pair}");
        }

        let sql = format!(
            "select log_time, level, name, message from events where run_id = '{run}' and message like 'pair {pair},%' \
             order by log_time_ns limit 200"
        );
        let expected: Vec<RunLogEntry> = self.decoded(&sql).await;
        let found = rows.read_attempts(&run).await.expect("attempts");
        let json = |entries: &[RunLogEntry]| serde_json::to_string(entries).expect("JSON");
        assert_eq!(json(&found), json(&expected), "{what}");

        for (first, last) in [(0, 2_990_000_000_000), (5_000_000_000, 90_000_000_000), (-9, -7)] {
            let sql = format!(
                "select log_time_ns as ns, temperature_c, humidity_pct, pressure_hpa, outside_level_db \
                 from environment where run_id = '{run}' and log_time_ns between {first} and {last} \
                 order by log_time_ns limit 2000"
            );
            let expected: Vec<AirReading> = self.decoded(&sql).await;
            let found = rows.read_air(&run, first, last).await.expect("readings");
            let json = |rows| serde_json::to_string(&AirSeries::new(rows, 0, "")).expect("JSON");
            assert_eq!(json(found), json(expected), "{what}");
        }
    }

    /// Compares rows of some runs, also of those that the reader does not see.
    async fn check_rows(&self, table: Table, columns: &str) {
        let runs: Vec<RunId> = ["r5", "r3", "r2", "r4", "r1", "r9"].map(|run| run.parse().expect("an id")).into();
        let names: Vec<_> = columns.split(", ").collect();
        for pairs in [vec![7], vec![150, 3, 299, 2950], vec![9_999]] {
            let sql = format!(
                "select {columns} from {} where run_id in ('r5', 'r3', 'r2', 'r4', 'r1', 'r9') and pair_id in ({})",
                table.name(),
                pairs.iter().map(i32::to_string).collect::<Vec<_>>().join(", ")
            );
            let expected = self.answer(&sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
            for reading in [RowReading::Places, RowReading::Kept] {
                let found = self.session.read_pair_rows(&self.snapshot, table, &runs, &pairs, &names, reading).await;
                assert_eq!(sorted_lines(&[found.expect("rows")]), sorted_lines(&expected), "{sql}, {reading:?}");
            }
        }
    }

    async fn check_all(&self) {
        for surface in ["flat", "wall", "ours-hall", "theirs-hall", "nowhere"] {
            for pair in [0, 3, 7, 150, 299, 2950] {
                self.check_pair(surface, pair).await;
            }
        }
        self.check_rows(Table::Measurements, "run_id, pair_id, surface_id, snr_db, ir, log_time, chunk_offset").await;
        self.check_rows(Table::Nce, "reflected_ir, run_id").await;
        self.check_rows(Table::Tnce, "tnce_2500, pair_id, run_id, flat_version, tnce_total_u_db").await;
    }

    fn seen_runs(&self) -> Vec<String> {
        self.snapshot.runs().map(|run| run.run.to_string()).collect()
    }
}

fn sorted_lines(batches: &[RecordBatch]) -> Vec<String> {
    let text = pretty_format_batches(batches).expect("a table").to_string();
    let mut lines: Vec<_> = text.lines().filter(|line| line.starts_with('|')).map(str::to_owned).collect();
    lines.sort();
    lines
}

#[tokio::test(flavor = "multi_thread")]
async fn rows_of_pairs_are_those_that_sql_answers() {
    let (_folder, lake) = test_lake().await;
    for layout in ["a file for each run", "merged files", "merged files, of which some rows are replaced"] {
        match layout {
            "merged files" => {
                lake.optimize(128 << 20, &AtomicBool::new(false), &mut |_| {}).await.expect("merged");
            }
            "merged files, of which some rows are replaced" => {
                test_run("wall", "r6", 6, 3..9).put(&lake).await;
                test_run("theirs-hall", "r7", 7, 5..8).put(&lake).await;
            }
            _ => {}
        }
        let restricted = lake.restricted_to(["ours".parse().expect("a name")].into());
        let [all, ours] = [TestReader::new(&lake).await, TestReader::new(&restricted).await];
        assert!(!ours.seen_runs().contains(&"r5".to_owned()), "{layout}");
        assert!(all.seen_runs().len() > ours.seen_runs().len(), "{layout}");
        all.check_all().await;
        ours.check_all().await;
        let hidden = ours.rows_of("theirs-hall", 7).read_measurement().await.expect("no fault");
        assert!(hidden.is_none(), "{layout}");
        for (reader, surface) in [(&all, "theirs-hall"), (&ours, "ours-hall"), (&ours, "flat")] {
            let seen = reader.rows_of(surface, 150).read_measurement().await.expect("no fault");
            assert!(seen.is_some(), "{layout}, {surface}");
        }
    }
}

// What is lost is refused in the same words.
#[tokio::test]
async fn a_table_with_a_fault_is_refused_as_sql_refuses_it() {
    let (folder, lake) = test_lake().await;
    let tables = folder.path().join("lake/tables");
    std::fs::remove_dir_all(tables.join("nce")).expect("removed");
    std::fs::remove_dir_all(tables.join("environment/_delta_log")).expect("removed");
    let names =
        |table: &str| std::fs::read_dir(tables.join(table)).expect("a folder").map(|entry| entry.expect("one").path());
    for file in names("tnce").filter(|path| path.extension().is_some_and(|ending| ending == "parquet")) {
        std::fs::remove_file(file).expect("removed");
    }
    for file in names("events").filter(|path| path.extension().is_some_and(|ending| ending == "parquet")) {
        let bytes = std::fs::read(&file).expect("a file");
        std::fs::write(&file, &bytes[..bytes.len() / 2]).expect("written");
    }
    let restricted = lake.restricted_to(["ours".parse().expect("a name")].into());
    for (lake, surface, run, pair) in [(&lake, "wall", "r3", 7), (&restricted, "ours-hall", "r4", 150)] {
        let reader = TestReader::new(lake).await;
        let rows = reader.rows_of(surface, pair);
        let id: RunId = run.parse().expect("an id");
        let energy = ["tnce_total".to_owned()];
        let found = [
            rows.read_responses(&[]).await.err(),
            rows.read_own_reflected().await.err(),
            rows.read_energies(&id, &[pair], [&energy, &[], &[], &[]]).await.err(),
            rows.read_attempts(&id).await.err(),
            rows.read_air(&id, 0, 1).await.err(),
        ];
        let pair_of = |surface: &str| format!("surface_id = '{surface}' and pair_id = {pair}");
        let queries = [
            format!("select avg_list(reflected_ir) from nce where {}", pair_of(surface)),
            format!("select reflected_ir from nce where {}", pair_of(surface)),
            format!("select pair_id, tnce_total from tnce where {} and run_id = '{run}'", pair_of(surface)),
            format!("select message from events where run_id = '{run}' and message like 'pair {pair},%'"),
            format!("select temperature_c from environment where run_id = '{run}' and log_time_ns between 0 and 1"),
        ];
        for (found, sql) in found.into_iter().zip(&queries) {
            let expected = reader.answer(sql).await.expect_err(sql);
            let found = found.unwrap_or_else(|| panic!("{sql}: {expected}"));
            let expected = RequestFault::from(expected);
            assert_eq!((found.code(), found.to_string()), (expected.code(), expected.to_string()), "{sql}");
        }
        assert!(rows.read_measurement().await.expect("no fault").is_some());
    }
}
