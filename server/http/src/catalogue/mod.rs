//! The catalogue: the data of the pages, each a query of the lake.
//!
//! [`light_routes`], [`heavy_routes`] and [`file_routes`] list the endpoints. [`answer_validated`] stands before all of
//! them: whether the client may ask, and whether it has the answer already.

mod analysis;
mod content;
mod contributed;
mod correlations;
mod curves;
mod diffusion;
mod environment;
mod facets;
mod figures;
mod lake;
mod map;
mod materials;
mod measured_pairs;
mod neighbours;
mod packing;
mod pair;
mod pair_rows;
mod relief;
mod request;
mod rows;
mod runs;
mod snapshot;
mod surface;
mod tables;
mod wav;

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::Response;
use axum::{Extension, Router};
use echolake_lake::Lake;
use echolake_schema::tables::Table;
use echolake_service::{FaultCode, QueryService, RequestFault, TokenScope};
use serde_json::Value;
use tokio::sync::Semaphore;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::conditions::{ConditionOutcome, is_named};
use super::extract::PathParams;
use super::format;
use super::problem::ProblemResponse;
use request::SurfacePath;
pub(super) use request::{CatalogueRequest, RunPath, find_run, text_value};
pub(super) use snapshot::view::AnswerContents;
pub(super) use snapshot::view::SnapshotViews;
pub(super) use snapshot::view::{SnapshotView, VisibleFile};
pub(super) use tables::{ColumnDescription, find_table};

/// The version of the lake for as long as which an answer is right, for the door, which may give it again until then.
pub const LASTING_VERSION: HeaderName = HeaderName::from_static("echolake-lasting-version");

/// The endpoints that are answered from tables by few queries.
pub(super) fn light_routes() -> OpenApiRouter {
    OpenApiRouter::new()
        .routes(routes!(facets::surfaces))
        .routes(routes!(surface::surface))
        .routes(routes!(surface::grid))
        .routes(routes!(curves::curves))
        .routes(routes!(relief::heightmap))
        .routes(routes!(relief::thumbnail))
        .routes(routes!(measured_pairs::measured_pairs))
        .routes(routes!(wav::wav))
        .routes(routes!(runs::runs))
        .routes(routes!(runs::run))
        .routes(routes!(environment::environment))
}

/// The endpoints that are answered from tables, those of users among them.
pub(super) fn contribution_routes() -> OpenApiRouter {
    OpenApiRouter::new()
        .routes(routes!(lake::lake))
        .routes(routes!(contributed::run_annotations))
        .routes(routes!(contributed::pair_predictions))
        .routes(routes!(contributed::surface_predictions))
        .routes(routes!(tables::tables))
        .routes(routes!(tables::table_files))
}

/// The endpoints that are answered from tables by many queries or long computations.
pub(super) fn heavy_routes() -> OpenApiRouter {
    OpenApiRouter::new()
        .routes(routes!(figures::grid_figure))
        .routes(routes!(figures::curves_figure))
        .routes(routes!(figures::levels_figure))
        .routes(routes!(figures::map_figure))
        .routes(routes!(pair::pair))
        .routes(routes!(analysis::analysis))
        .routes(routes!(analysis::spectrogram))
        .routes(routes!(map::map))
        .routes(routes!(neighbours::nearest_surfaces))
        .routes(routes!(neighbours::nearest_responses))
        .routes(routes!(correlations::correlations))
        .routes(routes!(diffusion::diffusion))
        .routes(routes!(materials::materials))
}

/// The endpoints that are answered from run files.
pub(super) fn file_routes() -> OpenApiRouter {
    OpenApiRouter::new().routes(routes!(relief::mesh))
}

/// Returns whether the endpoint of a path reads a run's file: its mesh, or its contents.
pub(super) fn reads_run_file(path: &str) -> bool {
    let of_surface = path.starts_with("/api/v1/surfaces/") && path.ends_with("/mesh.glb");
    of_surface || described_run(path).is_some()
}

/// Returns the run that the endpoint of a path describes, if it describes one.
pub(super) fn described_run(path: &str) -> Option<&str> {
    path.strip_prefix("/api/v1/runs/").filter(|run| !run.is_empty() && !run.contains('/'))
}

/// State shared by the endpoints.
#[derive(Clone)]
pub(super) struct LakeCatalogue(Arc<CatalogueState>);

struct CatalogueState {
    service: QueryService,
    /// Of all clients with the same rights.
    views: Arc<SnapshotViews>,
}

impl LakeCatalogue {
    /// The catalogue of one client; `views` are those of all clients with its rights.
    pub fn new(service: QueryService, views: Arc<SnapshotViews>) -> Self {
        Self(Arc::new(CatalogueState { service, views }))
    }

    /// Routes of the endpoints. Heavy ones wait for one of `heavy_places`.
    pub fn endpoint_router(&self, heavy_places: &Arc<Semaphore>) -> Router {
        let cached = |routes: Router, scope, contents| {
            routes.route_layer(from_fn_with_state((self.clone(), scope, contents), answer_validated))
        };
        let heavy = Router::from(heavy_routes()).route_layer(from_fn_with_state(heavy_places.clone(), answer_in_place));
        cached(Router::from(light_routes()).merge(heavy), TokenScope::Sql, AnswerContents::Runs)
            .merge(cached(contribution_routes().into(), TokenScope::Sql, AnswerContents::Contributions))
            .merge(cached(file_routes().into(), TokenScope::Files, AnswerContents::Runs))
    }

