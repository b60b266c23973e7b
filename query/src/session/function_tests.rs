//! Every function through SQL on a small lake: its example, golden cases, laws that must hold, and hostile input.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, BooleanArray, Float64Array, StringArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Float32Type, Float64Type, Int64Type};
use arrow::record_batch::RecordBatch;
use arrow::util::display::{ArrayFormatter, FormatOptions};
use arrow::util::pretty::pretty_format_batches;
use bytes::Bytes;
use echolake_functions::FunctionSet;
use echolake_lake::{FileName, Lake, ReferenceSurfaces, VisibleRun, encode_batches};
use echolake_schema::splits::{SplitParams, SplitSurface, assign_parts};
use echolake_schema::tables::Table;
use echolake_schema::{Rig, SurfaceId, Symmetry};
use expect_test::expect;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use crate::{Error, Session};

const LEN: usize = 384;
const BANDS: [&str; 5] = ["2500", "5000", "10000", "20000", "40000"];

/// Returns the rows of a batch as texts.
pub(crate) fn row_lines(batch: &RecordBatch, separator: &str) -> Vec<String> {
    let options = FormatOptions::default().with_null("null");
    let columns: Vec<_> =
        batch.columns().iter().map(|c| ArrayFormatter::try_new(c, &options).expect("printable")).collect();
    let line = |row| columns.iter().map(|c| c.value(row).to_string()).collect::<Vec<_>>().join(separator);
    (0..batch.num_rows()).map(line).collect()
}

/// Returns the rows of an answer, sorted, with `|` between columns.
///
/// # Errors
/// Those of the query.
pub(crate) async fn answer_lines(session: &Session, sql: &str) -> Result<Vec<String>, Error> {
    let mut answer = session.query(sql).await?;
    let mut lines = Vec::new();
    while let Some(batch) = answer.next().await? {
        lines.extend(row_lines(&batch, "|"));
    }
    lines.sort();
    Ok(lines)
}

/// A lake with two runs in it, made of the golden cases: surface `0015_0`, and its Flat.
pub(crate) struct SmallLake {
    _folder: tempfile::TempDir,
    pub lake: Lake,
    session: Session,
    golden: Vec<RecordBatch>,
}

impl SmallLake {
    pub async fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let golden = golden();
        put(&lake, "0015_0", &golden, "panel_ir", "reflected_ir").await;
        put(&lake, "flat", &golden, "flat_ir", "flat_reflected_ir").await;
        let session = Session::new(&lake).expect("a session");
        Self { _folder: folder, lake, session, golden }
    }

    pub async fn batches(&self, sql: &str) -> Result<Vec<RecordBatch>, Error> {
        let mut answer = self.session.query(sql).await?;
        let mut batches = vec![RecordBatch::new_empty(answer.schema.clone())];
        while let Some(batch) = answer.next().await? {
            batches.push(batch);
        }
        Ok(batches)
    }

    async fn rows(&self, sql: &str) -> RecordBatch {
        let batches = self.batches(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        arrow::compute::concat_batches(&batches[0].schema(), &batches).expect("one schema")
    }

    /// Returns the numbers of the first column, lists concatenated; NaN for null.
    async fn numbers(&self, sql: &str) -> Vec<f64> {
        let column = self.rows(sql).await.column(0).clone();
        let flat = match column.as_list_opt::<i32>() {
            Some(lists) => lists.values().slice(lists.value_offsets()[0] as usize, lists.values().len()),
            None => column,
        };
        let flat = cast(&flat, &DataType::Float64).expect("numbers");
        let flat = flat.as_primitive::<Float64Type>();
        (0..flat.len()).map(|i| if flat.is_null(i) { f64::NAN } else { flat.value(i) }).collect()
    }

    async fn number(&self, sql: &str) -> f64 {
        let numbers = self.numbers(sql).await;
        assert_eq!(numbers.len(), 1, "{sql}: {numbers:?}");
        numbers[0]
    }

    async fn refusal(&self, sql: &str) -> String {
        match self.batches(sql).await {
            Ok(batches) => format!("answered {}", pretty_format_batches(&batches).expect("a table")),
            Err(error) => error.to_string(),
        }
    }

    fn golden(&self, name: &str) -> Vec<f64> {
        let lists = self.golden.iter().map(|b| b.column_by_name(name).unwrap_or_else(|| panic!("no {name}")).clone());
        lists.flat_map(|column| numbers_of(&column)).collect()
    }
}

fn numbers_of(column: &ArrayRef) -> Vec<f64> {
    let values = column.as_list_opt::<i32>().map_or_else(|| column.clone(), |l| l.values().clone());
    values.as_primitive::<Float64Type>().values().to_vec()
}

fn golden() -> Vec<RecordBatch> {
    let bytes = Bytes::from(std::fs::read("../tests/fixtures/golden.parquet").expect("the fixture is committed"));
    let reader = ParquetRecordBatchReaderBuilder::try_new(bytes).expect("a Parquet file").build().expect("a reader");
    reader.map(|batch| batch.expect("a batch")).collect()
}

