//! Flight SQL connections of the door: HTTP/2, whose requests are forwarded to the engine of statements.

use std::convert::Infallible;

use axum::body::Body;
use axum::http::{Request, Response, header};
use echolake_flight::{WINDOW_BYTES, grpc_status};
use echolake_service::authorization::of_header;
use echolake_service::request_span::{REQUEST_ID, begin_request};
use echolake_service::{ClientIdentity, EngineRole, RequestFault, ServerProtocol};
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use tokio::net::TcpListener;
use tracing::Instrument as _;

use super::connection_places::{ConnectionPlaces, PlaceWork, PlacedStream};
use super::encryption::ProtocolEncryption;
use super::forward::EngineProtocol;
use super::http_connection::{drive_connection, http2_builder};
use crate::door::server_door::ServerDoor;

/// Connections at once. With those of the other protocols they are within the 1024 files that systems often allow.
const MOST: usize = 128;
/// Methods whose clients may wait for an answer before they end their request.
const INTERACTIVE: [&str; 3] = ["DoPut", "DoExchange", "Handshake"];

/// Answers connections; never ends.
pub(super) async fn serve_flight_clients(door: ServerDoor, listener: TcpListener, encryption: ProtocolEncryption) {
    let places =
        ConnectionPlaces::new(listener, MOST).listed_among(&door.activity().connections, ServerProtocol::FlightSql);
    places.attend_connections(|stream| answer_flight_connection(stream, encryption.clone(), door.clone())).await;
}

async fn answer_flight_connection(stream: PlacedStream, encryption: ProtocolEncryption, door: ServerDoor) {
    let evicted = stream.wait_for_eviction();
    let work = stream.work_handle();
    let Some(stream) = encryption.shake_hands(stream).await else { return };
    let drain = door.drain().clone();
    let place = work.clone();
    let service = service_fn(move |mut request: Request<Incoming>| {
        work.hear_request();
        let door = door.clone();
        let work = work.clone();
        let (span, id) = begin_request(request.headers_mut(), ServerProtocol::FlightSql);
        let answer = async move {
            let mut response = door.answer_flight(request, &work).await.unwrap_or_else(|fault| {
                door.metrics().record_failure(&fault);
                grpc_status(&fault).into_http()
            });
            response.headers_mut().insert(REQUEST_ID, id);
            Ok::<_, Infallible>(response)
        };
        answer.instrument(span)
    });
    let mut builder = http2_builder();
    let connection = builder.initial_stream_window_size(WINDOW_BYTES).serve_connection(TokioIo::new(stream), service);
    drive_connection(connection, |connection| connection.graceful_shutdown(), evicted, &drain, &place).await;
}

impl ServerDoor {
    async fn answer_flight(
        &self,
        request: Request<Incoming>,
        work: &PlaceWork,
    ) -> Result<Response<Body>, RequestFault> {
        if self.drain().is_begun() {
            return Err(RequestFault::Draining);
        }
        let token = request.headers().get(header::AUTHORIZATION).and_then(|v| v.to_str().ok()).and_then(of_header);
        self.failed_logins().check_address(work.peer())?;
        let found = self.access().client_of_token(token.as_deref(), ClientIdentity::local_programs);
        if let (Some(_), Err(RequestFault::Unauthenticated)) = (&token, &found) {
            self.failed_logins().count_failure(work.peer());
        }
        let client = self.note_client(work, ServerProtocol::FlightSql, found)?;
        let is_interactive = INTERACTIVE.iter().any(|method| request.uri().path().ends_with(method));
        let wire = if is_interactive { EngineProtocol::InteractiveGrpc } else { EngineProtocol::Grpc };
        let engines = self.engines();
        let role = EngineRole::Statements;
        let response = engines.forward_request(role, &client, request.map(Body::new), wire, Some(work)).await?;
        Ok(response.map(Body::new))
    }
}
