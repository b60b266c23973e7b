//! Foxglove's remote data loader: the manifest of what can be loaded (`manifest_schema.json` of the SDK's conformance
//! suite). Named runs without a narrower selection are static files, read by ranges; all else is a source that streams
//! a run's slice, ascending in time. Access is checked here and again when the data are requested.

use axum::extract::State;
use axum::http::{HeaderMap, Uri};
use axum::response::{IntoResponse as _, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD as BASE64;
use chrono::{DateTime, SecondsFormat};
use echolake_export::{Layout, OutlineSchema, OutlineTopic, Taken, outline};
use echolake_schema::RunId;
use serde::Serialize;

use super::super::files::RUN;
use super::super::problem::Problem;
use super::question::MOST_RUNS;
use super::selection::digest;
use super::{Question, Request, SLICE, Slices};
use crate::fault::Fault;

/// The manifest.
pub(in crate::http) const MANIFEST: &str = "/api/v1/foxglove/manifest";

#[derive(Serialize)]
struct Manifest {
    name: String,
    sources: Vec<Source>,
}

#[derive(Serialize)]
#[serde(untagged, rename_all_fields = "camelCase")]
enum Source {
    Static {
        url: String,
        supports_range_requests: bool,
    },
    Streamed {
        url: String,
        /// The key that the loader keeps the data by, for everybody.
        id: String,
        topics: Vec<Topic>,
        schemas: Vec<Schema>,
        start_time: String,
        end_time: String,
    },
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Topic {
    name: String,
    message_encoding: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    schema_id: Option<u16>,
}

#[derive(Serialize)]
struct Schema {
    id: u16,
    name: String,
    encoding: String,
    data: String,
}

/// Answers with the manifest of what is asked for.
pub(super) async fn manifest(State(slices): State<Slices>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let request = slices.request(&uri, &headers).await?;
    let manifest = match request.question.is_of_whole_runs() {
        true => whole_runs(&request.question),
        false => streamed(&slices, request).await?,
    };
    Ok(axum::Json(manifest).into_response())
}

fn whole_runs(question: &Question) -> Manifest {
    let url = |run: &RunId| RUN.replace("{run_id}", run.as_str());
    let source = |run: &RunId| Source::Static { url: url(run), supports_range_requests: true };
    let names: Vec<_> = question.runs.iter().map(RunId::as_str).collect();
    Manifest { name: names.join(", "), sources: question.runs.iter().map(source).collect() }
}

// A source a run: within a run a topic has one schema, and what is added to the lake leaves the other runs' keys alone.
async fn streamed(slices: &Slices, mut request: Request) -> Result<Manifest, Fault> {
    // Its data are read as they come, so they have to ascend.
    request.question.layout = Layout::InTime;
    let selection = slices.selection(&request).await?;
    let runs: Vec<_> = selection.taken.chunk_by(|a, b| a.run == b.run).collect();
    if runs.len() > MOST_RUNS {
        return Err(Fault::request(format!("{} runs are selected, {MOST_RUNS} may be; hint: run=RUN", runs.len())));
    }
    let mut sources = Vec::new();
    for taken in &runs {
        sources.push(source(slices, &request, taken).await?);
    }
    Ok(Manifest { name: format!("{} measurements of {} runs", selection.taken.len(), runs.len()), sources })
}

async fn source(slices: &Slices, request: &Request, taken: &[Taken]) -> Result<Source, Fault> {
    let service = slices.0.catalogue.service();
    let (params, lake, snapshot) =
        (Slices::params(request, taken.to_vec()), service.lake().clone(), request.view.snapshot.clone());
    let found = service.plan(&request.client, async move { Ok(outline(&lake, &snapshot, params).await?) }).await?;
    let number = |index: usize| u16::try_from(index + 1).ok();
    let topic = |topic: OutlineTopic| Topic {
        name: topic.name,
        message_encoding: topic.message_encoding,
        schema_id: topic.schema.and_then(number),
    };
    let schema = |(index, schema): (usize, OutlineSchema)| {
        let OutlineSchema { name, encoding, data } = schema;
        Some(Schema { id: number(index)?, name, encoding, data: BASE64.encode(&data) })
    };
    let digest = digest(&request.view, &request.question, taken);
    Ok(Source::Streamed {
        url: format!("{SLICE}?{}&id={digest}", request.question.query_of(&taken[0].run)),
        id: format!("echolake-{digest}"),
        topics: found.topics.into_iter().map(topic).collect(),
        schemas: found.schemas.into_iter().enumerate().filter_map(schema).collect(),
        start_time: time(found.start_ns),
        end_time: time(found.end_ns),
    })
}

fn time(nanos: i64) -> String {
    DateTime::from_timestamp_nanos(nanos).to_rfc3339_opts(SecondsFormat::Nanos, true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_keep_their_nanoseconds() {
        assert_eq!(time(1_767_758_400_000_000_001), "2026-01-07T04:00:00.000000001Z");
    }
}
