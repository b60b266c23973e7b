//! Who asks over HTTP: the holder of a token or of a browser's session.

use std::sync::Arc;

use axum::http::{HeaderMap, header};
use echolake_access::TokenAccess;
use echolake_http::is_same_origin;
use echolake_service::authorization::of_header;
use echolake_service::{ClientIdentity, RequestFault};

/// The cookie of a browser's session.
pub(super) const COOKIE: &str = "echolake";

/// Authenticates a client by token or by session; `local` makes the client of a server that has no tokens.
///
/// # Errors
/// [`RequestFault::Unauthenticated`], [`RequestFault::Foreign`].
pub(super) fn authenticate_client(
    access: &TokenAccess,
    headers: &HeaderMap,
    local: impl Fn() -> ClientIdentity,
) -> Result<Arc<ClientIdentity>, RequestFault> {
    let token = headers.get(header::AUTHORIZATION).and_then(|v| v.to_str().ok()).and_then(of_header);
    if token.is_some() || access.is_open() {
        return access.client_of_token(token.as_deref(), local);
    }
    let client = access.client_of_session(session_cookie(headers).ok_or(RequestFault::Unauthenticated)?, &local)?;
    // A browser sends cookies along whichever page asks.
    is_same_origin(headers)?;
    Ok(client)
}

fn session_cookie(headers: &HeaderMap) -> Option<&str> {
    let all = headers.get_all(header::COOKIE).iter().filter_map(|v| v.to_str().ok());
    all.flat_map(|v| v.split(';')).find_map(|pair| pair.trim().strip_prefix(COOKIE)?.strip_prefix('='))
}
