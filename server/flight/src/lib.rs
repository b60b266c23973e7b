//! Arrow Flight SQL: queries, prepared statements and the catalogue, as ADBC and JDBC drivers ask for them.

mod answer;
mod info;
mod service;
mod statements;
mod status;
mod values;

use std::convert::Infallible;
use std::io;
use std::task::{Context, Poll};

use arrow_flight::flight_service_server::FlightServiceServer;
use echolake_service::request_span::{continue_request, request_number};
use echolake_service::{EngineServices, Error, RequestFault, answer_numbered};
use futures::future::BoxFuture;
use futures::{FutureExt as _, stream};
use tokio::net::{UnixListener, UnixStream};
use tonic::body::Body;
use tonic::codegen::Service;
use tonic::codegen::http::{Request, Response};
use tonic::server::NamedService;
use tonic::transport::Server;

use service::LakeFlightService;

pub use status::grpc_status;

/// Bytes of an answer that may be on their way to one request: the door holds them while its client reads slowly.
pub const WINDOW_BYTES: u32 = 1 << 20;

/// Answers Flight SQL on an engine's socket that all clients share.
///
/// # Errors
/// [`Error::Transport`].
pub async fn serve_flight_socket(services: EngineServices, listener: UnixListener) -> Result<(), Error> {
    Server::builder()
        .trace_fn(|request| continue_request(request.headers()))
        .add_service(ClientFlightService(services))
        .serve_with_incoming(stream::unfold(listener, accept_next))
        .await
        .map_err(|e| Error::Transport(Box::new(e)))
}

/// Answers each request by the service of the client that the door has named: statements that one client holds are
/// found by no other.
#[derive(Clone)]
struct ClientFlightService(EngineServices);

type FlightServer = FlightServiceServer<LakeFlightService>;

impl NamedService for ClientFlightService {
    const NAME: &'static str = FlightServer::NAME;
}

impl Service<Request<Body>> for ClientFlightService {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, Result<Response<Body>, Infallible>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let server = self.0.client_of_request(request.headers()).and_then(|client| {
            client.protocol_state(|service| {
                let flight = LakeFlightService::new(service.clone());
                Ok(FlightServer::new(flight.map_err(RequestFault::defect("Flight SQL cannot be described"))?))
            })
        });
        let number = request_number(request.headers());
        match server {
            Ok(server) => answer_numbered(number, FlightServer::clone(&server).call(request)).boxed(),
            Err(fault) => std::future::ready(Ok(grpc_status(&fault).into_http())).boxed(),
        }
    }
}

async fn accept_next(listener: UnixListener) -> Option<(io::Result<UnixStream>, UnixListener)> {
    let accepted = listener.accept().await.map(|(stream, _)| stream);
    Some((accepted, listener))
}
