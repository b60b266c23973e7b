//! An engine within the process of a fuzz target, whose coverage counts there. It has no watchdog, which would end the
//! process for work of the fuzzer itself.

use std::path::Path;

use echolake_lake::Lake;
use echolake_query::QueryEngine;
use echolake_service::{ClientIdentity, EngineSocket, Error, QueryService};

/// Limits of a query: seconds, and rows of the answer.
const QUERY_SECONDS: u64 = 2;
const QUERY_ROWS: u64 = 10_000;

/// Answers the three protocols on the sockets of an engine, which are in this folder.
///
/// # Errors
/// [`Error::System`], [`Error::Query`], [`Error::Transport`].
pub async fn serve_engine(lake: &Lake, sockets: &Path, memory: usize) -> Result<(), Error> {
    let engine = QueryEngine::new(lake, Some(memory))?;
    let mut identity = ClientIdentity::local_programs();
    identity.seconds = Some(QUERY_SECONDS);
    identity.rows = Some(QUERY_ROWS);
    let service = QueryService::new(lake, engine, identity, None)?;
    let http = EngineSocket::Http.listen_in(sockets)?;
    let flight_sql = EngineSocket::FlightSql.listen_in(sockets)?;
    let postgres = EngineSocket::Postgres.listen_in(sockets)?;
    tokio::select! {
        failed = echolake_http::serve_http_socket(service.clone(), http) => failed,
        failed = echolake_flight::serve_flight_socket(service.clone(), flight_sql) => failed,
        failed = echolake_postgres::serve_postgres_socket(service, postgres) => failed,
    }
}
