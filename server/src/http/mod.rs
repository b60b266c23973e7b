//! HTTP: queries, the catalogue, the lake's files, the pages, health and figures.

mod catalogue;
mod connections;
mod files;
mod format;
mod guard;
mod health;
mod layout;
mod manifest;
mod openapi;
#[cfg(feature = "web")]
mod pages;
mod problem;
mod ranges;
mod session;
mod slices;
mod sql;

use axum::Router;
use axum::middleware::from_fn_with_state;
use axum::routing::{get, post};
use tokio::net::TcpListener;
use tower_http::catch_panic::CatchPanicLayer;

use crate::Error;
use crate::fault::Fault;
use crate::service::Service;
use catalogue::Catalogue;
use problem::Problem;

/// Answers HTTP until `stop`.
pub(crate) async fn serve(
    service: Service,
    listener: TcpListener,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    connections::serve(listener, router(service), stop).await;
    Ok(())
}

fn router(service: Service) -> Router {
    let catalogue = Catalogue::new(service.clone());
    let own = Router::new()
        .route("/api/v1/sql", post(sql::post))
        .route("/api/v1/session", post(session::post))
        .route("/api/v1/openapi.json", get(openapi::get))
        .route("/metrics", get(health::metrics))
        .route("/health", get(health::health))
        .with_state(service.clone())
        .merge(catalogue.router())
        .merge(files::for_own(&catalogue))
        .merge(manifest::for_own(&catalogue))
        .layer(from_fn_with_state(service, guard::own_pages_only));
    #[cfg(feature = "web")]
    let rest = pages::fallback;
    #[cfg(not(feature = "web"))]
    let rest = nothing;
    Router::new()
        .merge(own)
        .merge(files::for_viewers(&catalogue))
        .merge(slices::for_viewers(&catalogue))
        .merge(layout::for_viewers())
        .fallback(rest)
        .method_not_allowed_fallback(wrong_method)
        .layer(CatchPanicLayer::custom(|_| Problem(Fault::Internal).answer()))
        .layer(axum::middleware::map_response(guard::security_headers))
}

async fn nothing() -> Problem {
    Problem(Fault::NotFound { what: "this path".to_owned(), hint: "GET /api/v1/openapi.json lists what there is" })
}

async fn wrong_method() -> Problem {
    Problem(Fault::Method)
}
