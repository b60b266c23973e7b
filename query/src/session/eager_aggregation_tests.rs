//! Aggregates over joins with the rule that aggregates first, and without it: the same rows, names, types and nulls.

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, BooleanArray, Float64Array, Int32Array, Int64Array, ListArray, StringArray,
    UInt32Array,
};
use arrow::buffer::OffsetBuffer;
use arrow::compute::{cast, take};
use arrow::datatypes::{DataType, Field, Int32Type, SchemaRef};
use datafusion::physical_plan::displayable;
use echolake_schema::symmetry::MovedPair;
use echolake_schema::tables::Table;
use echolake_schema::{PointId, Symmetry};

use super::plan_tests::{check_same, plan_in, row_texts};
use super::tests::lake;
use super::*;
use crate::views::tests::{TABLES, put_columns};
use crate::views::{EagerAggregation, LookupFunctions};

/// Runs of the lake: surface, run, and rows of each.
const RUNS: [(&str, &str, usize); 6] = [
    ("flat", "r1", 40),
    ("0001_0", "r2", 70),
    ("0001_1", "r3", 1),
    ("0002_0", "r4", 0),
    ("0003_0", "r5", 55),
    ("0004_0", "r6", 90),
];
/// Sources of rows, and expressions of each to group by: any, and of floats.
const SOURCES: [(&str, &[&str], &[&str]); 17] = [
    (
        "tnce t join pairs p on p.pair_id = t.pair_id",
        &["cast(floor(p.incidence_deg / 20) as int)", "p.microphone % 4", "t.surface_id", "t.pair_id % 3", "p.speaker"],
        &["t.tnce_total", "t.energy_2500 * 2", "p.incidence_deg", "t.rise_2500_ms", "t.tnce_total * p.direct_mm"],
    ),
    (
        "pairs p right join tnce t on p.pair_id = t.pair_id",
        &["cast(floor(p.incidence_deg / 20) as int)", "t.run_id"],
        &["t.tnce_total", "p.direct_mm", "t.tnce_total_u_db"],
    ),
    (
        "(select * from tnce where tnce_total > 0.2) t join pairs p on p.pair_id = t.pair_id and p.incidence_deg < 40",
        &["p.microphone % 5", "t.surface_id", "t.speaker"],
        &["t.tnce_total", "p.incidence_deg"],
    ),
    (
        "measurements t join surfaces s on s.surface_id = t.surface_id",
        &["s.typology", "s.material", "t.verdict", "t.attempt", "t.snr_db > 3", "s.side"],
        &["t.snr_db", "t.temperature_c", "s.relief_rms_mm", "t.humidity_pct"],
    ),
    (
        "measurements t left join surfaces s on s.surface_id = t.surface_id and s.side = 1",
        &["s.typology", "coalesce(s.material, 'none')", "t.verdict", "s.side"],
        &["t.snr_db", "t.temperature_c", "s.relief_rms_mm", "t.humidity_pct"],
    ),
    (
        "surfaces s left join measurements t on s.surface_id = t.surface_id and t.attempt = 2",
        &["s.typology", "s.material", "t.attempt"],
        &["t.snr_db", "t.temperature_c", "s.relief_rms_mm"],
    ),
    (
        "runs r join (surfaces s join measurements t using (surface_id)) on r.run_id = t.run_id",
        &["s.typology", "r.state", "t.attempt", "s.material"],
        &["t.snr_db", "t.temperature_c", "s.relief_rms_mm", "r.temperature_min_c"],
    ),
    (
        "tnce t join pairs p using (pair_id) join surfaces s on s.surface_id = t.surface_id where s.side = 0",
        &["s.typology", "cast(floor(p.direct_mm / 100) as int)"],
        &["t.tnce_total", "p.direct_mm", "s.relief_rms_mm"],
    ),
    (
        "tnce t join (values (0, 'a', 1.5), (1, null, -2.0), (null, 'x', 0.5), (1, 'b', null)) v(k, w, z) \
         on v.k = t.pair_id % 3",
        &["v.w", "v.k", "t.surface_id"],
        &["t.tnce_total", "v.z", "t.energy_total"],
    ),
    (
        "(values (0, 'a', 1.5), (1, null, -2.0)) v(k, w, z) cross join tnce t",
        &["v.w", "t.pair_id + v.k", "t.surface_id"],
        &["t.tnce_total", "v.z"],
    ),
    (
        "augmented t",
        &["t.symmetry", "t.swapped", "t.d4_pair_id % 7", "t.surface_id"],
        &["t.microphone_x_mm * t.speaker_x_mm + t.microphone_y_mm * t.speaker_y_mm", "t.microphone_z_mm"],
    ),
    (
        "tnce_db t join surfaces s on s.surface_id = t.surface_id",
        &["s.material", "t.pair_id % 4", "t.incidence_deg > 30"],
        &["t.tnce_total_db", "t.incidence_deg", "s.relief_rms_mm"],
    ),
    (
        "measurements t join surfaces s on s.surface_id = t.surface_id where s.typology = 'nobody'",
        &["s.typology", "t.verdict"],
        &["t.snr_db", "s.relief_rms_mm"],
    ),
    (
        "tnce_d4 t join pairs p on p.pair_id = t.pair_id",
        &["t.symmetry", "p.microphone"],
        &["t.tnce_total", "p.direct_mm"],
    ),
    (
        "tnce_d4 t",
        &["t.symmetry", "t.swapped", "t.d4_pair_id % 7", "t.surface_id", "t.d4_speaker", "t.pair_id % 3"],
        &["t.microphone_x_mm * t.speaker_x_mm", "t.tnce_total", "t.energy_2500", "t.speaker_z_mm"],
    ),
    (
        "(select * from tnce_d4 where tnce_total > 0.5 and microphone_x_mm < 10 and surface_id <> 'flat') t",
        &["t.symmetry", "t.swapped", "t.surface_id"],
        &["t.microphone_x_mm", "t.tnce_total", "t.energy_2500"],
    ),
    (
        "tnce_d4 t join surfaces s on s.surface_id = t.surface_id and t.symmetry <> 'rot90'",
        &["t.symmetry", "s.typology", "t.swapped"],
        &["t.microphone_x_mm", "t.tnce_total", "s.relief_rms_mm"],
    ),
];

