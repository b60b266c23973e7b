//! The Model Context Protocol (MCP) for agents: `POST /mcp`, a message and its answer, without sessions. The protocol's
//! revisions with a handshake and the one without (2026-07-28) are both answered; `echolake mcp` passes the messages of
//! standard input on to the same route.
//!
//! [`message`] knows the protocol, [`tools`] what can be asked; a file each has the answers.

mod message;
mod query;
mod slice;
mod summary;
mod tables;
mod tools;

use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::routing::post;
use axum::{Json, Router};
use bytes::Bytes;
use serde_json::{Value, json};

use super::catalogue::LakeCatalogue;
use super::manifest::server_origin;
use super::problem::ProblemResponse;
use super::slices::SliceService;
use super::sql;
use message::{ClientMessage, MethodError, ProtocolRequest};
use tools::{AgentTool, ToolCall};

/// The path of messages.
pub const MCP: &str = "/mcp";

/// For an agent that knows nothing of the lake.
const INSTRUCTIONS: &str = "A lake of acoustic measurements: impulse responses between grid points over relief \
    surfaces, and the energy that each surface reflects against a flat plate (TNCE), by band. It can only be read. \
    Begin with list_tables, then describe_table; columns have units and meanings. `tnce_db` has levels with geometry, \
    `catalogue` one row per surface. SQL is DataFusion's with functions of the field (list_functions). Answers of \
    `query` are cut off at a number of rows and bytes and say so, so aggregate in SQL instead of fetching rows. Links \
    lead to pages for people.";

/// The catalogue that tools ask, and its slices.
#[derive(Clone)]
pub(crate) struct AgentService {
    catalogue: LakeCatalogue,
    slices: SliceService,
}

/// The route of agents.
pub(crate) fn agent_routes(catalogue: &LakeCatalogue, slices: &SliceService) -> Router {
    let agents = AgentService { catalogue: catalogue.clone(), slices: slices.clone() };
    Router::new().route(MCP, post(answer_message)).with_state(agents)
}

async fn answer_message(
    State(agents): State<AgentService>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let message = match sql::whole_body(body) {
        Ok(body) => ClientMessage::parse(&body),
        Err(fault) => return ProblemResponse(fault).into_response(),
    };
    let request = match message {
        Ok(ClientMessage::Request(request)) => request,
        // Nothing is kept between messages that a notification could change.
        Ok(ClientMessage::Notification) => return StatusCode::ACCEPTED.into_response(),
        Err(error) => return error.into_answer(&Value::Null, StatusCode::BAD_REQUEST),
    };
    let revision = match request.read_revision(&headers) {
        Ok(revision) => revision,
        Err(error) => return error.into_answer(&request.id, StatusCode::BAD_REQUEST),
    };
    match agents.method_result(&request, &server_origin(&headers)).await {
        Ok(result) => Json(json!({ "jsonrpc": "2.0", "id": request.id, "result": revision.complete_result(result) }))
            .into_response(),
        Err(error) => {
            let status = revision.error_status(&error);
            error.into_answer(&request.id, status)
        }
    }
}

impl AgentService {
    async fn method_result(&self, request: &ProtocolRequest, origin: &str) -> Result<Value, MethodError> {
        match request.method.as_str() {
            "initialize" => Ok(request.handshake_result(INSTRUCTIONS)),
            "server/discover" => Ok(message::discovery_result(INSTRUCTIONS)),
            "ping" => Ok(json!({})),
            "tools/list" => Ok(json!({ "tools": AgentTool::ALL.map(AgentTool::description) })),
            "tools/call" => {
                let (tool, arguments) = request.tool_call()?;
                let call = ToolCall { agents: self, origin };
                Ok(message::tool_result(call.answer_call(tool, arguments).await))
            }
            other => Err(MethodError::unknown_method(other)),
        }
    }
}
