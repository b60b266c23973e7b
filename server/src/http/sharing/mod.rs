//! Delta Sharing, by which spreadsheets, pandas and Spark attach the lake: lists of tables, and of the Parquet files of
//! each, whose addresses carry a signature of their own. There is one share with one schema; it has all tables, and the
//! views that hold no lists.
//!
//! [`tables`] says what is shared, [`files`] hands it out.

mod files;
mod tables;

use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Value, json};

use super::catalogue::{LakeCatalogue, SnapshotView};
use super::manifest::origin;
use super::problem::ProblemResponse;
use super::slices::SliceService;
use crate::fault::RequestFault;
use crate::signed_address::SIGNED_ROUTE;
use crate::tokens::{TokenScope, of_header};
use files::FileLimits;
use tables::SharedTable;

/// The paths of the protocol.
pub(crate) const SHARING: &str = "/delta-sharing/{*path}";

/// Below it are the routes of the protocol.
const ENDPOINT: &str = "/delta-sharing";
const SHARE: &str = "echolake";
const SCHEMA: &str = "lake";
/// Tables of a page of a list, if the request does not say.
const USUAL_PAGE: usize = 500;

/// The header with a table's version; it is the lake's, because a commit of `runs` may change what others show.
const VERSION: HeaderName = HeaderName::from_static("delta-table-version");
/// The header by which clients say which forms of answers they read.
const CAPABILITIES: &str = "delta-sharing-capabilities";

/// State of the routes.
#[derive(Clone)]
pub(in crate::http) struct SharingService {
    catalogue: LakeCatalogue,
    slices: SliceService,
}

/// The routes of the protocol.
pub(in crate::http) fn routes(catalogue: &LakeCatalogue, slices: &SliceService) -> Router {
    let service = SharingService { catalogue: catalogue.clone(), slices: slices.clone() };
    let table = |rest: &str| format!("{ENDPOINT}/shares/{{share}}/schemas/{{schema}}/tables/{{table}}{rest}");
    Router::new()
        .route(&format!("{ENDPOINT}/profile.share"), get(profile))
        .route(&format!("{ENDPOINT}/shares"), get(shares))
        .route(&format!("{ENDPOINT}/shares/{{share}}"), get(share))
        .route(&format!("{ENDPOINT}/shares/{{share}}/schemas"), get(schemas))
        .route(&format!("{ENDPOINT}/shares/{{share}}/all-tables"), get(all_tables))
        .route(&format!("{ENDPOINT}/shares/{{share}}/schemas/{{schema}}/tables"), get(all_tables))
        .route(&table(""), get(version))
        .route(&table("/version"), get(version))
        .route(&table("/metadata"), get(metadata))
        .route(&table("/query"), post(query))
        .route(&table("/changes"), get(changes))
        .route(SIGNED_ROUTE, get(files::file))
        .with_state(service)
}

/// The names in a path; those that it has not are None.
#[derive(Deserialize)]
struct SharePath {
    share: Option<String>,
    schema: Option<String>,
    table: Option<String>,
}

/// The page of a list.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct PageQuery {
    max_results: Option<usize>,
    page_token: Option<usize>,
}

/// A question about a table. Hints about predicates are not followed: files that they would leave out are listed.
#[derive(Default, Deserialize)]
#[serde(rename_all = "camelCase")]
struct TableQuery {
    limit_hint: Option<u64>,
    version: Option<u64>,
    timestamp: Option<String>,
    starting_version: Option<u64>,
    ending_version: Option<u64>,
}

impl SharingService {
    // What is shared is rows and files.
    fn authorise(&self) -> Result<(), RequestFault> {
        let service = self.catalogue.service();
        service.client(TokenScope::Sql)?;
        service.client(TokenScope::Files).map(drop)
    }

    // The table of a path, or none if the path names only share and schema.
    fn table(&self, path: &SharePath) -> Result<Option<SharedTable>, RequestFault> {
        self.authorise()?;
        for (found, known, what) in [(&path.share, SHARE, "share"), (&path.schema, SCHEMA, "schema")] {
            if let Some(found) = found.as_ref().filter(|found| !found.eq_ignore_ascii_case(known)) {
                let hint = "GET /delta-sharing/shares/echolake/all-tables lists what there is";
                return Err(RequestFault::NotFound { what: format!("{what} `{found}`"), hint });
            }
        }
        path.table.as_ref().map(|name| SharedTable::by_name(&self.catalogue, name)).transpose()
    }

    fn required_table(&self, path: &SharePath) -> Result<SharedTable, RequestFault> {
        self.table(path)?.ok_or(RequestFault::Internal)
    }
}

/// A profile: what a client needs to begin. It holds the token that it was asked with.
async fn profile(State(sharing): State<SharingService>, headers: HeaderMap) -> Result<Response, ProblemResponse> {
    sharing.authorise()?;
    let token = headers.get(header::AUTHORIZATION).and_then(|v| v.to_str().ok()).and_then(of_header);
    let is_open = sharing.catalogue.service().is_open();
    let token = match token {
        Some(token) => token,
        // Clients do not start without one.
        None if is_open => "none".to_owned(),
        None => {
            let hint = "ask with `Authorization: Bearer TOKEN`: the profile holds that token";
            return Err(
                RequestFault::request(format!("a browser's session has no token to put in; hint: {hint}")).into()
            );
        }
    };
    let profile = json!({
        "shareCredentialsVersion": 1,
        "endpoint": format!("{}{ENDPOINT}", origin(&headers)),
        "bearerToken": token,
    });
    Ok(([(header::CONTENT_DISPOSITION, "attachment; filename=\"echolake.share\"")], Json(profile)).into_response())
}

