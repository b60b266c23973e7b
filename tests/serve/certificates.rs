//! Clients that log in by certificate, over all three protocols; and HTTP/2 on the port of the pages.

use std::future::poll_fn;
use std::io::Read as _;
use std::pin::Pin;
use std::sync::Arc;

use hyper::body::Body as _;
use hyper::client::conn::http2::{self, SendRequest};
use hyper::{Request, Response};
use hyper_util::rt::{TokioExecutor, TokioIo};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;

use super::super::TestFolder;
use super::encryption::{FILES, TlsClient, ask_for_tls, begin_session, certified, client_config, get, shake_as};
use super::server::{ANSWER_LIMIT, ServedLake};
use super::{served, wait_until};

/// A lake whose server knows the certificates of ann and bob, and lets ann alone ask.
fn place_of_clients() -> TestFolder {
    let place = certified();
    let known = ["ann", "bob"].map(|name| {
        place.ok(&["certificate", "--client", name, "-o", name]);
        std::fs::read_to_string(place.path(name).join("certificate.pem")).expect("PEM")
    });
    place.ok(&["certificate", "--client", "eve", "-o", "eve"]);
    std::fs::write(place.path("clients.pem"), known.concat()).expect("written");
    std::fs::write(place.path("tokens.toml"), "[[token]]\nname = 'ann'\n").expect("written");
    place
}

fn serve_clients(place: &TestFolder) -> ServedLake {
    let more = ["--client-ca", "clients.pem", "--tokens", "tokens.toml"];
    served(place, &[&FILES[..], &more].concat())
}

fn connect(place: &TestFolder, server: &ServedLake, own: Option<&str>) -> std::io::Result<TlsClient> {
    let own = own.map(|name| place.path(name));
    let config = client_config(&place.path("tls/certificate.pem"), own.as_deref(), "http/1.1");
    shake_as(ServedLake::connect(&server.http), config, "http/1.1")
}

fn status(place: &TestFolder, server: &ServedLake, own: Option<&str>, headers: &str) -> String {
    let mut client = connect(place, server, own).expect("a handshake");
    get(&mut client, "/api/v1/tables", headers)[9..12].to_owned()
}

