//! Queries over HTTP. Answers are not kept: they may be larger than memory.

use std::io::{self, BufRead as _, BufReader, ErrorKind, Read, Write as _};
use std::net::TcpStream;

use super::query_client::AnswerDigest;
use super::{QueryClient, QueryOutcome, percent_encoded};
use crate::serve::http::HttpRequest;

/// Bytes of an error that are read.
const LARGEST_PROBLEM: u64 = 64 << 10;
/// Bytes of an answer's head.
const LARGEST_HEAD: u64 = 64 << 10;

/// Parsed head of an answer.
struct AnswerHead {
    status: u16,
    /// None if it comes in chunks.
    length: Option<u64>,
}

/// Runs a query; the answer is CSV.
pub(super) fn query_http(client: &QueryClient, sql: &str) -> QueryOutcome {
    let request = HttpRequest::post("/api/v1/sql?format=csv", sql).with("content-type", "text/plain");
    send_request(client, request)
}

/// Asks for a slice of the client's run.
pub(super) fn query_slice(client: &QueryClient, filter: &str) -> QueryOutcome {
    let path = format!("/api/v1/slices.mcap?run={}&where={}", client.run, percent_encoded(filter));
    send_request(client, HttpRequest::get(&path))
}

impl QueryClient {
    /// Asks for the data of a page.
    pub fn get_page(&self, path: &str) -> QueryOutcome {
        send_request(self, HttpRequest::get(path))
    }
}

/// Sends a request with the client's token and reads the answer.
pub(super) fn send_request(client: &QueryClient, request: HttpRequest) -> QueryOutcome {
    let address = &client.addresses.http;
    let bytes = request.with("authorization", &format!("Bearer {}", client.token)).bytes(address);
    let Ok(stream) = client.connections.connect(address) else { return QueryOutcome::Disconnected };
    // A server that has read enough may close before it has all, and answer.
    let _ = (&*stream).write_all(&bytes);
    let mut reader = BufReader::new(&*stream);
    let Ok(head) = read_head(&mut reader) else { return QueryOutcome::Disconnected };
    if head.status >= 400 {
        return QueryOutcome::Refused(read_code(&mut reader, &head));
    }
    let mut digest = AnswerDigest::default();
    match read_body(&mut reader, head.length, &mut digest) {
        Ok(()) => QueryOutcome::Answer(digest),
        Err(_) => QueryOutcome::Truncated,
    }
}

fn read_head(reader: &mut BufReader<&TcpStream>) -> io::Result<AnswerHead> {
    let mut head = AnswerHead { status: 0, length: None };
    for line in reader.by_ref().take(LARGEST_HEAD).lines() {
        let line = line?.to_ascii_lowercase();
        if line.is_empty() {
            return Ok(head);
        }
        if let Some(status) = line.strip_prefix("http/1.1 ") {
            head.status = status.split(' ').next().and_then(|s| s.parse().ok()).unwrap_or(0);
        }
        if let Some(length) = line.strip_prefix("content-length: ") {
            head.length = length.parse().ok();
        }
    }
    Err(ErrorKind::UnexpectedEof.into())
}

// The problem's code; the status if the body is no problem.
fn read_code(reader: &mut BufReader<&TcpStream>, head: &AnswerHead) -> String {
    let mut body = Vec::new();
    // What came of it will do.
    let _ = match head.length {
        Some(length) => reader.by_ref().take(length.min(LARGEST_PROBLEM)).read_to_end(&mut body).map(drop),
        None => Ok(()),
    };
    let problem: serde_json::Value = serde_json::from_slice(&body).unwrap_or_default();
    problem["code"].as_str().map_or_else(|| format!("status {}", head.status), str::to_owned)
}

fn read_body(reader: &mut BufReader<&TcpStream>, length: Option<u64>, digest: &mut AnswerDigest) -> io::Result<()> {
    match length {
        Some(length) => copy_whole(reader, length, digest),
        None => read_chunks(reader, digest),
    }
}

// RFC 9112, 7.1: the chunk of length 0 is the last.
fn read_chunks(reader: &mut BufReader<&TcpStream>, digest: &mut AnswerDigest) -> io::Result<()> {
    loop {
        let mut line = String::new();
        reader.by_ref().take(LARGEST_HEAD).read_line(&mut line)?;
        let size = u64::from_str_radix(line.trim_end(), 16).map_err(|_| io::Error::from(ErrorKind::InvalidData))?;
        copy_whole(reader, size, digest)?;
        copy_whole(reader, 2, &mut AnswerDigest::default())?;
        if size == 0 {
            return Ok(());
        }
    }
}

fn copy_whole(reader: &mut impl Read, length: u64, digest: &mut AnswerDigest) -> io::Result<()> {
    match io::copy(&mut reader.by_ref().take(length), digest)? {
        copied if copied == length => Ok(()),
        _ => Err(ErrorKind::UnexpectedEof.into()),
    }
}
