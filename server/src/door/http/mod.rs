//! HTTP connections of the door: so many at once, each of which must say what it wants in time. An engine answers what
//! reads the lake; the door answers the rest: pages, sessions, health and figures.

pub(crate) mod answer_cache;
mod authentication;
mod contributions;
mod health;
mod openapi;
#[cfg(feature = "web")]
mod pages;
mod queries;
mod router;
mod session;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use echolake_http::{
    FORWARDED_PROTO, ProblemResponse, RequestSite, SLICED_RUNS, engine_role, is_shared_answer, request_site,
};
use echolake_service::request_span::{REQUEST_ID, begin_request};
use echolake_service::{ClientIdentity, EngineRole, FaultCode, RequestFault, ServerProtocol};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tracing::Instrument as _;

use super::audit::{self, HandedFile};
use super::body_reader::ReadThroughBody;
use super::connection_places::{ConnectionPlaces, PlaceWork, PlacedStream};
use super::drain::ServerDrain;
use super::encryption::{ProtocolEncryption, agreed_protocol};
use super::forward::EngineProtocol;
use super::http_connection::{HTTP_2, drive_connection, http2_builder, restate_as_http1};
use crate::door::server_door::ServerDoor;
use answer_cache::{AnswerKey, CachedOutcome};
use authentication::authenticate_client;
use router::door_router;

/// Path to which a browser shows a token.
const SESSION_PATH: &str = "/api/v1/session";
/// Connections at once. Systems often allow a process 1024 open files.
const MOST: usize = 512;
/// Time limit for a request's head, and for an idle connection between two requests.
const HEAD: Duration = Duration::from_secs(30);

/// Answers connections; never ends.
pub(super) async fn serve_http_clients(door: ServerDoor, listener: TcpListener, encryption: ProtocolEncryption) {
    let router = door_router(&door);
    let places = ConnectionPlaces::new(listener, MOST).listed_among(&door.activity().connections, ServerProtocol::Http);
    places
        .attend_connections(|stream| {
            answer_http_connection(stream, encryption.clone(), router.clone(), door.drain().clone())
        })
        .await;
}

async fn answer_http_connection(
    stream: PlacedStream,
    encryption: ProtocolEncryption,
    router: Router,
    drain: ServerDrain,
) {
    let evicted = stream.wait_for_eviction();
    let work = stream.work_handle();
    let Some(stream) = encryption.shake_hands(stream).await else { return };
    let is_http2 = agreed_protocol(&stream) == Some(HTTP_2);
    let place = work.clone();
    let answers = TowerToHyperService::new(router);
    let service = service_fn(move |request: hyper::Request<Incoming>| {
        work.hear_request();
        // HTTP/1.1 ends the connection after such an answer, which clients read all the same.
        let mut request = match is_http2 {
            true => request.map(|body| Body::new(ReadThroughBody::new(body))),
            false => request.map(Body::new),
        };
        restate_as_http1(&mut request);
        if encryption.is_on() {
            request.headers_mut().insert(FORWARDED_PROTO, HeaderValue::from_static("https"));
        }
        request.extensions_mut().insert(work.clone());
        answers.call(request)
    });
    let stream = TokioIo::new(stream);
    if is_http2 {
        let connection = http2_builder().serve_connection(stream, service);
        drive_connection(connection, |connection| connection.graceful_shutdown(), evicted, &drain, &place).await;
    } else {
        let mut builder = http1::Builder::new();
        let connection = builder.timer(TokioTimer::new()).header_read_timeout(HEAD).serve_connection(stream, service);
        drive_connection(connection, |connection| connection.graceful_shutdown(), evicted, &drain, &place).await;
    }
}

fn shows_token(request: &Request) -> bool {
    request.headers().contains_key(header::AUTHORIZATION) || request.uri().path() == SESSION_PATH
}

impl ServerDoor {
    /// Forwards a request to the engine that answers it.
    pub async fn forward_http(State(door): State<Self>, request: Request) -> Response {
        door.answer_http(request).await.unwrap_or_else(|fault| {
            door.metrics().record_failure(&fault);
            ProblemResponse(fault).into_response()
        })
    }