    /// Returns the answer of a surface's endpoint.
    ///
    /// # Errors
    /// [`RequestFault::NotFound`], or those of its queries.
    pub async fn surface_value(&self, surface: &str) -> Result<Value, RequestFault> {
        let request = CatalogueRequest::new(self, &self.current_view().await?, false);
        let path = PathParams(SurfacePath { surface_id: surface.to_owned() });
        Box::pin(surface::surface(Extension(request), path)).await.map_err(|problem| problem.0)?.decode_json()
    }

    /// Returns the answer of a run's endpoint.
    ///
    /// # Errors
    /// As [`LakeCatalogue::surface_value`].
    pub async fn run_value(&self, run: &str) -> Result<Value, RequestFault> {
        let request = CatalogueRequest::new(self, &self.current_view().await?, false);
        let path = PathParams(RunPath { run_id: run.to_owned() });
        Box::pin(runs::run(Extension(request), path)).await.map_err(|problem| problem.0)?.decode_json()
    }

    pub fn service(&self) -> &QueryService {
        &self.0.service
    }

    pub fn lake(&self) -> &Lake {
        self.0.service.lake()
    }

    /// The lake as it is now, with what was computed of it already.
    pub async fn current_view(&self) -> Result<Arc<SnapshotView>, RequestFault> {
        self.0.views.current_view(&self.0.service).await
    }

    /// A table's file of this name, of the lake as it is or as it was while the server ran.
    pub fn find_file(&self, view: &SnapshotView, table: Table, name: &str) -> Option<VisibleFile> {
        self.0.views.find_file(view, table, name)
    }
}

/// Answers a request by its endpoint, unless its client has the answer already. The door remembers answers.
async fn answer_validated(
    State((catalogue, scope, contents)): State<(LakeCatalogue, TokenScope, AnswerContents)>,
    mut request: Request,
    next: Next,
) -> Result<Response, ProblemResponse> {
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        return Ok(next.run(request).await);
    }
    catalogue.service().authorised_client(scope)?;
    let view = catalogue.current_view().await?;
    let headers = request.headers().clone();
    let as_arrow = format::prefers_arrow(&headers);
    let address = request.uri().path_and_query().map_or_else(String::new, ToString::to_string);
    // A strong tag is for bytes as they are sent: packed ones are others.
    let as_gzip = format::accepts_encoding(&headers, "gzip");
    // What the client may do is in the lake's answer.
    let may_annotate = catalogue.service().has_scope(TokenScope::Annotate);
    let version = described_run(request.uri().path()).and_then(|run| view.run_version(run));
    let version = version.unwrap_or_else(|| view.content_version(contents));
    let etag = view.answer_etag(&version, &format!("{address} {as_arrow} {as_gzip} {may_annotate}"));
    let lasting = || view.lasting_version().map(|version| (LASTING_VERSION, HeaderValue::from(version)));
    let outcome = ConditionOutcome::new(&headers, &etag);
    let instead = || {
        let mut early = outcome.early_response(&etag, [(header::ETAG, &etag)])?;
        early.headers_mut().extend(lasting().filter(|_| outcome == ConditionOutcome::NotModified));
        Some(early)
    };
    // Only an answer has this tag: a client that names it had the answer, which need not be made again.
    if is_named(&headers, &etag)
        && let (ConditionOutcome::NotModified, Some(unchanged)) = (outcome, instead())
    {
        return Ok(unchanged);
    }
    // One answer is for both methods: HEAD's body is left out behind this.
    *request.method_mut() = Method::GET;
    request.extensions_mut().insert(CatalogueRequest::new(&catalogue, &view, as_arrow));
    let answer = next.run(request).await;
    if answer.status() != StatusCode::OK {
        let code = answer.extensions().get::<FaultCode>().copied();
        catalogue.service().report_failure(code.unwrap_or(FaultCode::Internal));
        return Ok(answer);
    }
    if let Some(instead) = instead() {
        return Ok(instead);
    }
    let mut response = with_validators(packing::pack_answer(answer, as_gzip).await?, &etag);
    response.headers_mut().extend(lasting());
    Ok(response)
}

/// Answers a request once there is a place.
async fn answer_in_place(State(places): State<Arc<Semaphore>>, request: Request, next: Next) -> Response {
    // An error would say that the places are closed, which nobody does.
    let _place = places.acquire().await;
    next.run(request).await
}

fn with_validators(mut response: Response, etag: &str) -> Response {
    let out = response.headers_mut();
    out.insert(header::VARY, HeaderValue::from_static("Accept, Accept-Encoding"));
    // Revalidated each time, by 304 for as long as nothing changes; no cache in between keeps what needed a token.
    out.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache"));
    if let Ok(etag) = HeaderValue::from_str(etag) {
        out.insert(header::ETAG, etag);
    }
    response
}
