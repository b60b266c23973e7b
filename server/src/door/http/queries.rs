//! `POST /api/v1/queries/ID/cancel`: ends a query that `system.queries` lists.

use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use echolake_http::ProblemResponse;
use echolake_service::{ClientIdentity, RequestFault};

use super::authentication::authenticate_client;
use crate::door::server_door::ServerDoor;

/// Cancels a query of the client's own; of any client, with a token for metrics.
///
/// `id` is that of `system.queries`. Queries over all protocols can be cancelled.
#[utoipa::path(
    post,
    path = "/api/v1/queries/{id}/cancel",
    operation_id = "cancel_query",
    tag = "operation",
    params(("id" = u64, Path, description = "Number of the query")),
    responses((status = 202, description = "It is being ended"))
)]
pub(super) async fn post_cancellation(
    State(door): State<ServerDoor>,
    id: Result<Path<u64>, PathRejection>,
    headers: HeaderMap,
) -> Result<StatusCode, ProblemResponse> {
    let done = cancel_query(&door, id, &headers).await;
    done.inspect_err(|fault| door.metrics().record_failure(fault))?;
    Ok(StatusCode::ACCEPTED)
}

async fn cancel_query(
    door: &ServerDoor,
    id: Result<Path<u64>, PathRejection>,
    headers: &HeaderMap,
) -> Result<(), RequestFault> {
    let client = authenticate_client(door.access(), headers, ClientIdentity::local_programs)?;
    let Path(id) =
        id.map_err(|_| RequestFault::bad_request("a query has a number; hint: select id from system.queries"))?;
    door.cancel_query(&client, id).await
}
