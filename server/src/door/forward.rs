//! Requests over HTTP on their way to an engine and back, for both versions of HTTP.

use std::io;
use std::pin::{Pin, pin};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::Body;
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, Request, Response, header};
use bytes::Bytes;
use echolake_flight::WINDOW_BYTES;
use echolake_service::request_span::request_number;
use echolake_service::{ClientIdentity, EngineRole, EngineSocket, RequestFault, mark_client};
use futures::stream;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::client::conn::http2;
use hyper_util::rt::{TokioExecutor, TokioIo};
use tokio::sync::MutexGuard;
use tokio_util::sync::WaitForCancellationFutureOwned;
use tracing::Span;

use super::body_reader::{BodyReader, check_declared_size};
use super::connection_places::{PlaceWork, WorkingPlace};
use super::engine_process::{EndReason, EngineProcess, HttpConnection};
use super::server_engines::ServerEngines;

/// Bytes of a request up to which it is kept, so that it can be sent again to a new engine.
const KEPT_BYTES: usize = 64 << 10;
/// Bytes of a request: that of HTTP's endpoints, which answer sooner than they have read more, and gRPC's of one
/// message with its length.
const LARGEST_HTTP: usize = 2 << 20;
const LARGEST_GRPC: usize = (4 << 20) + 5;
/// Time for which a request that may have ended an engine is repeated without the others.
const SUSPECT_TURN: Duration = Duration::from_secs(3);
/// Bytes of a frame of HTTP/2 between an engine and the door; the default of 16 KiB costs a wake-up each.
const FRAME_BYTES: u32 = 256 << 10;
/// Headers of one connection, not of the request (RFC 9110, section 7.6.1).
const OF_CONNECTION: [HeaderName; 4] =
    [header::CONNECTION, header::TRANSFER_ENCODING, header::UPGRADE, HeaderName::from_static("keep-alive")];

/// The protocol to an engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EngineProtocol {
    /// HTTP/1.1, on a connection that no other request has.
    Http,
    /// HTTP/2, on one connection for all.
    Grpc,
    /// The same for a client that may wait for an answer before it ends its request.
    InteractiveGrpc,
}

/// The body of a request.
enum RequestBody {
    Whole(Bytes),
    /// One that is too long to be kept, or that its client ends only after an answer.
    Streamed(Body, BodyFault),
}

/// The fault of a streamed body, once it is known.
type BodyFault = Arc<Mutex<Option<RequestFault>>>;

