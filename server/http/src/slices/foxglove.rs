//! Foxglove's remote data loader: the manifest of what can be loaded (`manifest_schema.json` of the SDK's conformance
//! suite). Named runs without a narrower selection are static files, read by ranges; all else is a source that streams
//! a run's slice, ascending in time. Access is checked here and again when the data are requested.

use axum::extract::State;
use axum::http::{HeaderMap, Uri};
use axum::response::{IntoResponse as _, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD as BASE64;
use chrono::{DateTime, SecondsFormat};
use echolake_export::{Layout, OutlineSchema, OutlineTopic, Taken, outline_slice};
use echolake_schema::RunId;
use echolake_service::RequestFault;
use serde::Serialize;
use utoipa::ToSchema;

use super::super::extract::QueryParams;
use super::super::files::RUN;
use super::super::manifest::forwarded_prefix;
use super::super::problem::ProblemResponse;
use super::query::{MOST_RUNS, SliceParameters};
use super::selection::slice_digest;
use super::{SLICE, SliceQuery, SliceRequest, SliceService};

/// The manifest.
pub(crate) const MANIFEST: &str = "/api/v1/foxglove/manifest";

/// A manifest.
#[derive(Serialize, ToSchema)]
struct FoxgloveManifest {
    name: String,
    sources: Vec<FoxgloveSource>,
}

/// A source of data.
#[derive(Serialize, ToSchema)]
#[serde(untagged)]
enum FoxgloveSource {
    #[serde(rename_all = "camelCase")]
    Static { url: String, supports_range_requests: bool },
    #[serde(rename_all = "camelCase")]
    Streamed {
        url: String,
        /// The key that the loader keeps the data by, for everybody.
        id: String,
        topics: Vec<FoxgloveTopic>,
        schemas: Vec<FoxgloveSchema>,
        #[schema(format = DateTime)]
        start_time: String,
        #[schema(format = DateTime)]
        end_time: String,
    },
}

/// A topic of a source.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "camelCase")]
struct FoxgloveTopic {
    name: String,
    message_encoding: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false, minimum = 1)]
    schema_id: Option<u16>,
}

/// A schema of a source's messages.
#[derive(Serialize, ToSchema)]
struct FoxgloveSchema {
    #[schema(minimum = 1)]
    id: u16,
    name: String,
    encoding: String,
    #[schema(content_encoding = "base64")]
    data: String,
}

/// The manifest of Foxglove's remote data loader.
///
/// Runs without where and topics are static files; all else is a streamed source per run, ascending in time.
#[utoipa::path(
    get,
    path = MANIFEST,
    operation_id = "foxglove_manifest",
    tag = "runs",
    params(SliceParameters),
    responses((status = 200, description = "OK", body = FoxgloveManifest)),
    extensions(("x-sql" = json!(["select run_id, pair_id, attempt, log_time_ns from measurements where (...)"])))
)]
pub(super) async fn get_manifest(
    State(slices): State<SliceService>,
    QueryParams(params): QueryParams<SliceParameters>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let request = slices.read_request(params, &uri, &headers).await?;
    let mut manifest = match request.question.is_of_whole_runs() {
        true => whole_runs(&request.question),
        false => streamed_manifest(&slices, request).await?,
    };
    for source in &mut manifest.sources {
        let (FoxgloveSource::Static { url, .. } | FoxgloveSource::Streamed { url, .. }) = source;
        url.insert_str(0, forwarded_prefix(&headers));
    }
    Ok(axum::Json(manifest).into_response())
}

fn whole_runs(question: &SliceQuery) -> FoxgloveManifest {
    let url = |run: &RunId| RUN.replace("{run_id}", run.as_str());
    let source = |run: &RunId| FoxgloveSource::Static { url: url(run), supports_range_requests: true };
    let names: Vec<_> = question.runs.iter().map(RunId::as_str).collect();
    FoxgloveManifest { name: names.join(", "), sources: question.runs.iter().map(source).collect() }
}

// One source per run: within a run a topic has one schema, and adding to the lake does not change other runs' keys.
async fn streamed_manifest(slices: &SliceService, mut request: SliceRequest) -> Result<FoxgloveManifest, RequestFault> {
    // Its data are read as they come, so they have to ascend.
    request.question.layout = Layout::InTime;
    let selection = slices.find_selection(&request).await?;
    let runs: Vec<_> = selection.taken.chunk_by(|a, b| a.run == b.run).collect();
    if runs.len() > MOST_RUNS {
        return Err(RequestFault::bad_request(format!(
            "{} runs are selected, {MOST_RUNS} may be; hint: run=RUN",
            runs.len()
        )));
    }
    let mut sources = Vec::new();
    for taken in &runs {
        sources.push(streamed_source(slices, &request, taken).await?);
    }
    Ok(FoxgloveManifest { name: format!("{} measurements of {} runs", selection.taken.len(), runs.len()), sources })
}

async fn streamed_source(
    slices: &SliceService,
    request: &SliceRequest,
    taken: &[Taken],
) -> Result<FoxgloveSource, RequestFault> {
    let service = slices.0.catalogue.service();
    let (params, lake, snapshot) =
        (SliceService::slice_params(request, taken.to_vec()), service.lake().clone(), request.view.snapshot.clone());
    let found =
        service.plan_query(&request.client, async move { Ok(outline_slice(&lake, &snapshot, params).await?) }).await?;
    let number = |index: usize| u16::try_from(index + 1).ok();
    let topic = |topic: OutlineTopic| FoxgloveTopic {
        name: topic.name,
        message_encoding: topic.message_encoding,
        schema_id: topic.schema.and_then(number),
    };
    let schema = |(index, schema): (usize, OutlineSchema)| {
        let OutlineSchema { name, encoding, data } = schema;
        Some(FoxgloveSchema { id: number(index)?, name, encoding, data: BASE64.encode(&data) })
    };
    let digest = slice_digest(&request.view, &request.question, taken);
    Ok(FoxgloveSource::Streamed {
        url: format!("{SLICE}?{}&id={digest}", request.question.query_of([&taken[0].run])),
        id: format!("echolake-{digest}"),
        topics: found.topics.into_iter().map(topic).collect(),
        schemas: found.schemas.into_iter().enumerate().filter_map(schema).collect(),
        start_time: format_nanos(found.start_ns),
        end_time: format_nanos(found.end_ns),
    })
}

fn format_nanos(nanos: i64) -> String {
    DateTime::from_timestamp_nanos(nanos).to_rfc3339_opts(SecondsFormat::Nanos, true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_keep_their_nanoseconds() {
        assert_eq!(format_nanos(1_767_758_400_000_000_001), "2026-01-07T04:00:00.000000001Z");
    }
}
