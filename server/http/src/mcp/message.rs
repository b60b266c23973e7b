//! Messages of the protocol (JSON-RPC 2.0): requests, their revision of the protocol, results and errors.

use axum::Json;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse as _, Response};
use echolake_service::RequestFault;
use serde_json::{Map, Value, json};

use super::tools::AgentTool;

/// Revisions that begin with `initialize`, and the one in which each request names its revision.
const HANDSHAKES: [&str; 4] = ["2024-11-05", "2025-03-26", "2025-06-18", "2025-11-25"];
const STATELESS: &str = "2026-07-28";
const NEWEST_HANDSHAKE: &str = HANDSHAKES[HANDSHAKES.len() - 1];

/// Headers that repeat what is in a message.
const VERSION_HEADER: &str = "mcp-protocol-version";
const METHOD_HEADER: &str = "mcp-method";
const NAME_HEADER: &str = "mcp-name";
/// Keys of a message's metadata.
const VERSION_KEY: &str = "io.modelcontextprotocol/protocolVersion";
const SERVER_KEY: &str = "io.modelcontextprotocol/serverInfo";
/// Time for which a client may keep the list of tools, which changes with the program alone.
const KEPT_MILLIS: u32 = 300_000;

/// Codes of JSON-RPC, and those that the protocol adds.
const PARSE: i32 = -32700;
const INVALID_REQUEST: i32 = -32600;
const UNKNOWN_METHOD: i32 = -32601;
const INVALID_PARAMS: i32 = -32602;
const HEADER_MISMATCH: i32 = -32020;
const UNSUPPORTED_VERSION: i32 = -32022;

/// A message of a client.
#[derive(Debug)]
pub(super) enum ClientMessage {
    Request(ProtocolRequest),
    /// One that is not answered.
    Notification,
}

/// A request.
#[derive(Debug)]
pub(super) struct ProtocolRequest {
    /// A number or a text.
    pub id: Value,
    pub method: String,
    params: Map<String, Value>,
}

/// An error of the protocol. Failures of a tool are results: the agent is to read them.
#[derive(Debug, PartialEq)]
pub(super) struct MethodError {
    code: i32,
    message: String,
    data: Option<Value>,
}

/// The revision of the protocol that a request is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ProtocolRevision {
    Handshake,
    Stateless,
}

impl ClientMessage {
    /// Reads a message.
    ///
    /// # Errors
    /// It is not one of JSON-RPC.
    pub fn parse(body: &[u8]) -> Result<Self, MethodError> {
        let message = serde_json::from_slice(body)
            .map_err(|e| MethodError::new(PARSE, format!("the message is not JSON: {e}; hint: JSON-RPC 2.0")))?;
        let invalid = |what: &str| MethodError::new(INVALID_REQUEST, format!("{what}; hint: one JSON-RPC 2.0 request"));
        let Value::Object(mut message) = message else { return Err(invalid("the message is not an object")) };
        if message.get("jsonrpc").is_none_or(|version| version != "2.0") {
            return Err(invalid("`jsonrpc` is not \"2.0\""));
        }
        let Some(Value::String(method)) = message.remove("method") else {
            return Err(invalid("`method` is not a text"));
        };
        let Some(id) = message.remove("id") else { return Ok(Self::Notification) };
        if !id.is_string() && !id.is_number() {
            return Err(invalid("`id` is neither a text nor a number"));
        }
        let params = match message.remove("params") {
            None => Map::new(),
            Some(Value::Object(params)) => params,
            Some(_) => return Err(invalid("`params` is not an object")),
        };
        Ok(Self::Request(ProtocolRequest { id, method, params }))
    }
}

impl ProtocolRequest {
    /// The revision of the request; its headers must say what it says.
    ///
    /// # Errors
    /// They do not, or the revision is not known.
    pub fn read_revision(&self, headers: &HeaderMap) -> Result<ProtocolRevision, MethodError> {
        let header = |name: &str| headers.get(name).map(|value| String::from_utf8_lossy(value.as_bytes()));
        let of_header = header(VERSION_HEADER);
        let named = self.params.get("_meta").and_then(|meta| meta.get(VERSION_KEY));
        let Some(named) = named else {
            return match of_header {
                Some(version) if !HANDSHAKES.contains(&&*version) => Err(MethodError::unsupported_version(&version)),
                _ => Ok(ProtocolRevision::Handshake),
            };
        };
        let Some(named) = named.as_str() else {
            return Err(MethodError::new(INVALID_PARAMS, format!("`{VERSION_KEY}` is not a text; hint: {STATELESS}")));
        };
        let tool = self.params.get("name").and_then(Value::as_str).filter(|_| self.method == "tools/call");
        let repeated = [(VERSION_HEADER, Some(named)), (METHOD_HEADER, Some(&*self.method)), (NAME_HEADER, tool)];
        for (name, expected) in repeated {
            if let (Some(found), Some(expected)) = (header(name), expected)
                && found != expected
            {
                let message =
                    format!("header `{name}` is `{found}`, the message has `{expected}`; hint: send the same");
                return Err(MethodError::new(HEADER_MISMATCH, message));
            }
        }
        if named == STATELESS { Ok(ProtocolRevision::Stateless) } else { Err(MethodError::unsupported_version(named)) }
    }