/// Numbers that only look random.
struct NumberStream(u64);

impl NumberStream {
    fn next(&mut self, below: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % below
    }

    fn pick<'a>(&mut self, options: &[&'a str]) -> &'a str {
        options[self.next(options.len())]
    }

    fn is_one_of(&mut self, count: usize) -> bool {
        self.next(count) == 0
    }
}

fn count_table_rows(table: Table, measured: usize) -> usize {
    match table {
        Table::Surfaces | Table::Runs => 1,
        Table::Heightmaps => Symmetry::ALL.len(),
        _ => measured,
    }
}

// Any values, nulls where there may be some; keys as they are in a lake.
fn column(table: Table, field: &Field, surface: &str, run: &str, measured: usize) -> ArrayRef {
    let rows = count_table_rows(table, measured);
    let seed = field.name().bytes().chain(run.bytes()).fold(table.name().len() as u64, |x, b| x * 131 + u64::from(b));
    let mut numbers = NumberStream(seed);
    let mut is_null = || field.is_nullable() && numbers.is_one_of(4);
    let nulls: Vec<bool> = (0..rows).map(|_| is_null()).collect();
    let mut next = |below: usize| numbers.next(below);
    match (field.name().as_str(), field.data_type()) {
        ("surface_id", _) => Arc::new(StringArray::from(vec![surface; rows])),
        ("run_id", _) => Arc::new(StringArray::from(vec![run; rows])),
        ("symmetry", _) => Arc::new(StringArray::from(Symmetry::ALL.map(Symmetry::name).to_vec())),
        ("pair_id", DataType::Int32) => {
            let pairs: Int64Array = (0..rows as i64).map(|row| row * 31 % 2951).collect();
            cast(&pairs, &DataType::Int32).expect("numbers")
        }
        (_, DataType::Utf8) => {
            Arc::new(nulls.iter().map(|null| (!null).then(|| ["a", "b", "c"][next(3)])).collect::<StringArray>())
        }
        (_, DataType::Boolean) => {
            Arc::new(nulls.iter().map(|null| (!null).then(|| next(2) == 0)).collect::<BooleanArray>())
        }
        (_, DataType::List(child)) => {
            let values = cast(&Int64Array::from(vec![1; 2 * rows]), child.data_type()).expect("numbers");
            Arc::new(ListArray::new(child.clone(), OffsetBuffer::from_lengths(vec![2; rows]), values, None))
        }
        (_, kind) if kind.is_floating() => {
            let values = nulls.iter().map(|null| (!null).then(|| next(4000) as f64 / 1000.0 - 1.0));
            cast(&values.collect::<Float64Array>(), kind).expect("numbers")
        }
        (_, kind) => {
            let values = nulls.iter().map(|null| (!null).then(|| next(3) as i64));
            cast(&values.collect::<Int64Array>(), kind).expect("numbers")
        }
    }
}

