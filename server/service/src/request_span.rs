//! Spans of requests in the log. The door numbers requests and connections, and the engine's lines about one carry the
//! same number. Spans are at the level of errors: no filter that lets a line through takes its spans away.

use std::sync::atomic::{AtomicU64, Ordering};

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use bytes::{BufMut as _, BytesMut};
use tracing::{Instrument as _, Span, field};

use crate::server_protocol::ServerProtocol;

/// Header of a request from the door to an engine: its number.
const HEADER: HeaderName = HeaderName::from_static("echolake-request");
/// The same of a connection of Postgres' protocol, as a parameter of its startup packet.
pub const PARAMETER: &str = "echolake.connection";

/// The header by which clients and proxies name a request, and every answer names it again.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// W3C's header of a trace that the request is part of.
const TRACE_PARENT: HeaderName = HeaderName::from_static("traceparent");
/// Characters of a request's name that is taken over.
const LONGEST_ID: usize = 128;

/// Begins the span of a request, and marks the request with its number and name; a client's own number is replaced.
/// Returns the name for the answer, too. The client is recorded once it is known.
pub fn begin_request(headers: &mut HeaderMap, protocol: ServerProtocol) -> (Span, HeaderValue) {
    let number = next_number();
    headers.insert(HEADER, HeaderValue::from(number));
    let id = headers.remove(REQUEST_ID).filter(is_sane).unwrap_or_else(random_id);
    headers.insert(REQUEST_ID, id.clone());
    let request_id = id.to_str().unwrap_or_default();
    let protocol = protocol.name();
    let span =
        tracing::error_span!("request", number, request_id, trace = field::Empty, protocol, client = field::Empty);
    #[cfg(feature = "otlp")]
    crate::request_trace::join_trace(&span, headers);
    if let Some(trace) = trace_id(headers) {
        span.record("trace", trace);
    }
    (span, id)
}

// Nothing that could be taken for more than a name, in a log or by a shell.
fn is_sane(id: &HeaderValue) -> bool {
    let is_plain = |byte: &u8| byte.is_ascii_alphanumeric() || b"-_.:/+=@".contains(byte);
    (1..=LONGEST_ID).contains(&id.len()) && id.as_bytes().iter().all(is_plain)
}

// A client sees it: a number that is counted would tell how much others ask.
fn random_id() -> HeaderValue {
    let random = getrandom::u64().unwrap_or(0);
    HeaderValue::from_str(&format!("{random:016x}")).unwrap_or_else(|_| HeaderValue::from(random))
}

// The trace of `00-TRACE-PARENT-FLAGS`.
fn trace_id(headers: &HeaderMap) -> Option<&str> {
    let text = headers.get(TRACE_PARENT)?.to_str().ok()?;
    let is_hex =
        |part: &str, length| part.len() == length && part.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
    let mut parts = text.split('-');
    let version = parts.next()?;
    let trace = parts.next()?;
    let parent = parts.next()?;
    let flags = parts.next()?;
    let is_right = is_hex(version, 2) && is_hex(trace, 32) && is_hex(parent, 16) && is_hex(flags, 2);
    (is_right && version != "ff" && trace.bytes().any(|b| b != b'0')).then_some(trace)
}

/// Begins the span of a connection of Postgres' protocol that the door forwards, and marks its startup packet unless
/// that would be larger than `limit`. Returns the connection's number, too.
pub fn begin_connection(startup: &mut BytesMut, client: &str, limit: usize) -> (Span, u64) {
    let number = next_number();
    mark_startup(startup, PARAMETER, &number.to_string(), limit);
    (tracing::error_span!("connection", number, protocol = ServerProtocol::Postgres.name(), client), number)
}

/// Adds a parameter to a startup packet of Postgres' protocol, unless that would be larger than `limit`.
pub fn mark_startup(startup: &mut BytesMut, name: &str, value: &str, limit: usize) {
    let mark = format!("{name}\0{value}\0\0");
    // The last byte ends the list of parameters.
    if let (Some((0, _)), Ok(length)) = (startup.split_last(), i32::try_from(startup.len() + mark.len() - 1))
        && startup.len() + mark.len() <= limit
    {
        startup.truncate(startup.len() - 1);
        startup.put_slice(mark.as_bytes());
        startup[..4].copy_from_slice(&length.to_be_bytes());
    }
}