/// Adds a run whose measurements are the golden cases, starting at pair 0.
async fn put(lake: &Lake, surface: &str, golden: &[RecordBatch], ir: &str, reflected: &str) {
    let pointer = VisibleRun {
        surface: surface.parse().expect("an id"),
        run: format!("r-{surface}").parse().expect("an id"),
        run_derivation: "a".into(),
        reference_derivation: Some("b".into()),
        verdicts: None,
    };
    let part = |derivation: &str| FileName::Rows {
        surface: pointer.surface.clone(),
        run: pointer.run.clone(),
        derivation: derivation.to_owned(),
    };
    let lists = |name: &str| -> ArrayRef {
        let all = golden.iter().map(|b| b.column_by_name(name).expect("a column").clone()).collect::<Vec<_>>();
        arrow::compute::concat(&all.iter().map(AsRef::as_ref).collect::<Vec<_>>()).expect("lists")
    };
    let pairs = lists(ir).len();
    let tables = [
        (Table::Measurements, part("a"), pairs),
        (Table::Nce, part("b"), pairs),
        (Table::Tnce, part("b"), pairs),
        (Table::Runs, FileName::Pointer(pointer.clone()), 1),
    ];
    let mut staged = Vec::new();
    for (table, name, count) in tables {
        let schema = table.schema(lake.rig());
        let column = |field: &Arc<Field>| -> ArrayRef {
            let numbers = || Float64Array::from_iter_values((0..count).map(|i| i as f64));
            match (field.name().as_str(), field.data_type()) {
                ("surface_id", _) => Arc::new(StringArray::from(vec![surface; count])),
                ("run_id", _) => Arc::new(StringArray::from(vec![pointer.run.as_str(); count])),
                ("ir", kind) => cast(&lists(ir), kind).expect("f32"),
                ("reflected_ir", kind) => cast(&lists(reflected), kind).expect("f32"),
                (name, kind @ DataType::List(_)) if name.starts_with("nce_") => {
                    cast(&lists(reflected), kind).expect("f32")
                }
                (name, DataType::Float64) if BANDS.iter().any(|band| name == format!("energy_{band}")) => {
                    let band = BANDS.iter().position(|band| name.ends_with(&format!("_{band}"))).expect("a band");
                    Arc::new(energies(golden, reflected, band))
                }
                (_, DataType::Utf8) => Arc::new(StringArray::from(vec!["x"; count])),
                (_, DataType::Boolean) => Arc::new(BooleanArray::from(vec![false; count])),
                (_, kind) => cast(&numbers(), kind).expect("numbers"),
            }
        };
        let batch = RecordBatch::try_new(schema.clone(), schema.fields().iter().map(column).collect()).expect("rows");
        let file = encode_batches(table, &schema, &[batch]).expect("encoded");
        staged.push(lake.stage_file(table, &name, file).await.expect("staged"));
    }
    let row = staged.pop().expect("the run's row").with_replaced_rows(&pointer, &[]);
    staged.push(row);
    lake.commit_staged(&staged).await.expect("committed");
}

/// Energy of each case in a band, from the golden bands of the panel; for Flat, which has none, the total energy.
fn energies(golden: &[RecordBatch], reflected: &str, band: usize) -> Float64Array {
    let name = if reflected == "reflected_ir" { "bands" } else { reflected };
    let cases = golden.iter().flat_map(|b| numbers_of(b.column_by_name(name).expect("a column")));
    let all: Vec<f64> = cases.collect();
    let per_case = if name == "bands" { BANDS.len() * LEN } else { LEN };
    let energy = |case: &[f64]| -> f64 {
        let part = if name == "bands" { &case[band * LEN..][..LEN] } else { case };
        part.iter().map(|x| x * x).sum()
    };
    all.chunks_exact(per_case).map(|case| Some(energy(case))).collect()
}

/// The query and the answer of a documented example.
fn example(documentation: &datafusion::logical_expr::Documentation) -> (String, String) {
    let text = documentation.sql_example.as_deref().expect("an example");
    let text = text.trim_start_matches("```sql\n> ").trim_end_matches("\n```");
    let (query, answer) = text.split_once(";\n").expect("a query and its answer");
    (query.to_owned(), answer.to_owned())
}

/// Returns the documented examples: the function's name, the query and its answer.
pub(crate) fn examples() -> Vec<(String, String, String)> {
    let functions = FunctionSet::all(&Rig::paper()).expect("the built-in rig is valid");
    let scalar = functions.scalar().iter().map(|f| (f.name(), f.documentation()));
    let all = scalar.chain(functions.aggregate().iter().map(|f| (f.name(), f.documentation())));
    let example = |(name, documentation): (&str, Option<&_>)| {
        let (query, answer) = example(documentation.expect("documentation"));
        (name.to_owned(), query, answer)
    };
    all.map(example).collect()
}

