//! TLS of all three protocols, as clients see it that trust the server's certificate alone.

use std::future::poll_fn;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;

use hyper::body::Body as _;
use hyper::client::conn::http2::{self, SendRequest};
use hyper::{Request, Response};
use hyper_util::rt::{TokioExecutor, TokioIo};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

use super::super::TestFolder;
use super::server::{ANSWER_LIMIT, ServedLake};
use super::{lake, served, wait_until};

type TlsClient = StreamOwned<ClientConnection, TcpStream>;

/// A lake with a certificate in the folder `tls`.
fn certified() -> TestFolder {
    let place = lake();
    place.ok(&["certificate", "localhost", "127.0.0.1", "-o", "tls"]);
    place
}

/// The same with a token, which is returned.
fn certified_with_token() -> (TestFolder, String) {
    let place = certified();
    let made = place.run(&["token", "ann"]);
    std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
    let token = super::super::stderr(&made).lines().next().expect("a token").to_owned();
    (place, token)
}

const FILES: [&str; 4] = ["--certificate", "tls/certificate.pem", "--key", "tls/key.pem"];

/// A client of a protocol that trusts one certificate, and shows the one in the folder `own`.
fn client_config(certificate: &Path, own: Option<&Path>, protocol: &str) -> ClientConfig {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(certificate).expect("PEM")).expect("a certificate");
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_root_certificates(roots);
    let mut config = match own {
        Some(own) => {
            let shown = CertificateDer::from_pem_file(own.join("certificate.pem")).expect("PEM");
            let key = PrivateKeyDer::from_pem_file(own.join("key.pem")).expect("PEM");
            config.with_client_auth_cert(vec![shown], key).expect("a certificate and its key")
        }
        None => config.with_no_client_auth(),
    };
    config.alpn_protocols = vec![protocol.as_bytes().to_vec()];
    config
}

/// Shakes hands on a connection, as a client of a protocol that trusts one certificate.
fn shake(stream: TcpStream, certificate: &Path, protocol: &str) -> std::io::Result<TlsClient> {
    shake_as(stream, client_config(certificate, None, protocol), protocol)
}

/// Shakes hands on a connection.
fn shake_as(stream: TcpStream, config: ClientConfig, protocol: &str) -> std::io::Result<TlsClient> {
    let name = ServerName::try_from("localhost").expect("a name");
    let mut client = StreamOwned::new(ClientConnection::new(Arc::new(config), name).expect("a client"), stream);
    client.flush()?;
    while client.conn.is_handshaking() {
        client.conn.complete_io(&mut client.sock)?;
    }
    assert_eq!(client.conn.alpn_protocol(), Some(protocol.as_bytes()));
    Ok(client)
}

/// Asks for a path; the connection stays.
fn get(client: &mut TlsClient, path: &str, more: &str) -> String {
    write!(client, "GET {path} HTTP/1.1\r\nHost: localhost\r\n{more}\r\n").expect("sent");
    let mut text = String::new();
    while !text.contains("\r\n\r\n") {
        let mut byte = [0; 1];
        client.read_exact(&mut byte).expect("an answer");
        text.push(char::from(byte[0]));
    }
    let length = text.to_lowercase().split_once("content-length: ").expect("a length").1.to_owned();
    let length = length.split("\r\n").next().expect("a line").parse().expect("a number");
    let mut body = vec![0; length];
    client.read_exact(&mut body).expect("the body");
    text + &String::from_utf8_lossy(&body)
}

/// Begins a session of a user over Postgres' protocol.
fn begin_session(stream: &mut dyn std::io::Write, user: &str) {
    let mut body = 196_608_i32.to_be_bytes().to_vec();
    body.extend(format!("user\0{user}\0database\0datafusion\0\0").as_bytes());
    let length = ((body.len() + 4) as i32).to_be_bytes();
    stream.write_all(&[&length[..], &body].concat()).expect("sent");
}

/// Connects over Postgres' protocol, up to the handshake.
fn ask_for_tls(server: &ServedLake) -> TcpStream {
    let mut asked = ServedLake::connect(&server.postgres);
    let mut answer = [0; 1];
    asked.write_all(&[0, 0, 0, 8, 0x04, 0xd2, 0x16, 0x2f]).expect("sent");
    asked.read_exact(&mut answer).expect("an answer");
    assert_eq!(&answer, b"S");
    asked
}