/// Continues, in an engine, the span of a request that the door has marked.
pub fn continue_request(headers: &HeaderMap) -> Span {
    let span = tracing::error_span!("request", number = field::Empty, request_id = field::Empty, trace = field::Empty);
    if let Some(id) = headers.get(REQUEST_ID).and_then(|id| id.to_str().ok()) {
        span.record("request_id", id);
    }
    if let Some(trace) = trace_id(headers) {
        span.record("trace", trace);
    }
    if let Some(number) = request_number(headers) {
        span.record("number", number);
    }
    span
}

/// Returns the door's number of a request.
pub fn request_number(headers: &HeaderMap) -> Option<u64> {
    headers.get(HEADER)?.to_str().ok()?.parse().ok()
}

/// Continues, in an engine, the span of a connection; [`record_connection`] adds its number once it is known.
pub fn continue_connection() -> Span {
    tracing::error_span!("connection", number = field::Empty)
}

/// Adds the number of a connection, as its startup packet has it, to its span.
pub fn record_connection(number: &str) {
    if let Ok(number) = number.parse::<u64>() {
        Span::current().record("number", number);
    }
}

/// Answers a request of HTTP within its span, as a layer of an engine's router.
pub async fn trace_request(request: Request, next: Next) -> Response {
    let span = continue_request(request.headers());
    next.run(request).instrument(span).await
}

// Counted from the start of the door.
fn next_number() -> u64 {
    static LAST: AtomicU64 = AtomicU64::new(0);
    LAST.fetch_add(1, Ordering::Relaxed) + 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mark_of_the_client_is_replaced() {
        let mut headers = HeaderMap::new();
        headers.insert(HEADER, HeaderValue::from_static("of the client"));
        begin_request(&mut headers, ServerProtocol::Http);
        let marks: Vec<_> = headers.get_all(HEADER).iter().collect();
        let number = marks[0].to_str().expect("text").parse::<u64>();
        assert!(marks.len() == 1 && number.is_ok(), "{marks:?}");
    }

    #[test]
    fn a_sane_name_is_taken_over() {
        let id = |id: &[u8]| {
            let mut headers = HeaderMap::new();
            headers.insert(REQUEST_ID, HeaderValue::from_bytes(id).expect("a header"));
            let (_, named) = begin_request(&mut headers, ServerProtocol::Http);
            assert_eq!(headers.get(REQUEST_ID), Some(&named));
            named.to_str().expect("text").to_owned()
        };
        assert_eq!(id(b"01J9ZK-a_b.c:d/e+f=@"), "01J9ZK-a_b.c:d/e+f=@");
        for wrong in [&b""[..], b"two words", b"a\"b", b"{}", b"caf\xe9", &[b'x'; LONGEST_ID + 1]] {
            let named = id(wrong);
            assert!(named.len() == 16 && u64::from_str_radix(&named, 16).is_ok(), "{wrong:?} became {named}");
            assert_ne!(named.get(..8), id(wrong).get(..8), "the next one does not follow from it");
        }
    }

    #[test]
    fn traces_are_those_of_the_standard() {
        let trace = |text: &'static str| {
            let headers = HeaderMap::from_iter([(TRACE_PARENT, HeaderValue::from_static(text))]);
            trace_id(&headers).map(str::to_owned)
        };
        let id = "4bf92f3577b34da6a3ce929d0e0e4736";
        assert_eq!(trace("00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01").as_deref(), Some(id));
        for wrong in [
            "",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7",
            "00-4BF92F3577B34DA6A3CE929D0E0E4736-00f067aa0ba902b7-01",
            "00-00000000000000000000000000000000-00f067aa0ba902b7-01",
            "ff-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6-00f067aa0ba902b7-01",
        ] {
            assert_eq!(trace(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_startup_packet_is_marked_within_its_limit() {
        let packet = b"\0\0\0\x12\0\x03\0\0user\0ann\0\0";
        let mut marked = BytesMut::from(&packet[..]);
        begin_connection(&mut marked, "ann", 100);
        let length = i32::from_be_bytes([marked[0], marked[1], marked[2], marked[3]]);
        assert_eq!(usize::try_from(length).ok(), Some(marked.len()));
        let rest = marked.strip_prefix(b"\0\0\0").and_then(|rest| rest[1..].strip_prefix(&packet[4..17]));
        let rest = rest.expect("what it was");
        let number = rest.strip_prefix(b"echolake.connection\0").and_then(|rest| rest.strip_suffix(b"\0\0"));
        assert!(number.is_some_and(|digits| digits.iter().all(u8::is_ascii_digit)), "{rest:?}");
        let mut full = BytesMut::from(&packet[..]);
        begin_connection(&mut full, "ann", packet.len());
        assert_eq!(&full[..], packet);
    }
}
