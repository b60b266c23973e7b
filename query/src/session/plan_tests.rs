//! Plans that another engine on the same lake runs: encoded, decoded, and run there as they are and with what it holds.

use std::collections::BTreeSet;
use std::sync::atomic::AtomicBool;

use arrow::record_batch::RecordBatch;
use datafusion::datasource::physical_plan::{FileScanConfig, ParquetSource};
use datafusion::datasource::source::DataSourceExec;
use datafusion::logical_expr::{ColumnarValue, Volatility, create_udf};
use datafusion::physical_plan::{ExecutionPlan, collect, displayable};
use datafusion::scalar::ScalarValue;
use datafusion_proto::bytes::{
    physical_plan_from_bytes_with_proto_converter, physical_plan_to_bytes_with_proto_converter,
};
use datafusion_proto::physical_plan::{
    DeduplicatingProtoConverter, DefaultPhysicalExtensionCodec, DefaultPhysicalProtoConverter,
    PhysicalProtoConverterExtension,
};
use echolake_lake::{ContributedFile, annotation_rows};
use echolake_schema::annotations::{Annotation, AnnotationKind};
use echolake_schema::tables::Table;

use super::function_tests::{SmallLake, examples, row_lines};
use super::tests::{lake, put_events};
use super::*;
use crate::views::LakeView;
use crate::views::tests::put;
use crate::{EngineLimits, check_transport};

/// Plans a query as a session does, without running it.
async fn physical_plan(engine: &QueryEngine, sql: &str) -> Result<(SessionState, Arc<dyn ExecutionPlan>), Error> {
    plan_in(&engine.create_context(), engine, sql).await
}

pub(super) async fn plan_in(
    context: &SessionContext,
    engine: &QueryEngine,
    sql: &str,
) -> Result<(SessionState, Arc<dyn ExecutionPlan>), Error> {
    let mut statement = parse_statement(sql, 50)?;
    engine.catalog().register_tables(context, Vec::new(), &mut statement).await?;
    let state = context.state();
    let plan = prepare_statement(sql, statement, &state).await?;
    let plan = state.create_physical_plan(&plan).await.map_err(|e| Error::from_optimizing(sql, &e))?;
    Ok((state, plan))
}

/// The rows as texts, in the order of texts.
pub(super) async fn row_texts(plan: Arc<dyn ExecutionPlan>, state: &SessionState) -> Vec<String> {
    let text = displayable(plan.as_ref()).indent(false).to_string();
    let batches = collect(plan, state.task_ctx()).await.unwrap_or_else(|e| panic!("{e}: {text}"));
    let mut rows: Vec<_> = batches.iter().flat_map(|batch| row_lines(batch, " | ")).collect();
    rows.sort();
    rows
}

// Sums of floats differ in their last digits with the order of rows.
fn is_same_text(left: &str, right: &str) -> bool {
    let parts = |text: &str| text.split([' ', ',', '[', ']', '{', '}']).map(str::to_owned).collect::<Vec<_>>();
    let is_same = |left: &String, right: &String| {
        let numbers = left.parse::<f64>().ok().zip(right.parse::<f64>().ok());
        left == right || numbers.is_some_and(|(x, y)| (x - y).abs() <= 1e-6 * x.abs().max(y.abs()))
    };
    let left = parts(left);
    let right = parts(right);
    left.len() == right.len() && left.iter().zip(&right).all(|(left, right)| is_same(left, right))
}

pub(super) fn check_same(sql: &str, how: &str, expected: &[String], rows: &[String]) {
    let is_same = expected.len() == rows.len() && expected.iter().zip(rows).all(|(a, b)| is_same_text(a, b));
    assert!(is_same, "{how}: {sql}\n{expected:#?}\n{rows:#?}");
}

