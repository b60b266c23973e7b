//! Connections of HTTP, of both of its versions.

use std::pin::{Pin, pin};
use std::time::Duration;

use axum::http::{HeaderValue, Request, Uri, Version, header};
use hyper::server::conn::http2;
use hyper_util::rt::{TokioExecutor, TokioTimer};

use super::connection_places::PlaceWork;
use super::drain::ServerDrain;

/// The name of HTTP/2 in a handshake.
pub(crate) const HTTP_2: &[u8] = b"h2";
/// Silence after which a client is asked whether it still lives; its queries end when it does not.
const KEEPALIVE: Duration = Duration::from_secs(20);
/// Requests of one connection at once.
const STREAMS: u32 = 64;

/// Makes connections of HTTP/2.
pub(crate) fn http2_builder() -> http2::Builder<TokioExecutor> {
    let mut builder = http2::Builder::new(TokioExecutor::new());
    builder.timer(TokioTimer::new()).keep_alive_interval(KEEPALIVE).max_concurrent_streams(STREAMS);
    builder
}

/// Answers a connection to its end: that of its client, an eviction, or the server's.
pub(super) async fn drive_connection<C: Future>(
    connection: C,
    shut_down: impl FnOnce(Pin<&mut C>),
    evicted: impl Future<Output = ()>,
    drain: &ServerDrain,
    place: &PlaceWork,
) {
    let awaited = drain.count_connection();
    let mut connection = pin!(connection);
    // A connection that breaks off is its client's matter.
    tokio::select! {
        _ = connection.as_mut() => return,
        () = evicted => return,
        // One that comes later may ask, and is told that nothing is taken.
        () = drain.wait_until_begun(), if awaited.is_some() => shut_down(connection.as_mut()),
    }
    tokio::select! {
        _ = connection => {}
        () = place.wait_until_quiet() => {}
    }
}

/// Gives a request of HTTP/2 the form of HTTP/1.1, which routes, guards and engines read: its authority becomes its
/// Host.
pub(super) fn restate_as_http1<B>(request: &mut Request<B>) {
    if request.version() != Version::HTTP_2 {
        return;
    }
    let authority = request.uri().authority().and_then(|authority| HeaderValue::from_str(authority.as_str()).ok());
    if let Some(host) = authority {
        request.headers_mut().insert(header::HOST, host);
    }
    if let Some(path) = request.uri().path_and_query().cloned() {
        *request.uri_mut() = Uri::from(path);
    }
    *request.version_mut() = Version::HTTP_11;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_authority_becomes_the_host() {
        let request = |version, uri: &str| {
            let request = Request::builder().version(version).uri(uri).header("host", "other");
            let mut request = request.body(()).expect("a request");
            restate_as_http1(&mut request);
            (request.uri().to_string(), request.headers()["host"].to_str().expect("a text").to_owned())
        };
        let expected = ("/a?b=c".to_owned(), "lab:8080".to_owned());
        assert_eq!(request(Version::HTTP_2, "https://lab:8080/a?b=c"), expected);
        assert_eq!(request(Version::HTTP_2, "/a"), ("/a".to_owned(), "other".to_owned()));
        let absolute = ("http://lab/a".to_owned(), "other".to_owned());
        assert_eq!(request(Version::HTTP_11, "http://lab/a"), absolute, "as it came: guards compare both");
    }
}