    /// The answer to `initialize`.
    pub fn handshake_result(&self, instructions: &str) -> Value {
        let wanted = self.params.get("protocolVersion").and_then(Value::as_str).unwrap_or_default();
        let version = HANDSHAKES.into_iter().find(|known| *known == wanted).unwrap_or(NEWEST_HANDSHAKE);
        json!({
            "protocolVersion": version,
            "capabilities": server_capabilities(),
            "serverInfo": server_info(),
            "instructions": instructions,
        })
    }

    /// The tool that is called, and its arguments.
    ///
    /// # Errors
    /// There is no such tool, or the arguments are not an object.
    pub fn tool_call(&self) -> Result<(AgentTool, Map<String, Value>), MethodError> {
        let name = self.params.get("name").and_then(Value::as_str).unwrap_or_default();
        let tool = AgentTool::ALL.into_iter().find(|tool| tool.name() == name).ok_or_else(|| {
            let known = AgentTool::ALL.map(AgentTool::name).join(", ");
            MethodError::new(INVALID_PARAMS, format!("there is no tool `{name}`; hint: {known}"))
        })?;
        match self.params.get("arguments") {
            None | Some(Value::Null) => Ok((tool, Map::new())),
            Some(Value::Object(arguments)) => Ok((tool, arguments.clone())),
            Some(_) => {
                Err(MethodError::new(INVALID_PARAMS, "`arguments` is not an object; hint: {\"sql\": \"...\"}".into()))
            }
        }
    }
}

impl ProtocolRevision {
    /// Adds to a result what the revision wants in it.
    pub fn complete_result(self, mut result: Value) -> Value {
        if let (Self::Stateless, Some(fields)) = (self, result.as_object_mut()) {
            fields.insert("resultType".to_owned(), "complete".into());
            fields.insert("_meta".to_owned(), json!({ SERVER_KEY: server_info() }));
            if fields.contains_key("tools") || fields.contains_key("supportedVersions") {
                fields.insert("ttlMs".to_owned(), KEPT_MILLIS.into());
                fields.insert("cacheScope".to_owned(), "private".into());
            }
        }
        result
    }

    /// The status of an answer with this error: 200 before it was said which one.
    pub fn error_status(self, error: &MethodError) -> StatusCode {
        match (self, error.code) {
            (Self::Handshake, _) => StatusCode::OK,
            (Self::Stateless, UNKNOWN_METHOD) => StatusCode::NOT_FOUND,
            (Self::Stateless, _) => StatusCode::BAD_REQUEST,
        }
    }
}

impl MethodError {
    fn new(code: i32, message: String) -> Self {
        Self { code, message, data: None }
    }

    fn unsupported_version(requested: &str) -> Self {
        let supported: Vec<_> = HANDSHAKES.into_iter().chain([STATELESS]).collect();
        let message = format!("revision `{requested}` is not supported; hint: {}", supported.join(", "));
        let data = Some(json!({ "supported": supported, "requested": requested }));
        Self { code: UNSUPPORTED_VERSION, message, data }
    }

    /// A method that is not there.
    pub fn unknown_method(method: &str) -> Self {
        let hint = "initialize, ping, tools/list, tools/call, server/discover";
        Self::new(UNKNOWN_METHOD, format!("there is no method `{method}`; hint: {hint}"))
    }

    /// The error as the answer to a request.
    pub fn into_answer(self, id: &Value, status: StatusCode) -> Response {
        let mut error = json!({ "code": self.code, "message": self.message });
        if let Some(data) = self.data {
            error["data"] = data;
        }
        (status, Json(json!({ "jsonrpc": "2.0", "id": id, "error": error }))).into_response()
    }
}

/// The answer to `server/discover`.
pub(super) fn discovery_result(instructions: &str) -> Value {
    json!({
        "supportedVersions": HANDSHAKES.into_iter().chain([STATELESS]).collect::<Vec<_>>(),
        "capabilities": server_capabilities(),
        "instructions": instructions,
    })
}

/// The result of a tool: what it answers, as a value and as text for clients that read no values.
pub(super) fn tool_result(answer: Result<Value, RequestFault>) -> Value {
    match answer {
        Ok(value) => {
            json!({ "content": [text_content(value.to_string())], "structuredContent": value, "isError": false })
        }
        Err(fault) => {
            json!({ "content": [text_content(format!("{}: {fault}", fault.code().name()))], "isError": true })
        }
    }
}