impl ServerEngines {
    /// Answers a request of `client` by the engine of a role; `work` marks its connection, if it came on one. If the
    /// engine ends before its answer begins, the next one is asked once, unless the request itself ended it.
    ///
    /// # Errors
    /// [`RequestFault::EngineEnded`], [`RequestFault::EngineLost`], [`RequestFault::Backoff`],
    /// [`RequestFault::TooLarge`], [`RequestFault::Request`].
    pub async fn forward_request(
        &self,
        role: EngineRole,
        client: &ClientIdentity,
        request: Request<Body>,
        wire: EngineProtocol,
        work: Option<&PlaceWork>,
    ) -> Result<Response<EngineBody>, RequestFault> {
        Span::current().record("client", &client.name);
        let (mut parts, body) = request.into_parts();
        for name in OF_CONNECTION {
            parts.headers.remove(name);
        }
        mark_client(&mut parts.headers, client)?;
        let number = request_number(&parts.headers);
        let mut body = match wire {
            EngineProtocol::InteractiveGrpc => {
                RequestBody::from_reader(Bytes::new(), BodyReader::new(body, 1), usize::MAX)
            }
            EngineProtocol::Http => read_body(body, &parts.headers, LARGEST_HTTP).await?,
            EngineProtocol::Grpc => read_body(body, &parts.headers, LARGEST_GRPC).await?,
        };
        let working = work.map(PlaceWork::begin_work);
        let mut ended = None;
        // Held by a request that is repeated and may be what ended the engine.
        let mut alone = None;
        loop {
            let engine = match self.engine_for(role, client).await {
                // The cause is what ended the first engine.
                Err(RequestFault::Backoff { ends, wait }) => {
                    return Err(ended.unwrap_or(RequestFault::Backoff { ends, wait }));
                }
                found => found?,
            };
            let (sent, fault, again) = body.into_parts();
            let fetched = EngineAnswer::fetch_from(&engine, request_of(&parts, sent), wire);
            let failed = match await_in_turn(fetched, &mut alone).await {
                Ok(answer) => {
                    let end = self.client_end(&client.name).cancelled_owned();
                    return Ok(answer.into_engine_response(engine, number, working, end));
                }
                Err(failed) => failed,
            };
            let why = engine.why_ended().await;
            let is_unknown = why.as_ref().is_some_and(EndReason::is_unknown);
            let is_culprit = why.as_ref().is_some_and(|why| why.is_for(number)) || is_unknown && alone.is_some();
            if is_unknown && alone.is_some() {
                self.count_lone_end(client);
            }
            let found = find_engine_fault(why.as_ref(), number, &failed);
            let known = fault.lock().unwrap_or_else(PoisonError::into_inner).take();
            match again {
                Some(again) if ended.is_none() && !is_culprit => {
                    body = again;
                    ended = Some(found);
                    if is_unknown {
                        alone = Some(self.suspect_turn().await);
                    }
                }
                _ => return Err(known.unwrap_or(found)),
            }
        }
    }
}

// Waits for an answer, and gives up the turn of a suspect if it takes long.
async fn await_in_turn<T>(answer: impl Future<Output = T>, turn: &mut Option<MutexGuard<'_, ()>>) -> T {
    let mut answer = pin!(answer);
    if turn.is_some() {
        if let Ok(answer) = tokio::time::timeout(SUSPECT_TURN, &mut answer).await {
            return answer;
        }
        turn.take();
    }
    answer.await
}

impl RequestBody {
    // The rest of a body, after `read`, in pieces. It fails if it is too long or takes too long: one that just ended
    // would look whole.
    fn from_reader(read: Bytes, rest: BodyReader, most: usize) -> Self {
        let fault = BodyFault::default();
        let found = fault.clone();
        let stream = stream::try_unfold((read, rest, most), move |(read, mut rest, left)| {
            let found = found.clone();
            async move {
                let piece = if read.is_empty() { rest.next_piece().await } else { Ok(read) };
                let fault = match piece {
                    Ok(piece) if piece.is_empty() => return Ok(None),
                    Ok(piece) => match left.checked_sub(piece.len()) {
                        Some(left) => return Ok(Some((piece, (Bytes::new(), rest, left)))),
                        None => RequestFault::TooLarge { limit: most },
                    },
                    Err(fault) => fault,
                };
                let failed = io::Error::other(fault.to_string());
                *found.lock().unwrap_or_else(PoisonError::into_inner) = Some(fault);
                Err(failed)
            }
        });
        Self::Streamed(Body::from_stream(stream), fault)
    }

    // Returns the body to send, its fault, and a copy for a retry.
    fn into_parts(self) -> (Body, BodyFault, Option<Self>) {
        match self {
            Self::Whole(bytes) => {
                let again = Self::Streamed(Body::from(bytes.clone()), BodyFault::default());
                (Body::from(bytes), BodyFault::default(), Some(again))
            }
            Self::Streamed(body, fault) => (body, fault, None),
        }
    }
}

fn request_of(parts: &Parts, body: Body) -> Request<Body> {
    let mut request = Request::new(body);
    *request.method_mut() = parts.method.clone();
    *request.uri_mut() = parts.uri.clone();
    *request.headers_mut() = parts.headers.clone();
    request
}