#[tokio::test]
async fn examples_answer_what_they_say() {
    let small = SmallLake::new().await;
    let mut wrong = String::new();
    for (name, query, answer) in examples() {
        let given = pretty_format_batches(&[small.rows(&query).await]).expect("a table").to_string();
        if given != answer {
            wrong += &format!("== {name}\n{given}\n");
        }
    }
    assert!(wrong.is_empty(), "examples that answer something else:\n{wrong}");
}

#[tokio::test]
async fn bands_and_curves_are_the_golden_ones() {
    let small = SmallLake::new().await;
    let cases: usize = small.golden.iter().map(RecordBatch::num_rows).sum();
    for (band, name) in BANDS.iter().enumerate() {
        let sql = format!(
            "select nce(p.reflected_ir, list_energy(f.reflected_ir), {name}) from nce p join nce f using (pair_id) \
             where p.surface_id = '0015_0' and f.surface_id = 'flat' order by pair_id"
        );
        let (curves, expected) = (small.numbers(&sql).await, small.golden("nce"));
        for case in 0..cases {
            let ours = &curves[case * LEN..][..LEN];
            let theirs = &expected[(case * BANDS.len() + band) * LEN..][..LEN];
            let off: f64 = ours.iter().zip(theirs).map(|(a, e)| (a - e).powi(2)).sum();
            let size: f64 = theirs.iter().map(|e| e * e).sum();
            assert!((off / size).sqrt() < 1e-3, "{name}, case {case}");
        }
        // The same energies from the transform, and from a struct's field.
        for value in
            [format!("band_energy(reflected_ir, {name})"), format!("band_energy(reflected_ir)['energy_{name}']")]
        {
            let sql = format!(
                "select max(abs({value} / energy_{name} - 1)) from nce join tnce on nce.run_id = tnce.run_id \
                 and nce.pair_id = tnce.pair_id where nce.surface_id = '0015_0'"
            );
            assert!(small.number(&sql).await < 1e-3, "{value}");
        }
    }
    let whole = "select max(abs(band_energy(reflected_ir)['energy_total'] / list_energy(reflected_ir) - 1)) from nce";
    assert!(small.number(whole).await < 1e-6);
    let last = "select max(abs(array_element(nce(reflected_ir, 2), -1) * 2 / list_energy(reflected_ir) - 1)) from nce";
    assert!(small.number(last).await < 1e-6);
}

#[tokio::test]
async fn a_decay_a_spectrum_and_an_arrival_that_are_known() {
    let small = SmallLake::new().await;
    // x = 0.9^n falls by 20 log10(0.9) dB per sample.
    let decay = "select edc(array_agg(power(0.9, n) order by n)) from (select unnest(range(2000)) as n)";
    for (n, level) in small.numbers(decay).await.iter().enumerate().take(500) {
        assert!((level - 20.0 * 0.9f64.log10() * n as f64).abs() < 1e-6, "{n}: {level}");
    }
    let frequencies = small.numbers("select spectrum_frequencies(384)").await;
    assert_eq!((frequencies.len(), frequencies[1], frequencies[192]), (193, 250.0, 48_000.0));
    let impulse = "select spectrum(array_concat(array_repeat(0, 100), [1], array_repeat(0, 283)))";
    assert!(small.numbers(impulse).await.iter().all(|level| level.abs() < 1e-9));
    let late = "select arrival(array_concat(array_repeat(0, 96), [1], array_repeat(0, 287)), 0)";
    assert_eq!(small.number(late).await, 1.0);
    assert!((small.number("select speed_of_sound(20)").await - 343.2).abs() < 0.05);
}

// What is nearest to a measurement, by a constant list and by a column, against plain sums.
#[tokio::test]
async fn distances_of_lists_are_the_plain_ones() {
    let small = SmallLake::new().await;
    let responses = small.golden("reflected_ir");
    let wanted = &responses[2 * LEN..][..LEN];
    let mean = |x: &[f64]| x.iter().sum::<f64>() / LEN as f64;
    let product = |x: &[f64], y: &[f64]| -> f64 { x.iter().zip(y).map(|(a, b)| (a - mean(x)) * (b - mean(y))).sum() };
    let rms = |x: &[f64]| (x.iter().zip(wanted).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / LEN as f64).sqrt();
    let unlike = |x: &[f64]| 1.0 - product(x, wanted) / (product(x, x) * product(wanted, wanted)).sqrt();
    let own = "select reflected_ir from nce where surface_id = '0015_0' and pair_id = 2";
    let check = async |function: &str, expected: Vec<f64>| {
        for (list, from) in [
            (format!("({own})"), "nce n".to_owned()),
            ("o.reflected_ir".to_owned(), format!("nce n cross join ({own}) o")),
        ] {
            let distance = function.replace("LIST", &list);
            let sql = format!("select {distance} as d from {from} where n.surface_id = '0015_0' order by d limit 3");
            let given = small.numbers(&sql).await;
            let close = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-5 * expected[2].abs();
            assert!(given.len() == 3 && given.iter().zip(&expected).all(close), "{sql}: {given:?} {expected:?}");
        }
    };
    let nearest = |distance: &dyn Fn(&[f64]) -> f64| {
        let mut all: Vec<_> = responses.chunks_exact(LEN).map(distance).collect();
        all.sort_by(f64::total_cmp);
        all
    };
    check("rms_difference(n.reflected_ir, LIST)", nearest(&rms)).await;
    check("1 - pearson(n.reflected_ir, LIST)", nearest(&unlike)).await;
}

