//! `GET /health` and `GET /metrics`: for those who look after the server.

use axum::Json;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use serde_json::{Value, json};

use super::guard::MaySeeMetrics;
use crate::service::Service;

/// That it answers.
pub(super) async fn health() -> Json<Value> {
    Json(json!({ "status": "ok", "version": env!("CARGO_PKG_VERSION") }))
}

/// The figures, in Prometheus' text format.
pub(super) async fn metrics(State(service): State<Service>, _: MaySeeMetrics) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], service.metrics().text())
}
