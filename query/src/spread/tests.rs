//! Queries over workers of this process: they answer what one machine does, and refuse and lose what they should.

use std::net::SocketAddr;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray as _};
use arrow::datatypes::{DataType, Float32Type, Float64Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use arrow::util::display::array_value_to_string;
use datafusion::common::DataFusionError;
use echolake_lake::Lake;
use object_store::ObjectStoreExt as _;
use object_store::path::Path;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tonic::transport::Server;
use tonic::transport::server::TcpIncoming;

use super::*;
use crate::functions::tests::{SmallLake, examples};
use crate::mcap::tests as mcap_tests;
use crate::{EngineClient, EngineLimits, Error, QueryEngine, QueryQuota, Session};

const BUILD: &str = "0.1.0-test";

fn identity(lake: &str) -> WorkerIdentity {
    WorkerIdentity { build: BUILD.to_owned(), lake: lake.to_owned() }
}

/// A worker on threads of its own; its connections end with them.
pub(super) struct TestWorker {
    pub(super) address: SocketAddr,
    runtime: Option<Runtime>,
}

impl TestWorker {
    pub(super) fn start(lake: &Lake) -> Self {
        let runtime = Runtime::new().expect("threads");
        let engine = QueryEngine::new(lake, EngineLimits::default()).expect("an engine");
        let worker = SpreadWorker::new(&engine, &identity("small"), &WorkerLink::default()).expect("a worker");
        let listening = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        listening.set_nonblocking(true).expect("tokio's");
        let address = listening.local_addr().expect("an address");
        let serving = async move {
            let incoming = TcpIncoming::from(TcpListener::from_std(listening).expect("a listener"));
            // Its tasks need the engine as long as it runs.
            let _engine = engine;
            Server::builder().add_routes(worker.into_routes()).serve_with_incoming(incoming).await
        };
        runtime.spawn(serving);
        Self { address, runtime: Some(runtime) }
    }

    fn end(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Drop for TestWorker {
    fn drop(&mut self) {
        self.end();
    }
}

fn settings(workers: &[TestWorker]) -> ClusterSettings {
    let urls = workers.iter().map(|worker| format!("http://{}", worker.address).parse().expect("a URL"));
    ClusterSettings {
        workers: urls.collect(),
        link: WorkerLink::default(),
        identity: identity("small"),
        least_bytes: 0,
    }
}

fn session(lake: &Lake, workers: &[TestWorker], change: impl FnOnce(&mut ClusterSettings)) -> Session {
    let mut settings = settings(workers);
    change(&mut settings);
    session_over(lake, &Arc::new(WorkerCluster::new(settings).expect("a cluster")))
}

fn session_over(lake: &Lake, cluster: &Arc<WorkerCluster>) -> Session {
    let engine = QueryEngine::new(lake, EngineLimits::default()).expect("an engine");
    engine.spread_over(cluster.clone());
    engine.session(&Arc::new(EngineClient::new("somebody", QueryQuota::default())))
}

pub(super) async fn answer(session: &Session, sql: &str) -> Result<(SchemaRef, Vec<RecordBatch>), Error> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok((answer.schema.clone(), batches))
}

// A row as text. Sums of floats depend on the order of their parts, in their last digits.
fn cell(column: &ArrayRef, row: usize) -> String {
    if column.is_null(row) {
        return "null".to_owned();
    }
    let list = |values: ArrayRef| (0..values.len()).map(|i| cell(&values, i)).collect::<Vec<_>>().join(",");
    match column.data_type() {
        DataType::Float64 => format!("{:.9e}", column.as_primitive::<Float64Type>().value(row)),
        DataType::Float32 => format!("{:.5e}", column.as_primitive::<Float32Type>().value(row)),
        DataType::List(_) => list(column.as_list::<i32>().value(row)),
        DataType::FixedSizeList(..) => list(column.as_fixed_size_list().value(row)),
        _ => array_value_to_string(column, row).expect("a text"),
    }
}

pub(super) fn lines(batches: &[RecordBatch], is_ordered: bool) -> Vec<String> {
    let line = |batch: &RecordBatch, row| batch.columns().iter().map(|c| cell(c, row)).collect::<Vec<_>>().join(" | ");
    let of_batch = |batch: &RecordBatch| (0..batch.num_rows()).map(|row| line(batch, row)).collect::<Vec<_>>();
    let mut lines: Vec<_> = batches.iter().flat_map(of_batch).collect();
    if !is_ordered {
        lines.sort();
    }
    lines
}

async fn explained(session: &Session, sql: &str) -> String {
    let (_, batches) = answer(session, &format!("explain {sql}")).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    lines(&batches, true).join("\n")
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

async fn check_answers(lake: &Lake, workers: &[TestWorker], queries: &[String]) -> usize {
    let local = Session::new(lake).expect("a session");
    let spread = session(lake, workers, |_| {});
    let mut count = 0;
    for sql in queries {
        let (schema, expected) = answer(&local, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        let (spread_schema, given) = answer(&spread, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        assert_eq!(spread_schema, schema, "{sql}");
        for batch in &given {
            assert_eq!(batch.schema(), schema, "{sql}");
        }
        let is_ordered = sql.contains("order by") && !sql.contains("over (");
        assert_eq!(lines(&given, is_ordered), lines(&expected, is_ordered), "{sql} over {} workers", workers.len());
        let is_spread =
            explained(&spread, sql).await.contains(&format!("\nspread over {0} of {0} workers", workers.len()));
        count += usize::from(is_spread);
    }
    count
}

/// Every kind of function over rows that workers read: the examples of the manual have their own rows, mostly.
const FUNCTIONS: [&str; 14] = [
    "db(abs(ir[5]))",
    "list_db(list_multiply(ir, ir))",
    "band_energy(ir)",
    "nce(ir, list_energy(ir))",
    "spectrum(ir)",
    "edc(ir)",
    "arrival(ir, 0)",
    "rise_time(nce(ir, list_energy(ir)))",
    "centre_time(nce(ir, list_energy(ir)))",
    "pearson(ir, ir)",
    "similarity(ir, ir)",
    "d4_pair(pair_id, 'rot180')",
    "d4_point(0, 'rot180')",
    "speed_of_sound(20 + ir[1])",
];

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn explain_says_what_is_spread_and_why_not() {
    let small = SmallLake::new().await;
    let workers = [TestWorker::start(&small.lake), TestWorker::start(&small.lake)];
    let eager = session(&small.lake, &workers, |_| {});
    let heavy = "select surface_id, sum(ir[1]) from measurements group by surface_id";
    let text = explained(&eager, heavy).await;
    assert!(text.contains("spread over 2 of 2 workers: it reads about 1 MiB"), "{text}");
    assert!(text.contains("NetworkShuffleExec") || text.contains("NetworkCoalesceExec"), "{text}");
    for (sql, reason) in [
        ("select 1", "it reads no table file"),
        ("select count(*) from pairs", "it reads no table file"),
        ("select count(*) from generate_series(1, 10)", "is not sent to workers"),
        ("select * from nce order by surface_id, pair_id limit 7", "asks for the first rows of an order"),
    ] {
        let text = explained(&eager, sql).await;
        assert!(text.contains("not spread over workers: ") && text.contains(reason), "{sql}: {text}");
    }
    // No statistics exclude files from what is computed.
    let computed = "select pair_id from measurements order by list_energy(ir) limit 3";
    let text = explained(&eager, computed).await;
    assert!(text.contains("spread over 2 of 2 workers"), "{text}");
    let usual = session(&small.lake, &workers, |settings| settings.least_bytes = 64 << 20);
    let text = explained(&usual, heavy).await;
    assert!(text.contains("not spread over workers: it reads about 1 MiB, less than 64 MiB"), "{text}");
    let analyzed =
        lines(&answer(&eager, &format!("explain analyze {heavy}")).await.expect("metrics").1, true).join("\n");
    assert!(analyzed.contains("output_rows"), "{analyzed}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_of_others_are_not_used() {
    let small = SmallLake::new().await;
    let workers = [TestWorker::start(&small.lake)];
    let sql = "select count(*) from measurements where ir[1] <> 0";
    let expected = lines(&answer(&Session::new(&small.lake).expect("a session"), sql).await.expect("rows").1, true);
    for other in [identity("another"), WorkerIdentity { build: "0.1.0-other".to_owned(), lake: "small".to_owned() }] {
        let session = session(&small.lake, &workers, |settings| settings.identity = other);
        let text = explained(&session, sql).await;
        assert!(text.contains("not spread over workers: none of 1 answers"), "{text}");
        assert_eq!(lines(&answer(&session, sql).await.expect("rows").1, true), expected);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_worker_costs_no_answer() {
    let small = SmallLake::new().await;
    let mut workers: Vec<_> = (0..3).map(|_| TestWorker::start(&small.lake)).collect();
    let cluster = Arc::new(WorkerCluster::new(settings(&workers)).expect("a cluster"));
    let session = session_over(&small.lake, &cluster);
    let sql = "select surface_id, count(*), sum(pair_id) from measurements where ir[1] <> 7 group by 1 order by 1";
    let expected = lines(&answer(&session, sql).await.expect("rows").1, true);
    assert_eq!(expected.len(), 2);
    // The engine takes all for alive, because it has just asked them.
    workers[0].end();
    assert_eq!(lines(&answer(&session, sql).await.expect("over two").1, true), expected);
    assert_eq!(cluster.counts(), SpreadCounts { spread: 2, repeated: 1, returned: 0 });
    workers[1].end();
    workers[2].end();
    assert_eq!(lines(&answer(&session, sql).await.expect("here").1, true), expected);
    assert_eq!(cluster.counts(), SpreadCounts { spread: 3, repeated: 1, returned: 1 });
    let text = explained(&session, sql).await;
    assert!(text.contains("none of 3 answers"), "{text}");
    assert!(cluster.workers().iter().all(|worker| worker.problem.is_some()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn limits_hold_and_own_errors_stay() {
    let small = SmallLake::new().await;
    let workers = [TestWorker::start(&small.lake), TestWorker::start(&small.lake)];
    let session = session(&small.lake, &workers, |_| {});
    let local = Session::new(&small.lake).expect("a session");
    let wrong = "select 1 / (pair_id - pair_id) from measurements where ir[1] <> 7";
    let errors =
        [answer(&session, wrong).await, answer(&local, wrong).await].map(|a| a.expect_err("a fault").to_string());
    assert_eq!(errors[0], errors[1]);
    let text = DataFusionError::from(WorkerLoss::new("it is gone"));
    assert!(matches!(Error::execution(&text), Error::WorkerLost { message } if message == "it is gone"));
}

mod slow {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn spread_answers_are_those_of_one_machine() {
        let small = SmallLake::new().await;
        let queries = QUERIES.map(str::to_owned);
        for count in [1, 2, 4] {
            let workers: Vec<_> = (0..count).map(|_| TestWorker::start(&small.lake)).collect();
            let spread = check_answers(&small.lake, &workers, &queries).await;
            assert!(count == 1 || spread == queries.len(), "{spread} of {} are spread over {count}", queries.len());
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn functions_answer_over_workers_what_they_do_here() {
        let small = SmallLake::new().await;
        let workers = [TestWorker::start(&small.lake), TestWorker::start(&small.lake)];
        let examples: Vec<_> = examples().into_iter().map(|(_, query, _)| query).collect();
        let spread = check_answers(&small.lake, &workers, &examples).await;
        assert!(spread > 0, "none of {} examples is spread", examples.len());
        let from = "from measurements where pair_id < 10 order by surface_id, pair_id";
        let mut queries: Vec<_> = FUNCTIONS.map(|call| format!("select {call} as x, ir[1] as y {from}")).into();
        queries.push(
            "select surface_id, p90_mean(ir[9]), avg_list(ir) from measurements group by 1 order by 1".to_owned(),
        );
        let spread = check_answers(&small.lake, &workers, &queries).await;
        assert_eq!(spread, queries.len());
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn run_files_are_read_by_workers() {
        let small = SmallLake::new().await;
        for (name, seconds) in [("a", 30), ("b", 3), ("c", 11)] {
            let file = mcap_tests::json_file(mcap_tests::options(None), seconds);
            let path = Path::from(format!("inbox/{name}.mcap"));
            small.lake.store().put(&path, file.into()).await.expect("written");
        }
        let files = "inbox/a.mcap,inbox/b.mcap,inbox/c.mcap";
        let queries = [
            format!(
                "select run_id, log_time, x, name, tags, \"at\" from mcap('{files}', '/point') order by name, log_time"
            ),
            format!(
                "select topic, count(*), sum(size), max(data) from mcap_messages('{files}') group by topic order by topic"
            ),
            format!(
                "select p.name, m.pair_id from mcap('{files}', '/point') p join measurements m on p.sequence = m.pair_id \
                 order by p.name, m.surface_id"
            ),
            format!("select count(*) from mcap('{files}', '/point') where x > 3 and log_time_ns % 3 = 0"),
            format!("select name from mcap('{files}', '/point') where log_time_ns < 1767657605000000000"),
        ];
        for count in [2, 3] {
            let workers: Vec<_> = (0..count).map(|_| TestWorker::start(&small.lake)).collect();
            assert_eq!(check_answers(&small.lake, &workers, &queries).await, queries.len());
        }
        // Few rows of a run file are few bytes.
        let workers = [TestWorker::start(&small.lake), TestWorker::start(&small.lake)];
        let usual = session(&small.lake, &workers, |settings| settings.least_bytes = 1);
        let text = explained(&usual, &format!("select name from mcap('{files}', '/point') limit 3")).await;
        assert!(text.contains("not spread over workers: it reads about 0 MiB"), "{text}");
    }
}
