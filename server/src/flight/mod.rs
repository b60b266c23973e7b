//! Arrow Flight SQL: queries, prepared statements and the catalogue, as ADBC and JDBC drivers ask for them.

mod answer;
mod info;
mod service;
mod statements;
mod status;
mod values;

use std::io;

use arrow_flight::flight_service_server::FlightServiceServer;
use futures::stream;
use tokio::net::{UnixListener, UnixStream};
use tonic::transport::Server;

use crate::Error;
use crate::request_span::continue_request;
use crate::service::QueryService;
pub(crate) use status::grpc_status;

/// Bytes of an answer that may be on their way to one request: the door holds them while its client reads slowly.
pub(crate) const WINDOW_BYTES: u32 = 1 << 20;

/// Answers Flight SQL on an engine's socket.
pub(crate) async fn serve_flight_socket(service: QueryService, listener: UnixListener) -> Result<(), Error> {
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