fn find_engine_fault(why: Option<&EndReason>, request: Option<u64>, failed: &str) -> RequestFault {
    match why {
        Some(why) => why.fault(request),
        None => {
            tracing::error!(error = failed, "an engine does not answer");
            RequestFault::Internal
        }
    }
}

// Reads a short body to its end; of a long one, what is read goes before the rest.
async fn read_body(body: Body, headers: &HeaderMap, limit: usize) -> Result<RequestBody, RequestFault> {
    check_declared_size(headers, limit)?;
    let mut rest = BodyReader::new(body, KEPT_BYTES);
    let read = rest.next_piece().await?;
    match rest.is_ended() {
        true => Ok(RequestBody::Whole(read)),
        false => Ok(RequestBody::from_reader(read, rest, limit)),
    }
}

struct EngineAnswer {
    response: Response<Incoming>,
    connection: Option<HttpConnection>,
    wire: EngineProtocol,
}

impl EngineAnswer {
    async fn fetch_from(engine: &EngineProcess, request: Request<Body>, wire: EngineProtocol) -> Result<Self, String> {
        let mut connection = None;
        let response = match wire {
            EngineProtocol::Http => {
                connection.insert(engine.take_connection().await?).sender.send_request(request).await
            }
            EngineProtocol::Grpc | EngineProtocol::InteractiveGrpc => {
                engine.flight_sender().await?.send_request(request).await
            }
        };
        let response = response.map_err(|e| e.to_string())?;
        Ok(Self { response, connection, wire })
    }

    fn into_engine_response(
        self,
        engine: Arc<EngineProcess>,
        number: Option<u64>,
        working: Option<WorkingPlace>,
        client_end: WaitForCancellationFutureOwned,
    ) -> Response<EngineBody> {
        let Self { response, connection, wire } = self;
        response.map(|incoming| {
            let is_ended = false;
            let client_end = Box::pin(client_end);
            let span = Span::current();
            EngineBody { incoming, wire, engine, connection, number, client_end, _working: working, span, is_ended }
        })
    }
}

impl Drop for EngineBody {
    fn drop(&mut self) {
        if hyper::body::Body::is_end_stream(self)
            && let Some(connection) = self.connection.take()
        {
            self.engine.keep_connection(connection);
        }
    }
}

impl EngineProcess {
    // The connection that all gRPC requests to the engine share, until one of both ends it.
    async fn flight_sender(&self) -> Result<http2::SendRequest<Body>, String> {
        let mut shared = self.flight.lock().await;
        if let Some(sender) = shared.as_ref().filter(|sender| !sender.is_closed()) {
            return Ok(sender.clone());
        }
        let stream = self.connect_socket(EngineSocket::FlightSql).await.map_err(|e| e.to_string())?;
        let handshake = http2::Builder::new(TokioExecutor::new())
            .initial_stream_window_size(WINDOW_BYTES)
            // Requests are held back each by its own window, never by another's.
            .initial_connection_window_size(u32::MAX >> 1)
            .max_frame_size(FRAME_BYTES)
            .handshake(TokioIo::new(stream));
        let (sender, driver) = handshake.await.map_err(|e| e.to_string())?;
        tokio::spawn(async move {
            if let Err(failed) = driver.await {
                tracing::warn!(error = ?failed, "a connection to an engine ended");
            }
        });
        Ok(shared.insert(sender).clone())
    }
}

/// The body of an engine's answer. Dropping it ends the query.
pub(crate) struct EngineBody {
    incoming: Incoming,
    wire: EngineProtocol,
    engine: Arc<EngineProcess>,
    connection: Option<HttpConnection>,
    /// The door's number of its request.
    number: Option<u64>,
    /// The end of its client's rights, which ends the answer, too.
    client_end: Pin<Box<WaitForCancellationFutureOwned>>,
    _working: Option<WorkingPlace>,
    span: Span,
    is_ended: bool,
}

