//! An engine: queries of all clients, in a process that reads the lake and writes nothing. It answers the three protocols
//! on Unix sockets in a folder that only its user may enter; the door, which started it, is its only peer, has
//! authenticated the clients, and names the client of each request.

pub mod confinement;
mod watchdog;

use std::convert::Infallible;
use std::io::BufRead as _;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use echolake_lake::Lake;
use echolake_query::{
    ClusterSettings, EngineClient, EngineLimits, QueryEngine, QueryQuota, Session, WorkerCluster, stack_bytes,
};
use echolake_schema::tables::Table;
use echolake_service::{DoorMessage, EngineReport, EngineRole, EngineServices, EngineSocket, Error, LakeFigures};
use futures::FutureExt as _;
use tokio::sync::mpsc;

/// A query that has a new engine read what every query reads.
const WARM_UP: &str = "select count(*) from runs";
/// Time between two looks at the lake for its figures: in a folder, and on an object store, where three requests cost
/// money.
const LAKE_LOOK: Duration = Duration::from_secs(15);
const REMOTE_LAKE_LOOK: Duration = Duration::from_secs(60);
/// Statements of pages that compute at once, for each core: they are short, and of one client.
const PAGES_PER_CORE: usize = 8;
/// Those that have threads and wait until their rows are fetched, besides.
const PAUSED_SEATS: usize = 16;
/// Niceness of threads that run statements from outside: a page, which is computed beside them, has the processors
/// first.
const STATEMENT_NICENESS: i32 = 10;

/// What an engine is started with.
#[derive(Debug, Clone)]
pub struct EngineOptions<'a> {
    /// What it answers.
    pub role: EngineRole,
    /// The folder of its sockets.
    pub sockets: &'a Path,
    /// Bytes that its queries may hold.
    pub memory: usize,
    /// Bytes of decoded columns that it keeps.
    pub column_bytes: usize,
    /// Time from which a query is logged as slow; None for never.
    pub slow: Option<Duration>,
    /// Workers over which heavy queries are spread; None for no workers.
    pub workers: Option<ClusterSettings>,
}

/// Answers requests until standard input ends, which the door holds. It reads the lake first, and reports that it is
/// ready.
///
/// # Errors
/// [`Error::System`], [`Error::Query`], [`Error::Transport`].
pub async fn run_engine(lake: &Lake, options: EngineOptions<'_>) -> Result<(), Error> {
    let EngineOptions { role, sockets, memory, column_bytes, slow, workers } = options;
    let messages = read_messages();
    let http = EngineSocket::Http.listen_in(sockets)?;
    let flight_sql = EngineSocket::FlightSql.listen_in(sockets)?;
    #[cfg(feature = "postgres")]
    let postgres = EngineSocket::Postgres.listen_in(sockets)?;
    let niceness = (role == EngineRole::Statements).then_some(STATEMENT_NICENESS);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let computing = (role == EngineRole::Pages).then_some(cores * PAGES_PER_CORE);
    // Pages fetch the rows of their statements at once, but they may wait for a busy processor.
    let seats = computing.map(|computing| computing + PAUSED_SEATS);
    let limits = EngineLimits { memory: Some(memory), computing, niceness, column_bytes: Some(column_bytes), seats };
    let engine = QueryEngine::with_limits(lake, limits)?;
    warm_up(&engine).await?;
    if let Some(workers) = &workers {
        spread_queries(&engine, workers).await;
    }
    let services = EngineServices::new(lake, engine, slow)?;
    // Behind the start of its threads, whose stacks count.
    let stacks = seats.map_or(0, stack_bytes);
    confinement::limit_memory(memory + column_bytes + stacks).map_err(Error::System)?;
    watchdog::start_watchdog(&services, role, memory, column_bytes).map_err(Error::System)?;
    EngineReport::Ready.send_line();
    #[cfg(feature = "postgres")]
    let postgres = echolake_postgres::serve_postgres_socket(services.clone(), postgres);
    #[cfg(not(feature = "postgres"))]
    let postgres = std::future::pending();
    let of_statements = async {
        match role {
            EngineRole::Pages => match report_lake(lake, services.engine()).await {},
            EngineRole::Statements => tokio::select! {
                failed = echolake_flight::serve_flight_socket(services.clone(), flight_sql) => failed,
                failed = postgres => failed,
            },
        }
    };
    tokio::select! {
        () = services.obey_door(messages) => Ok(()),
        failed = echolake_http::serve_http_socket(services.clone(), Some(role), http) => failed,
        failed = of_statements => failed,
    }
}