// Rows of `tnce_d4` as `ingest` derives them from rows of `tnce`.
fn moved_column(lake: &Lake, field: &Field, surface: &str, run: &str, measured: usize) -> ArrayRef {
    let own = |field: &Field| column(Table::Tnce, field, surface, run, measured);
    let schema = Table::Tnce.schema(lake.rig());
    if let Ok(measured) = schema.field_with_name(field.name()) {
        let values = own(measured);
        let rows: UInt32Array = (0..values.len() as u32).flat_map(|row| [row; 8]).collect();
        return take(&values, &rows, None).expect("rows");
    }
    let pairs = own(schema.field_with_name("pair_id").expect("a key"));
    let pairs: Vec<_> = pairs.as_primitive::<Int32Type>().values().iter().map(|pair| *pair as usize).collect();
    let moved = Symmetry::ALL.map(|symmetry| lake.grid().moved_pairs(symmetry).expect("moved"));
    let moved: Vec<_> = pairs.iter().flat_map(|pair| moved.iter().map(move |moved| moved[*pair])).collect();
    let ids = |id: fn(&MovedPair) -> u32| -> ArrayRef {
        Arc::new(moved.iter().map(|moved| Some(id(moved) as i32)).collect::<Int32Array>())
    };
    let place = |end: fn(&MovedPair) -> PointId, axis: usize| -> ArrayRef {
        let point = |moved| lake.grid().point(end(moved)).map(|point| point.position_mm[axis]);
        Arc::new(moved.iter().map(point).collect::<Float64Array>())
    };
    match field.name().as_str() {
        "symmetry" => {
            let names = pairs.iter().flat_map(|_| Symmetry::ALL.map(Symmetry::name));
            Arc::new(StringArray::from(names.collect::<Vec<_>>()))
        }
        "swapped" => Arc::new(moved.iter().map(|moved| Some(moved.swapped)).collect::<BooleanArray>()),
        "d4_pair_id" => ids(|moved| moved.pair.id.0),
        "d4_microphone" => ids(|moved| moved.pair.microphone.0),
        "d4_speaker" => ids(|moved| moved.pair.speaker.0),
        "microphone_x_mm" => place(|moved| moved.pair.microphone, 0),
        "microphone_y_mm" => place(|moved| moved.pair.microphone, 1),
        "microphone_z_mm" => place(|moved| moved.pair.microphone, 2),
        "speaker_x_mm" => place(|moved| moved.pair.speaker, 0),
        "speaker_y_mm" => place(|moved| moved.pair.speaker, 1),
        "speaker_z_mm" => place(|moved| moved.pair.speaker, 2),
        other => panic!("{other} is new"),
    }
}

