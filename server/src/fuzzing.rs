//! An engine within the process of a fuzz target, whose coverage counts there. It has no watchdog, which would end the
//! process for work of the fuzzer itself. It answers what both engines of a server do.

use std::path::Path;

use echolake_lake::Lake;
use echolake_query::QueryEngine;
use echolake_service::{EngineServices, EngineSocket, Error};

/// Answers the three protocols on the sockets of an engine, which are in this folder.
///
/// # Errors
/// [`Error::System`], [`Error::Query`], [`Error::Transport`].
pub async fn serve_engine(lake: &Lake, sockets: &Path, memory: usize) -> Result<(), Error> {
    let services = EngineServices::new(lake, QueryEngine::new(lake, Some(memory))?, None)?;
    let http = EngineSocket::Http.listen_in(sockets)?;
    let flight_sql = EngineSocket::FlightSql.listen_in(sockets)?;
    let postgres = EngineSocket::Postgres.listen_in(sockets)?;
    tokio::select! {
        failed = echolake_http::serve_http_socket(services.clone(), None, http) => failed,
        failed = echolake_flight::serve_flight_socket(services.clone(), flight_sql) => failed,
        failed = echolake_postgres::serve_postgres_socket(services, postgres) => failed,
    }
}
