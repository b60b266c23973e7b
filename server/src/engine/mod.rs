//! An engine: the queries of one client, in a process of their own. It answers the three protocols on Unix sockets in a
//! folder that only its user may enter; the door, which started it, is its only peer and has authenticated the client.

pub mod confinement;
pub(crate) mod report;
mod watchdog;

use std::io::BufRead as _;
use std::path::Path;
use std::sync::Arc;

use echolake_lake::Lake;
use echolake_query::{EngineClient, EngineLimits, QueryEngine, QueryQuota};
use futures::FutureExt as _;
use tokio::sync::oneshot;

use crate::client_identity::ClientIdentity;
use crate::engine_socket::EngineSocket;
use crate::service::QueryService;
use crate::{Error, flight, http, postgres};
use report::EngineReport;

/// A query that has a new engine read what every query reads.
const WARM_UP: &str = "select count(*) from runs";

/// Answers one client's requests until standard input ends, which the door holds.
///
/// It is a spare at first: it reads the lake, reports that it is ready, and learns whose engine it is by the first line
/// of standard input.
///
/// # Errors
/// [`Error::System`], [`Error::Query`], [`Error::Transport`].
pub async fn run_engine(lake: &Lake, sockets: &Path, memory: Option<usize>) -> Result<(), Error> {
    let assigned = read_assignment();
    let http = EngineSocket::Http.listen(sockets)?;
    let flight_sql = EngineSocket::FlightSql.listen(sockets)?;
    let postgres = EngineSocket::Postgres.listen(sockets)?;
    let engine = QueryEngine::new(lake, EngineLimits { memory })?;
    warm_up(&engine).await?;
    EngineReport::Ready.send();
    // The door went away before it had a use for this engine.
    let Ok(identity) = assigned.await else { return Ok(()) };
    let limit = identity.memory_bytes.into_iter().chain(memory).min();
    let service = QueryService::new(lake, engine, identity)?;
    // Behind the start of its threads, whose stacks count.
    limit.map(confinement::limit_memory).transpose().map_err(Error::System)?;
    watchdog::start(&service).map_err(Error::System)?;
    tokio::select! {
        failed = http::serve(service.clone(), http) => failed,
        failed = flight::serve(service.clone(), flight_sql) => failed,
        failed = postgres::serve(service, postgres) => failed,
    }
}

// A thread of its own, so that an engine ends with its door whatever its other threads do.
fn read_assignment() -> oneshot::Receiver<ClientIdentity> {
    let (send, receive) = oneshot::channel();
    std::thread::spawn(move || {
        let mut send = Some(send);
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            let identity = serde_json::from_str(&line).ok();
            if let (Some(identity), Some(send)) = (identity, send.take()) {
                // The receiver is gone if the engine has failed meanwhile.
                let _ = send.send(identity);
            }
        }
        std::process::exit(0);
    });
    receive
}

async fn warm_up(engine: &QueryEngine) -> Result<(), Error> {
    let session = engine.session(&Arc::new(EngineClient::new("warm-up", QueryQuota::default())));
    // A defect of the lake is reported to each client that queries it.
    let answer = async { session.query(WARM_UP).await?.next().await };
    drop(answer.boxed().await);
    Ok(())
}