fn text_content(text: String) -> Value {
    json!({ "type": "text", "text": text })
}

fn server_capabilities() -> Value {
    json!({ "tools": {} })
}

fn server_info() -> Value {
    json!({ "name": "echolake", "title": "echolake", "version": env!("CARGO_PKG_VERSION") })
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn request(message: Value) -> ProtocolRequest {
        match ClientMessage::parse(message.to_string().as_bytes()) {
            Ok(ClientMessage::Request(request)) => request,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn messages_that_are_none_are_refused() {
        for (body, code) in [
            ("", PARSE),
            ("{", PARSE),
            ("[]", INVALID_REQUEST),
            ("null", INVALID_REQUEST),
            (r#"{"id":1,"method":"ping"}"#, INVALID_REQUEST),
            (r#"{"jsonrpc":"2.0","id":1}"#, INVALID_REQUEST),
            (r#"{"jsonrpc":"2.0","id":1,"method":7}"#, INVALID_REQUEST),
            (r#"{"jsonrpc":"2.0","id":null,"method":"ping"}"#, INVALID_REQUEST),
            (r#"{"jsonrpc":"2.0","id":1,"method":"ping","params":[]}"#, INVALID_REQUEST),
            (&"[".repeat(100_000), PARSE),
        ] {
            let error = ClientMessage::parse(body.as_bytes()).expect_err("a defect");
            assert_eq!(error.code, code, "{error:?}");
            assert!(error.message.contains("hint: "), "{error:?}");
        }
        let notified = ClientMessage::parse(br#"{"jsonrpc":"2.0","method":"notifications/initialized"}"#);
        assert!(matches!(notified, Ok(ClientMessage::Notification)), "{notified:?}");
    }

    #[test]
    fn a_handshake_has_the_revision_that_is_wanted_or_the_newest() {
        for (wanted, expected) in [("2025-03-26", "2025-03-26"), ("2026-07-28", "2025-11-25"), ("1", "2025-11-25")] {
            let asked = request(json!({
                "jsonrpc": "2.0", "id": 1, "method": "initialize", "params": { "protocolVersion": wanted }
            }));
            assert_eq!(asked.handshake_result("")["protocolVersion"], expected);
        }
    }

    #[test]
    fn a_revision_is_in_the_message_and_the_same_in_its_headers() {
        let check = |version: Option<&str>, headers: &[(&'static str, &'static str)]| {
            let meta = version.map_or(json!({}), |version| json!({ VERSION_KEY: version }));
            let params = json!({ "_meta": meta, "name": "query" });
            let asked = request(json!({ "jsonrpc": "2.0", "id": "a", "method": "tools/call", "params": params }));
            let headers = headers
                .iter()
                .map(|(name, value)| (axum::http::HeaderName::from_static(name), HeaderValue::from_static(value)));
            asked.read_revision(&headers.collect()).map_err(|error| error.code)
        };
        assert_eq!(check(None, &[]), Ok(ProtocolRevision::Handshake));
        assert_eq!(check(None, &[(VERSION_HEADER, "2025-06-18")]), Ok(ProtocolRevision::Handshake));
        assert_eq!(check(None, &[(VERSION_HEADER, "1999-01-01")]), Err(UNSUPPORTED_VERSION));
        assert_eq!(check(Some(STATELESS), &[]), Ok(ProtocolRevision::Stateless));
        let same = [(VERSION_HEADER, STATELESS), (METHOD_HEADER, "tools/call"), (NAME_HEADER, "query")];
        assert_eq!(check(Some(STATELESS), &same), Ok(ProtocolRevision::Stateless));
        assert_eq!(check(Some("2027-01-01"), &[]), Err(UNSUPPORTED_VERSION));
        for other in [(VERSION_HEADER, "2025-06-18"), (METHOD_HEADER, "ping"), (NAME_HEADER, "tables")] {
            assert_eq!(check(Some(STATELESS), &[other]), Err(HEADER_MISMATCH), "{other:?}");
        }
    }

    #[test]
    fn a_call_names_a_tool_and_has_an_object_of_arguments() {
        let call = |params: Value| {
            request(json!({ "jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": params })).tool_call()
        };
        let (tool, arguments) = call(json!({ "name": "query", "arguments": { "sql": "x" } })).expect("a call");
        assert_eq!((tool, &arguments["sql"]), (AgentTool::Query, &json!("x")));
        for wrong in [json!({}), json!({ "name": "drop" }), json!({ "name": "query", "arguments": [] })] {
            let error = call(wrong).expect_err("a defect");
            assert_eq!(error.code, INVALID_PARAMS);
            assert!(error.message.contains("hint: "), "{error:?}");
        }
    }
}