fn generate_query(numbers: &mut NumberStream) -> String {
    let (source, keys, floats) = SOURCES[numbers.next(SOURCES.len())];
    let mut keys: Vec<_> = (0..numbers.next(3)).map(|_| numbers.pick(keys)).collect();
    keys.dedup();
    let mut calls = Vec::new();
    for _ in 0..=numbers.next(3) {
        let value = numbers.pick(floats);
        let call = match numbers.next(16) {
            0..3 => "count(*)".to_owned(),
            3 => format!("count({value})"),
            4 => format!("min({value})"),
            5 => format!("max({value})"),
            6 | 7 => format!("sum({value})"),
            8..11 => format!("avg({value})"),
            11 => "sum(t.pair_id)".to_owned(),
            12 => "avg(t.microphone)".to_owned(),
            13 => "max(t.surface_id)".to_owned(),
            14 => format!("count(distinct {value})"),
            _ => format!("sum({value}) filter (where t.pair_id > 300)"),
        };
        calls.push(call);
    }
    let columns: Vec<_> = keys
        .iter()
        .map(|key| (*key).to_owned())
        .chain(calls)
        .enumerate()
        .map(|(n, c)| format!("{c} as c{n}"))
        .collect();
    let places: Vec<_> = (1..=keys.len()).map(|n| n.to_string()).collect();
    let places = places.join(", ");
    let group = if keys.is_empty() { String::new() } else { format!(" group by {places}") };
    let having = if numbers.is_one_of(4) { " having count(*) > 4" } else { "" };
    let order = match numbers.next(4) {
        _ if keys.is_empty() => String::new(),
        0 => format!(" order by {places}"),
        1 => format!(" order by {places} limit {}", numbers.next(4)),
        2 => format!(" order by {places} offset 1"),
        _ => String::new(),
    };
    format!("select {} from {source}{group}{having}{order}", columns.join(", "))
}

fn check_schema(sql: &str, expected: &SchemaRef, schema: &SchemaRef) {
    let fields = |schema: &SchemaRef| -> Vec<_> {
        schema.fields().iter().map(|field| (field.name().clone(), field.data_type().clone())).collect()
    };
    assert_eq!(fields(expected), fields(schema), "{sql}");
    // `coalesce(flag, false)` is an AND for DataFusion, which may be null for it.
    let is_stricter = |(own, expected): (&Arc<Field>, &Arc<Field>)| expected.is_nullable() && !own.is_nullable();
    assert!(!schema.fields().iter().zip(expected.fields()).any(is_stricter), "{sql}");
}

/// A lake with runs of different values.
pub(super) async fn varied_lake() -> (tempfile::TempDir, Lake) {
    let (folder, lake) = lake().await;
    for (surface, run, rows) in RUNS {
        let tables: Vec<_> = [Table::TnceD4].into_iter().chain(TABLES).collect();
        let own = |table: Table, field: &Field| match table {
            Table::TnceD4 => moved_column(&lake, field, surface, run, rows),
            table => column(table, field, surface, run, rows),
        };
        put_columns(&lake, surface, run, &tables, &own).await;
    }
    (folder, lake)
}

