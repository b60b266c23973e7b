//! The catalogue: the data of the pages, each a query of the lake, answered once per snapshot and cached.
//!
//! [`ENDPOINTS`] is the table of them; `web/openapi.json` is their contract.

mod asked;
mod content;
mod correlations;
mod curves;
mod environment;
mod facets;
mod kept;
mod lake;
mod map;
mod pair;
mod params;
mod relief;
mod runs;
mod summary;
mod surface;
mod tables;
mod view;
mod wav;

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use axum::Router;
use axum::extract::RawPathParams;
use axum::extract::rejection::RawPathParamsRejection;
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use echolake_lake::Lake;
use echolake_schema::tables::Table;

use super::format;
use super::problem::ProblemResponse;
use crate::fault::RequestFault;
use crate::service::QueryService;
use crate::tokens::TokenScope;
pub(super) use asked::{CatalogueRequest, run, text};
use content::AnswerContent;
pub(super) use params::RequestParams;
pub(super) use tables::table;
use view::SnapshotViews;
pub(super) use view::{SnapshotView, VisibleFile};

/// The pending answer of an endpoint.
type PendingAnswer = Pin<Box<dyn Future<Output = Result<AnswerContent, RequestFault>> + Send>>;

/// An address of the catalogue.
#[derive(Clone, Copy)]
struct CatalogueEndpoint {
    path: &'static str,
    scope: TokenScope,
    answer: fn(CatalogueRequest) -> PendingAnswer,
}

macro_rules! endpoint {
    ($path:literal, $scope:ident, $answer:path) => {
        CatalogueEndpoint { path: $path, scope: TokenScope::$scope, answer: |asked| Box::pin($answer(asked)) }
    };
}

const ENDPOINTS: [CatalogueEndpoint; 17] = [
    endpoint!("/api/v1/lake", Sql, lake::lake),
    endpoint!("/api/v1/surfaces", Sql, facets::surfaces),
    endpoint!("/api/v1/surfaces/{surface_id}", Sql, surface::surface),
    endpoint!("/api/v1/surfaces/{surface_id}/grid", Sql, surface::grid),
    endpoint!("/api/v1/surfaces/{surface_id}/curves", Sql, curves::curves_of),
    endpoint!("/api/v1/surfaces/{surface_id}/heightmap", Sql, relief::heightmap),
    endpoint!("/api/v1/surfaces/{surface_id}/thumbnail.png", Sql, relief::thumbnail),
    endpoint!("/api/v1/surfaces/{surface_id}/mesh.glb", Files, relief::mesh),
    endpoint!("/api/v1/surfaces/{surface_id}/pairs/{pair_id}", Sql, pair::pair),
    endpoint!("/api/v1/surfaces/{surface_id}/pairs/{pair_id}/ir.wav", Sql, wav::wav),
    endpoint!("/api/v1/map", Sql, map::map),
    endpoint!("/api/v1/correlations", Sql, correlations::correlations),
    endpoint!("/api/v1/runs", Sql, runs::runs),
    endpoint!("/api/v1/runs/{run_id}", Sql, runs::run),
    endpoint!("/api/v1/runs/{run_id}/environment", Sql, environment::environment),
    endpoint!("/api/v1/tables", Sql, tables::tables),
    endpoint!("/api/v1/tables/{table}", Sql, tables::files),
];

/// State shared by the endpoints.
#[derive(Clone)]
pub(super) struct LakeCatalogue(Arc<CatalogueState>);

struct CatalogueState {
    service: QueryService,
    views: SnapshotViews,
}

impl LakeCatalogue {
    pub(super) fn new(service: QueryService) -> Self {
        Self(Arc::new(CatalogueState { service, views: SnapshotViews::default() }))
    }

    /// The addresses of the catalogue.
    pub(super) fn router<S: Clone + Send + Sync + 'static>(&self) -> Router<S> {
        ENDPOINTS.into_iter().fold(Router::new(), |router, endpoint| {
            let catalogue = self.clone();
            let handler = move |path: Result<RawPathParams, RawPathParamsRejection>, uri: Uri, headers: HeaderMap| {
                let catalogue = catalogue.clone();
                async move { catalogue.respond(endpoint, path, &uri, &headers).await.map_err(ProblemResponse) }
            };
            router.route(endpoint.path, get(handler))
        })
    }

    pub(super) fn service(&self) -> &QueryService {
        &self.0.service
    }

    pub(super) fn lake(&self) -> &Lake {
        self.0.service.lake()
    }

    /// The lake as it is now, with what was computed of it already.
    pub(super) async fn view(&self) -> Result<Arc<SnapshotView>, RequestFault> {
        self.0.views.current(&self.0.service).await
    }

    /// A table's file of this name, of the lake as it is or as it was while the server ran.
    pub(super) fn shown(&self, view: &SnapshotView, table: Table, name: &str) -> Option<VisibleFile> {
        self.0.views.shown(view, table, name)
    }

    async fn respond(
        &self,
        endpoint: CatalogueEndpoint,
        path: Result<RawPathParams, RawPathParamsRejection>,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<Response, RequestFault> {
        self.service().client(endpoint.scope)?;
        let path = path.map_err(|_| RequestFault::request("the path is not UTF-8"))?;
        let view = self.view().await?;
        let as_arrow = format::prefers_arrow(headers);
        let etag = view.etag(as_arrow);
        if is_known(headers, &etag) {
            return Ok((StatusCode::NOT_MODIFIED, [(header::ETAG, etag)]).into_response());
        }
        let params = RequestParams::of(uri)?;
        let key = (uri.path_and_query().map_or_else(String::new, ToString::to_string), as_arrow);
        let path = path.iter().map(|(name, value)| (name.to_owned(), value.to_owned())).collect();
        let asked = CatalogueRequest { catalogue: self.clone(), view: view.clone(), path, params, as_arrow };
        let answer = (endpoint.answer)(asked);
        let content =
            view.answers.once(key, answer).await.inspect_err(|f| self.service().metrics().failed(f.code()))?;
        Ok(response(&content, headers, etag))
    }
}

/// Returns whether the client has this version already.
pub(super) fn is_known(headers: &HeaderMap, etag: &str) -> bool {
    let tags = headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok());
    tags.flat_map(|v| v.split(',')).map(str::trim).any(|tag| tag == "*" || tag.trim_start_matches("W/") == etag)
}

fn response(content: &AnswerContent, headers: &HeaderMap, etag: String) -> Response {
    let (body, packed) = content.body(headers);
    let mut response =
        ([(header::CONTENT_TYPE, content.media_type), (header::VARY, "Accept, Accept-Encoding")], body).into_response();
    let out = response.headers_mut();
    // Revalidated each time, by 304 for as long as nothing changes; no cache in between keeps what needed a token.
    out.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache"));
    if packed {
        out.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        out.insert(header::ETAG, etag);
    }
    let name = content.name.as_ref().map(|name| format!("attachment; filename=\"{name}\""));
    if let Some(Ok(name)) = name.map(|name| HeaderValue::from_str(&name)) {
        out.insert(header::CONTENT_DISPOSITION, name);
    }
    response
}

#[cfg(test)]
mod tests;
