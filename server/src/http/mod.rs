//! HTTP. An engine answers what reads the lake ([`serve_http_socket`]): queries, the catalogue, files and slices. The door answers the
//! rest ([`door_router`]): pages, sessions, health and figures.

mod catalogue;
mod conditions;
mod extract;
mod files;
mod format;
mod guard;
mod health;
mod layout;
mod manifest;
mod mcp;
mod openapi;
#[cfg(feature = "web")]
mod pages;
mod problem;
mod queries;
mod ranges;
mod request_protocol;
mod session;
mod slices;
mod sql;

use axum::Router;
use axum::middleware::{from_fn, from_fn_with_state, map_response};
use axum::routing::any;
use hyper::server::conn::http1;
use hyper_util::rt::TokioIo;
use hyper_util::service::TowerToHyperService;
use tokio::net::UnixListener;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::openapi::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::Error;
use crate::door::server_door::ServerDoor;
use crate::fault::RequestFault;
use crate::metrics::ServerProtocol;
use crate::request_span::trace_request;
use crate::service::QueryService;
use catalogue::LakeCatalogue;
pub(crate) use guard::{FORWARDED_PROTO, RequestSite, authenticate_client, request_site};
pub(crate) use layout::ViewerLayout;
pub(crate) use mcp::MCP;
pub(crate) use problem::ProblemResponse;
pub(crate) use request_protocol::request_protocol;
pub(crate) use slices::SLICED_RUNS;
use slices::SliceService;

/// Answers HTTP on an engine's socket; a connection is one request.
pub(crate) async fn serve_http_socket(service: QueryService, listener: UnixListener) -> Result<(), Error> {
    let router = engine_router(&service);
    loop {
        let (stream, _) = listener.accept().await.map_err(Error::System)?;
        let answers = TowerToHyperService::new(router.clone());
        let guard = service.activity().begin_work();
        tokio::spawn(async move {
            let _guard = guard;
            // A connection that breaks off is the door's matter.
            let _ = http1::Builder::new().serve_connection(TokioIo::new(stream), answers).await;
        });
    }
}

fn engine_router(service: &QueryService) -> Router {
    let catalogue = LakeCatalogue::new(service.clone());
    let slices = SliceService::new(&catalogue);
    let files = files::own_routes().merge(manifest::manifest_routes());
    let own = Router::from(sql::sql_routes())
        .with_state(service.clone())
        .merge(catalogue.endpoint_router())
        .merge(Router::from(files).with_state(catalogue.clone()))
        .merge(of_protocol(ServerProtocol::Mcp, mcp::agent_routes(&catalogue, &slices)))
        .layer(from_fn_with_state(service.is_open(), guard::own_pages_only));
    let viewers = Router::from(files::viewer_routes()).with_state(catalogue.clone());
    let all = own.merge(viewers).merge(slices::for_viewers(slices)).fallback(refuse_unknown_path);
    with_refusals(all).layer(from_fn(trace_request))
}

fn of_protocol(protocol: ServerProtocol, routes: Router) -> Router {
    routes.layer(from_fn_with_state(protocol, request_protocol::set_protocol))
}

/// The paths of the server: those of the door, and those that it forwards to the client's engine.
pub(crate) fn door_router(door: &ServerDoor) -> Router {
    let own = Router::from(door_routes()).layer(from_fn_with_state(door.access().is_open(), guard::own_pages_only));
    let viewers = [files::RUN, slices::SLICE, slices::SOFA, slices::FOXGLOVE_MANIFEST, slices::LICHTBLICK_SESSION];
    // Here and not for all routes: a preflight must come to the layer.
    let viewers =
        viewers.into_iter().fold(Router::new(), |router, path| router.route(path, any(ServerDoor::forward_http)));
    let forwarded = ["/api/{*path}", MCP]
        .into_iter()
        .fold(Router::new(), |router, path| router.route(path, any(ServerDoor::forward_http)));
    let forwarded = forwarded.merge(viewers.layer(ranges::cors_layer()));
    #[cfg(feature = "web")]
    let rest = pages::serve_page;
    #[cfg(not(feature = "web"))]
    let rest = refuse_unknown_path;
    let all =
        own.merge(forwarded).with_state(door.clone()).merge(layout::for_viewers(door.layout().clone())).fallback(rest);
    let all = with_refusals(all.layer(from_fn_with_state(door.clone(), health::refuse_while_draining)));
    all.layer(from_fn_with_state(door.clone(), ServerDoor::name_request))
}

// What the door answers itself, but for pages and the layout.
fn door_routes() -> OpenApiRouter<ServerDoor> {
    OpenApiRouter::new()
        .routes(routes!(session::post_session))
        .routes(routes!(queries::post_cancellation))
        .routes(routes!(openapi::get_openapi))
        .routes(routes!(health::metrics))
        .routes(routes!(health::health))
        .routes(routes!(health::ready))
}

// The contract of all routes: of those whose answers to GET have an ETag, and of the others.
fn contract_parts() -> [OpenApi; 2] {
    let files = files::viewer_routes().merge(files::own_routes()).merge(manifest::manifest_routes());
    let mut validated = catalogue::table_routes().merge(catalogue::file_routes()).into_openapi();
    validated.merge(layout::layout_routes().into_openapi());
    validated.merge(files.into_openapi());
    let mut others = sql::sql_routes().into_openapi();
    others.merge(slices::slice_routes().into_openapi());
    others.merge(door_routes().into_openapi());
    [validated, others]
}

fn with_refusals(router: Router) -> Router {
    router
        .method_not_allowed_fallback(problem::refuse_method)
        .layer(CatchPanicLayer::custom(|_| ProblemResponse(RequestFault::Internal).to_response()))
        .layer(map_response(guard::security_headers))
}

async fn refuse_unknown_path() -> ProblemResponse {
    ProblemResponse(RequestFault::NotFound {
        what: "this path".to_owned(),
        hint: "GET /api/v1/openapi.json lists what there is",
    })
}