async fn shares(
    State(sharing): State<SharingService>,
    Query(page): Query<PageQuery>,
) -> Result<Json<Value>, ProblemResponse> {
    sharing.authorise()?;
    Ok(page.select(vec![json!({ "name": SHARE })]))
}

async fn share(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
) -> Result<Json<Value>, ProblemResponse> {
    sharing.table(&path)?;
    Ok(Json(json!({ "share": { "name": SHARE } })))
}

async fn schemas(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
    Query(page): Query<PageQuery>,
) -> Result<Json<Value>, ProblemResponse> {
    sharing.table(&path)?;
    Ok(page.select(vec![json!({ "name": SCHEMA, "share": SHARE })]))
}

async fn all_tables(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
    Query(page): Query<PageQuery>,
) -> Result<Json<Value>, ProblemResponse> {
    sharing.table(&path)?;
    let table = |table: SharedTable| json!({ "name": table.name(), "schema": SCHEMA, "share": SHARE });
    Ok(page.select(SharedTable::all(&sharing.catalogue).into_iter().map(table).collect()))
}

impl PageQuery {
    fn select(&self, mut items: Vec<Value>) -> Json<Value> {
        let all = items.len();
        let start = self.page_token.unwrap_or(0).min(all);
        let end = start.saturating_add(self.max_results.unwrap_or(USUAL_PAGE).max(1)).min(all);
        items = items.drain(start..end).collect();
        let mut page = json!({ "items": items });
        if end < all {
            page["nextPageToken"] = end.to_string().into();
        }
        Json(page)
    }
}

async fn version(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    sharing.required_table(&path)?;
    check_form(&headers)?;
    let view = sharing.catalogue.view().await?;
    Ok((StatusCode::OK, [(VERSION, lake_version(&view).to_string())]).into_response())
}

async fn metadata(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let table = sharing.required_table(&path)?;
    check_form(&headers)?;
    let view = sharing.catalogue.view().await?;
    Ok(lines(&view, &head(&sharing, &table)))
}

async fn query(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
    headers: HeaderMap,
    body: Bytes,
) -> Result<Response, ProblemResponse> {
    let table = sharing.required_table(&path)?;
    check_form(&headers)?;
    let wanted: TableQuery = match body.is_empty() {
        true => TableQuery::default(),
        false => serde_json::from_slice(&body).map_err(|e| {
            RequestFault::request(format!("the body is not as expected: {e}; hint: {{\"limitHint\": 100}}"))
        })?,
    };
    let view = sharing.catalogue.view().await?;
    let now = lake_version(&view);
    let is_past = wanted.version.is_some_and(|version| version != now);
    if is_past || wanted.timestamp.is_some() || wanted.starting_version.is_some() || wanted.ending_version.is_some() {
        return Err(past_fault(now).into());
    }
    let limits = FileLimits { rows: wanted.limit_hint };
    let files = sharing.files(&view, &table, limits, &headers).await?;
    let mut all = head(&sharing, &table);
    all.extend(files);
    Ok(lines(&view, &all))
}

async fn changes(
    State(sharing): State<SharingService>,
    Path(path): Path<SharePath>,
) -> Result<Response, ProblemResponse> {
    sharing.required_table(&path)?;
    let view = sharing.catalogue.view().await?;
    Err(past_fault(lake_version(&view)).into())
}

fn past_fault(now: u64) -> RequestFault {
    RequestFault::request(format!(
        "the lake is shared as it is, at version {now}, without its past and its changes; hint: `VERSION AS OF` in SQL"
    ))
}

fn lake_version(view: &SnapshotView) -> u64 {
    view.snapshot.lake_version().unwrap_or(0)
}

// Clients that read Delta's own actions alone are told that there are none, before they read Parquet's as such.
fn check_form(headers: &HeaderMap) -> Result<(), RequestFault> {
    let wanted = headers.get(CAPABILITIES).and_then(|v| v.to_str().ok()).unwrap_or_default().to_ascii_lowercase();
    match wanted.contains("responseformat=") && !wanted.contains("parquet") {
        true => Err(RequestFault::unsupported("the response format delta (hint: responseformat=parquet)")),
        false => Ok(()),
    }
}

// The lines before the files.
fn head(sharing: &SharingService, table: &SharedTable) -> Vec<Value> {
    let metadata = json!({
        "id": table.id(sharing.catalogue.lake().location()),
        "name": table.name(),
        "format": { "provider": "parquet", "options": {} },
        "schemaString": table.schema_text(),
        "partitionColumns": [],
        "configuration": {},
    });
    vec![json!({ "protocol": { "minReaderVersion": 1 } }), json!({ "metaData": metadata })]
}

fn lines(view: &SnapshotView, lines: &[Value]) -> Response {
    let text: String = lines.iter().map(|line| line.to_string() + "\n").collect();
    let headers = [
        (header::CONTENT_TYPE, "application/x-ndjson; charset=utf-8".to_owned()),
        (VERSION, lake_version(view).to_string()),
    ];
    (headers, text).into_response()
}