#[tokio::test]
async fn fresnel_zones_are_those_of_table_pairs() {
    let small = SmallLake::new().await;
    let zone = "fresnel(m.x_mm, m.y_mm, m.z_mm, s.x_mm, s.y_mm, s.z_mm";
    let from = "from pairs p join points m on m.point_id = p.microphone join points s on s.point_id = p.speaker";
    for (hz, least, greatest) in [(2000, 227.6, 535.5), (40000, 47.3, 162.3)] {
        let minor = small.number(&format!("select min({zone}, {hz})['minor_mm']) {from}")).await;
        let major = small.number(&format!("select max({zone}, {hz})['major_mm']) {from}")).await;
        assert!((minor - least).abs() < 0.05 && (major - greatest).abs() < 0.05, "{hz}: {minor} {major}");
        let sql = format!("select max(abs({zone}, {hz}, 343)['major_mm'] - p.fresnel_major_{hz}_mm)) {from}");
        assert!(small.number(&sql).await < 1e-9);
    }
}

#[tokio::test]
async fn symmetries_are_a_group_on_points_pairs_and_maps() {
    let small = SmallLake::new().await;
    let inverse = |symmetry: Symmetry| match symmetry {
        Symmetry::Rot90 => Symmetry::Rot270,
        Symmetry::Rot270 => Symmetry::Rot90,
        other => other,
    };
    for symmetry in Symmetry::ALL {
        let (there, back) = (symmetry.name(), inverse(symmetry).name());
        for sql in [
            format!("select count(*) from points where d4_point(d4_point(point_id, '{there}'), '{back}') <> point_id"),
            format!(
                "select count(*) from pairs where d4_pair(d4_pair(pair_id, '{there}')['pair_id'], '{back}')['pair_id'] \
                    <> pair_id"
            ),
            format!(
                "select count(*) from points p join points q on q.point_id = d4_point(p.point_id, '{there}') \
                 where abs(d4(p.x_mm, p.y_mm, '{there}')['x'] - q.x_mm) + abs(d4(p.x_mm, p.y_mm, '{there}')['y'] - \
                 q.y_mm) > 1e-9"
            ),
        ] {
            assert_eq!(small.number(&sql).await, 0.0, "{sql}");
        }
        let map = format!("select d4_heightmap(d4_heightmap(range(16), '{there}'), '{back}')");
        assert_eq!(small.numbers(&map).await, (0..16).map(f64::from).collect::<Vec<_>>(), "{there}");
    }
    let swapped = small.number("select count(*) from pairs where d4_pair(pair_id, 'rot90')['swapped']").await;
    assert!((164.0..=1050.0).contains(&swapped), "{swapped}");
}

#[tokio::test]
async fn aggregates_are_the_same_however_rows_are_divided() {
    let small = SmallLake::new().await;
    let values =
        "(select n, n % 7 as g, cast((n * 7919) % 1009 as double) as x from (select unnest(range(20000)) as n))";
    let all: Vec<f64> = (0..20_000u32).map(|n| f64::from((n * 7919) % 1009)).collect();
    let expected = echolake_dsp::level::p90_mean(&all, &mut Vec::new()).expect("some");
    let close = |a: f64, b: f64| (a - b).abs() <= 1e-9 * b.abs();
    assert!(close(small.number(&format!("select p90_mean(x) from {values}")).await, expected));
    let one: Vec<f64> = all.iter().copied().enumerate().filter(|(n, _)| n % 7 == 3).map(|(_, x)| x).collect();
    let expected = echolake_dsp::level::p90_mean(&one, &mut Vec::new()).expect("some");
    let sql = format!("select p from (select g, p90_mean(x) as p from {values} group by g) where g = 3");
    assert!(close(small.number(&sql).await, expected));
    let expected =
        echolake_dsp::diffusion::diffusion_of_levels(&one.iter().map(|x| x / 50.0).collect::<Vec<_>>()).expect("some");
    let sql =
        format!("select d from (select g, diffusion_coefficient(x / 50) as d from {values} group by g) where g = 3");
    assert!(close(small.number(&sql).await, expected));
    let list = small.number(&format!("select diffusion(array_agg(x / 50)) from {values} where g = 3")).await;
    assert!(close(list, expected));
    let sql = format!("select a from (select g, avg_list([x, -x, 1]) as a from {values} group by g) where g = 3");
    let mean = one.iter().sum::<f64>() / one.len() as f64;
    let ours = small.numbers(&sql).await;
    assert!(close(ours[0], mean) && close(ours[1], -mean) && ours[2] == 1.0, "{ours:?}");
    // One group per row, filters, and windows.
    assert_eq!(
        small
            .number(&format!(
                "select count(*) from (select n, p90_mean(x) as p, x from {values} group by n, x) where p <> x"
            ))
            .await,
        0.0
    );
    assert_eq!(small.number(&format!("select p90_mean(x) filter (where x = 5) from {values}")).await, 5.0);
    let running = "select avg_list(x) over (order by k) from (values (1, [2]), (2, [4]), (3, [9])) as t(k, x)";
    assert_eq!(small.numbers(running).await, [2.0, 3.0, 5.0]);
    let running = "select p90_mean(x) over (order by k) from (values (1, 2.0), (2, 4.0)) as t(k, x)";
    assert_eq!(small.numbers(running).await, [2.0, 2.0]);
    let none = "select p90_mean(x) from (values (null), ('nan'::double), ('inf'::double)) as t(x)";
    assert!(small.number(none).await.is_nan());
    for empty in ["p90_mean(1.0)", "diffusion_coefficient(1.0)", "avg_list([1])"] {
        let batch = small.rows(&format!("select {empty} from points where point_id < 0")).await;
        assert!(batch.column(0).is_null(0), "{empty}");
    }
}

