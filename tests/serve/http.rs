//! As much of an HTTP client as these tests need, so that they see what is on the wire.

use std::fmt::Write as _;
use std::io::{ErrorKind, Read as _, Write as _};
use std::net::TcpStream;

use super::server::{ANSWER_LIMIT, ServedLake};

/// A request.
pub(crate) struct HttpRequest {
    method: &'static str,
    path: String,
    host: Option<String>,
    headers: String,
    body: Vec<u8>,
    is_chunked: bool,
}

/// An answer.
#[derive(Debug)]
pub(crate) struct HttpResponse {
    pub status: u16,
    headers: Vec<(String, String)>,
    pub body: Vec<u8>,
    /// True if its end was received.
    pub is_whole: bool,
}

impl HttpRequest {
    pub fn get(path: &str) -> Self {
        let headers = String::new();
        let body = Vec::new();
        Self { method: "GET", path: path.to_owned(), host: None, headers, body, is_chunked: false }
    }

    pub fn head(path: &str) -> Self {
        Self { method: "HEAD", ..Self::get(path) }
    }

    pub fn options(path: &str) -> Self {
        Self { method: "OPTIONS", ..Self::get(path) }
    }

    pub fn post(path: &str, body: &str) -> Self {
        Self::post_bytes(path, body.into())
    }

    pub fn post_bytes(path: &str, body: Vec<u8>) -> Self {
        Self { method: "POST", body, ..Self::get(path) }
    }

    pub fn with(mut self, name: &str, value: &str) -> Self {
        let _ = write!(self.headers, "{name}: {value}\r\n");
        self
    }

    pub fn host(mut self, host: &str) -> Self {
        self.host = Some(host.to_owned());
        self
    }

    /// Sends the body as one chunk, so that its length is not known before its end.
    pub fn chunked(mut self) -> Self {
        let length = format!("{:x}\r\n", self.body.len());
        self.body = [length.as_bytes(), &self.body, b"\r\n0\r\n\r\n"].concat();
        self.is_chunked = true;
        self
    }

    /// Sends it and does not wait.
    pub fn begin(self, server: &ServedLake) -> TcpStream {
        let bytes = self.bytes(&server.http);
        let (head, body) = bytes.split_at(bytes.len() - self.body.len());
        let mut stream = ServedLake::connect(&server.http);
        stream.write_all(head).expect("sent");
        // A server that has read enough may close before it has all.
        let _ = stream.write_all(body);
        stream
    }

    /// Returns the request as it is sent to this address.
    pub fn bytes(&self, address: &str) -> Vec<u8> {
        let length = match self.is_chunked {
            true => "transfer-encoding: chunked".to_owned(),
            false => format!("content-length: {}", self.body.len()),
        };
        let head = format!(
            "{} {} HTTP/1.1\r\nhost: {}\r\nconnection: close\r\n{length}\r\n{}\r\n",
            self.method,
            self.path,
            self.host.as_deref().unwrap_or(address),
            self.headers
        );
        [head.as_bytes(), &self.body].concat()
    }

    pub fn send(self, server: &ServedLake) -> HttpResponse {
        self.attempt(server).expect("headers")
    }

    /// None if the connection ended before an answer began.
    pub fn attempt(self, server: &ServedLake) -> Option<HttpResponse> {
        let name = format!("{} {}", self.method, self.path);
        let mut stream = self.begin(server);
        let mut bytes = Vec::new();
        // A connection that is broken off ends in an error, after what came; one that hangs is a failure.
        if let Err(error) = stream.read_to_end(&mut bytes) {
            let is_late = matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut);
            assert!(!is_late, "{name}: nothing more for {ANSWER_LIMIT:?}, after {} bytes", bytes.len());
        }
        HttpResponse::read(&bytes)
    }
}

impl HttpResponse {
    /// Reads an answer; None if its head is not whole.
    pub fn read(bytes: &[u8]) -> Option<Self> {
        let end = bytes.windows(4).position(|w| w == b"\r\n\r\n")?;
        let head = std::str::from_utf8(&bytes[..end]).expect("text");
        let mut lines = head.lines();
        let status = lines.next().and_then(|l| l.split(' ').nth(1)).and_then(|s| s.parse().ok()).expect("a status");
        let pair = |line: &str| line.split_once(": ").map(|(n, v)| (n.to_ascii_lowercase(), v.to_owned()));
        let headers: Vec<_> = lines.filter_map(pair).collect();
        let rest = &bytes[end + 4..];
        let chunked = headers.iter().any(|(name, value)| name == "transfer-encoding" && value == "chunked");
        let (body, is_whole) = if chunked { unchunked(rest) } else { (rest.to_vec(), true) };
        Some(Self { status, headers, body, is_whole })
    }

    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(known, _)| known == name).map(|(_, value)| value.as_str())
    }

    pub fn text(&self) -> String {
        String::from_utf8(self.body.clone()).expect("text")
    }
}

// The chunks that came, and whether the last one, which is empty, did.
fn unchunked(mut bytes: &[u8]) -> (Vec<u8>, bool) {
    let mut body = Vec::new();
    while let Some(line) = bytes.windows(2).position(|w| w == b"\r\n") {
        let size = std::str::from_utf8(&bytes[..line]).ok().and_then(|t| usize::from_str_radix(t, 16).ok());
        let size = size.expect("a chunk's size");
        if size == 0 {
            return (body, true);
        }
        let Some(chunk) = bytes.get(line + 2..line + 2 + size) else { break };
        body.extend_from_slice(chunk);
        bytes = bytes.get(line + 4 + size..).unwrap_or_default();
    }
    (body, false)
}
