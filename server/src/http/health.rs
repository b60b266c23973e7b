//! `GET /health` and `GET /metrics`, for operators of the server.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::IntoResponse;
use serde_json::{Value, json};

use super::guard::authenticate;
use super::problem::Problem;
use crate::client_identity::ClientIdentity;
use crate::door::Door;
use crate::tokens::Scope;

/// That it answers.
pub(super) async fn health() -> Json<Value> {
    Json(json!({ "status": "ok", "version": env!("CARGO_PKG_VERSION") }))
}

/// The figures, in Prometheus' text format.
pub(super) async fn metrics(State(door): State<Door>, headers: HeaderMap) -> Result<impl IntoResponse, Problem> {
    let client = authenticate(door.access(), &headers, ClientIdentity::pages);
    client.and_then(|client| client.require(Scope::Metrics)).inspect_err(|f| door.metrics().failed(f.code()))?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], door.figures()))
}
