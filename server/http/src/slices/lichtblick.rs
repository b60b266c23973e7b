//! Lichtblick's sessions: a viewer that is opened with `?sessionid=ID` asks the server that it was built for what there
//! is to show. The ID says it by itself, so that nothing is kept: names of runs, or the parameters of a slice.

use axum::extract::{Path, State};
use axum::http::{HeaderMap, Uri};
use axum::response::{IntoResponse as _, Response};
use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD as BASE64;
use chrono::{SecondsFormat, Utc};
use echolake_schema::RunId;
use echolake_service::RequestFault;
use serde_json::{Value, json};

use super::super::extract::parse_query;
use super::super::files::RUN;
use super::super::manifest::server_origin;
use super::super::problem::ProblemResponse;
use super::query::{MOST_RUNS, SliceParameters};
use super::{SLICE, SliceRequest, SliceService};

/// A session.
pub(crate) const SESSION: &str = "/session/{id}";
/// Beginning of an ID that has the parameters of a slice, in base 64 for URLs; `.` is in no name of a run.
const OF_SLICE: &str = "q.";
/// Separator of names of runs.
const SEPARATOR: char = '.';

/// Answers the URLs of a session's MCAP files, in the form in which Lichtblick reads all answers.
pub(super) async fn get_session(
    State(slices): State<SliceService>,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let request = slices.read_request(parse_id(&id)?, &uri, &headers).await?;
    let files = slices.session_files(&request, &server_origin(&headers)).await?;
    let now = Utc::now().to_rfc3339_opts(SecondsFormat::Secs, true);
    let answer = json!({ "data": { "mcaps": files }, "timestamp": now, "path": format!("session/{id}") });
    Ok(axum::Json(answer).into_response())
}

fn parse_id(id: &str) -> Result<SliceParameters, RequestFault> {
    let Some(encoded) = id.strip_prefix(OF_SLICE) else {
        return Ok(SliceParameters::new(None, id.split(SEPARATOR).map(str::to_owned).collect(), Vec::new()));
    };
    let decoded = BASE64.decode(encoded.trim_end_matches('=')).ok();
    let uri = decoded.and_then(|query| format!("{SLICE}?{}", String::from_utf8(query).ok()?).parse().ok());
    let uri: Uri = uri.ok_or_else(|| {
        let hint = "q. and the parameters of a slice (run=RUN&where=pair_id%3C5) in base 64 for URLs";
        RequestFault::bad_request(format!(
            "`{id}` is no session; hint: names of runs with dots between them, or {hint}"
        ))
    })?;
    parse_query(&uri)
}

impl SliceService {
    // Whole runs are their files, which viewers read by ranges; of others, each run has a slice of its own.
    async fn session_files(&self, request: &SliceRequest, origin: &str) -> Result<Vec<Value>, RequestFault> {
        let question = &request.question;
        if question.is_of_whole_runs() {
            let url = |run: &RunId| format!("{origin}{}", RUN.replace("{run_id}", run.as_str()));
            return Ok(question.runs.iter().map(|run| session_file(request, run, url(run))).collect());
        }
        let selection = self.find_selection(request).await?;
        let mut runs: Vec<_> = selection.taken.iter().map(|taken| &taken.run).collect();
        runs.dedup();
        if runs.len() > MOST_RUNS {
            let found = runs.len();
            return Err(RequestFault::bad_request(format!(
                "{found} runs are selected, {MOST_RUNS} may be; hint: run=RUN"
            )));
        }
        // A comma would be the end of the URL, and is encoded in it.
        let url = |run: &RunId| format!("{origin}{SLICE}?{}", question.query_of([run]));
        Ok(runs.into_iter().map(|run| session_file(request, run, url(run))).collect())
    }
}

fn session_file(request: &SliceRequest, run: &RunId, url: String) -> Value {
    let surface = request.view.snapshot.run(run).map(|visible| visible.surface.as_str());
    json!({ "url": url, "metadata": { "run_id": run.as_str(), "surface_id": surface } })
}

#[cfg(test)]
mod tests {
    use super::super::SliceQuery;
    use super::*;

    fn question(id: &str) -> Result<SliceQuery, RequestFault> {
        SliceQuery::new(parse_id(id)?)
    }

    #[test]
    fn an_id_says_what_it_is() {
        let named = question("a-1.b_2").unwrap_or_else(|e| panic!("{e}"));
        assert!(named.is_of_whole_runs());
        assert_eq!(named.runs.iter().map(RunId::as_str).collect::<Vec<_>>(), ["a-1", "b_2"]);
        let query = "run=a&where=snr_db%20%3E%2030&topics=/ir";
        for id in [format!("q.{}", BASE64.encode(query)), format!("q.{}==", BASE64.encode(query))] {
            let slice = question(&id).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!((slice.predicate(), slice.topics.len(), slice.runs.len()), ("snr_db > 30", 1, 1));
        }
        for wrong in ["", "a..b", "a'b", "q.", "q.!", "q.YQ", &"a.".repeat(MOST_RUNS + 1)] {
            assert!(question(wrong).is_err(), "{wrong}");
        }
    }
}