impl EngineBody {
    // gRPC reports a failure in trailers behind the answer, so that the client sees it; HTTP/1.1 breaks the connection
    // off.
    fn failure_frame(&self) -> Option<Frame<Bytes>> {
        let stopped = || RequestFault::EngineLost { reason: "it stopped answering".to_owned() };
        let fault = self.engine.end_reason().map_or_else(stopped, |why| why.fault(self.number));
        self.span.in_scope(|| tracing::info!(reason = fault.to_string(), "an answer broke off"));
        self.fault_trailers(&fault)
    }

    fn refusal_frame(&self) -> Option<Frame<Bytes>> {
        self.span.in_scope(|| tracing::info!("an answer to a client that may no longer ask is broken off"));
        self.fault_trailers(&RequestFault::Unauthenticated)
    }

    fn fault_trailers(&self, fault: &RequestFault) -> Option<Frame<Bytes>> {
        if self.wire == EngineProtocol::Http {
            return None;
        }
        let mut trailers = HeaderMap::new();
        echolake_flight::grpc_status(fault).add_header(&mut trailers).ok()?;
        Some(Frame::trailers(trailers))
    }
}

/// Why an answer breaks off.
#[derive(Debug)]
pub(crate) enum EngineBodyError {
    /// Its engine ended, or the connection to it.
    Broken(hyper::Error),
    /// Its client may no longer ask, or may do other things now.
    ClientEnded,
}

impl std::fmt::Display for EngineBodyError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Broken(failed) => failed.fmt(f),
            Self::ClientEnded => f.write_str("the client may no longer ask"),
        }
    }
}

impl std::error::Error for EngineBodyError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Broken(failed) => Some(failed),
            Self::ClientEnded => None,
        }
    }
}

impl hyper::body::Body for EngineBody {
    type Data = Bytes;
    type Error = EngineBodyError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, EngineBodyError>>> {
        if self.is_ended {
            return Poll::Ready(None);
        }
        if self.client_end.as_mut().poll(context).is_ready() {
            self.is_ended = true;
            self.connection = None;
            return match self.refusal_frame() {
                Some(refusal) => Poll::Ready(Some(Ok(refusal))),
                None => Poll::Ready(Some(Err(EngineBodyError::ClientEnded))),
            };
        }
        let polled = Pin::new(&mut self.incoming).poll_frame(context);
        match polled {
            Poll::Ready(Some(Err(failed))) => {
                self.is_ended = true;
                self.connection = None;
                Poll::Ready(Some(self.failure_frame().ok_or(EngineBodyError::Broken(failed))))
            }
            Poll::Ready(None) => {
                self.is_ended = true;
                Poll::Ready(None)
            }
            Poll::Ready(Some(Ok(frame))) => Poll::Ready(Some(Ok(frame))),
            Poll::Pending => Poll::Pending,
        }
    }

    fn is_end_stream(&self) -> bool {
        self.is_ended || self.incoming.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        hyper::body::Body::size_hint(&self.incoming)
    }
}

#[cfg(test)]
mod tests {
    use axum::body::to_bytes;

    use super::*;

    async fn forwarded_length(bytes: usize, limit: usize) -> Option<usize> {
        let body = read_body(Body::from(vec![7; bytes]), &HeaderMap::new(), limit).await.ok()?;
        let (sent, ..) = body.into_parts();
        to_bytes(sent, usize::MAX).await.ok().map(|sent| sent.len())
    }

    #[tokio::test]
    async fn a_body_in_one_piece_is_counted_once() {
        for bytes in [0, KEPT_BYTES - 1, KEPT_BYTES, LARGEST_HTTP / 2 + 1, LARGEST_HTTP] {
            assert_eq!(forwarded_length(bytes, LARGEST_HTTP).await, Some(bytes));
        }
        assert_eq!(forwarded_length(LARGEST_HTTP + 1, LARGEST_HTTP).await, None);
    }
}
