//! `POST /api/v1/session`: a token becomes a cookie, because pictures and downloads of a page can send no header.

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use echolake_access::LIFETIME;
use echolake_http::{ProblemResponse, is_encrypted};
use echolake_service::RequestFault;
use serde::Deserialize;
use utoipa::ToSchema;

use super::authentication::COOKIE;
use crate::door::body_reader::read_whole_body;
use crate::door::server_door::ServerDoor;

/// Bytes of a request.
const LARGEST: usize = 4 << 10;

/// A token.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = Session)]
struct SessionRequest {
    token: String,
}

/// Takes a token and answers with a cookie (HttpOnly, SameSite=Strict) that stands for it.
///
/// Pictures and downloads of a page can send no Authorization header. Only if the server has tokens.
#[utoipa::path(
    post,
    path = "/api/v1/session",
    operation_id = "session",
    tag = "operation",
    request_body = SessionRequest,
    responses((status = 204, description = "The cookie is set"))
)]
pub(super) async fn post_session(
    State(door): State<ServerDoor>,
    headers: HeaderMap,
    body: Body,
) -> Result<impl IntoResponse, ProblemResponse> {
    let body = read_whole_body(body, &headers, LARGEST).await?;
    let SessionRequest { token } = serde_json::from_slice(&body)
        .map_err(|_| RequestFault::bad_request("the body is not as expected; hint: {\"token\": \"echolake_...\"}"))?;
    let secret = door.access().begin_session(&token).inspect_err(|f| door.metrics().count_failure(f.code()))?;
    // Behind TLS, this server's or a proxy's, the cookie never leaves it.
    let secure = if is_encrypted(&headers) { "; Secure" } else { "" };
    let cookie =
        format!("{COOKIE}={secret}; HttpOnly; SameSite=Strict; Path=/; Max-Age={}{secure}", LIFETIME.as_secs());
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]))
}
