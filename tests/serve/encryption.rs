//! TLS of all three protocols, as clients see it that trust the server's certificate alone.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;

use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

use super::super::TestFolder;
use super::server::ServedLake;
use super::{lake, served, wait_until};

pub(super) type TlsClient = StreamOwned<ClientConnection, TcpStream>;

/// A lake with a certificate in the folder `tls`.
pub(super) fn certified() -> TestFolder {
    let place = lake();
    place.ok(&["certificate", "localhost", "127.0.0.1", "-o", "tls"]);
    place
}

pub(super) const FILES: [&str; 4] = ["--certificate", "tls/certificate.pem", "--key", "tls/key.pem"];

/// A client of a protocol that trusts one certificate, and shows the one in the folder `own`.
pub(super) fn client_config(certificate: &Path, own: Option<&Path>, protocol: &str) -> ClientConfig {
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
pub(super) fn shake_as(stream: TcpStream, config: ClientConfig, protocol: &str) -> std::io::Result<TlsClient> {
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
pub(super) fn get(client: &mut TlsClient, path: &str, more: &str) -> String {
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
pub(super) fn begin_session(stream: &mut dyn std::io::Write, user: &str) {
    let mut body = 196_608_i32.to_be_bytes().to_vec();
    body.extend(format!("user\0{user}\0database\0datafusion\0\0").as_bytes());
    let length = ((body.len() + 4) as i32).to_be_bytes();
    stream.write_all(&[&length[..], &body].concat()).expect("sent");
}

/// Connects over Postgres' protocol, up to the handshake.
pub(super) fn ask_for_tls(server: &ServedLake) -> TcpStream {
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
    let place = certified();
    let tokens = place.run(&["token", "analyst"]);
    std::fs::write(place.path("tokens.toml"), &tokens.stdout).expect("written");
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