// Without workers, an engine runs all queries itself.
async fn spread_queries(engine: &QueryEngine, workers: &ClusterSettings) {
    let session = engine.open_session(&Arc::new(EngineClient::new("workers", QueryQuota::default())));
    // If the lake cannot be read now, the first query finds its id.
    let lake_id = session.current_snapshot().await.map_or_else(|_| String::new(), |lake| lake.tables_id().to_owned());
    match WorkerCluster::new(workers, &lake_id) {
        Ok(cluster) => engine.spread_over(Arc::new(cluster)),
        Err(error) => tracing::warn!(error = &error as &dyn std::error::Error, "queries run without workers"),
    }
}

// A thread of its own, so that an engine ends with its door whatever its other threads do.
fn read_messages() -> mpsc::UnboundedReceiver<DoorMessage> {
    let (send, receive) = mpsc::unbounded_channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            match serde_json::from_str(&line) {
                // The receiver is gone if the engine has failed meanwhile.
                Ok(message) => drop(send.send(message)),
                Err(e) => tracing::error!(error = &e as &dyn std::error::Error, "the door wrote what is no message"),
            }
        }
        std::process::exit(0);
    });
    receive
}

// Reports the lake's figures again and again.
async fn report_lake(lake: &Lake, engine: &QueryEngine) -> Infallible {
    let session = engine.open_session(&Arc::new(EngineClient::new("lake figures", QueryQuota::default())));
    // Counted once for each version of `runs`.
    let mut damaged = (None, 0);
    loop {
        let figures = look_at_lake(lake, &session, &mut damaged).await;
        let figures = figures.inspect_err(|error| tracing::warn!(error, "the lake cannot be read")).ok();
        EngineReport::Lake(figures).send_line();
        tokio::time::sleep(if lake.is_remote() { REMOTE_LAKE_LOOK } else { LAKE_LOOK }).await;
    }
}

async fn look_at_lake(lake: &Lake, session: &Session, damaged: &mut (Option<u64>, u64)) -> Result<LakeFigures, String> {
    let snapshot = session.current_snapshot().await.map_err(|e| e.to_string())?;
    snapshot.check_run_tables().map_err(|e| e.to_string())?;
    let version = snapshot.log_version(Table::Runs);
    if damaged.0 != version {
        *damaged = (version, count_damaged_runs(session).await.map_err(|e| e.to_string())?);
    }
    LakeFigures::from_lake(lake, &snapshot, damaged.1).await.map_err(|e| e.to_string())
}

async fn count_damaged_runs(session: &Session) -> Result<u64, echolake_query::Error> {
    let mut answer = session.query("select run_id from runs where damaged > 0").await?;
    let mut runs = 0;
    while let Some(batch) = answer.next().await? {
        runs += batch.num_rows() as u64;
    }
    Ok(runs)
}

async fn warm_up(engine: &QueryEngine) -> Result<(), Error> {
    let session = engine.open_session(&Arc::new(EngineClient::new("warm-up", QueryQuota::default())));
    // A defect of the lake is reported to each client that queries it.
    let answer = async { session.query(WARM_UP).await?.next().await };
    drop(answer.boxed().await);
    // Plans all views.
    drop(session.table_schemas());
    Ok(())
}
