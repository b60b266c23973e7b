//! Arrow Flight SQL: queries, prepared statements and the catalogue, as ADBC and JDBC drivers ask for them.

mod answer;
mod connections;
mod info;
mod service;
mod statements;
mod status;
mod values;

use std::time::Duration;

use arrow_flight::flight_service_server::FlightServiceServer;
use tokio::net::TcpListener;
use tonic::transport::Server;

use crate::Error;
use crate::service::Service;

/// Silence after which a client is asked whether it still lives; its queries end when it does not.
const KEEPALIVE: Duration = Duration::from_secs(20);
/// Requests of one connection at once.
const STREAMS: u32 = 64;

/// Answers Flight SQL until `stop`.
pub(crate) async fn serve(
    service: Service,
    listener: TcpListener,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    let flight = service::Flight::new(service).map_err(|e| Error::Transport(Box::new(e)))?;
    Server::builder()
        .http2_keepalive_interval(Some(KEEPALIVE))
        .max_concurrent_streams(Some(STREAMS))
        .add_service(FlightServiceServer::new(flight))
        .serve_with_incoming_shutdown(connections::incoming(listener), stop)
        .await
        .map_err(|e| Error::Transport(Box::new(e)))
}
