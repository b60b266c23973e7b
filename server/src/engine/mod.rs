//! An engine: the queries of one client, in a process of their own. It answers the three protocols on Unix sockets in a
//! folder that only its user may enter; the door, which started it, is its only peer and has authenticated the client.

pub mod confinement;
mod watchdog;

use std::convert::Infallible;
use std::io::BufRead as _;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use echolake_lake::Lake;
use echolake_query::{EngineClient, QueryEngine, QueryQuota, Session};
use echolake_schema::tables::Table;
use echolake_service::{ClientIdentity, DoorMessage, EngineReport, EngineSocket, Error, LakeFigures, QueryService};
use futures::FutureExt as _;
use tokio::sync::mpsc;

/// A query that has a new engine read what every query reads.
const WARM_UP: &str = "select count(*) from runs";
/// Time between two looks at the lake for its figures: in a folder, and on an object store, where three requests cost
/// money.
const LAKE_LOOK: Duration = Duration::from_secs(15);
const REMOTE_LAKE_LOOK: Duration = Duration::from_secs(60);

/// Answers one client's requests until standard input ends, which the door holds. Its queries may hold `memory` bytes;
/// those that take as long as `slow` are logged.
///
/// It is a spare at first: it reads the lake, reports that it is ready, and learns whose engine it is by the first line
/// of standard input.
///
/// # Errors
/// [`Error::System`], [`Error::Query`], [`Error::Transport`].
pub async fn run_engine(lake: &Lake, sockets: &Path, memory: usize, slow: Option<Duration>) -> Result<(), Error> {
    let mut messages = read_messages();
    let http = EngineSocket::Http.listen_in(sockets)?;
    let flight_sql = EngineSocket::FlightSql.listen_in(sockets)?;
    #[cfg(feature = "postgres")]
    let postgres = EngineSocket::Postgres.listen_in(sockets)?;
    let engine = QueryEngine::new(lake, Some(memory))?;
    warm_up(&engine).await?;
    EngineReport::Ready.send_line();
    let identity = tokio::select! {
        identity = next_client(&mut messages) => identity,
        never = report_lake(lake, &engine) => match never {},
    };
    // The door went away before it had a use for this engine.
    let Some(identity) = identity else { return Ok(()) };
    let limit = identity.memory_bytes.map_or(memory, |own| own.min(memory));
    let lake = &identity.visible_lake(lake);
    // Whatever the spare engine has read of the lake, it read as a reader of all projects.
    let engine = match lake.is_restricted() {
        true => QueryEngine::new(lake, Some(memory))?,
        false => engine,
    };
    let service = QueryService::new(lake, engine, identity, slow)?;
    // If the engine is new, this plans all views, which the watchdog would take for work that nobody waits for.
    drop(service.lake_tables());
    // Behind the start of its threads, whose stacks count.
    confinement::limit_memory(limit).map_err(Error::System)?;
    watchdog::start_watchdog(&service).map_err(Error::System)?;
    let obeying = service.clone();
    #[cfg(feature = "postgres")]
    let postgres = echolake_postgres::serve_postgres_socket(service.clone(), postgres);
    #[cfg(not(feature = "postgres"))]
    let postgres = std::future::pending();
    tokio::select! {
        () = obeying.obey_door(messages) => Ok(()),
        failed = echolake_http::serve_http_socket(service.clone(), http) => failed,
        failed = echolake_flight::serve_flight_socket(service.clone(), flight_sql) => failed,
        failed = postgres => failed,
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

async fn next_client(messages: &mut mpsc::UnboundedReceiver<DoorMessage>) -> Option<ClientIdentity> {
    loop {
        if let DoorMessage::Client(identity) = messages.recv().await? {
            return Some(identity);
        }
    }
}

// Reports the lake's figures again and again: an engine that waits for a client has nothing else to do.
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
