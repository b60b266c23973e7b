//! HTTP of an engine, which reads the lake: queries, the catalogue, files and slices. Of what it has for the door, a
//! server builds the rest.

mod catalogue;
mod conditions;
mod contributions;
mod extract;
mod files;
mod format;
mod guard;
pub mod layout;
mod manifest;
mod mcp;
mod problem;
mod ranges;
mod request_protocol;
mod slices;
mod sql;

use std::convert::Infallible;

use axum::Router;
use axum::middleware::{from_fn, from_fn_with_state, map_response};
use axum::response::Response;
use echolake_service::request_span::trace_request;
use echolake_service::{Error, QueryService, RequestFault, ServerProtocol};
use http_body_util::BodyExt as _;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::TokioIo;
use hyper_util::service::TowerToHyperService;
use tokio::net::UnixListener;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::openapi::OpenApi;

pub use catalogue::LASTING_VERSION;
use catalogue::LakeCatalogue;
pub use conditions::ConditionOutcome;
pub use contributions::{AddedContribution, AnnotationsRequest, PredictionParams};
pub use extract::BinaryContent;
pub use format::{accepts_encoding, prefers_arrow};
pub use guard::{FORWARDED_PROTO, RequestSite, is_encrypted, is_same_origin, own_pages_only, request_site};
pub use mcp::MCP;
pub use problem::{ProblemBody, ProblemResponse};
pub use ranges::cors_layer;
pub use slices::SLICED_RUNS;
use slices::{FOXGLOVE_MANIFEST, LICHTBLICK_SESSION, SLICE, SOFA, SliceService};

/// Paths that viewers on pages of any origin use.
pub const VIEWER_PATHS: [&str; 5] = [files::RUN, SLICE, SOFA, FOXGLOVE_MANIFEST, LICHTBLICK_SESSION];

/// Answers HTTP on an engine's socket. A request counts until its answer is sent or dropped.
pub async fn serve_http_socket(service: QueryService, listener: UnixListener) -> Result<(), Error> {
    let router = engine_router(&service);
    loop {
        let (stream, _) = listener.accept().await.map_err(Error::System)?;
        let router = TowerToHyperService::new(router.clone());
        let activity = service.activity().clone();
        let answers = service_fn(move |request| {
            let guard = activity.begin_work();
            let answer = router.call(request);
            async move {
                let answer: Response = answer.await?;
                Ok::<_, Infallible>(answer.map(|body| {
                    body.map_frame(move |frame| {
                        let _guard = &guard;
                        frame
                    })
                }))
            }
        });
        tokio::spawn(async move {
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
        .merge(contributions::draft_routes(&catalogue))
        .merge(Router::from(files).with_state(catalogue.clone()))
        .merge(with_protocol(ServerProtocol::Mcp, mcp::agent_routes(&catalogue, &slices)))
        .layer(from_fn_with_state(service.is_open(), guard::own_pages_only));
    let viewers = Router::from(files::viewer_routes()).with_state(catalogue.clone());
    let all = own.merge(viewers).merge(slices::for_viewers(slices)).fallback(refuse_unknown_path);
    with_refusals(all).layer(from_fn(trace_request))
}

fn with_protocol(protocol: ServerProtocol, routes: Router) -> Router {
    routes.layer(from_fn_with_state(protocol, request_protocol::set_protocol))
}

/// The contract of an engine's routes and of the layout's: of those whose answers to GET have an ETag, and of the
/// others.
pub fn contract_parts() -> [OpenApi; 2] {
    let files = files::viewer_routes().merge(files::own_routes()).merge(manifest::manifest_routes());
    let catalogue = catalogue::light_routes()
        .merge(catalogue::contribution_routes())
        .merge(catalogue::heavy_routes())
        .merge(catalogue::file_routes());
    let mut validated = catalogue.into_openapi();
    validated.merge(layout::layout_routes().into_openapi());
    validated.merge(files.into_openapi());
    let mut others = sql::sql_routes().into_openapi();
    others.merge(slices::slice_routes().into_openapi());
    [validated, others]
}

/// Refuses other methods, turns panics into failures, and adds the headers that every answer has.
pub fn with_refusals(router: Router) -> Router {
    router
        .method_not_allowed_fallback(problem::refuse_method)
        .layer(CatchPanicLayer::custom(|_| ProblemResponse(RequestFault::Internal).to_response()))
        .layer(map_response(guard::security_headers))
}

/// Answers a path that does not exist.
pub async fn refuse_unknown_path() -> ProblemResponse {
    ProblemResponse(RequestFault::NotFound {
        what: "this path".to_owned(),
        hint: "GET /api/v1/openapi.json lists what there is",
    })
}
