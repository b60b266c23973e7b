//! Arrow Flight SQL: queries, prepared statements and the catalogue, as ADBC and JDBC drivers ask for them.

mod answer;
mod info;
mod service;
mod statements;
mod status;
mod values;

use std::io;

use arrow_flight::flight_service_server::FlightServiceServer;
use echolake_service::request_span::continue_request;
use echolake_service::{Error, QueryService};
use futures::stream;
use tokio::net::{UnixListener, UnixStream};
use tonic::transport::Server;

pub use status::grpc_status;

/// Bytes of an answer that may be on their way to one request: the door holds them while its client reads slowly.
pub const WINDOW_BYTES: u32 = 1 << 20;

/// Answers Flight SQL on an engine's socket.
pub async fn serve_flight_socket(service: QueryService, listener: UnixListener) -> Result<(), Error> {
    let flight = service::LakeFlightService::new(service).map_err(|e| Error::Transport(Box::new(e)))?;
    Server::builder()
        .trace_fn(|request| continue_request(request.headers()))
        .add_service(FlightServiceServer::new(flight))
        .serve_with_incoming(stream::unfold(listener, accept_next))
        .await
        .map_err(|e| Error::Transport(Box::new(e)))
}

async fn accept_next(listener: UnixListener) -> Option<(io::Result<UnixStream>, UnixListener)> {
    let accepted = listener.accept().await.map(|(stream, _)| stream);
    Some((accepted, listener))
}
