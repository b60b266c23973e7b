//! Files of the lake, as they are: whole or in ranges, for viewers on pages of other origins, too.
//!
//! Which file it is comes from the snapshot; a request's text is only ever compared with the names in it.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use echolake_lake::Lake;
use echolake_schema::quoted_text;
use echolake_service::{RequestFault, TokenScope};
use futures::TryStreamExt as _;
use object_store::path::Path as StorePath;
use object_store::{GetOptions, GetRange, ObjectStore as _};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::catalogue::{self, CatalogueRequest, LakeCatalogue, RunPath, SnapshotView, text_value};
use super::extract::{BinaryContent, PathParams};
use super::problem::ProblemResponse;
use super::ranges::{FileDescription, RangeAnswer};

/// A run's file.
pub(super) const RUN: &str = "/api/v1/runs/{run_id}/file.mcap";

/// The path of a table's file.
#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(super) struct TableFilePath {
    table: String,
    file: String,
}

/// Routes that viewers on other pages use: run files may be requested from any origin, without credentials, and with
/// the headers that ranges need. A page of another origin learns no run's name here.
pub(super) fn viewer_routes() -> OpenApiRouter<LakeCatalogue> {
    OpenApiRouter::new().routes(routes!(run_file))
}

/// The files that only the server's own pages and programs read.
pub(super) fn own_routes() -> OpenApiRouter<LakeCatalogue> {
    OpenApiRouter::new().routes(routes!(table_file))
}

/// The MCAP file of a run.
///
/// Range, If-Range, HEAD; CORS with Accept-Ranges, Content-Length, Content-Range and ETag exposed; ETag is its SHA-256.
#[utoipa::path(
    get,
    path = RUN,
    tag = "runs",
    params(RunPath, ("Range" = Option<String>, Header, nullable = false)),
    responses(
        (status = 200, description = "OK", body = inline(BinaryContent), content_type = "application/octet-stream"),
        (status = 206, description = "The range", body = inline(BinaryContent),
            content_type = "application/octet-stream")
    ),
    extensions(("x-sql" = json!(["select file, file_bytes, file_sha256 from runs where run_id = $1"])))
)]
async fn run_file(
    State(catalogue): State<LakeCatalogue>,
    PathParams(path): PathParams<RunPath>,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    catalogue.service().authorised_client(TokenScope::Files)?;
    let view = catalogue.current_view().await?;
    let run = catalogue::find_run(&view, &path.run_id)?;
    let FileRow { file_sha256, file_bytes } = file_row(&catalogue, &view, run.run.as_str()).await?;
    let described = FileDescription {
        etag: format!("\"{file_sha256}\""),
        media_type: "application/octet-stream",
        // A page elsewhere may embed what it may read.
        policy: "cross-origin",
    };
    let bytes = u64::try_from(file_bytes).unwrap_or(0);
    let stored = RangedFile { path: Lake::run_path(&run.surface, &run.run), bytes, described };
    Ok(stored.answer_request(catalogue.lake(), &headers).await?)
}

/// One Parquet file; Range.
#[utoipa::path(
    get,
    path = "/api/v1/tables/{table}/{file}",
    tag = "files",
    params(TableFilePath, ("Range" = Option<String>, Header, nullable = false)),
    responses(
        (status = 200, description = "OK", body = inline(BinaryContent),
            content_type = "application/vnd.apache.parquet"),
        (status = 206, description = "The range", body = inline(BinaryContent),
            content_type = "application/vnd.apache.parquet")
    )
)]
async fn table_file(
    State(catalogue): State<LakeCatalogue>,
    PathParams(path): PathParams<TableFilePath>,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    catalogue.service().authorised_client(TokenScope::Files)?;
    let table = catalogue::find_table(&path.table)?;
    let name = &path.file;
    let view = catalogue.current_view().await?;
    let hint = "GET /api/v1/tables/{table} lists what there is";
    let file = catalogue.find_file(&view, table, name);
    let file = file.ok_or_else(|| RequestFault::NotFound {
        what: format!("file `{}` of table `{}`", quoted_text(name), table.name()),
        hint,
    })?;
    let described = FileDescription {
        // Its name is a digest of what it was made of.
        etag: format!("\"{name}-{}\"", file.bytes),
        media_type: "application/vnd.apache.parquet",
        policy: "same-origin",
    };
    let stored = RangedFile { path: file.path.clone(), bytes: file.bytes, described };
    Ok(stored.answer_request(catalogue.lake(), &headers).await?)
}

#[derive(Deserialize)]
struct FileRow {
    file_sha256: String,
    file_bytes: i64,
}

// What a run's row says of its file.
async fn file_row(catalogue: &LakeCatalogue, view: &Arc<SnapshotView>, run: &str) -> Result<FileRow, RequestFault> {
    let sql = "select file_sha256, file_bytes from runs where run_id = $1";
    let rows: Vec<FileRow> =
        CatalogueRequest::new(catalogue, view, false).read_rows(sql, vec![text_value(run)]).await?;
    let hint = "GET /api/v1/runs lists what there is";
    rows.into_iter().next().ok_or(RequestFault::NotFound { what: format!("run `{run}`"), hint })
}

/// A file of the lake's store that never changes.
struct RangedFile {
    path: StorePath,
    bytes: u64,
    described: FileDescription,
}

impl RangedFile {
    async fn answer_request(&self, lake: &Lake, headers: &HeaderMap) -> Result<Response, RequestFault> {
        let store = lake.store();
        let unread = |e: object_store::Error| match e {
            object_store::Error::NotFound { .. } => {
                RequestFault::Gone { what: "this file", hint: "ask for the list of files again" }
            }
            other => {
                tracing::warn!(error = &other as &dyn std::error::Error, "a file cannot be read");
                RequestFault::Unreadable
            }
        };
        let part = match self.described.range_answer(headers, self.bytes) {
            RangeAnswer::Answer(answer) => return Ok(answer),
            RangeAnswer::Part(part) => part,
        };
        let body = match part.range.is_empty() {
            true => Body::empty(),
            false => {
                let range = Some(GetRange::Bounded(part.range.clone()));
                let found = store.get_opts(&self.path, GetOptions { range, ..GetOptions::default() }).await;
                let found = found.map_err(unread)?;
                if found.meta.size != self.bytes {
                    tracing::warn!(path = %self.path, actual = found.meta.size, expected = self.bytes, "a file \
                        changed");
                    return Err(RequestFault::Unreadable);
                }
                let stream = found.into_stream();
                Body::from_stream(stream.inspect_err(|e| {
                    tracing::warn!(error = e as &dyn std::error::Error, "a file broke off");
                }))
            }
        };
        Ok(self.described.part_response(&part, body))
    }
}