#[test]
fn all_protocols_are_encrypted() {
    let place = certified();
    let server = served(&place, &FILES);
    let certificate = place.path("tls/certificate.pem");
    let mut http = shake(ServedLake::connect(&server.http), &certificate, "http/1.1").expect("a handshake");
    assert!(get(&mut http, "/health", "").starts_with("HTTP/1.1 200"));
    let files = get(&mut http, "/api/v1/files?table=runs", "Origin: https://localhost\r\n");
    assert!(files.contains("\"https://localhost/"), "{files}");
    shake(ServedLake::connect(&server.flight_sql), &certificate, "h2").expect("a handshake");
    // Plain text is answered by no protocol.
    let mut plain = ServedLake::connect(&server.http);
    plain.write_all(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("sent");
    let mut said = Vec::new();
    let _ = plain.read_to_end(&mut said);
    assert!(!String::from_utf8_lossy(&said).contains("HTTP/1.1"), "{said:?}");
    let mut plain = ServedLake::connect(&server.postgres);
    begin_session(&mut plain, "me");
    let mut said = String::new();
    let _ = plain.read_to_string(&mut said);
    assert!(said.starts_with('E') && said.contains("sslmode=require"), "{said:?}");
    let mut postgres = shake(ask_for_tls(&server), &certificate, "postgresql").expect("a handshake");
    begin_session(&mut postgres, "me");
    let mut header = [0; 9];
    postgres.read_exact(&mut header).expect("an answer");
    assert_eq!(header, [b'R', 0, 0, 0, 8, 0, 0, 0, 0], "the session has begun");
}

#[test]
fn what_cannot_be_encrypted_is_refused() {
    let (place, _) = certified_with_token();
    let beyond = ["serve", "--listen", "0.0.0.0:0", "--tokens", "tokens.toml"];
    place.fails(1, &beyond, "nothing would be encrypted");
    place.fails(2, &["serve", "--certificate", "tls/certificate.pem"], "--key");
    std::fs::write(place.path("empty.pem"), "").expect("written");
    place.fails(1, &["serve", "--certificate", "empty.pem", "--key", "tls/key.pem"], "`empty.pem`");
    place.fails(1, &["serve", "--certificate", "none.pem", "--key", "tls/key.pem"], "`none.pem`");
    place.ok(&["certificate", "localhost", "-o", "other"]);
    let files = ["serve", "--certificate", "tls/certificate.pem", "--key", "other/key.pem"];
    place.fails(1, &files, "`other/key.pem`");
    place.fails(1, &["certificate", "localhost", "-o", "tls"], "cannot write `tls/key.pem`");
    std::fs::write(place.path("certified.toml"), "[[token]]\nname = 'ann'\n").expect("written");
    place.fails(1, &["serve", "--tokens", "certified.toml"], "missing field `sha256`");
}

#[test]
fn a_certificate_logs_nobody_in() {
    let (place, token) = certified_with_token();
    let server = served(&place, &[&FILES[..], &["--tokens", "tokens.toml"]].concat());
    place.ok(&["certificate", "ann", "-o", "own"]);
    let mut config = client_config(&place.path("tls/certificate.pem"), Some(&place.path("own")), "http/1.1");
    let mut client = shake_as(ServedLake::connect(&server.http), config.clone(), "http/1.1").expect("a handshake");
    assert!(get(&mut client, "/api/v1/tables", "").starts_with("HTTP/1.1 401"));
    let bearer = format!("Authorization: Bearer {token}\r\n");
    assert!(get(&mut client, "/api/v1/tables", &bearer).starts_with("HTTP/1.1 200"));
    config.alpn_protocols = vec![b"postgresql".to_vec()];
    let mut session = shake_as(ask_for_tls(&server), config, "postgresql").expect("a handshake");
    begin_session(&mut session, "ann");
    let mut header = [0; 9];
    session.read_exact(&mut header).expect("an answer");
    assert_eq!(header[5..], [0, 0, 0, 10], "it has to prove that it has the token");
}

async fn connect_http2(place: &TestFolder, address: &str) -> SendRequest<String> {
    let config = client_config(&place.path("tls/certificate.pem"), None, "h2");
    let stream = tokio::net::TcpStream::connect(address).await.expect("connected");
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
    let (place, token) = certified_with_token();
    let server = served(&place, &[&FILES[..], &["--tokens", "tokens.toml"]].concat());
    let ann = connect_http2(&place, &server.http).await;
    let bearer = format!("Bearer {token}");
    let request = |path: &str, body: &str| {
        let method = if body.is_empty() { "GET" } else { "POST" };
        let request = Request::builder().method(method).uri(format!("https://localhost{path}"));
        let request = request.header("authorization", &bearer).header("content-type", "text/plain");
        request.body(body.to_owned()).expect("a request")
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
    let mut nobodys = request("/api/v1/tables", "");
    nobodys.headers_mut().remove("authorization");
    let refused = ask(&ann, nobodys).await;
    assert_eq!(refused.status(), 401);
    assert!(refused.headers().contains_key("x-request-id"));
}

/// A frame of HTTP/2: type, flags, stream and payload.
fn write_frame(client: &mut TlsClient, kind: u8, flags: u8, stream: u32, payload: &[u8]) {
    let length = (payload.len() as u32).to_be_bytes();
    let head = [&length[1..], &[kind, flags], &stream.to_be_bytes()].concat();
    client.write_all(&[&head[..], payload].concat()).expect("sent");
    client.flush().expect("sent");
}

/// Reads frames up to one of a type that has a flag; returns the types of all, and the payloads of data.
fn read_frames(client: &mut TlsClient, last: (u8, u8)) -> (Vec<u8>, Vec<u8>) {
    let mut kinds = Vec::new();
    let mut data = Vec::new();
    loop {
        let mut head = [0; 9];
        client.read_exact(&mut head).expect("a frame");
        let mut payload = vec![0; u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize];
        client.read_exact(&mut payload).expect("its payload");
        kinds.push(head[3]);
        if head[3] == DATA {
            data.extend(payload);
        }
        if head[3] == last.0 && head[4] & last.1 != 0 {
            return (kinds, data);
        }
    }
}

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
/// Ends a stream, or says that a ping was heard.
const END_OR_ACK: u8 = 1;
const END_HEADERS: u8 = 4;

/// B1: the stream of a refused request with a body is not reset while its client sends, so that it reads the answer.
#[test]
fn a_refused_body_of_http_2_is_read_to_its_end() {
    let place = certified();
    let made = place.run(&["token", "ana", "--scopes", "sql"]);
    std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
    let token = super::super::stderr(&made).lines().next().expect("a token").to_owned();
    let server = served(&place, &[&FILES[..], &["--tokens", "tokens.toml"]].concat());
    let certificate = place.path("tls/certificate.pem");
    for (path, bearer, bytes, status) in [
        ("/api/v1/annotations", format!("Bearer {token}"), "12", 403),
        ("/api/v1/predictions?model=a&version=1", format!("Bearer {token}"), "12", 403),
        ("/api/v1/sql", "Bearer wrong".to_owned(), "12", 401),
        ("/api/v1/sql", format!("Bearer {token}"), "99999999", 413),
    ] {
        let mut client = shake(ServedLake::connect(&server.http), &certificate, "h2").expect("a handshake");
        client.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").expect("sent");
        write_frame(&mut client, SETTINGS, 0, 0, &[]);
        let headers = [
            (":method", "POST"),
            (":scheme", "https"),
            (":authority", "localhost"),
            (":path", path),
            ("authorization", bearer.as_str()),
            ("content-type", "application/json"),
            ("content-length", bytes),
        ];
        // Literal fields without an index (RFC 7541, section 6.2.2).
        let field = |(name, value): (&str, &str)| {
            [&[0, name.len() as u8][..], name.as_bytes(), &[value.len() as u8], value.as_bytes()].concat()
        };
        write_frame(&mut client, HEADERS, END_HEADERS, 1, &headers.map(field).concat());
        write_frame(&mut client, DATA, 0, 1, b"{\"a\"");
        let (kinds, problem) = read_frames(&mut client, (DATA, END_OR_ACK));
        assert!(!kinds.contains(&RST_STREAM), "{path}: {kinds:?}");
        let problem: serde_json::Value = serde_json::from_slice(&problem).expect("JSON");
        assert_eq!(problem["status"], status, "{problem}");
        // The client sends on, and ends.
        write_frame(&mut client, DATA, 0, 1, b": 1, ");
        write_frame(&mut client, PING, 0, 0, &[7; 8]);
        let (kinds, _) = read_frames(&mut client, (PING, END_OR_ACK));
        assert!(!kinds.contains(&RST_STREAM), "{path}: {kinds:?}");
        if bytes == "12" {
            write_frame(&mut client, DATA, END_OR_ACK, 1, b"\"\"}");
            write_frame(&mut client, PING, 0, 0, &[8; 8]);
            let (kinds, _) = read_frames(&mut client, (PING, END_OR_ACK));
            assert!(!kinds.contains(&RST_STREAM), "{path}: {kinds:?}");
        }
    }
}

mod slow {
    use super::*;

    #[test]
    fn a_renewed_certificate_is_taken_without_a_lost_connection() {
        let place = certified();
        let server = served(&place, &FILES);
        let (old, new) = (place.path("tls/certificate.pem"), place.path("renewed/certificate.pem"));
        let kept = place.path("old.pem");
        std::fs::copy(&old, &kept).expect("copied");
        let mut before = shake(ServedLake::connect(&server.http), &kept, "http/1.1").expect("a handshake");
        place.ok(&["certificate", "localhost", "-o", "renewed"]);
        std::fs::copy(place.path("renewed/key.pem"), place.path("tls/key.pem")).expect("copied");
        std::fs::copy(&new, &old).expect("copied");
        let shakes = |certificate: &Path| shake(ServedLake::connect(&server.http), certificate, "http/1.1").is_ok();
        wait_until("the new certificate is in use", || shakes(&new));
        assert!(!shakes(&kept));
        assert!(get(&mut before, "/health", "").starts_with("HTTP/1.1 200"), "the old connection goes on");
    }
}
