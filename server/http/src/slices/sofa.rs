//! `GET /api/v1/slices.sofa`: responses of chosen measurements of one run as a SOFA file, which is made in memory: a
//! run's responses are some ten megabytes.

use arrow::array::{ArrayRef, AsArray as _};
use arrow::compute::concat_batches;
use arrow::record_batch::RecordBatch;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, Uri, header};
use axum::response::Response;
use bytes::Bytes;
use echolake_export::{SOFA_COLUMNS, write_sofa_file};
use echolake_lake::VisibleRun;
use echolake_service::RequestFault;
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use utoipa::IntoParams;

use super::super::extract::{BinaryContent, QueryParams};
use super::super::problem::ProblemResponse;
use super::super::ranges::FileDescription;
use super::query::SliceParameters;
use super::{SliceRequest, SliceService, name_runs};

/// SOFA files.
pub(crate) const SOFA: &str = "/api/v1/slices.sofa";

/// The parameters after the path's `?`.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct SofaParameters {
    /// The run; the only one of the measurements if there is none.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    run: Option<String>,
    /// An SQL predicate over the columns of table measurements; all measurements of the run if there is none.
    #[serde(rename = "where")]
    #[param(example = "surface_id = 'flat' and pair_id < 5")]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    predicate: Option<String>,
}

/// The responses of one run's measurements as SOFA (AES69, convention SingleRoomSRIR 1.0).
///
/// The file that `export sofa` writes of the same measurements. Needs the scopes sql and files.
#[utoipa::path(
    get,
    path = SOFA,
    operation_id = "sofa",
    tag = "runs",
    params(SofaParameters),
    responses(
        (status = 200, description = "The file", body = inline(BinaryContent),
            content_type = "application/x-hdf5", headers(("ETag" = String))),
        (status = 304, description = "Not changed since the ETag of If-None-Match")
    ),
    extensions(("x-sql" = json!([
        "select pair_id, log_time_ns, temperature_c, ir from measurements where run_id = $1 and (...)"
    ])))
)]
pub(super) async fn get_sofa(
    State(slices): State<SliceService>,
    QueryParams(params): QueryParams<SofaParameters>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let params = SliceParameters::new(params.predicate, params.run.into_iter().collect(), Vec::new());
    let request = slices.read_request(params, &uri, &headers).await?;
    let rows = slices.read_responses(&request).await?;
    let run = only_run(&request, &rows)?;
    let name = format!("{}.sofa", run.surface);
    let run_id = run.run.clone();
    let lake = slices.0.catalogue.lake().clone();
    let made = slices.0.catalogue.service().compute_blocking(move || sofa_bytes(&lake, &run, &rows)).await??;
    let described = FileDescription {
        etag: format!("\"{}\"", hex::encode(&Sha256::digest(&made)[..16])),
        media_type: "application/x-hdf5",
        policy: "cross-origin",
    };
    if let Some(instead) = described.condition_answer(&headers) {
        return Ok(instead);
    }
    let mut response = described.stream_response(made.into());
    let saved = format!("attachment; filename=\"{name}\"");
    if let Ok(saved) = HeaderValue::try_from(saved) {
        response.headers_mut().insert(header::CONTENT_DISPOSITION, saved);
    }
    // Made anew for each request: a range would cost as much.
    response.headers_mut().remove(header::ACCEPT_RANGES);
    Ok(name_runs(response, &[&run_id]))
}

impl SliceService {
    // The rows of the measurements, read by the client's own query.
    async fn read_responses(&self, request: &SliceRequest) -> Result<RecordBatch, RequestFault> {
        let select = request.question.select_of(&format!("run_id, {}", SOFA_COLUMNS.join(", ")));
        let mut running = request.begin_query(self.0.catalogue.service(), select).await?;
        let most = self.0.catalogue.lake().grid().pairs().len();
        let mut batches: Vec<RecordBatch> = Vec::new();
        while let Some(batch) = running.next_part().await? {
            batches.push(batch);
            // A run has a measurement of a pair: these are of several.
            if batches.iter().map(RecordBatch::num_rows).sum::<usize>() > most {
                return Err(several_runs());
            }
        }
        concat_batches(&running.schema, &batches).map_err(RequestFault::defect("responses cannot be put together"))
    }
}

fn several_runs() -> RequestFault {
    RequestFault::bad_request("the measurements are of several runs, and a SOFA file has those of one; hint: run=RUN")
}

// The run that all rows are of.
fn only_run(request: &SliceRequest, rows: &RecordBatch) -> Result<VisibleRun, RequestFault> {
    let names: Option<ArrayRef> = rows.column_by_name("run_id").cloned();
    let names = names.as_ref().and_then(|names| names.as_string_opt::<i32>()).ok_or(RequestFault::Internal)?;
    let mut names = names.iter().flatten();
    let Some(first) = names.next() else {
        let hint = "POST /api/v1/sql tries predicates over `measurements`";
        return Err(RequestFault::NoData { what: "what is selected".to_owned(), data: "measurements", hint });
    };
    match names.all(|name| name == first) {
        true => super::super::catalogue::find_run(&request.view, first).cloned(),
        false => Err(several_runs()),
    }
}

fn sofa_bytes(lake: &echolake_lake::Lake, run: &VisibleRun, rows: &RecordBatch) -> Result<Bytes, RequestFault> {
    let failed = RequestFault::defect("a SOFA file cannot be made");
    let folder = tempfile::tempdir().map_err(failed)?;
    let path = folder.path().join("responses.sofa");
    write_sofa_file(lake, run, rows, &path)?;
    std::fs::read(&path).map(Bytes::from).map_err(failed)
}