/// E31: loaders that ask for splits have those of an export, also of a panel whose other side is a reference.
#[tokio::test]
async fn panel_splits_are_those_of_an_export() {
    let small = SmallLake::new().await;
    let sides = (0..120).map(|side| format!("{:04}_{}", side / 2, side % 2)).chain(["flat".to_owned()]);
    let ids: Vec<SurfaceId> = sides.map(|id| id.parse().expect("an id")).collect();
    let is_reference = |id: &SurfaceId| id.as_str() == "flat" || id.as_str().ends_with("5_1");
    for seed in [1, 7, u64::MAX] {
        let surface = |id| SplitSurface { id, typology: "brick", macrostructure: None, is_reference: is_reference(id) };
        let surfaces: Vec<_> = ids.iter().map(surface).collect();
        let parts = assign_parts(&surfaces, SplitParams { seed, ..SplitParams::default() });
        let named = ids.iter().zip(parts).map(|(id, part)| (id.as_str(), part.expect("a part").name()));
        let expected: BTreeMap<_, _> = named.collect();
        let rows: Vec<_> = ids.iter().map(|id| format!("('{id}', {})", is_reference(id))).collect();
        let from = format!("from (values {}) as t(id, is_reference)", rows.join(", "));
        let batch = small.rows(&format!("select panel_splits(id, is_reference, {}) {from}", seed.cast_signed())).await;
        let splits = batch.column(0).as_map();
        let names = splits.keys().as_string::<i32>().iter().flatten();
        let given: BTreeMap<_, _> = names.zip(splits.values().as_string::<i32>().iter().flatten()).collect();
        assert_eq!(given, expected);
        assert_eq!(given.values().collect::<BTreeSet<_>>().len(), 3, "{seed}");
    }
    let none = small.rows("select panel_splits(surface_id, true, 1) from surfaces where false").await;
    assert!(none.column(0).is_null(0));
    let refused =
        [("'../x', false, 1", "is \"../x\""), ("'a', 0, 1", "not a boolean"), ("'a', true, n", "have one seed")];
    for (arguments, told) in refused {
        let refusal = small.refusal(&format!("select panel_splits({arguments}) from (values (1), (2)) as t(n)")).await;
        assert!(refusal.contains(told), "{refusal}");
    }
}

#[tokio::test]
async fn bytes_have_a_length() {
    let small = SmallLake::new().await;
    let lengths = "select [octet_length(b), octet_length('Å'), octet_length(x'010203'), coalesce(octet_length(null), \
                   -1)] from (values (x'0102'), (x'00')) as bytes(b)";
    assert_eq!(small.numbers(lengths).await, [2.0, 2.0, 3.0, -1.0, 1.0, 2.0, 3.0, -1.0]);
}

#[tokio::test]
async fn calls_of_mcap_are_refused_with_a_hint_and_errors_control_no_terminal() {
    let small = SmallLake::new().await;
    let refusal = small.refusal("select * from mcap('wood', '/point')").await;
    assert!(refusal.starts_with("no surface and no run is called `wood`\nhint: it may be a surface"), "{refusal}");
    let refusal = small.refusal("explain select * from mcap('flat', '/point')").await;
    assert!(refusal.starts_with("the query failed: cannot read `runs/flat/r-flat.mcap`"), "{refusal}");
    let refusal = small.refusal("select cast(chr(27) as bigint)").await;
    assert!(refusal.contains("\\u{1b}"), "{refusal}");
}

#[tokio::test]
async fn functions_are_listed() {
    let small = SmallLake::new().await;
    let listed = "select count(distinct routine_name) from information_schema.routines where routine_name in ('edc', \
        'p90_mean')";
    let batch = small.rows(listed).await;
    assert_eq!(batch.column(0).as_primitive::<Int64Type>().value(0), 2);
    let edc = small.rows("select list_rms(ir) as r, edc(ir) as e from measurements where pair_id = 3").await;
    assert_eq!(edc.column(1).as_list::<i32>().values().as_primitive::<Float32Type>().len() % LEN, 0);
}

