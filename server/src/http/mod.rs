//! HTTP: queries, the tables, health and figures. What else is served over HTTP is added to this one table.

mod format;
mod guard;
mod health;
mod problem;
mod sql;
mod tables;

use axum::Router;
use axum::middleware::from_fn_with_state;
use axum::routing::{get, post};
use tokio::net::TcpListener;
use tower_http::catch_panic::CatchPanicLayer;

use crate::Error;
use crate::fault::Fault;
use crate::service::Service;
use problem::Problem;

/// Answers HTTP until `stop`.
pub(crate) async fn serve(
    service: Service,
    listener: TcpListener,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    axum::serve(listener, router(service)).with_graceful_shutdown(stop).await.map_err(Error::System)
}

fn router(service: Service) -> Router {
    let asked = Router::new()
        .route("/api/v1/sql", post(sql::post))
        .route("/api/v1/tables", get(tables::get))
        .route("/metrics", get(health::metrics));
    Router::new()
        .merge(asked)
        .route("/health", get(health::health))
        .fallback(nothing)
        .method_not_allowed_fallback(wrong_method)
        .layer(from_fn_with_state(service.clone(), guard::own_pages_only))
        .layer(CatchPanicLayer::custom(|_| Problem(Fault::Internal).answer()))
        .layer(axum::middleware::map_response(guard::security_headers))
        .with_state(service)
}

async fn nothing() -> Problem {
    Problem(Fault::NotFound { what: "this path".to_owned(), hint: "POST /api/v1/sql, GET /api/v1/tables, GET /health" })
}

async fn wrong_method() -> Problem {
    Problem(Fault::request("this path is not for this method; hint: POST /api/v1/sql, GET for all others"))
}
