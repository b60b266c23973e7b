//! The door for one agent, on standard input and output: each line is a message of the Model Context Protocol, which an
//! engine answers as it answers `POST /mcp`.

use std::collections::HashMap;
use std::io::{self, BufRead, Read as _, Write as _};
use std::sync::Arc;

use axum::body::{Body, to_bytes};
use axum::http::{HeaderValue, Request, StatusCode, Uri, header};
use bytes::Bytes;
use echolake_access::TokenAccess;
use echolake_http::{FORWARDED_PROTO, MCP};
use echolake_lake::Lake;
use echolake_service::request_span::begin_request;
use echolake_service::{ClientIdentity, EngineRole, Error, RequestFault, ServerProtocol};
use serde_json::{Value, json};
use tokio::sync::{Semaphore, mpsc};
use tokio::task::{AbortHandle, JoinSet};
use tracing::Instrument as _;

use super::engine_process::EngineSettings;
use super::forward::EngineProtocol;
use super::server_engines::ServerEngines;
use crate::door::activity::ServerActivity;

/// Name of the client.
const AGENT: &str = "agent";
/// Bytes of a message, as over HTTP, and of its answer.
const LARGEST: u64 = 2 << 20;
const LARGEST_ANSWER: usize = 16 << 20;
/// Messages that are answered at once.
const MOST_AT_ONCE: usize = 8;
/// The notification that ends a request.
const CANCELLED: &str = "notifications/cancelled";
/// Codes of JSON-RPC: a message that is not one, and a failure of the server.
const PARSE: i32 = -32700;
const INTERNAL: i32 = -32603;

/// A door for one agent.
pub struct AgentDoor {
    route: Arc<AgentRoute>,
}

/// The way of messages to the engine.
struct AgentRoute {
    engines: ServerEngines,
    client: ClientIdentity,
    host: HeaderValue,
    scheme: HeaderValue,
}

/// A line of standard input.
enum InputLine {
    Message(Vec<u8>),
    /// One that is longer than is read.
    TooLong,
}

impl AgentDoor {
    /// A door of a lake. `pages` is where a server shows its pages, for links.
    ///
    /// # Errors
    /// [`Error::Pages`], [`Error::Temp`], [`Error::System`].
    pub fn new(lake: &Lake, engines: EngineSettings, pages: &str) -> Result<Self, Error> {
        let (scheme, host) = origin_headers(pages).ok_or_else(|| Error::Pages { found: pages.to_owned() })?;
        let activity = Arc::new(ServerActivity::new()?);
        let engines = ServerEngines::new(lake, engines, activity, Arc::new(TokenAccess::new(None)))?;
        // No page of elsewhere reaches standard input.
        let client = ClientIdentity { is_open: false, ..ClientIdentity::local_client(AGENT) };
        Ok(Self { route: Arc::new(AgentRoute { engines, client, host, scheme }) })
    }

    /// Answers until standard input ends and what it asked is answered, or until `stop`.
    ///
    /// # Errors
    /// [`Error::System`].
    pub async fn answer_until(self, stop: impl Future<Output = ()>) -> Result<(), Error> {
        tokio::select! {
            () = answer_lines(&self.route, read_lines()) => {}
            () = stop => {}
        }
        self.route.engines.end_all().await;
        Ok(())
    }
}

async fn answer_lines(route: &Arc<AgentRoute>, mut lines: mpsc::Receiver<InputLine>) {
    let mut tasks = JoinSet::new();
    let mut running: HashMap<String, AbortHandle> = HashMap::new();
    let places = Arc::new(Semaphore::new(MOST_AT_ONCE));
    while let Some(line) = lines.recv().await {
        while tasks.try_join_next().is_some() {}
        running.retain(|_, task| !task.is_finished());
        let message = match line {
            InputLine::Message(message) => message,
            InputLine::TooLong => {
                write_error(&Value::Null, PARSE, &RequestFault::TooLarge { limit: LARGEST as usize }.to_string());
                continue;
            }
        };
        let parsed: Value = serde_json::from_slice(&message).unwrap_or_default();
        if parsed["method"] == CANCELLED {
            // Dropping its request ends its query.
            if let Some(task) = running.remove(&parsed["params"]["requestId"].to_string()) {
                task.abort();
            }
            continue;
        }
        let route = route.clone();
        let id = parsed["id"].clone();
        // Never closed.
        let place = places.clone().acquire_owned().await;
        let key = id.to_string();
        let task = tasks.spawn(async move {
            let _place = place;
            match route.answer_message(message.into()).await {
                Ok(Some(answer)) => write_line(&answer),
                Ok(None) => {}
                Err(fault) => write_error(&id, INTERNAL, &fault.to_string()),
            }
        });
        running.insert(key, task);
    }
    while tasks.join_next().await.is_some() {}
}

