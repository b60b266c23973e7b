//! `GET /health` and `GET /metrics`, for operators of the server.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::IntoResponse;
use serde::Serialize;
use utoipa::ToSchema;

use super::guard::authenticate;
use super::problem::ProblemResponse;
use crate::client_identity::ClientIdentity;
use crate::door::server_door::ServerDoor;
use crate::tokens::TokenScope;

/// The state of the server.
#[derive(Serialize, ToSchema)]
pub(super) struct ServerHealth {
    status: &'static str,
    version: &'static str,
}

/// Answers that the server is up, with its version.
#[utoipa::path(
    get,
    path = "/health",
    tag = "operation",
    responses((status = 200, description = "It is up", body = ServerHealth))
)]
pub(super) async fn health() -> Json<ServerHealth> {
    Json(ServerHealth { status: "ok", version: env!("CARGO_PKG_VERSION") })
}

/// The figures, in Prometheus' text format.
#[utoipa::path(
    get,
    path = "/metrics",
    tag = "operation",
    responses((status = 200, description = "OK", body = String, content_type = "text/plain"))
)]
pub(super) async fn metrics(
    State(door): State<ServerDoor>,
    headers: HeaderMap,
) -> Result<impl IntoResponse, ProblemResponse> {
    let client = authenticate(door.access(), &headers, ClientIdentity::pages);
    client.and_then(|client| client.require(TokenScope::Metrics)).inspect_err(|f| door.metrics().failed(f.code()))?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], door.figures()))
}
