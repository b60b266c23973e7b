//! HTTP connections of the door: so many at once, each of which must say what it wants in time.

use std::pin::pin;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::HeaderValue;
use axum::response::{IntoResponse as _, Response};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::Instrument as _;

use super::connection_places::{ConnectionPlaces, PlaceWork, PlacedStream};
use super::encryption::ProtocolEncryption;
use super::forward::EngineProtocol;
use crate::client_identity::ClientIdentity;
use crate::door::server_door::ServerDoor;
use crate::fault::RequestFault;
use crate::http::{FORWARDED_PROTO, ProblemResponse, RequestSite, authenticate, door_router, request_site};
use crate::metrics::ServerProtocol;
use crate::request_span::begin_request;

/// Connections at once. Systems often allow a process 1024 open files.
const MOST: usize = 512;
/// Time limit for a request's head, and for an idle connection between two requests.
const HEAD: Duration = Duration::from_secs(30);

/// Answers connections until `stopping`, then lets pending requests end.
pub(super) async fn serve(
    door: ServerDoor,
    listener: TcpListener,
    encryption: ProtocolEncryption,
    stopping: watch::Receiver<bool>,
) {
    let router = door_router(&door);
    let places = ConnectionPlaces::new(listener, MOST);
    let mut stopped = stopping.clone();
    let mut open = JoinSet::new();
    loop {
        tokio::select! {
            _ = stopped.wait_for(|stopping| *stopping) => break,
            stream = places.next() => drop(open.spawn(answer(stream, encryption.clone(), router.clone(), stopping.clone()))),
            Some(_) = open.join_next() => {}
        }
    }
    while open.join_next().await.is_some() {}
}

async fn answer(
    stream: PlacedStream,
    encryption: ProtocolEncryption,
    router: Router,
    mut stopping: watch::Receiver<bool>,
) {
    let evicted = stream.evicted();
    let work = stream.work();
    let Some(stream) = encryption.accept(stream).await else { return };
    let answers = TowerToHyperService::new(router);
    let service = service_fn(move |mut request: hyper::Request<Incoming>| {
        work.hear_request();
        if encryption.is_on() {
            request.headers_mut().insert(FORWARDED_PROTO, HeaderValue::from_static("https"));
        }
        request.extensions_mut().insert(work.clone());
        answers.call(request)
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .serve_connection(TokioIo::new(stream), service);
    let mut connection = pin!(connection);
    // A connection that breaks off is its client's matter.
    tokio::select! {
        _ = connection.as_mut() => return,
        () = evicted => return,
        _ = stopping.wait_for(|stopping| *stopping) => connection.as_mut().graceful_shutdown(),
    }
    let _ = connection.await;
}

impl ServerDoor {
    /// Forwards a request to the client's engine.
    pub(crate) async fn forward_http(State(door): State<Self>, mut request: Request) -> Response {
        let span = begin_request(request.headers_mut(), ServerProtocol::Http);
        let answer = async {
            door.answer_http(request).await.unwrap_or_else(|fault| {
                door.metrics().record_failure(&fault);
                ProblemResponse(fault).into_response()
            })
        };
        answer.instrument(span).await
    }

    async fn answer_http(&self, request: Request) -> Result<Response, RequestFault> {
        let work = request.extensions().get::<PlaceWork>().cloned().ok_or(RequestFault::Internal)?;
        let local = || match request_site(request.uri(), request.headers()) {
            RequestSite::Foreign => ClientIdentity::foreign(),
            RequestSite::OwnPage => ClientIdentity::pages(),
            RequestSite::Program => ClientIdentity::programs(),
        };
        let client = authenticate(self.access(), request.headers(), local)?;
        let response = self.engines().forward(&client, request, EngineProtocol::Http, &work).await?;
        Ok(response.map(Body::new))
    }
}
