//! Queries over workers of this process: they answer what one machine does, and refuse and lose what they should.

use std::net::SocketAddr;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray as _};
use arrow::datatypes::{DataType, Float32Type, Float64Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use arrow::util::display::array_value_to_string;
use datafusion::common::DataFusionError;
use datafusion::physical_plan::{ExecutionPlan, collect};
use echolake_lake::{ContributedFile, Lake, annotation_rows};
use echolake_mcap_tables::{decode_mcap_scan, encode_mcap_scan};
use echolake_schema::Table;
use echolake_schema::annotations::{Annotation, AnnotationKind};
use object_store::ObjectStoreExt as _;
use object_store::path::Path;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic::transport::server::TcpIncoming;

use super::*;
use crate::session::function_tests::{SmallLake, examples};
use crate::{ContextExtension, EngineClient, Error, QueryEngine, QueryQuota, Session};

const BUILD: &str = "0.1.0-test";
const TOKEN: &str = "0123456789abcdef0123456789abcdef";

/// A worker on threads of its own; its connections end with them.
pub(super) struct TestWorker {
    pub address: SocketAddr,
    runtime: Option<Runtime>,
}

impl TestWorker {
    pub async fn start(lake: &Lake) -> Self {
        Self::start_with(lake, BUILD, None).await
    }

    async fn start_with(lake: &Lake, build: &str, token: Option<WorkerToken>) -> Self {
        let link = WorkerLink::new(token, None).expect("a link");
        let router = WorkerService::start(lake, None, build, &link).await.expect("a worker").into_router();
        let listening = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        listening.set_nonblocking(true).expect("tokio's");
        let address = listening.local_addr().expect("an address");
        let serving = async move {
            let incoming = TcpIncoming::from(TcpListener::from_std(listening).expect("a listener"));
            Server::builder().add_routes(Routes::from(router)).serve_with_incoming(incoming).await
        };
        let runtime = Runtime::new().expect("threads");
        runtime.spawn(serving);
        Self { address, runtime: Some(runtime) }
    }

    async fn start_some(lake: &Lake, count: usize) -> Vec<Self> {
        let mut workers = Vec::new();
        for _ in 0..count {
            workers.push(Self::start(lake).await);
        }
        workers
    }

    fn stop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Drop for TestWorker {
    fn drop(&mut self) {
        self.stop();
    }
}

fn make_settings(workers: &[TestWorker]) -> ClusterSettings {
    ClusterSettings {
        workers: workers.iter().map(|worker| format!("http://{}", worker.address)).collect(),
        token: None,
        authorities: None,
        least_bytes: 0,
        build: BUILD.to_owned(),
    }
}

async fn make_cluster(lake: &Lake, settings: &ClusterSettings) -> Arc<WorkerCluster> {
    let snapshot = lake.snapshot().await.expect("a snapshot");
    Arc::new(WorkerCluster::new(settings, snapshot.tables_id()).expect("a cluster"))
}

async fn open_session(lake: &Lake, workers: &[TestWorker], change: impl FnOnce(&mut ClusterSettings)) -> Session {
    let mut settings = make_settings(workers);
    change(&mut settings);
    session_over(lake, &make_cluster(lake, &settings).await)
}

fn session_over(lake: &Lake, cluster: &Arc<WorkerCluster>) -> Session {
    let engine = QueryEngine::new(lake, None).expect("an engine");
    engine.spread_over(cluster.clone());
    engine.open_session(&Arc::new(EngineClient::new("somebody", QueryQuota::default())))
}

pub(super) async fn read_answer(session: &Session, sql: &str) -> Result<(SchemaRef, Vec<RecordBatch>), Error> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok((answer.schema.clone(), batches))
}

// Sums of floats depend on the order of their parts, in their last digits.
fn cell_text(column: &ArrayRef, row: usize) -> String {
    if column.is_null(row) {
        return "null".to_owned();
    }
    let list = |values: ArrayRef| (0..values.len()).map(|i| cell_text(&values, i)).collect::<Vec<_>>().join(",");
    match column.data_type() {
        DataType::Float64 => format!("{:.11e}", column.as_primitive::<Float64Type>().value(row)),
        DataType::Float32 => format!("{:.5e}", column.as_primitive::<Float32Type>().value(row)),
        DataType::List(_) => list(column.as_list::<i32>().value(row)),
        DataType::FixedSizeList(..) => list(column.as_fixed_size_list().value(row)),
        _ => array_value_to_string(column, row).expect("a text"),
    }
}

pub(super) fn row_texts(batches: &[RecordBatch], is_ordered: bool) -> Vec<String> {
    let text =
        |batch: &RecordBatch, row| batch.columns().iter().map(|c| cell_text(c, row)).collect::<Vec<_>>().join(" | ");
    let of_batch = |batch: &RecordBatch| (0..batch.num_rows()).map(|row| text(batch, row)).collect::<Vec<_>>();
    let mut texts: Vec<_> = batches.iter().flat_map(of_batch).collect();
    if !is_ordered {
        texts.sort();
    }
    texts
}

async fn read_rows(session: &Session, sql: &str) -> Vec<String> {
    row_texts(&read_answer(session, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}")).1, true)
}

async fn explain(session: &Session, sql: &str) -> String {
    read_rows(session, &format!("explain {sql}")).await.join("\n")
}

fn find_leaf(plan: &Arc<dyn ExecutionPlan>) -> &Arc<dyn ExecutionPlan> {
    plan.children().first().map_or(plan, |child| find_leaf(child))
}

/// Queries of the lake's kinds; in each, all that is not ordered is compared as a set.
const QUERIES: [&str; 16] = [
    "select surface_id, run_id, pair_id, ir from measurements order by surface_id, pair_id",
    "select * from nce where pair_id < 7 order by surface_id, pair_id",
    "select * from measurements",
    "select surface_id, count(*), avg(snr_db), max(ir[1]) from measurements group by surface_id order by surface_id",
    "select count(*) from nce where nce_2500[10] > 0",
    "select count(distinct pair_id) from measurements where ir[3] <> 0",
    "select m.pair_id, n.nce_5000[384] as last from measurements m join nce n using (surface_id, pair_id) order by 1, 2",
    "select m.pair_id, p.direct_mm, list_energy(m.ir) as e from measurements m join pairs p using (pair_id) order by 1, 3",
    "select * from ir order by surface_id, pair_id",
    "select pair_id, ir[1] from measurements where surface_id = 'flat' union all select pair_id, nce_2500[1] from nce",
    "select pair_id from measurements where pair_id in (select pair_id from nce where nce_2500[1] >= 0) order by 1",
    "select pair_id, (select max(nce_2500[384]) from nce) as most from measurements order by pair_id, most",
    "select pair_id, row_number() over (partition by surface_id order by pair_id) as n, ir[2] from measurements",
    "select a.pair_id, b.pair_id from measurements a left join nce b on a.pair_id = b.pair_id + 3 and b.nce_2500[1] > 0",
    "select d.m, count(*) from (select ir[1] > 0 as m, surface_id from measurements) d group by grouping sets ((d.m), ())",
    "select list_energy(ir) as e, surface_id || '-' || pair_id as name from measurements where pair_id % 2 = 1 order by e",
];

/// Returns how many of the queries are spread, after comparing all answers with those of one machine.
async fn compare_answers(lake: &Lake, workers: &[TestWorker], queries: &[String]) -> usize {
    let local = Session::new(lake).expect("a session");
    let cluster = make_cluster(lake, &make_settings(workers)).await;
    let spread = session_over(lake, &cluster);
    let mut count = 0;
    for sql in queries {
        let (schema, expected) = read_answer(&local, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        let before = cluster.spread_counts();
        let (spread_schema, given) = read_answer(&spread, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        let counts = cluster.spread_counts().since(&before);
        assert_eq!(counts.repeated, 0, "{sql}");
        assert_eq!(spread_schema, schema, "{sql}");
        for batch in &given {
            assert_eq!(batch.schema(), schema, "{sql}");
        }
        let is_ordered = sql.contains("order by") && !sql.contains("over (");
        let expected = row_texts(&expected, is_ordered);
        assert_eq!(row_texts(&given, is_ordered), expected, "{sql} over {} workers", workers.len());
        count += usize::from(counts.spread > counts.returned);
    }
    count
}

/// Every kind of function over rows that workers read: the examples of the manual have their own rows, mostly.
const FUNCTIONS: [&str; 13] = [
    "db(abs(ir[5]))",
    "list_db(list_multiply(ir, ir))",
    "band_energy(ir)",
    "nce(ir, list_energy(ir))",
    "spectrum(ir)",
    "edc(ir)",
    "arrival(ir, 0)",
    "rise_time(nce(ir, list_energy(ir)))",
    "pearson(ir, ir)",
    "similarity(ir, ir)",
    "d4_pair(pair_id, 'rot180')",
    "d4_point(0, 'rot180')",
    "speed_of_sound(20 + ir[1])",
];

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn explain_gives_the_decision_and_its_reason() {
    let small = SmallLake::new().await;
    let workers = TestWorker::start_some(&small.lake, 2).await;
    let eager = open_session(&small.lake, &workers, |_| {}).await;
    let heavy = "select surface_id, max(ir[1]) from measurements group by surface_id";
    let text = explain(&eager, heavy).await;
    assert!(text.contains("spread over 2 of 2 workers: it reads about 1 MiB"), "{text}");
    assert!(text.contains("NetworkShuffleExec") || text.contains("NetworkCoalesceExec"), "{text}");
    for (sql, reason) in [
        ("select 1", "it reads no table file"),
        ("select count(*) from generate_series(1, 10)", "is not sent to workers"),
        ("select * from nce order by surface_id, pair_id limit 7", "asks for the first rows of an order"),
        ("select count(*) from nce n asof join measurements m using (run_id, pair_id)", "SortedJoinExec"),
    ] {
        let text = explain(&eager, sql).await;
        assert!(text.contains("not spread over workers: ") && text.contains(reason), "{sql}: {text}");
    }
    // No statistics exclude files from what is computed.
    let computed = "select pair_id from measurements order by list_energy(ir) limit 3";
    let text = explain(&eager, computed).await;
    assert!(text.contains("spread over 2 of 2 workers"), "{text}");
    let usual = open_session(&small.lake, &workers, |settings| settings.least_bytes = 64 << 20).await;
    let text = explain(&usual, heavy).await;
    assert!(text.contains("not spread over workers: it reads about 1 MiB, less than 64 MiB"), "{text}");
    let analyzed = read_rows(&eager, &format!("explain analyze {heavy}")).await.join("\n");
    assert!(analyzed.contains("output_rows"), "{analyzed}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_of_others_are_not_used() {
    let small = SmallLake::new().await;
    let token = || Some(WorkerToken::parse(TOKEN).expect("a token"));
    let sql = "select count(*) from measurements where ir[1] <> 0";
    let expected = read_rows(&Session::new(&small.lake).expect("a session"), sql).await;
    let own = [TestWorker::start(&small.lake).await];
    let guarded = [TestWorker::start_with(&small.lake, BUILD, token()).await];
    let of_other_build = [TestWorker::start_with(&small.lake, "0.1.0-other", None).await];
    let other_lake = SmallLake::new().await;
    let of_other_lake = [TestWorker::start(&other_lake.lake).await];
    let other_token = Some(WorkerToken::parse(&TOKEN.replace('0', "x")).expect("a token"));
    for (workers, token, reason) in [
        (&of_other_build, None, "it is of another build: 0.1.0-other, expected 0.1.0-test"),
        (&of_other_lake, None, "it has another lake"),
        (&guarded, None, "this worker needs a token"),
        (&guarded, other_token, "the token is not this worker's"),
    ] {
        let settings = ClusterSettings { token, ..make_settings(workers) };
        let cluster = make_cluster(&small.lake, &settings).await;
        let session = session_over(&small.lake, &cluster);
        let text = explain(&session, sql).await;
        assert!(text.contains("not spread over workers: none of 1 answers"), "{text}");
        assert_eq!(read_rows(&session, sql).await, expected);
        let problem = cluster.worker_states()[0].problem.clone().expect("a problem");
        assert!(problem.contains(reason), "{problem}");
        assert!(cluster.worker_states()[0].was_asked());
    }
    for (workers, token) in [(&own, None), (&guarded, token())] {
        let cluster = make_cluster(&small.lake, &ClusterSettings { token, ..make_settings(workers) }).await;
        assert_eq!(cluster.usable_workers().await.len(), 1);
        let state = cluster.worker_states().remove(0);
        assert!(state.figures.is_some() && state.build.as_deref() == Some(BUILD), "{state:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tables_that_were_made_again_are_found_on_workers() {
    let small = SmallLake::new().await;
    let workers = TestWorker::start_some(&small.lake, 2).await;
    let before = WorkerCluster::new(&make_settings(&workers), "the tables of before").expect("a cluster");
    assert!(before.ask_workers().await.iter().all(|worker| worker.problem.is_some()));
    let sql = "select surface_id, max(ir[1]) from measurements group by surface_id";
    let text = explain(&session_over(&small.lake, &Arc::new(before)), sql).await;
    assert!(text.contains("spread over 2 of 2 workers"), "{text}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_worker_costs_no_answer() {
    let small = SmallLake::new().await;
    let mut workers = TestWorker::start_some(&small.lake, 3).await;
    let cluster = make_cluster(&small.lake, &make_settings(&workers)).await;
    let session = session_over(&small.lake, &cluster);
    let sql =
        "select surface_id, count(*), min(pair_id) from measurements where array_length(ir) > 7 group by 1 order by 1";
    let expected = read_rows(&session, sql).await;
    assert_eq!(expected.len(), 2);
    // The engine takes all for alive, because it has just asked them.
    workers[0].stop();
    assert_eq!(read_rows(&session, sql).await, expected);
    assert_eq!(cluster.spread_counts(), SpreadCounts { spread: 2, repeated: 1, returned: 0 });
    workers[1].stop();
    workers[2].stop();
    assert_eq!(read_rows(&session, sql).await, expected);
    assert_eq!(cluster.spread_counts(), SpreadCounts { spread: 3, repeated: 1, returned: 1 });
    let text = explain(&session, sql).await;
    assert!(text.contains("none of 3 answers"), "{text}");
    assert!(cluster.worker_states().iter().all(|worker| worker.problem.is_some()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn own_errors_stay() {
    let small = SmallLake::new().await;
    let workers = TestWorker::start_some(&small.lake, 2).await;
    let session = open_session(&small.lake, &workers, |_| {}).await;
    let local = Session::new(&small.lake).expect("a session");
    let wrong = "select 1 / (pair_id - pair_id) from measurements where ir[1] <> 7";
    let errors = [read_answer(&session, wrong).await, read_answer(&local, wrong).await]
        .map(|answer| answer.expect_err("a fault").to_string());
    assert_eq!(errors[0], errors[1]);
    let lost = DataFusionError::from(WorkerLoss::new("it is gone"));
    assert!(matches!(Error::from_execution("", &lost), Error::WorkerLost { message } if message == "it is gone"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_takes_its_time_zone_along() {
    let small = SmallLake::new().await;
    let workers = TestWorker::start_some(&small.lake, 2).await;
    let sql = "select date_trunc('minute', to_timestamp(pair_id)) as minute, count(*) from measurements \
               where array_length(ir) > 7 group by 1 order by 1";
    let zoned = "select cast(date_trunc('day', cast(to_timestamp(pair_id) as timestamptz)) as varchar) as day, count(*) \
                 from measurements where array_length(ir) > 7 group by 1 order by 1";
    let mut seen = Vec::new();
    for zone in ["UTC", "Asia/Tokyo"] {
        let extend: ContextExtension = Arc::new(move |context| {
            context.state_ref().write().config_mut().options_mut().execution.time_zone = Some(zone.to_owned());
            Ok(())
        });
        let cluster = make_cluster(&small.lake, &make_settings(&workers)).await;
        let spread = session_over(&small.lake, &cluster).with_extension(extend.clone());
        let local = Session::new(&small.lake).expect("a session").with_extension(extend);
        for sql in [sql, zoned] {
            let expected = read_rows(&local, sql).await;
            assert_eq!(read_rows(&spread, sql).await, expected, "{zone}: {sql}");
            seen.push(expected);
        }
        assert_eq!(cluster.spread_counts(), SpreadCounts { spread: 2, repeated: 0, returned: 0 }, "{zone}");
    }
    assert_ne!(seen[1], seen[3], "the zone matters");
    let extend: ContextExtension = Arc::new(|context| {
        context.state_ref().write().config_mut().options_mut().execution.keep_partition_by_columns = true;
        Ok(())
    });
    let other = open_session(&small.lake, &workers, |_| {}).await.with_extension(extend);
    let text = explain(&other, sql).await;
    assert!(
        text.contains("not spread over workers: workers do not take over the option datafusion.execution."),
        "{text}"
    );
}

// Rejects two pairs of the panel's run, as a server does.
async fn reject_pairs(lake: &Lake) {
    let table = Table::Annotations;
    lake.prepare_contributions(table).await.expect("prepared");
    let snapshot = lake.snapshot().await.expect("a snapshot");
    let seen = snapshot.log_version(table).expect("a log");
    let annotation = Annotation {
        annotation_id: "a".to_owned(),
        run_id: "r-0015_0".parse().expect("an id"),
        pair_ids: Some(vec![1, 3]),
        kind: AnnotationKind::Verdict,
        value: "rejected".to_owned(),
        comment: String::new(),
        author: "a test".to_owned(),
        time: chrono::DateTime::UNIX_EPOCH,
        lake_version: None,
    };
    let rows = annotation_rows(lake, &snapshot, &[annotation]).expect("rows");
    let files = ContributedFile::encode_rows(lake, table, &rows).expect("files");
    lake.add_contribution(table, seen, files).await.expect("added").expect("the newest");
}

/// A file of so many messages of `/point`, ten in a chunk, and as many of `/note`.
pub(super) fn write_run_file(count: u32) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let mut writer = mcap::Writer::new(&mut file).expect("a writer");
    let layout = br#"{"type":"object","properties":{"x":{"type":"number"},"name":{"type":"string"}}}"#;
    let schema = writer.add_schema("Point", "jsonschema", layout).expect("added");
    let point = writer.add_channel(schema, "/point", "json", &Default::default()).expect("added");
    let note = writer.add_channel(0, "/note", "json", &Default::default()).expect("added");
    for sequence in 0..count {
        let log_time = u64::from(sequence) * 1_000_000_000;
        let header =
            |channel_id| mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        let text = format!(r#"{{"x":{sequence}.5,"name":"p{sequence}"}}"#);
        writer.write_to_known_channel(&header(point), text.as_bytes()).expect("written");
        writer.write_to_known_channel(&header(note), br#"{"free":"form"}"#).expect("written");
        if sequence % 10 == 9 {
            writer.flush().expect("flushed");
        }
    }
    writer.finish().expect("finished");
    drop(writer);
    file.into_inner()
}

mod slow {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn run_files_are_read_by_workers() {
        let small = SmallLake::new().await;
        for (name, count) in [("a", 300), ("b", 3), ("c", 110)] {
            let path = Path::from(format!("inbox/{name}.mcap"));
            small.lake.store().put(&path, write_run_file(count).into()).await.expect("written");
        }
        let files = "inbox/a.mcap,inbox/b.mcap,inbox/c.mcap";
        let queries = [
            format!(
                "select run_id, log_time, x, name, sequence from mcap('{files}', '/point') order by name, log_time"
            ),
            format!("select topic, count(*), sum(size), max(data) from mcap_messages('{files}') group by 1 order by 1"),
            format!(
                "select p.name, m.pair_id from mcap('{files}', '/point') p \
                 join measurements m on p.sequence = m.pair_id order by p.name, m.surface_id"
            ),
            format!("select count(*) from mcap('{files}', '/point') where x > 3 and log_time_ns % 3 = 0"),
            format!("select name from mcap('{files}', '/point') where log_time_ns < 57605000000"),
            format!("select count(*) from mcap_messages('{files}', '/note')"),
        ];
        for count in [2, 3] {
            let workers = TestWorker::start_some(&small.lake, count).await;
            assert_eq!(compare_answers(&small.lake, &workers, &queries).await, queries.len());
        }
        // Few rows of a run file are few bytes.
        let workers = TestWorker::start_some(&small.lake, 2).await;
        let usual = open_session(&small.lake, &workers, |settings| settings.least_bytes = 1).await;
        let text = explain(&usual, &format!("select name from mcap('{files}', '/point') limit 3")).await;
        assert!(text.contains("not spread over workers: it reads about 0 MiB"), "{text}");
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn run_files_that_change_are_an_error() {
        let small = SmallLake::new().await;
        let path = Path::from("inbox/a.mcap");
        small.lake.store().put(&path, write_run_file(300).into()).await.expect("written");
        let session = Session::new(&small.lake).expect("a session");
        let plan = session.plan_locally("select x from mcap('inbox/a.mcap', '/point')").await;
        let bytes = encode_mcap_scan(find_leaf(&plan).as_ref()).expect("encoded").expect("a scan of run files");
        small.lake.store().put(&path, write_run_file(200).into()).await.expect("written");
        let engine = QueryEngine::new(&small.lake, None).expect("an engine");
        let scan = decode_mcap_scan(&bytes, engine.catalog().run_files()).expect("decoded");
        let error = collect(scan, engine.template_state().task_ctx()).await.expect_err("another file");
        assert!(error.to_string().contains("when the query was planned"), "{error}");
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn spread_answers_are_those_of_one_machine() {
        let small = SmallLake::new().await;
        let queries = QUERIES.map(str::to_owned);
        for count in [1, 2, 4] {
            let workers = TestWorker::start_some(&small.lake, count).await;
            let spread = compare_answers(&small.lake, &workers, &queries).await;
            assert!(count == 1 || spread == queries.len(), "{spread} of {} are spread over {count}", queries.len());
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn rejected_pairs_are_left_out_on_workers() {
        let small = SmallLake::new().await;
        reject_pairs(&small.lake).await;
        let workers = TestWorker::start_some(&small.lake, 2).await;
        let queries = [
            "select surface_id, pair_id, ir from ir order by surface_id, pair_id",
            "select surface_id, count(*), max(ir[5]) from ir group by surface_id order by surface_id",
        ];
        let local = Session::new(&small.lake).expect("a session");
        let count = |rows: Vec<String>| rows.len();
        let all = count(read_rows(&local, "select 1 from measurements").await);
        assert_eq!(count(read_rows(&local, queries[0]).await), all - 2, "they are left out");
        assert_eq!(compare_answers(&small.lake, &workers, &queries.map(str::to_owned)).await, queries.len());
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn functions_answer_over_workers_what_they_do_here() {
        let small = SmallLake::new().await;
        let workers = TestWorker::start_some(&small.lake, 2).await;
        let examples: Vec<_> = examples().into_iter().map(|(_, query, _)| query).collect();
        compare_answers(&small.lake, &workers, &examples).await;
        let from = "from measurements where pair_id < 10 order by surface_id, pair_id";
        let mut queries: Vec<_> = FUNCTIONS.map(|call| format!("select {call} as x, ir[1] as y {from}")).into();
        queries.push(
            "select surface_id, p90_mean(ir[9]), avg_list(ir) from measurements group by 1 order by 1".to_owned(),
        );
        let spread = compare_answers(&small.lake, &workers, &queries).await;
        assert_eq!(spread, queries.len());
    }
}
