//! `GET /health` and `GET /metrics`, for operators of the server.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::IntoResponse;
use serde_json::{Value, json};

use super::guard::authenticate;
use super::problem::ProblemResponse;
use crate::client_identity::ClientIdentity;
use crate::door::ServerDoor;
use crate::tokens::TokenScope;

/// Answers that the server is up, with its version.
pub(super) async fn health() -> Json<Value> {
    Json(json!({ "status": "ok", "version": env!("CARGO_PKG_VERSION") }))
}

/// The figures, in Prometheus' text format.
pub(super) async fn metrics(
    State(door): State<ServerDoor>,
    headers: HeaderMap,
) -> Result<impl IntoResponse, ProblemResponse> {
    let client = authenticate(door.access(), &headers, ClientIdentity::pages);
    client.and_then(|client| client.require(TokenScope::Metrics)).inspect_err(|f| door.metrics().failed(f.code()))?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], door.figures()))
}