    /// Answers a request within its span, and names it in the answer; the layer of all routes.
    pub async fn name_request(State(door): State<Self>, mut request: Request, next: Next) -> Response {
        let begun = Instant::now();
        let (span, id) = begin_request(request.headers_mut(), ServerProtocol::Http);
        let peer = request.extensions().get::<PlaceWork>().map(PlaceWork::peer);
        // A page that nobody has logged in to shows no token.
        let login = peer.filter(|_| shows_token(&request));
        let mut response = match login.map_or(Ok(()), |peer| door.failed_logins().check_address(peer)) {
            Ok(()) => next.run(request).instrument(span.clone()).await,
            Err(fault) => ProblemResponse(fault).into_response(),
        };
        if let (Some(peer), Some(code)) = (peer, response.extensions().get::<FaultCode>())
            && !door.access().is_open()
        {
            if let (Some(peer), FaultCode::Unauthenticated) = (login, code) {
                door.failed_logins().count_failure(peer);
            }
            span.in_scope(|| audit::record_refusal(peer, ServerProtocol::Http, *code));
        }
        response.headers_mut().insert(REQUEST_ID, id);
        door.metrics().count_answer(response.status().as_u16(), begun.elapsed().as_secs_f64());
        response
    }

    /// Authenticates who sends a request, and takes note of it.
    fn identify_client(&self, work: &PlaceWork, request: &Request) -> Result<Arc<ClientIdentity>, RequestFault> {
        let site = request_site(request.uri(), request.headers());
        let local = || match site {
            RequestSite::Foreign => ClientIdentity::foreign_pages(),
            RequestSite::OwnPage => ClientIdentity::own_pages(),
            RequestSite::Program => ClientIdentity::local_programs(),
        };
        // A refusal is noted with those of the other routes.
        let client = authenticate_client(self.access(), request.headers(), local)?;
        self.note_client(work, ServerProtocol::Http, Ok(client))
    }

    async fn answer_http(&self, request: Request) -> Result<Response, RequestFault> {
        let work = request.extensions().get::<PlaceWork>().cloned().ok_or(RequestFault::Internal)?;
        let client = self.identify_client(&work, &request)?;
        let path = request.uri().path().to_owned();
        let method = request.method().clone();
        let role = engine_role(&method, &path);
        let key = AnswerKey::from_request(&client, &request).filter(|_| is_shared_answer(&method, &path));
        let mut response = self.answer_or_forward(role, &client, request, key, &work).await?;
        let runs = response.headers_mut().remove(SLICED_RUNS);
        if !self.access().is_open() {
            let runs = runs.as_ref().and_then(|runs| runs.to_str().ok());
            let file = HandedFile { client: &client.name, path: &path, runs };
            audit::record_file(work.peer(), &method, response.status(), &file);
        }
        Ok(response)
    }

    // The cached answer to a request, or that of an engine, which many who ask the same have computed once.
    async fn answer_or_forward(
        &self,
        role: EngineRole,
        client: &ClientIdentity,
        mut request: Request,
        key: Option<AnswerKey>,
        work: &PlaceWork,
    ) -> Result<Response, RequestFault> {
        let headers = request.headers().clone();
        let mut turn = None;
        if let Some(key) = &key {
            let mut found = self.answers().find_answer(key, &headers).await;
            if !matches!(found, CachedOutcome::Answer(_)) {
                turn = Some(self.answers().computing_turn(key).await);
                found = self.answers().find_answer(key, &headers).await;
            }
            match found {
                CachedOutcome::Answer(answer) => return Ok(answer),
                // The client's own conditions come first.
                CachedOutcome::Outdated(etag) if !has_conditions(&headers) => {
                    request.headers_mut().insert(header::IF_NONE_MATCH, etag);
                }
                CachedOutcome::Outdated(_) | CachedOutcome::Nothing => {}
            }
        }
        let engines = self.engines();
        let answer = engines.forward_request(role, client, request, EngineProtocol::Http, Some(work)).await?;
        let answer = self.answers().keep_answer(key.as_ref(), &headers, answer.map(Body::new)).await;
        drop(turn);
        answer
    }
}

fn has_conditions(headers: &HeaderMap) -> bool {
    headers.contains_key(header::IF_NONE_MATCH) || headers.contains_key(header::IF_MATCH)
}