mod slow {
    use super::*;

    #[tokio::test]
    async fn any_kind_of_list_gives_the_same() {
        let small = SmallLake::new().await;
        for kind in [
            "List(Float32)",
            "List(Float64)",
            "LargeList(Float32)",
            "LargeList(Float64)",
            "List(Int16)",
            "FixedSizeList(4 x Float32)",
            "FixedSizeList(4 x Float64)",
            "LargeList(Int64)",
        ] {
            let list = format!("arrow_cast([1, 2, 3, 6], '{kind}')");
            for (call, expected) in [
                (format!("list_energy({list})"), 50.0),
                (format!("array_sum(list_multiply({list}, {list}))"), 50.0),
                (format!("pearson({list}, [2, 4, 6, 12])"), 1.0),
                (format!("rms_difference({list}, [2, 4, 6, 12])"), 12.5f64.sqrt()),
                (format!("round(similarity({list}, {list}), 5)"), 1.0),
                (format!("array_element(nce({list}, 50), -1)"), 1.0),
                (format!("array_element(edc({list}), 1)"), 0.0),
                (format!("array_element(d4_heightmap({list}, 'rot180'), 1)"), 6.0),
                (format!("round(band_energy({list})['energy_total'], 4)"), 50.0),
                (format!("round(array_element(spectrum({list}), 1), 4)"), (20.0 * 12f64.log10() * 1e4).round() / 1e4),
            ] {
                let given = small.number(&format!("select {call}")).await;
                assert!((given - expected).abs() < 2e-5, "{call}: {given}");
                // As a column, with a null row before it.
                let column = call.replace(&list, "x");
                let rows = format!(
                    "select {column} from (select null as x union all select {list} as x) order by 1 nulls first"
                );
                let given = small.numbers(&rows).await;
                assert!(given[0].is_nan() && (given[1] - expected).abs() < 2e-5, "{column} of {kind}: {given:?}");
            }
        }
        let kept =
            small.rows("select edc(ir) as a, list_multiply(ir, [1]) as b from measurements where pair_id < 0").await;
        let element = |i: usize| match kept.schema().field(i).data_type() {
            DataType::List(child) => child.data_type().clone(),
            other => other.clone(),
        };
        assert_eq!((element(0), element(1)), (DataType::Float32, DataType::Float64));
    }

