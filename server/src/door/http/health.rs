//! `GET /health`, `GET /ready` and `GET /metrics`, for operators of the server; answered while it drains, too.

use axum::Json;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use echolake_http::ProblemResponse;
use echolake_service::{ClientIdentity, FaultCode, RequestFault, TokenScope};
use serde::Serialize;
use utoipa::ToSchema;

use super::authentication::authenticate_client;
use crate::door::server_door::ServerDoor;

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

/// Answers whether the server takes requests, for balancers.
///
/// 503 while it stops, while the lake cannot be read, and while no engine can be started.
#[utoipa::path(
    get,
    path = "/ready",
    tag = "operation",
    responses((status = 200, description = "It takes requests", body = ServerHealth))
)]
pub(super) async fn ready(State(door): State<ServerDoor>) -> Result<Json<ServerHealth>, ProblemResponse> {
    door.check_ready().await?;
    Ok(Json(ServerHealth { status: "ready", version: env!("CARGO_PKG_VERSION") }))
}

/// Refuses requests while the server drains, but for those of operators.
pub(super) async fn refuse_while_draining(State(door): State<ServerDoor>, request: Request, next: Next) -> Response {
    let is_operators = matches!(request.uri().path(), "/health" | "/ready" | "/metrics");
    if door.drain().is_begun() && !is_operators {
        door.metrics().count_failure(FaultCode::Stopping);
        return ProblemResponse(RequestFault::Draining).into_response();
    }
    next.run(request).await
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
    let client = authenticate_client(door.access(), &headers, ClientIdentity::own_pages);
    client
        .and_then(|client| client.require_scope(TokenScope::Metrics))
        .inspect_err(|f| door.metrics().count_failure(f.code()))?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], door.gather_figures().await?))
}
