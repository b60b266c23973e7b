//! The paths of the server: what the door answers itself, and what it forwards to an engine.

use axum::Router;
use axum::middleware::from_fn_with_state;
use axum::routing::any;
use echolake_http::{MCP, VIEWER_PATHS, cors_layer, layout, own_pages_only, with_refusals};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

#[cfg(feature = "web")]
use super::pages;
use super::{contributions, health, openapi, queries, session};
use crate::door::server_door::ServerDoor;

/// The paths of the server: those of the door, and those that it forwards to an engine.
pub(super) fn door_router(door: &ServerDoor) -> Router {
    let own = Router::from(door_routes()).layer(from_fn_with_state(door.access().is_open(), own_pages_only));
    // Here and not for all routes: a preflight must come to the layer.
    let viewers =
        VIEWER_PATHS.into_iter().fold(Router::new(), |router, path| router.route(path, any(ServerDoor::forward_http)));
    let forwarded = ["/api/{*path}", MCP]
        .into_iter()
        .fold(Router::new(), |router, path| router.route(path, any(ServerDoor::forward_http)));
    let forwarded = forwarded.merge(viewers.layer(cors_layer()));
    #[cfg(feature = "web")]
    let rest = pages::serve_page;
    #[cfg(not(feature = "web"))]
    let rest = echolake_http::refuse_unknown_path;
    let all =
        own.merge(forwarded).with_state(door.clone()).merge(layout::for_viewers(door.layout().clone())).fallback(rest);
    let all = with_refusals(all.layer(from_fn_with_state(door.clone(), health::refuse_while_draining)));
    all.layer(from_fn_with_state(door.clone(), ServerDoor::name_request))
}

/// What the door answers itself, but for pages and the layout.
pub(super) fn door_routes() -> OpenApiRouter<ServerDoor> {
    OpenApiRouter::new()
        .routes(routes!(session::post_session))
        .routes(routes!(queries::post_cancellation))
        .routes(routes!(contributions::post_annotations))
        .routes(routes!(contributions::post_predictions))
        .routes(routes!(openapi::get_openapi))
        .routes(routes!(health::metrics))
        .routes(routes!(health::health))
        .routes(routes!(health::ready))
}