// As `datafusion-distributed` does; each with a codec that knows no nodes and no functions.
fn sent_plan(plan: &Arc<dyn ExecutionPlan>, worker: &SessionState) -> Result<Arc<dyn ExecutionPlan>, DataFusionError> {
    check_transport(plan, worker)?;
    let codec = DefaultPhysicalExtensionCodec {};
    let mut sent = None;
    let converters: [&dyn PhysicalProtoConverterExtension; 2] =
        [&DefaultPhysicalProtoConverter {}, &DeduplicatingProtoConverter::default()];
    for converter in converters {
        let bytes = physical_plan_to_bytes_with_proto_converter(plan.clone(), &codec, converter)?;
        let task = worker.task_ctx();
        sent = Some(physical_plan_from_bytes_with_proto_converter(&bytes, &task, &codec, converter)?);
    }
    Ok(sent.expect("two converters"))
}

/// Runs a query here and on the worker, with and without what they hold; returns its rows.
async fn check_sent(engine: &QueryEngine, worker: &QueryEngine, sql: &str) -> Vec<String> {
    let (state, plan) = physical_plan(engine, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let at_worker = worker.worker_state();
    let sent = sent_plan(&plan, &at_worker).unwrap_or_else(|e| panic!("{sql}: {e}"));
    // A plan that has run keeps what it has learned of its rows, so each runs once.
    let again = sent_plan(&plan, &at_worker).expect("sent as before");
    let rows = row_texts(plan, &state).await;
    let (state, plan) = physical_plan(engine, sql).await.expect("planned as before");
    let local = engine.rewrite_local_scans(plan).expect("rewritten");
    check_same(sql, "rewritten", &rows, &row_texts(local, &state).await);
    let held = worker.rewrite_local_scans(again).expect("rewritten");
    check_same(sql, "sent", &rows, &row_texts(sent, &at_worker).await);
    check_same(sql, "sent and rewritten", &rows, &row_texts(held, &at_worker).await);
    rows
}

// Whether all of a plan's tables are standard scans.
fn check_standard(sql: &str, plan: &Arc<dyn ExecutionPlan>) {
    if let Some(source) = plan.downcast_ref::<DataSourceExec>() {
        let scan = source.data_source().downcast_ref::<FileScanConfig>();
        let is_parquet = scan.is_some_and(|scan| scan.file_source().downcast_ref::<ParquetSource>().is_some());
        assert!(is_parquet, "{sql}: {}", displayable(plan.as_ref()).indent(true));
        assert_eq!(scan.map(|scan| scan.object_store_url.as_str()), Some("echolake://lake/"), "{sql}");
    }
    plan.children().into_iter().for_each(|child| check_standard(sql, child));
}

async fn reject(lake: &Lake, id: &str, run: &str, pairs: Option<Vec<u32>>, value: &str) {
    let annotation = Annotation {
        annotation_id: id.to_owned(),
        run_id: run.parse().expect("an id"),
        pair_ids: pairs,
        kind: AnnotationKind::Verdict,
        value: value.to_owned(),
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

/// Queries with every kind of node and function that statements of clients have.
const QUERIES: [&str; 37] = [
    "select count(*) from pairs",
    "select min(pair_id), max(direct_mm), sum(pair_id), avg(direct_mm) from pairs where incidence_deg < 30",
    "select microphone, count(*) as n, sum(direct_mm) as d from pairs group by microphone having count(*) > 5",
    "select p.pair_id, q.z_mm from pairs p join points q on q.point_id = p.speaker where p.pair_id < 40",
    "select * from pairs order by direct_mm desc, pair_id limit 7",
    "select pair_id, row_number() over (partition by speaker order by pair_id) as nth from pairs where pair_id < 99",
    "select sum(pair_id) over (order by pair_id rows between 2 preceding and current row) from pairs where pair_id < 9",
    "select pair_id + 1, pair_id - 2, pair_id * 3, -pair_id, pair_id / 2 from pairs where pair_id < 9",
    "select sqrt(direct_mm), direct_mm * 0 / 0, nullif(direct_mm, -0.0) from pairs where pair_id < 9",
    "select count(distinct direct_mm * 0) from pairs",
    "select pair_id from pairs where pair_id = any([3, null, 7])",
    "select pair_id in (1, 2), array_has([1, 2], pair_id) from pairs where pair_id < 4",
    "select pair_id from pairs where pair_id not in (select point_id from points) order by 1 limit 3",
    "select pair_id from pairs p where exists (select 1 from points q where q.point_id = p.pair_id) and pair_id > 60",
    "select (select max(z_mm) from points) as most, pair_id from pairs where pair_id < 3",
    "select pair_id from pairs where pair_id < 9 except select point_id from points where point_id < 4",
    "select pair_id from pairs where pair_id < 3 union all select point_id from points where point_id < 3",
    "select point_id from points intersect all select pair_id from pairs",
    "select m.pair_id, p.incidence_deg from measurements m join pairs p using (pair_id)",
    "select surface_id, pair_id, ir[1], list_energy(ir) from measurements where pair_id > 1",
    "select surface_id, avg_list(reflected_ir) from nce group by surface_id",
    "select pair_id, sum(x * x), count(*) from (select pair_id, unnest(ir) as x from measurements) v group by pair_id",
    "select surface_id, run_id, pair_id, incidence_deg from ir where pair_id = 1",
    "select ir from ir order by surface_id, pair_id limit 1",
    "select count(*) from augmented where symmetry = 'rot90'",
    "select d4_pair_id, swapped, flat_ratio_total from augmented where pair_id = 2",
    "select range(1, 4), generate_series(1, 3)",
    "select octet_length('x'), to_char(to_timestamp('2026-01-05T08:00:00Z'), 'YYYY-MM-DD')",
    "select timestamp '2026-01-05T08:00:00' at time zone 'Europe/Berlin', to_date('05.01.2026', 'DD.MM.YYYY')",
    "select list(pair_id order by pair_id), approx_median(direct_mm), mode(speaker) from pairs where pair_id < 9",
    "select speaker, percentile_cont(0.1) within group (order by direct_mm), median(direct_mm) from pairs group by speaker",
    "select arg_max(speaker, pair_id), first_value(pair_id order by direct_mm desc, pair_id) from pairs",
    "select coalesce(null, surface_id), case surface_id when 'flat' then 1 else 2 end from runs",
    "select unnest([1, 2, 3]) as x, {a: 1, b: 'x'} as s",
    "select surface_id, is_rejected(run_id, pair_id) from measurements",
    "select count(*) from measurements where is_rejected(run_id, pair_id)",
    "select surface_id, count(*) from tnce_db group by rollup(surface_id)",
];

#[tokio::test(flavor = "multi_thread")]
async fn plans_run_on_another_engine_of_the_lake() {
    let (_folder, lake) = measured_lake().await;
    let lake = &lake;
    let engines = [(); 2].map(|()| QueryEngine::new(lake, None).expect("an engine"));
    let [engine, worker] = &engines;
    worker.catalog().current_snapshot().await.expect("its snapshot: what the worker holds follows from it");
    let tables = Table::ALL.map(Table::name).into_iter().chain(LakeView::ALL.map(LakeView::name));
    let tables = tables.flat_map(|table| {
        let whole = format!("select * from {table}");
        [format!("select count(*) from {table}"), whole]
    });
    for sql in tables.chain(QUERIES.map(str::to_owned)) {
        check_sent(engine, worker, &sql).await;
    }
    reject(lake, "one", "r1", Some(vec![1]), "rejected").await;
    reject(lake, "two", "r2", None, "rejected").await;
    reject(lake, "three", "r2", Some(vec![0]), "accepted").await;
    let [before, after] = [QueryEngine::new(lake, None), QueryEngine::new(lake, None)].map(|e| e.expect("an engine"));
    for view in LakeView::ALL.map(LakeView::name) {
        check_sent(&before, &after, &format!("select * from {view}")).await;
    }
    for sql in QUERIES {
        check_sent(&before, &after, sql).await;
    }
    let pairs = check_sent(&before, &after, "select surface_id, pair_id from ir").await;
    assert_eq!(pairs, ["0001_0 | 0", "0001_0 | 2", "flat | 0"]);
}

// Whichever partition reads them. What depends on the order of rows keeps it.
#[tokio::test(flavor = "multi_thread")]
async fn values_of_lists_are_aggregated_by_all_partitions() {
    let (_folder, lake) = measured_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let shared = "UnnestExec | RepartitionExec: partitioning=RoundRobinBatch";
    for (values, is_shared) in [("sum(x * x), count(*)", true), ("max(x)", true), ("array_agg(x)", false)] {
        let sql = format!(
            "select pair_id, {values} from (select pair_id, unnest(ir) as x from measurements) v group by pair_id"
        );
        let (_, plan) = physical_plan(&engine, &sql).await.expect("planned");
        let node_texts = |plan: &Arc<dyn ExecutionPlan>| {
            let text = displayable(plan.as_ref()).indent(false).to_string();
            text.lines().map(str::trim).collect::<Vec<_>>().join(" | ")
        };
        assert!(!node_texts(&plan).contains(shared), "{}", node_texts(&plan));
        let local = engine.rewrite_local_scans(plan).expect("rewritten");
        assert_eq!(node_texts(&local).contains(shared), is_shared, "{}", node_texts(&local));
    }
}

// However large its files are: a range of a file may be read by another process, which does not hold it.
#[tokio::test]
async fn a_small_table_is_not_divided() {
    let (_folder, lake) = lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let context = engine.create_context();
    context.state_ref().write().config_mut().options_mut().optimizer.repartition_file_min_size = 0;
    let sql = "select pair_id, direct_mm from pairs where direct_mm > 100";
    let (state, plan) = plan_in(&context, &engine, sql).await.expect("planned");
    let local = engine.rewrite_local_scans(plan).expect("rewritten");
    let text = displayable(local.as_ref()).indent(false).to_string();
    assert!(text.contains("rows in memory"), "{text}");
    assert!(!row_texts(local, &state).await.is_empty());
}

/// Runs a query by plans of an engine, whose process keeps columns, and of one that keeps none.
async fn check_kept(engine: &QueryEngine, without: &QueryEngine, sql: &str) {
    let mut texts = Vec::new();
    let mut expected: Option<Vec<String>> = None;
    for engine in [without, engine, engine] {
        let (state, plan) = physical_plan(engine, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        let local = engine.rewrite_local_scans(plan).expect("rewritten");
        texts.push(displayable(local.as_ref()).indent(false).to_string());
        let rows = row_texts(local, &state).await;
        match &expected {
            Some(expected) => check_same(sql, "kept", expected, &rows),
            None => expected = Some(rows),
        }
    }
    let is_held: Vec<_> = texts.iter().map(|text| text.contains("rows in memory")).collect();
    assert_eq!(is_held, [false, true, true], "{sql}: {texts:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn columns_that_are_kept_give_the_rows_of_their_files() {
    let (_folder, lake) = merged_lake(30_000).await;
    for (run, lines) in [("r6", 9000), ("r7", 1), ("r8", 2951)] {
        put_events(&lake, "flat", run, "old", lines).await;
    }
    let restricted = lake.restricted_to(["ours".parse().expect("a name")].into());
    for lake in [&lake, &restricted] {
        let limits = EngineLimits { column_bytes: Some(1), ..EngineLimits::default() };
        let without = QueryEngine::with_limits(lake, limits).expect("an engine");
        let engine = QueryEngine::new(lake, None).expect("an engine");
        for sql in [
            "select * from events",
            "select message, log_time_ns from events where log_time_ns between 2000 and 2005 and surface_id <> 'foam'",
            "select run_id, count(*), sum(log_time_ns), max(message) from events group by run_id",
            "select log_time_ns + 1, run_id from events order by log_time_ns desc, run_id limit 7",
            "select count(message) from (select message from events where message <> '' limit 20000)",
            "select a.run_id, count(*) from events a join runs b on a.run_id = b.run_id where a.log_time_ns % 3 = 1 \
             group by a.run_id",
            "select count(*) from events where run_id = 'r2' and length(message) > 1",
            "select surface_id, run_id from runs",
        ] {
            check_kept(&engine, &without, sql).await;
        }
    }
}

// Of lists, the pages of the pairs that a query names; all other scans of lists read files as before.
#[tokio::test(flavor = "multi_thread")]
async fn lists_of_named_pairs_are_those_of_their_rows() {
    let (_folder, lake) = measured_lake().await;
    for (surface, run) in [("0001_0", "r3"), ("theirs-wall", "r4"), ("ours-wall", "r5")] {
        put(&lake, surface, run).await;
    }
    reject(&lake, "one", "r3", Some(vec![1]), "rejected").await;
    for is_merged in [false, true] {
        if is_merged {
            lake.optimize(128 << 20, &AtomicBool::new(false), &mut |_| {}).await.expect("merged");
            put(&lake, "0002_0", "r6").await;
        }
        let restricted = lake.restricted_to(["ours", "text"].map(|name| name.parse().expect("a name")).into());
        for lake in [&lake, &restricted] {
            let limits = EngineLimits { column_bytes: Some(1), ..EngineLimits::default() };
            let without = QueryEngine::with_limits(lake, limits).expect("an engine");
            let engine = QueryEngine::new(lake, None).expect("an engine");
            for sql in [
                "select ir from measurements where pair_id = 1",
                "select run_id, ir from measurements where pair_id = 1 and surface_id = '0001_0' and run_id > 'r1'",
                "select * from nce where pair_id in (0, 2)",
                "select run_id, reflected_ir[1] + pair_id, list_energy(reflected_ir) from nce where pair_id = 2",
                "select surface_id, avg_list(reflected_ir) from nce where pair_id = 1 or pair_id = 0 group by surface_id",
                "select ir, reflected_ir from ir where pair_id = 1",
                "select reflected_ir from nce where pair_id = 1 and microphone <> 1",
                "select count(*) from (select ir from measurements where pair_id = 1 limit 2)",
            ] {
                check_kept(&engine, &without, sql).await;
            }
            for sql in [
                "select ir from measurements",
                "select ir from measurements where pair_id > 0",
                "select ir from measurements where pair_id = 1 or microphone = 2",
            ] {
                let (_, plan) = physical_plan(&engine, sql).await.expect("planned");
                let local = engine.rewrite_local_scans(plan).expect("rewritten");
                let text = displayable(local.as_ref()).indent(false).to_string();
                assert!(!text.contains("rows in memory"), "{sql}: {text}");
            }
        }
    }
}

// Of a large file, a filter reads few groups of rows; what leaves out rows while the first ones are found does not count.
#[tokio::test(flavor = "multi_thread")]
async fn columns_of_a_large_file_are_kept_unless_a_filter_selects_rows() {
    let (_folder, lake) = lake().await;
    put_events(&lake, "flat", "r1", "old", 70_000).await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    for (sql, is_kept) in [
        ("select message, count(*) from events group by message", true),
        ("select log_time_ns, message from events order by log_time_ns % 1000 desc, log_time_ns limit 3", true),
        ("select log_time_ns from events order by log_time_ns desc limit 3", true),
        ("select log_time_ns from events where log_time_ns > 69000 order by log_time_ns desc limit 3", false),
        ("select count(message) from events where log_time_ns % 3 = 0", false),
        ("select message from events limit 3", false),
    ] {
        let (state, plan) = physical_plan(&engine, sql).await.expect("planned");
        let expected = row_texts(plan, &state).await;
        let (state, plan) = physical_plan(&engine, sql).await.expect("planned");
        let local = engine.rewrite_local_scans(plan).expect("rewritten");
        let text = displayable(local.as_ref()).indent(false).to_string();
        assert_eq!(text.contains("rows in memory"), is_kept, "{sql}: {text}");
        check_same(sql, "kept", &expected, &row_texts(local, &state).await);
    }
}

// What cannot be sent is named, and stays where it is.
#[tokio::test]
async fn what_only_one_process_knows_is_not_sent() {
    let (_folder, lake) = lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let worker = engine.worker_state();
    let recursive = "with recursive n(i) as (select 1 union all select i + 1 from n where i < 5) select max(i) from n";
    let (_, plan) = physical_plan(&engine, recursive).await.expect("planned");
    let error = check_transport(&plan, &worker).expect_err("a recursive query").to_string();
    assert!(error.contains("WorkTableExec of this process"), "{error}");
    let context = engine.create_context();
    let answer = |_: &[ColumnarValue]| Ok(ColumnarValue::Scalar(ScalarValue::Int32(Some(1))));
    let function =
        create_udf("own_number", vec![DataType::Int32], DataType::Int32, Volatility::Volatile, Arc::new(answer));
    context.register_udf(function);
    let sql = "select pair_id from pairs where pair_id > 3 and own_number(pair_id) + 1 = 2";
    let (_, plan) = plan_in(&context, &engine, sql).await.expect("planned");
    let error = check_transport(&plan, &worker).expect_err("a function of the session").to_string();
    assert!(error.contains("function own_number of this session"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn functions_run_on_another_engine_of_the_lake() {
    let small = SmallLake::new().await;
    let [engine, worker] = [(); 2].map(|()| QueryEngine::new(&small.lake, None).expect("an engine"));
    for (_, sql, _) in examples() {
        check_sent(&engine, &worker, &sql).await;
    }
}

/// A lake with rows of two runs in the tables that views read.
async fn measured_lake() -> (tempfile::TempDir, Lake) {
    let (folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    put(&lake, "flat", "r2").await;
    (folder, lake)
}

#[tokio::test]
async fn tables_are_read_by_standard_scans_alone() {
    let (_folder, lake) = measured_lake().await;
    reject(&lake, "one", "r1", Some(vec![1]), "rejected").await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let views =
        LakeView::ALL.into_iter().filter(|view| !matches!(view, LakeView::RoomParameters | LakeView::Augmented));
    let names = Table::ALL.map(Table::name).into_iter().chain(views.map(LakeView::name));
    for sql in names.map(|name| format!("select * from {name}")) {
        let (_, plan) = physical_plan(&engine, &sql).await.expect(&sql);
        check_standard(&sql, &plan);
    }
}

/// A lake whose events are in one merged file: of three runs, one of which has newer rows elsewhere, and one of another
/// project; beside it files of one run. `lines` of the last make the table a small one, or not.
async fn merged_lake(lines: usize) -> (tempfile::TempDir, Lake) {
    let (folder, lake) = lake().await;
    for (surface, run, lines) in [("flat", "r1", 3), ("foam", "r2", 5), ("wood_secret", "r3", 7), ("foam", "r4", lines)]
    {
        put_events(&lake, surface, run, "old", lines).await;
    }
    lake.optimize(128 << 20, &AtomicBool::new(false), &mut |_| {}).await.expect("merged");
    put_events(&lake, "foam", "r2", "new", 2).await;
    put_events(&lake, "foam", "r5", "old", 4).await;
    (folder, lake)
}

async fn check_hidden_parts(others: usize) {
    let (_folder, lake) = merged_lake(others).await;
    let restricted = lake.restricted_to(["ours".parse().expect("a name")].into());
    let of_all = vec![("r1", 3), ("r2", 2), ("r3", 7), ("r4", others), ("r5", 4)];
    let of_ours: Vec<_> = of_all.iter().copied().filter(|(run, _)| *run != "r3").collect();
    for (lake, runs) in [(&lake, of_all), (&restricted, of_ours)] {
        let engines = [(); 2].map(|()| QueryEngine::new(lake, None).expect("an engine"));
        let [engine, worker] = &engines;
        worker.catalog().current_snapshot().await.expect("its snapshot");
        let view = lake.snapshot().await.expect("a view");
        let hidden = view.files(Table::Events).iter().filter(|file| !file.hidden.is_empty());
        assert_eq!(hidden.count(), 1, "a file has hidden rows");
        let total = runs.iter().map(|(_, rows)| rows).sum::<usize>();
        let expected = runs.iter().filter(|(_, rows)| *rows > 0).map(|(run, rows)| format!("{run} | {rows}"));
        let expected: Vec<_> = expected.collect();
        let counted = check_sent(engine, worker, "select run_id, count(*) from events group by run_id").await;
        assert_eq!(counted, expected);
        for (sql, expected) in [
            ("select count(*) from events", total.to_string()),
            ("select count(message) from events", total.to_string()),
            (
                "select count(*) from events where surface_id >= 'wood'",
                runs.iter().find(|(run, _)| *run == "r3").map_or(0, |(_, rows)| *rows).to_string(),
            ),
            ("select count(*) from events where message = 'old' and run_id = 'r2'", "0".to_owned()),
            ("select max(run_id) from events where run_id < 'r4'", runs[runs.len() - 3].0.to_owned()),
            ("select count(*) from (select message from events limit 4)", "4".to_owned()),
        ] {
            assert_eq!(check_sent(engine, worker, sql).await, [expected], "{sql}");
        }
        let all = check_sent(engine, worker, "select * from events").await;
        assert_eq!(all.len(), total);
    }
    let session = Session::new(&restricted).expect("a session");
    for sql in [
        "explain verbose select * from events",
        "explain verbose select count(*) from events where surface_id >= 'wood'",
        "explain analyze select run_id, count(*) from events where message <> 'x' group by run_id",
        "explain analyze verbose select message from events where log_time_ns >= 0",
    ] {
        let text: String = super::tests::rows(&session, sql).await.iter().map(|batch| format!("{batch:?}")).collect();
        for hidden in ["r3", "secret"] {
            assert!(!text.contains(hidden), "{sql}: {hidden}: {text}");
        }
        // All rows of the file, and those of the reader's projects that have been replaced.
        let counts: BTreeSet<usize> =
            text.split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse().ok()).collect();
        for count in [others + 15, others + 8].into_iter().filter(|count| *count > 1000) {
            assert!(!counts.contains(&count), "{sql}: {count}: {text}");
        }
    }
    // What another one computes of a hidden row would be seen by its error.
    let divided = "select count(*) from events where 1 / (length(surface_id) - 11) < 5";
    let counted = super::tests::rows(&session, divided).await;
    assert_eq!(counted.iter().map(RecordBatch::num_rows).sum::<usize>(), 1);
}

// Whether a scan of Parquet files leaves out rows by its predicate.
fn filters_rows(plan: &Arc<dyn ExecutionPlan>) -> bool {
    let scan = plan.downcast_ref::<DataSourceExec>().and_then(|scan| scan.data_source().downcast_ref());
    let source = scan.and_then(|scan: &FileScanConfig| scan.file_source().downcast_ref::<ParquetSource>());
    source.is_some_and(|source| source.table_parquet_options().global.pushdown_filters)
        || plan.children().into_iter().any(filters_rows)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_first_rows_of_large_files_are_found_by_their_order_columns() {
    let (_folder, lake) = merged_lake(70_000).await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    for (sql, is_filtered) in [
        ("select run_id, log_time_ns, message from events order by log_time_ns desc, run_id limit 5", true),
        ("select run_id, log_time_ns from events order by log_time_ns, run_id desc limit 12", true),
        ("select run_id, log_time from events where log_time_ns % 7 = 3 order by log_time desc, run_id limit 40", true),
        ("select surface_id, log_time_ns from events where message = 'old' order by run_id, log_time_ns limit 9", true),
        ("select run_id, log_time_ns from events where log_time_ns < -1 order by log_time_ns, run_id limit 3", false),
        ("select run_id, log_time_ns from events where run_id = 'r4' and log_time_ns > 69990", false),
        ("select run_id, count(*) as n from events group by run_id order by n desc limit 2", false),
    ] {
        let (state, plan) = physical_plan(&engine, sql).await.expect(sql);
        let expected = row_texts(plan, &state).await;
        let (state, plan) = physical_plan(&engine, sql).await.expect(sql);
        let local = engine.rewrite_local_scans(plan).expect("rewritten");
        let text = displayable(local.as_ref()).indent(false).to_string();
        assert_eq!(filters_rows(&local), is_filtered, "{sql}: {text}");
        check_same(sql, &text, &expected, &row_texts(local, &state).await);
    }
}

mod slow {
    use super::*;

    // A small table is in memory, a larger one is scanned.
    #[tokio::test(flavor = "multi_thread")]
    async fn hidden_rows_stay_hidden_on_another_engine() {
        for others in [0, 30_000] {
            check_hidden_parts(others).await;
        }
    }
}