impl AgentRoute {
    // The answer to a message; none to a notification.
    async fn answer_message(&self, message: Bytes) -> Result<Option<Bytes>, RequestFault> {
        let mut request = Request::post(MCP).body(Body::from(message)).map_err(|_| RequestFault::Internal)?;
        let headers = request.headers_mut();
        headers.insert(header::HOST, self.host.clone());
        headers.insert(FORWARDED_PROTO, self.scheme.clone());
        let (span, _) = begin_request(headers, ServerProtocol::Mcp);
        let work = async {
            let role = EngineRole::Statements;
            let response =
                self.engines.forward_request(role, &self.client, request, EngineProtocol::Http, None).await?;
            if response.status() == StatusCode::ACCEPTED {
                return Ok(None);
            }
            let body = to_bytes(Body::new(response.into_body()), LARGEST_ANSWER).await;
            body.map(Some).map_err(|_| RequestFault::EngineLost { reason: "it stopped answering".to_owned() })
        };
        work.instrument(span).await
    }
}

// Scheme and host with port; an address has no path.
fn origin_headers(pages: &str) -> Option<(HeaderValue, HeaderValue)> {
    let uri: Uri = pages.parse().ok()?;
    let scheme = uri.scheme_str().filter(|scheme| ["http", "https"].contains(scheme))?;
    let host = uri.authority().filter(|_| uri.path() == "/" && uri.query().is_none())?;
    Some((HeaderValue::from_str(scheme).ok()?, HeaderValue::from_str(host.as_str()).ok()?))
}

// A thread of its own: a read of standard input cannot be ended.
fn read_lines() -> mpsc::Receiver<InputLine> {
    let (send, receive) = mpsc::channel(1);
    std::thread::spawn(move || {
        let mut input = io::stdin().lock();
        while let Ok(Some(line)) = next_line(&mut input, LARGEST) {
            if send.blocking_send(line).is_err() {
                return;
            }
        }
    });
    receive
}

// The next line that is not empty; None at the end.
fn next_line(input: &mut impl BufRead, limit: u64) -> io::Result<Option<InputLine>> {
    loop {
        let mut line = Vec::new();
        input.by_ref().take(limit + 1).read_until(b'\n', &mut line)?;
        if line.is_empty() {
            return Ok(None);
        }
        if line.len() as u64 > limit && line.last() != Some(&b'\n') {
            // The rest is passed over a piece at a time.
            while line.last().is_some_and(|last| *last != b'\n') {
                line.clear();
                input.by_ref().take(limit).read_until(b'\n', &mut line)?;
            }
            return Ok(Some(InputLine::TooLong));
        }
        if !line.trim_ascii().is_empty() {
            return Ok(Some(InputLine::Message(line)));
        }
    }
}

fn write_error(id: &Value, code: i32, message: &str) {
    let answer = json!({ "jsonrpc": "2.0", "id": id, "error": { "code": code, "message": message } });
    write_line(answer.to_string().as_bytes());
}

// An agent that has gone reads nothing; its end of standard input says so.
fn write_line(answer: &[u8]) {
    let mut output = io::stdout().lock();
    let _ = output.write_all(answer).and_then(|()| output.write_all(b"\n")).and_then(|()| output.flush());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_bounded() {
        let mut input = &b"{}\n\n  \n0123456789\n01234567\n01234567890123456789012345\nlast"[..];
        let mut lines = Vec::new();
        while let Some(line) = next_line(&mut input, 9).expect("read") {
            lines.push(match line {
                InputLine::Message(line) => String::from_utf8_lossy(&line).trim_end().to_owned(),
                InputLine::TooLong => "too long".to_owned(),
            });
        }
        assert_eq!(lines, ["{}", "too long", "01234567", "too long", "last"]);
    }

    #[test]
    fn links_begin_with_an_origin() {
        let expected = (HeaderValue::from_static("https"), HeaderValue::from_static("lab.example.org:8443"));
        assert_eq!(origin_headers("https://lab.example.org:8443"), Some(expected));
        for wrong in ["", "localhost:8080", "ftp://x", "http://x/pages", "http://x?a", "http://", "x"] {
            assert_eq!(origin_headers(wrong), None, "{wrong}");
        }
    }
}
