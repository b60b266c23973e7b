//! HTTP of the engines, which read the lake: queries, the catalogue, files and slices. Of what it has for the door, a
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
use std::sync::Arc;

use axum::Router;
use axum::http::Method;
use axum::middleware::{from_fn, from_fn_with_state, map_response};
use axum::response::{IntoResponse as _, Response};
use echolake_schema::ProjectName;
use echolake_service::request_span::{self, trace_request};
use echolake_service::{
    EngineRole, EngineServices, Error, QueryService, RequestFault, ServerProtocol, answer_numbered,
};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::TokioIo;
use hyper_util::service::TowerToHyperService;
use quick_cache::sync::Cache;
use tokio::net::UnixListener;
use tokio::sync::Semaphore;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::openapi::OpenApi;

pub use catalogue::LASTING_VERSION;
use catalogue::{LakeCatalogue, SnapshotViews};
pub use conditions::ConditionOutcome;
pub use contributions::{AddedContribution, AnnotationsRequest, PredictionParams};
pub use extract::BinaryContent;
pub use format::{accepts_encoding, prefers_arrow};
pub use guard::{FORWARDED_PROTO, RequestSite, is_encrypted, is_same_origin, own_pages_only, request_site};
pub use mcp::MCP;
pub use problem::{ProblemBody, ProblemResponse};
pub use ranges::cors_layer;
pub use slices::SLICED_RUNS;
use slices::{FOXGLOVE_MANIFEST, LICHTBLICK_SESSION, SLICE, SOFA, SliceRoom, SliceService};

/// Paths that viewers on pages of any origin use.
pub const VIEWER_PATHS: [&str; 5] = [files::RUN, SLICE, SOFA, FOXGLOVE_MANIFEST, LICHTBLICK_SESSION];

/// The lake as readers with each right see it, with what was computed of it.
type RightViews = Cache<Option<Vec<ProjectName>>, Arc<SnapshotViews>>;

/// Rights of which views are kept.
const KEPT_RIGHTS: usize = 16;

/// HTTP of an engine that all clients share.
#[derive(Clone)]
struct HttpEngine(Arc<HttpEngineState>);

struct HttpEngineState {
    services: EngineServices,
    /// What it answers; None for all.
    role: Option<EngineRole>,
    views: RightViews,
    /// Places of heavy endpoints, one per core: light ones never wait for all the heavy ones that are requested.
    heavy_places: Arc<Semaphore>,
    slices: SliceRoom,
}

/// Answers HTTP on the socket of an engine with this role; None for both.
///
/// # Errors
/// [`Error::System`] if the socket accepts no connection.
pub async fn serve_http_socket(
    services: EngineServices,
    role: Option<EngineRole>,
    listener: UnixListener,
) -> Result<(), Error> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let heavy_places = Arc::new(Semaphore::new(cores));
    let engine = HttpEngine(Arc::new(HttpEngineState {
        services,
        role,
        views: Cache::new(KEPT_RIGHTS),
        heavy_places,
        slices: SliceRoom::default(),
    }));
    loop {
        let (stream, _) = listener.accept().await.map_err(Error::System)?;
        let engine = engine.clone();
        let answers = service_fn(move |request: hyper::Request<Incoming>| {
            let engine = engine.clone();
            async move { Ok::<_, Infallible>(engine.answer_request(request).await) }
        });
        tokio::spawn(async move {
            // A connection that breaks off is the door's matter.
            let _ = http1::Builder::new().serve_connection(TokioIo::new(stream), answers).await;
        });
    }
}

impl HttpEngine {
    // Answers a request of the client that the door has named, by routes that are that client's alone.
    async fn answer_request(&self, request: hyper::Request<Incoming>) -> Response {
        let router = self.0.services.client_of_request(request.headers()).and_then(|client| {
            // Which engine answers what is decided by one function; the door asks it, too.
            let role = engine_role(request.method(), request.uri().path());
            match self.0.role.is_none_or(|own| own == role) {
                true => client.protocol_state(|service| Ok(self.client_router(service))),
                false => Err(RequestFault::Internal),
            }
        });
        let number = request_span::request_number(request.headers());
        match router {
            // A router's own failures are answers.
            Ok(router) => {
                let answer = TowerToHyperService::new(Router::clone(&router)).call(request);
                answer_numbered(number, answer).await.unwrap_or_else(|never| match never {})
            }
            Err(fault) => ProblemResponse(fault).into_response(),
        }
    }

    fn client_router(&self, service: &QueryService) -> Router {
        let right = service.lake().visible_projects().map(|projects| projects.iter().cloned().collect());
        // Never fails to make them.
        let views = self.0.views.get_or_insert_with(&right, || Ok::<_, Infallible>(Arc::default()));
        let views = views.unwrap_or_else(|never| match never {});
        engine_router(&LakeCatalogue::new(service.clone(), views), &self.0)
    }
}

fn engine_router(catalogue: &LakeCatalogue, shared: &HttpEngineState) -> Router {
    let service = catalogue.service();
    let slices = SliceService::new(catalogue, &shared.slices);
    let files = files::own_routes().merge(manifest::manifest_routes());
    let own = Router::from(sql::sql_routes())
        .with_state(service.clone())
        .merge(catalogue.endpoint_router(&shared.heavy_places))
        .merge(contributions::draft_routes(catalogue))
        .merge(Router::from(files).with_state(catalogue.clone()))
        .merge(with_protocol(ServerProtocol::Mcp, mcp::agent_routes(catalogue, &slices)))
        .layer(from_fn_with_state(service.is_open(), guard::own_pages_only));
    let viewers = Router::from(files::viewer_routes()).with_state(catalogue.clone());
    let all = own.merge(viewers).merge(slices::for_viewers(slices)).fallback(refuse_unknown_path);
    with_refusals(all).layer(from_fn(trace_request))
}

/// Returns the engine that answers a request, by its method and path alone.
///
/// Statements and predicates from outside, bodies, and what decodes run files or uploads go to the engine of
/// statements. The engine of pages answers the rest: the program's own statements with bound values, and files as they
/// are.
pub fn engine_role(method: &Method, path: &str) -> EngineRole {
    let reads = matches!(*method, Method::GET | Method::HEAD);
    let is_slice = [SLICE, SOFA, FOXGLOVE_MANIFEST, LICHTBLICK_SESSION].contains(&path);
    match reads && !is_slice && !catalogue::reads_run_file(path) {
        true => EngineRole::Pages,
        false => EngineRole::Statements,
    }
}

/// Returns whether the answer to a request, by its method and path alone, may be given to others with the same rights.
///
/// That is what the engine of pages answers, and the description of a run. Others are large, or statements.
pub fn is_shared_answer(method: &Method, path: &str) -> bool {
    engine_role(method, path) == EngineRole::Pages
        || (*method == Method::GET && catalogue::described_run(path).is_some())
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