    #[tokio::test]
    async fn hostile_arguments_are_refused_in_words_or_null() {
        let small = SmallLake::new().await;
        let mut said = String::new();
        for sql in [
            "select edc()",
            "select nce([1])",
            "select edc('x')",
            "select edc(['x'])",
            "select db('loud')",
            "select d4_point(1.5, 'rot90')",
            "select band_energy([1, 2], 3000)",
            "select band_energy([1, 2], 'nan'::double)",
            "select nce([1, 2], 1, 0)",
            "select edc([1, null])",
            "select avg_list(x) from (values ([1]), ([1, null])) as t(x)",
            "select avg_list(x) from (values ([1]), ([1, 2])) as t(x)",
            "select pearson([1, 2], [1])",
            "select rms_difference([1, 2], [1])",
            "select rms_difference([1, null], [1, 2])",
            "select similarity([1, 2], [1])",
            "select list_multiply([1, 2], [1])",
            "select spectrum(['nan'::double])",
            "select band_energy(['inf'::double, 1])",
            "select edc(['nan'::double])",
            "select arrival([1.0, 'inf'::double])",
            "select similarity([1.0], ['nan'::double])",
            "select arrival([1], 3)",
            "select band_filter([1, 2], 2500)",
            "select band_filter([1, 2], 63000, 3)",
            "select room_parameters([1, 2], 1000, 2)",
            "select d4(1, 2, 'rot45')",
            "select d4_point(78, 'rot90')",
            "select d4_pair(-1, 'rot90')",
            "select d4_heightmap([1, 2, 3], 'rot90')",
            "select fresnel(0, 0, -1, 0, 0, 1, 2000)",
            "select fresnel(0, 0, 1, 0, 0, 1, 0)",
            "select speed_of_sound(-300)",
            "select spectrum_frequencies(-1)",
            "select spectrum_frequencies(9223372036854775807)",
            "select spectrum(array_repeat(1, 200000))",
            "select p90_mean(distinct x), p90_mean(distinct y) from (values (1, 2), (2, 3)) as t(x, y)",
            "select p90_mean('x')",
        ] {
            let refusal = small.refusal(sql).await;
            assert!(refusal.contains("hint: "), "{sql}: {refusal}");
            said += &format!("{sql}\n    {refusal}\n");
        }
        expect![[r#"
            select edc()
                `edc`: 0 arguments are given
            hint: edc(ir)
            select nce([1])
                `nce`: 1 argument is given
            hint: nce(ir, flat_energy[, centre_hz])
            select edc('x')
                `edc`: argument 1, `ir`, is Utf8, not a list of numbers
            hint: it is the response
            select edc(['x'])
                `edc`: argument 1, `ir`, is List(Utf8), not a list of numbers
            hint: it is the response
            select db('loud')
                `db`: argument 1, `x`, is Utf8, not a number
            hint: it is ratio of energies, as tnce_total
            select d4_point(1.5, 'rot90')
                `d4_point`: argument 1, `point_id`, is Float64, not a whole number
            hint: it is a point of table points
            select band_energy([1, 2], 3000)
                the query failed: `band_energy`: `centre_hz` is 3000.0 in row 1 of its batch; hint: the lake's bands are at 2500, 5000, 10000, 20000, 40000 Hz
            select band_energy([1, 2], 'nan'::double)
                the query failed: `band_energy`: `centre_hz` is NaN in row 1 of its batch; hint: the lake's bands are at 2500, 5000, 10000, 20000, 40000 Hz
            select nce([1, 2], 1, 0)
                the query failed: `nce`: `centre_hz` is 0.0 in row 1 of its batch; hint: the lake's bands are at 2500, 5000, 10000, 20000, 40000 Hz
            select edc([1, null])
                the query failed: `edc`: element 2 of `ir` is null in row 1 of its batch; hint: array_compact() takes nulls out, or leave such rows out
            select avg_list(x) from (values ([1]), ([1, null])) as t(x)
                the query failed: `avg_list`: element 2 of `list` is null in row 2 of its batch; hint: array_compact() takes nulls out, or leave such rows out
            select avg_list(x) from (values ([1]), ([1, 2])) as t(x)
                the query failed: `avg_list`, row 2 of its batch: a list has 2 samples, expected 1; hint: the lists of a row must be equally long
            select pearson([1, 2], [1])
                the query failed: `pearson`, row 1 of its batch: the second signal has 1 samples, expected 2; hint: the lists of a row must be equally long
            select rms_difference([1, 2], [1])
                the query failed: `rms_difference`, row 1 of its batch: the second signal has 1 samples, expected 2; hint: the lists of a row must be equally long
            select rms_difference([1, null], [1, 2])
                the query failed: `rms_difference`: element 2 of `x` is null in row 1 of its batch; hint: array_compact() takes nulls out, or leave such rows out
            select similarity([1, 2], [1])
                the query failed: `similarity`, row 1 of its batch: the second response has 1 samples, expected 2; hint: the lists of a row must be equally long
            select list_multiply([1, 2], [1])
                the query failed: `list_multiply`, row 1 of its batch: the second list has 1 samples, expected 2; hint: the lists of a row must be equally long
            select spectrum(['nan'::double])
                the query failed: `spectrum`, row 1 of its batch: the response has samples that are not finite; hint: leave out rows with NaN or infinity, as WHERE list_energy(ir) < 1e300
            select band_energy(['inf'::double, 1])
                the query failed: `band_energy`, row 1 of its batch: the response has samples that are not finite; hint: leave out rows with NaN or infinity, as WHERE list_energy(ir) < 1e300
            select edc(['nan'::double])
                the query failed: `edc`, row 1 of its batch: the response has samples that are not finite; hint: leave out rows with NaN or infinity, as WHERE list_energy(ir) < 1e300
            select arrival([1.0, 'inf'::double])
                the query failed: `arrival`, row 1 of its batch: the response has samples that are not finite; hint: leave out rows with NaN or infinity, as WHERE list_energy(ir) < 1e300
            select similarity([1.0], ['nan'::double])
                the query failed: `similarity`, row 1 of its batch: the second signal has samples that are not finite; hint: leave out rows with NaN or infinity, as WHERE list_energy(ir) < 1e300
            select arrival([1], 3)
                the query failed: `arrival`: `threshold_db` is 3.0 in row 1 of its batch; hint: it is relative to the greatest sample: 0 dB or less
            select band_filter([1, 2], 2500)
                the query failed: `band_filter`: `midband_hz` is 2500.0 in row 1 of its batch; hint: octaves are at 500, 1000, 2000, 4000 Hz and so on; thirds of an octave have a third argument, 3
            select band_filter([1, 2], 63000, 3)
                the query failed: `band_filter`: `midband_hz` is 63000.0 in row 1 of its batch; hint: the band's upper edge is 70794.6 Hz at a sampling rate of 96000 Hz, expected over 10 Hz and below half of the rate
            select room_parameters([1, 2], 1000, 2)
                the query failed: `room_parameters`: `fraction` is 2 in row 1 of its batch; hint: 1 is an octave, 3 a third of an octave
            select d4(1, 2, 'rot45')
                the query failed: `d4`: `symmetry` is "rot45" in row 1 of its batch; hint: one of identity, rot90, rot180, rot270, mirror_x, mirror_y, mirror_diag, mirror_anti
            select d4_point(78, 'rot90')
                the query failed: `d4_point`: `point_id` is 78 in row 1 of its batch; hint: the lake has 0 to 77
            select d4_pair(-1, 'rot90')
                the query failed: `d4_pair`: `pair_id` is -1 in row 1 of its batch; hint: the lake has 0 to 2950
            select d4_heightmap([1, 2, 3], 'rot90')
                the query failed: `d4_heightmap`, row 1 of its batch: the map of heights is 3 values, expected a square number of values; hint: A square map under a symmetry about its centre, in the unit of its values: what stood at p stands where p goes.
            select fresnel(0, 0, -1, 0, 0, 1, 2000)
                the query failed: `fresnel`: `mic_z` is -1.0 in row 1 of its batch; hint: height of the microphone over the plane, mm, above 0
            select fresnel(0, 0, 1, 0, 0, 1, 0)
                the query failed: `fresnel`: `frequency_hz` is 0.0 in row 1 of its batch; hint: frequency, Hz, above 0
            select speed_of_sound(-300)
                the query failed: `speed_of_sound`: `temperature_c` is -300.0 in row 1 of its batch; hint: it is in degrees Celsius, -273.15 or more
            select spectrum_frequencies(-1)
                the query failed: `spectrum_frequencies`: `n` is -1 in row 1 of its batch; hint: it is the number of samples, as array_length(ir)
            select spectrum_frequencies(9223372036854775807)
                the query failed: `spectrum_frequencies`: `n` is 9223372036854775807 in row 1 of its batch; hint: it is the number of samples, as array_length(ir)
            select spectrum(array_repeat(1, 200000))
                the query failed: `spectrum`: a list has 200000 samples, at most 131072 are taken; hint: array_slice() takes a part
            select p90_mean(distinct x), p90_mean(distinct y) from (values (1, 2), (2, 3)) as t(x, y)
                the query failed: `p90_mean` knows no DISTINCT; hint: take them from a subquery with SELECT DISTINCT
            select p90_mean('x')
                `p90_mean`: argument 1, `x`, is Utf8, not a number
            hint: it is the values, as tnce_total (linear, not dB)
        "#]].assert_eq(&said);
        let mut wrong = String::new();
        for null in [
            "edc(null)",
            "edc([0, 0])",
            "edc([])",
            "arrival([])",
            "arrival([0])",
            "db(0)",
            "db(-1)",
            "db(null)",
            "spl(0)",
            "db_amplitude(0)",
            "band_energy([])",
            "band_energy([], 2500)",
            "band_energy(null, 2500)",
            "nce([1], 0)",
            "nce([1], null)",
            "nce(null, 1)",
            "nce([1], 1, null)",
            "pearson([], [])",
            "pearson([1], [1])",
            "pearson(null, [1])",
            "pearson([0, 0], [1, 2])",
            "rms_difference([], [])",
            "rms_difference(null, [1])",
            "rms_difference([1], ['nan'::double])",
            "similarity([], [])",
            "similarity([0], [1])",
            "diffusion([])",
            "diffusion([1])",
            "diffusion_normalised([1, 2], [0, 0])",
            "d4(1, null, 'rot90')",
            "d4(1, 2, null)",
            "d4_point(null, 'rot90')",
            "d4_pair(null, 'rot90')",
            "d4_heightmap(null, 'rot90')",
            "spectrum(null)",
            "spectrum_frequencies(null)",
            "list_energy(null)",
            "list_multiply(null, [1])",
            "speed_of_sound(null)",
            "fresnel(0, 0, 1, 0, 0, null, 1000)",
            "arrival([1], null)",
        ] {
            match small.batches(&format!("select {null}")).await {
                Ok(batches) if batches[1].column(0).is_null(0) => {}
                other => wrong += &format!("{null}: {other:?}\n"),
            }
        }
        for (call, expected) in [
            ("list_energy([])", 0.0),
            ("list_rms([])", 0.0),
            ("rms_difference([0, 0], [0, 0])", 0.0),
            ("array_length(spectrum([1]))", 1.0),
            ("coalesce(array_length(spectrum([])), 0)", 0.0),
            ("coalesce(array_length(d4_heightmap([], 'rot90')), 0)", 0.0),
            ("coalesce(array_length(nce([], 1)), 0)", 0.0),
            ("coalesce(array_length(spectrum_frequencies(0)), 0)", 0.0),
            ("array_length(edc(array_repeat(1, 2000000)))", 2e6),
            ("list_energy(array_repeat(2, 2000000))", 8e6),
            ("array_length(spectrum(array_repeat(1, 131072)))", 65537.0),
            ("array_length(spectrum(array_repeat(1, 99991)))", 49996.0),
            ("band_energy([1, 2, 3], 2500) + 0 * band_energy([1, 2], 2500)", f64::NAN),
        ] {
            let given = small.number(&format!("select {call}")).await;
            if given != expected && !(expected.is_nan() && given.is_finite()) {
                wrong += &format!("{call}: {given}\n");
            }
        }
        assert!(wrong.is_empty(), "{wrong}");
        // More lengths than cached plans, in one batch.
        let lengths = "select count(spectrum(array_repeat(1, n))) from (select unnest(range(1, 300)) as n)";
        assert_eq!(small.number(lengths).await, 299.0);
        assert!(small.number("select db('nan'::double)").await.is_nan());
    }
}
