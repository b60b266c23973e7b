//! Spans of requests in the log. The door numbers requests and connections, and the engine's lines about one carry the
//! same number. Spans are at the level of errors: no filter that lets a line through takes its spans away.

use std::sync::atomic::{AtomicU64, Ordering};

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use bytes::{BufMut as _, BytesMut};
use tracing::{Instrument as _, Span, field};

use crate::metrics::ServerProtocol;

/// Header of a request from the door to an engine: its number.
const HEADER: HeaderName = HeaderName::from_static("echolake-request");
/// The same of a connection of Postgres' protocol, as a parameter of its startup packet.
pub(crate) const PARAMETER: &str = "echolake.connection";

/// Begins the span of a request that the door forwards, and marks the request with its number; a client's own mark is
/// replaced. The client is recorded once it is known.
pub(crate) fn begin_request(headers: &mut HeaderMap, protocol: ServerProtocol) -> Span {
    let number = next_number();
    headers.insert(HEADER, HeaderValue::from(number));
    tracing::error_span!("request", number, protocol = protocol.name(), client = field::Empty)
}

/// Begins the span of a connection of Postgres' protocol that the door forwards, and marks its startup packet unless that
/// would be larger than `limit`.
pub(crate) fn begin_connection(startup: &mut BytesMut, client: &str, limit: usize) -> Span {
    let number = next_number();
    let mark = format!("{PARAMETER}\0{number}\0\0");
    // The last byte ends the list of parameters.
    if let (Some((0, _)), Ok(length)) = (startup.split_last(), i32::try_from(startup.len() + mark.len() - 1))
        && startup.len() + mark.len() <= limit
    {
        startup.truncate(startup.len() - 1);
        startup.put_slice(mark.as_bytes());
        startup[..4].copy_from_slice(&length.to_be_bytes());
    }
    tracing::error_span!("connection", number, protocol = ServerProtocol::Postgres.name(), client)
}

/// Continues, in an engine, the span of a request that the door has marked.
pub(crate) fn continue_request(headers: &HeaderMap) -> Span {
    let span = tracing::error_span!("request", number = field::Empty);
    if let Some(number) = headers.get(HEADER).and_then(|number| number.to_str().ok()?.parse::<u64>().ok()) {
        span.record("number", number);
    }
    span
}

/// Continues, in an engine, the span of a connection; [`record_connection`] adds its number once it is known.
pub(crate) fn continue_connection() -> Span {
    tracing::error_span!("connection", number = field::Empty)
}

/// Adds the number of a connection, as its startup packet has it, to its span.
pub(crate) fn record_connection(number: &str) {
    if let Ok(number) = number.parse::<u64>() {
        Span::current().record("number", number);
    }
}

/// Answers a request of HTTP within its span, as a layer of an engine's router.
pub(crate) async fn trace_request(request: Request, next: Next) -> Response {
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