// In TLS 1.3 a client hears of a refused certificate when it reads.
fn is_refused(place: &TestFolder, server: &ServedLake, own: &str) -> bool {
    let Ok(mut client) = connect(place, server, Some(own)) else { return true };
    let sent = std::io::Write::write_all(&mut client, b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n");
    sent.and_then(|()| client.read_exact(&mut [0; 1])).is_err()
}

#[test]
fn a_certificate_logs_its_client_in() {
    let place = place_of_clients();
    let server = serve_clients(&place);
    let ask = |own, headers| status(&place, &server, own, headers);
    assert_eq!(ask(Some("ann"), ""), "200");
    assert_eq!(ask(Some("ann"), "Origin: https://evil.example\r\n"), "403", "a browser shows it to every page");
    assert_eq!(ask(Some("ann"), "Authorization: Bearer nonsense\r\n"), "401", "a token that is shown counts");
    assert_eq!(ask(Some("bob"), ""), "401", "its name has no line");
    assert_eq!(ask(None, ""), "401");
    assert!(is_refused(&place, &server, "eve"), "nobody knows it");
    wait_until("it is logged", || server.said().iter().any(|line| line.contains("a client's certificate was refused")));
    let first_message = |own: Option<&str>, user: &str| {
        let own = own.map(|name| place.path(name));
        let config = client_config(&place.path("tls/certificate.pem"), own.as_deref(), "postgresql");
        let mut stream = shake_as(ask_for_tls(&server), config, "postgresql").expect("a handshake");
        begin_session(&mut stream, user);
        let mut header = [0; 9];
        stream.read_exact(&mut header).expect("an answer");
        header
    };
    let (let_in, password) = ([b'R', 0, 0, 0, 8, 0, 0, 0, 0], [b'R', 0, 0, 0, 8, 0, 0, 0, 3]);
    assert_eq!(first_message(Some("ann"), "ann"), let_in);
    for (own, user) in [(Some("ann"), "bob"), (Some("bob"), "ann"), (Some("bob"), "bob"), (None, "ann")] {
        assert_eq!(first_message(own, user), password, "{own:?} as {user}");
    }
}

#[test]
fn what_lets_nobody_in_is_said() {
    let place = place_of_clients();
    let with = |more: &[&'static str]| [&["serve"][..], &FILES, more].concat();
    place.fails(1, &with(&["--tokens", "tokens.toml"]), "`ann` has no sha256");
    place.fails(2, &with(&["--client-ca", "clients.pem"]), "--tokens");
    std::fs::write(place.path("empty.pem"), "").expect("written");
    let empty = with(&["--tokens", "tokens.toml", "--client-ca", "empty.pem"]);
    place.fails(1, &empty, "`empty.pem`");
    place.fails(1, &["certificate", "--client", "ann", "bob"], "2 names, expected one");
}

async fn connect_http2(place: &TestFolder, address: &str, own: Option<&str>) -> SendRequest<String> {
    let own = own.map(|name| place.path(name));
    let config = client_config(&place.path("tls/certificate.pem"), own.as_deref(), "h2");
    let stream = TcpStream::connect(address).await.expect("connected");
    let name = ServerName::try_from("localhost").expect("a name");
    let stream = TlsConnector::from(Arc::new(config)).connect(name, stream).await.expect("a handshake");
    assert_eq!(stream.get_ref().1.alpn_protocol(), Some(&b"h2"[..]));
    let (sender, connection) =
        http2::handshake(TokioExecutor::new(), TokioIo::new(stream)).await.expect("a connection of HTTP/2");
    tokio::spawn(async move { drop(connection.await) });
    sender
}

async fn ask(sender: &SendRequest<String>, request: Request<String>) -> Response<Vec<u8>> {
    let answer = async {
        let (parts, mut incoming) = sender.clone().send_request(request).await.expect("an answer").into_parts();
        let mut body = Vec::new();
        while let Some(frame) = poll_fn(|context| Pin::new(&mut incoming).poll_frame(context)).await {
            body.extend_from_slice(frame.expect("whole").data_ref().map_or(&[][..], |data| data));
        }
        Response::from_parts(parts, body)
    };
    tokio::time::timeout(ANSWER_LIMIT, answer).await.expect("in time")
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_and_queries_share_a_connection_of_http_2() {
    let place = place_of_clients();
    let server = serve_clients(&place);
    let ann = connect_http2(&place, &server.http, Some("ann")).await;
    let request = |path: &str, body: &str| {
        let method = if body.is_empty() { "GET" } else { "POST" };
        let request = Request::builder().method(method).uri(format!("https://localhost{path}"));
        request.header("content-type", "text/plain").body(body.to_owned()).expect("a request")
    };
    let rows = "select value, repeat('x', 1000) as text from generate_series(1, 20000)";
    let (tables, answer, files) = tokio::join!(
        ask(&ann, request("/api/v1/tables", "")),
        ask(&ann, request("/api/v1/sql?format=csv", rows)),
        ask(&ann, request("/api/v1/files?table=runs", "")),
    );
    assert_eq!((tables.status(), answer.status()), (200.try_into().expect("a status"), tables.status()));
    assert_eq!(answer.body().iter().filter(|byte| **byte == b'\n').count(), 20_001);
    assert!(String::from_utf8_lossy(files.body()).contains("\"https://localhost/"), "its authority is its host");
    let refused = ask(&connect_http2(&place, &server.http, None).await, request("/api/v1/tables", "")).await;
    assert_eq!(refused.status(), 401);
    assert!(refused.headers().contains_key("x-request-id"));
    let mut foreign = request("/api/v1/tables", "");
    foreign.headers_mut().insert("origin", "https://evil.example".parse().expect("a header"));
    assert_eq!(ask(&ann, foreign).await.status(), 403);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_certificate_logs_in_over_flight_sql() {
    let place = place_of_clients();
    let server = serve_clients(&place);
    let code = async |own| {
        let sender = connect_http2(&place, &server.flight_sql, own).await;
        let request = Request::post("https://localhost/arrow.flight.protocol.FlightService/Nothing");
        let request = request.header("content-type", "application/grpc").header("te", "trailers");
        let answer = ask(&sender, request.body("\0\0\0\0\0".to_owned()).expect("a request")).await;
        answer.headers().get("grpc-status").map(|code| code.to_str().expect("a number").to_owned())
    };
    const UNIMPLEMENTED: &str = "12";
    const UNAUTHENTICATED: &str = "16";
    assert_eq!(code(Some("ann")).await.as_deref(), Some(UNIMPLEMENTED));
    assert_eq!(code(Some("bob")).await.as_deref(), Some(UNAUTHENTICATED));
    assert_eq!(code(None).await.as_deref(), Some(UNAUTHENTICATED));
}

mod slow {
    use super::*;

    #[test]
    fn who_is_taken_back_is_refused() {
        let place = place_of_clients();
        let server = serve_clients(&place);
        let mut open = connect(&place, &server, Some("ann")).expect("a handshake");
        assert!(get(&mut open, "/api/v1/tables", "").starts_with("HTTP/1.1 200"));
        std::fs::write(place.path("tokens.toml"), "[[token]]\nname = 'bob'\n").expect("written");
        wait_until("ann has no line", || get(&mut open, "/api/v1/tables", "").starts_with("HTTP/1.1 401"));
        assert_eq!(status(&place, &server, Some("bob"), ""), "200");
        std::fs::copy(place.path("ann/certificate.pem"), place.path("clients.pem")).expect("copied");
        wait_until("bob's certificate is none", || is_refused(&place, &server, "bob"));
        assert_eq!(status(&place, &server, Some("ann"), ""), "401");
    }
}
