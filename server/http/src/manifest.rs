//! `GET /api/v1/files`: the Parquet files of the lake's snapshot as URLs, so that loaders of training sets take a list
//! and read by ranges, without a copy.

use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, header};
use axum::response::{IntoResponse as _, Response};
use echolake_lake::{DataFile, LakeSnapshot};
use echolake_schema::tables::Table;
use echolake_service::{RequestFault, TokenScope};
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::catalogue::{self, AnswerContents, LakeCatalogue};
use super::conditions::ConditionOutcome;
use super::extract::QueryParams;
use super::guard::is_encrypted;
use super::problem::ProblemResponse;

/// The path that a proxy takes off before it forwards a request.
const FORWARDED_PREFIX: HeaderName = HeaderName::from_static("x-forwarded-prefix");

/// The tables that files are listed of.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct FilesQuery {
    /// Only of these tables.
    #[param(style = Form, explode)]
    table: Vec<String>,
}

/// The Parquet files of a snapshot.
#[derive(Serialize, ToSchema)]
struct FileManifest<'a> {
    /// Of the snapshot; another one, another version.
    version: &'a str,
    files: Vec<ManifestFile>,
    /// Rows that only queries give, because their files hold rows of projects that the client may not see.
    rows_elsewhere: Vec<RowsElsewhere>,
}

/// Rows of a table that are in no file of the manifest.
#[derive(Serialize, ToSchema)]
struct RowsElsewhere {
    table: &'static str,
    rows: u64,
}

/// A Parquet file with its address.
#[derive(Serialize, ToSchema)]
struct ManifestFile {
    table: &'static str,
    #[schema(format = "uri")]
    url: String,
    bytes: u64,
    /// Rows that the snapshot shows.
    rows: u64,
    /// Rows that are in the file, too, but were replaced by newer rows of the same runs.
    superseded_rows: u64,
}

/// The route of the list.
pub(super) fn manifest_routes() -> OpenApiRouter<LakeCatalogue> {
    OpenApiRouter::new().routes(routes!(files))
}

/// The Parquet files of the lake's snapshot as URLs, for loaders that take a list of them.
///
/// Needs the scope files.
#[utoipa::path(
    get,
    path = "/api/v1/files",
    tag = "files",
    params(FilesQuery),
    responses((status = 200, description = "OK", body = FileManifest)),
    extensions(("x-sql" = json!(["the commit log"])))
)]
async fn files(
    State(catalogue): State<LakeCatalogue>,
    QueryParams(query): QueryParams<FilesQuery>,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    catalogue.service().authorised_client(TokenScope::Files)?;
    let tables = query.table.iter().map(|name| catalogue::find_table(name));
    let tables = tables.collect::<Result<Vec<_>, RequestFault>>()?;
    let view = catalogue.current_view().await?;
    let origin = server_origin(&headers);
    // The answer has the tables that were asked for, and the server's address as this client knows it.
    let version = view.content_version(AnswerContents::Contributions);
    let etag = view.answer_etag(&version, &format!("{origin} files {:?}", query.table));
    let validators = [
        (header::ETAG, etag.as_str()),
        (header::CACHE_CONTROL, "private, no-cache"),
        (header::VARY, "Host, X-Forwarded-Proto, X-Forwarded-Prefix"),
    ];
    if let Some(instead) = ConditionOutcome::new(&headers, &etag).early_response(&etag, validators.clone()) {
        return Ok(instead);
    }
    let all: Vec<_> = Table::ALL.into_iter().filter(|table| tables.is_empty() || tables.contains(table)).collect();
    let snapshot = &view.snapshot;
    for table in &all {
        snapshot.check_table(*table).map_err(|fault| RequestFault::Query(fault.into()))?;
    }
    let files = all.iter().flat_map(|table| {
        let origin = &origin;
        snapshot.readable_files(*table).filter_map(move |file| ManifestFile::from_data_file(origin, *table, file))
    });
    let rows_elsewhere = all.iter().filter_map(|table| RowsElsewhere::from_snapshot(snapshot, *table)).collect();
    let manifest = FileManifest { version: &version, files: files.collect(), rows_elsewhere };
    Ok((validators, axum::Json(manifest)).into_response())
}

/// The beginning of this server's URLs as the client sees it: behind a proxy with TLS `https`, and the path that it
/// serves below.
pub(super) fn server_origin(headers: &HeaderMap) -> String {
    let text = |name: HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
    let scheme = if is_encrypted(headers) { "https" } else { "http" };
    format!("{scheme}://{}{}", text(header::HOST).unwrap_or_default(), forwarded_prefix(headers))
}

/// The path below which a proxy serves, if it names one: empty, or as `/lake`.
pub(super) fn forwarded_prefix(headers: &HeaderMap) -> &str {
    let is_path =
        |path: &&str| path.starts_with('/') && path.bytes().all(|b| b.is_ascii_alphanumeric() || b"/-_.~".contains(&b));
    let named = headers.get(FORWARDED_PREFIX).and_then(|v| v.to_str().ok());
    named.filter(is_path).unwrap_or_default().trim_end_matches('/')
}

impl RowsElsewhere {
    fn from_snapshot(snapshot: &LakeSnapshot, table: Table) -> Option<Self> {
        let all: u64 = snapshot.files(table).iter().map(|file| file.visible_rows()).sum();
        let readable: u64 = snapshot.readable_files(table).map(DataFile::visible_rows).sum();
        (all > readable).then(|| Self { table: table.name(), rows: all - readable })
    }
}

impl ManifestFile {
    fn from_data_file(origin: &str, table: Table, file: &DataFile) -> Option<Self> {
        let name = file.path.filename()?;
        let rows = file.visible_rows();
        Some(Self {
            table: table.name(),
            url: format!("{origin}/api/v1/tables/{}/{name}", table.name()),
            bytes: file.bytes,
            rows,
            superseded_rows: file.rows - rows,
        })
    }
}