/// Plans and runs a query without the rule, and with it whatever the size of tables; returns the plan with it.
async fn check_query(engine: &QueryEngine, lookups: &LookupFunctions, sql: &str) -> String {
    let contexts = [(); 2].map(|()| engine.create_context());
    contexts.iter().for_each(|context| assert!(context.remove_optimizer_rule("eager_aggregation")));
    let [without, with] = &contexts;
    with.add_optimizer_rule(Arc::new(EagerAggregation::of_any_size(lookups)));
    let (state, plan) = plan_in(without, engine, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let expected_schema = plan.schema();
    let expected = row_texts(plan, &state).await;
    let (state, plan) = plan_in(with, engine, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let text = displayable(plan.as_ref()).indent(false).to_string();
    check_schema(sql, &expected_schema, &plan.schema());
    check_same(sql, &text, &expected, &row_texts(plan, &state).await);
    text
}

fn lookups_of(lake: &Lake) -> LookupFunctions {
    let functions = echolake_functions::FunctionSet::all(lake.rig()).expect("functions");
    LookupFunctions::from_lake(lake, &functions).expect("lookups")
}

fn aggregates_first(plan: &str) -> bool {
    plan.contains("__partial_0") || plan.contains("__total_0")
}

#[tokio::test(flavor = "multi_thread")]
async fn groups_joined_are_those_of_joined_rows() {
    let (_folder, lake) = varied_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let lookups = lookups_of(&lake);
    let mut numbers = NumberStream(7);
    let mut changed = 0;
    for _ in 0..400 {
        let sql = generate_query(&mut numbers);
        changed += usize::from(aggregates_first(&check_query(&engine, &lookups, &sql).await));
    }
    assert!(changed > 100, "{changed} of 400 queries aggregate first");
}

#[tokio::test]
async fn an_empty_lake_has_the_same_empty_groups() {
    let (_folder, lake) = lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let lookups = lookups_of(&lake);
    let mut numbers = NumberStream(8);
    for _ in 0..40 {
        check_query(&engine, &lookups, &generate_query(&mut numbers)).await;
    }
}

#[tokio::test]
async fn aggregates_stand_below_joins_where_they_split() {
    let (_folder, lake) = varied_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let lookups = lookups_of(&lake);
    let first = [
        "select s.typology, count(*), avg(t.snr_db) from measurements t join surfaces s using (surface_id) group by 1",
        "select cast(floor(p.incidence_deg / 5) as int) as d, count(*), max(t.tnce_total) from tnce t \
         join pairs p on p.pair_id = t.pair_id group by d order by d",
        "select avg(p.incidence_deg) from tnce t join pairs p on p.pair_id = t.pair_id",
        "select symmetry, swapped, count(*), avg(microphone_x_mm * speaker_x_mm) from augmented group by 1, 2",
        "select s.side, sum(t.x) from (select surface_id, temperature_c * 2 as x from measurements) t \
         left join surfaces s using (surface_id) group by 1",
    ];
    for sql in first {
        let plan = check_query(&engine, &lookups, sql).await;
        let inner = plan.lines().rfind(|line| line.contains("AggregateExec")).expect("an aggregate");
        assert!(aggregates_first(&plan), "{sql}: {plan}");
        if plan.contains("Join") {
            let join = plan.find("Join").expect("a join");
            assert!(plan.find(inner).expect("the lowest aggregate") > join, "{sql}: {plan}");
        }
    }
    let last = [
        "select s.typology, count(distinct t.attempt) from measurements t join surfaces s using (surface_id) group by 1",
        "select s.typology, count(*) filter (where t.attempt > 1) from measurements t join surfaces s using (surface_id) \
         group by 1",
        "select s.typology, stddev(t.snr_db) from measurements t join surfaces s using (surface_id) group by 1",
        "select s.typology, sum(t.snr_db * s.relief_rms_mm) from measurements t join surfaces s using (surface_id) group by 1",
        "select s.typology, t.snr_db, count(*) from measurements t join surfaces s using (surface_id) group by 1, 2",
        "select s.typology, count(t.attempt) from surfaces s left join measurements t using (surface_id) group by 1",
        "select s.typology, max(10 / t.attempt) from measurements t join surfaces s using (surface_id) where t.attempt > 0 \
         group by 1",
        "select s.typology, max(random()) > 2 from measurements t join surfaces s using (surface_id) group by 1",
        "select verdict, count(*) from measurements group by 1",
    ];
    for sql in last {
        assert!(!aggregates_first(&check_query(&engine, &lookups, sql).await), "{sql}");
    }
    // As it is outside of tests, rows that are fewer than pairs are joined as they are.
    let context = engine.create_context();
    let (_, plan) = plan_in(&context, &engine, first[1]).await.expect("planned");
    assert!(!aggregates_first(&displayable(plan.as_ref()).indent(false).to_string()));
}

// What `tnce_d4` has for other readers is what its aggregates are made of here.
#[tokio::test]
async fn aggregates_of_moved_rows_are_those_of_measured_ones() {
    let (_folder, lake) = varied_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let lookups = lookups_of(&lake);
    let columns = Table::TnceD4.schema(lake.rig());
    let columns = columns.fields().iter().filter(|field| !field.data_type().is_nested());
    for field in columns {
        let name = field.name();
        let value = match field.data_type() {
            DataType::Boolean => format!("cast({name} as int)"),
            _ => name.clone(),
        };
        let sql = format!(
            "select symmetry, d4_pair_id % 40, count({value}), min({value}), max({value}) from tnce_d4 group by 1, 2"
        );
        let plan = check_query(&engine, &lookups, &sql).await;
        assert!(plan.contains("/tnce/") && !plan.contains("/tnce_d4/"), "{sql}: {plan}");
    }
    for sql in [
        "select foam_version, swapped, count(*), max(tnce_total) from tnce_d4 where tnce_total > 0.3 group by 1, 2",
        "select count(distinct flat_version) from tnce_d4",
    ] {
        let plan = check_query(&engine, &lookups, sql).await;
        assert!(plan.contains("/tnce/") && !plan.contains("/tnce_d4/"), "{sql}: {plan}");
    }
    // What has no nulls is counted as rows: a group for each pair is not needed.
    let sql = "select s.typology, count(*), count(t.microphone_y_mm) from tnce_d4 t \
               join surfaces s on s.surface_id = t.surface_id where t.run_id > 'r2' group by 1";
    let plan = check_query(&engine, &lookups, sql).await;
    assert!(plan.contains("/tnce/") && !plan.contains("pair_id"), "{sql}: {plan}");
    // A table without some of the rows is read itself, and so is one whose rows are wanted.
    for sql in ["select symmetry, surface_id, pair_id from tnce_d4 where pair_id = 31", "select count(*) from tnce_d4"]
    {
        assert!(!check_query(&engine, &lookups, sql).await.contains("/tnce/"), "{sql}");
    }
    put_columns(&lake, "0005_0", "r7", &TABLES, &|table, field| column(table, field, "0005_0", "r7", 9)).await;
    let sql = "select symmetry, avg(tnce_total) from tnce_d4 group by symmetry";
    assert!(!check_query(&engine, &lookups, sql).await.contains("/tnce/"), "{sql}");
}

#[tokio::test]
async fn an_explained_aggregate_shows_its_partial_results() {
    let (_folder, lake) = varied_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let context = engine.create_context();
    assert!(context.remove_optimizer_rule("eager_aggregation"));
    context.add_optimizer_rule(Arc::new(EagerAggregation::of_any_size(&lookups_of(&lake))));
    let sql = "explain select s.typology, avg(t.snr_db) as mean from measurements t join surfaces s using (surface_id) \
               group by 1";
    let (state, plan) = plan_in(&context, &engine, sql).await.expect("planned");
    let rows = row_texts(plan, &state).await;
    let logical = rows.iter().find(|row| row.starts_with("logical_plan")).expect("a plan");
    let place = |text: &str| logical.find(text).unwrap_or_else(|| panic!("{text}: {logical}"));
    let second = place("aggr=[[sum(__partial_0) AS __total_0, sum(__partial_1) AS __total_1]]");
    let join = place("Inner Join: ");
    let first = place("groupBy=[[");
    assert!(first <= second && second < join, "{logical}");
    assert!(logical[join..].contains("AS __partial_0") && logical[join..].contains("AS __partial_1"), "{logical}");
}
