//! The contract: what paths there are and what they answer, for people, generated clients and tests.

use axum::http::header;
use axum::response::IntoResponse;

/// The document, which the pages' types are generated from.
pub(super) const DOCUMENT: &str = include_str!("../../../web/openapi.json");

/// `GET /api/v1/openapi.json`.
pub(super) async fn get() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-cache")], DOCUMENT)
}
