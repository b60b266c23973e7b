//! Slices of run files over HTTP: cut while they are sent, or, for clients that read by ranges, cut once and cached.
//!
//! A slice's bytes follow from its measurements, topics and layout alone, so its ETag is a digest of these, and it may
//! be cut any number of times: a client that reads it to its end gets it as it is cut, in bounded memory. Ranges, HEAD
//! and a script's plain GET need its length, so for them it is cut to its end first, into a file without a name.

mod cutting;
mod foxglove;
mod lichtblick;
mod query;
mod selection;
mod sofa;
mod spool;

use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, Uri};
use axum::response::Response;
use axum::routing::get;
use echolake_export::{Check, SliceParams, Taken};
use echolake_query::{EngineClient, PredicateForm};
use echolake_schema::RunId;
use echolake_service::{RequestFault, TokenScope};
use futures::stream;
use tokio::sync::Semaphore;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::catalogue::{LakeCatalogue, SnapshotView};
use super::extract::{BinaryContent, QueryParams};
use super::guard;
use super::problem::ProblemResponse;
use super::ranges::{FileDescription, RangeAnswer, needs_length};
use cutting::{SliceResources, SliceTask};
pub(super) use query::SliceParameters;
use query::SliceQuery;
use selection::{SelectionCache, SliceSelection};
pub(crate) use sofa::SOFA;
use spool::SliceSpool;

/// Foxglove's manifest of slices.
pub(crate) use foxglove::MANIFEST as FOXGLOVE_MANIFEST;
/// Lichtblick's sessions of runs and slices.
pub(crate) use lichtblick::SESSION as LICHTBLICK_SESSION;

/// A slice.
pub(crate) const SLICE: &str = "/api/v1/slices.mcap";
/// Header of an engine's answer with the runs of a slice, for the door's audit.
pub const SLICED_RUNS: HeaderName = HeaderName::from_static("echolake-sliced-runs");
/// Bytes of that header's names.
const NAMED_BYTES: usize = 8 << 10;
/// Slices of all clients that are open at once: each holds some 8 MB.
const MOST: usize = 128;
/// Slices that are worked at, at any moment, beside those that begin: a few a thread, so that one that begins does not
/// wait for all that have.
const TURNS: usize = 4;

/// State shared by slices.
#[derive(Clone)]
pub(super) struct SliceService(Arc<SlicesState>);

struct SlicesState {
    catalogue: LakeCatalogue,
    selections: SelectionCache,
    spool: SliceSpool,
    room: SliceRoom,
}

/// What the slices of all clients share.
#[derive(Clone)]
pub(super) struct SliceRoom {
    places: Arc<Semaphore>,
    turns: Arc<Semaphore>,
}

impl Default for SliceRoom {
    fn default() -> Self {
        Self { places: Arc::new(Semaphore::new(MOST)), turns: Arc::new(Semaphore::new(TURNS)) }
    }
}

/// Routes of slices and of their manifest.
pub(super) fn slice_routes() -> OpenApiRouter<SliceService> {
    OpenApiRouter::new().routes(routes!(slice)).routes(routes!(foxglove::get_manifest)).routes(routes!(sofa::get_sofa))
}

/// Slices and their manifest for viewers on pages of any origin.
pub(super) fn for_viewers(slices: SliceService) -> Router {
    let routes = Router::from(slice_routes()).route(LICHTBLICK_SESSION, get(lichtblick::get_session));
    routes.method_not_allowed_fallback(super::problem::refuse_method).with_state(slices)
}

/// An authorised request for a slice.
struct SliceRequest {
    client: Arc<EngineClient>,
    view: Arc<SnapshotView>,
    question: SliceQuery,
}

/// The addresses of a slice, and what is in it.
pub(super) struct SliceAddress {
    pub path: String,
    pub manifest_path: String,
    pub measurements: usize,
    pub runs: Vec<RunId>,
}

impl SliceService {
    /// Slices of a lake for one client, in the room of all clients.
    pub fn new(catalogue: &LakeCatalogue, room: &SliceRoom) -> Self {
        Self(Arc::new(SlicesState {
            catalogue: catalogue.clone(),
            selections: SelectionCache::default(),
            spool: SliceSpool::default(),
            room: room.clone(),
        }))
    }

    /// The addresses of a slice. Who asks is this server's page or a program.
    ///
    /// # Errors
    /// A defect of the predicate, a missing scope, or a slice without measurements.
    pub async fn slice_address(&self, params: SliceParameters) -> Result<SliceAddress, RequestFault> {
        let client = self.authorise_client()?;
        let question = SliceQuery::new(params)?;
        let request = self.known_runs(client, question).await?;
        let selection = self.find_selection(&request).await?;
        let query = request.question.query_of(&request.question.runs);
        let mut runs: Vec<_> = selection.taken.iter().map(|taken| taken.run.clone()).collect();
        runs.dedup();
        Ok(SliceAddress {
            path: format!("{SLICE}?{query}"),
            manifest_path: format!("{FOXGLOVE_MANIFEST}?{query}"),
            measurements: selection.taken.len(),
            runs,
        })
    }

    // A slice holds what files do, and is chosen by SQL.
    fn authorise_client(&self) -> Result<Arc<EngineClient>, RequestFault> {
        let service = self.0.catalogue.service();
        service.authorised_client(TokenScope::Files)?;
        service.authorised_client(TokenScope::Sql)
    }

    async fn known_runs(&self, client: Arc<EngineClient>, question: SliceQuery) -> Result<SliceRequest, RequestFault> {
        let view = self.0.catalogue.current_view().await?;
        for run in &question.runs {
            super::catalogue::find_run(&view, run.as_str())?;
        }
        Ok(SliceRequest { client, view, question })
    }

    async fn read_request(
        &self,
        params: SliceParameters,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<SliceRequest, RequestFault> {
        let client = self.authorise_client()?;
        let mut question = SliceQuery::new(params)?;
        // Without tokens a page of elsewhere may read the runs whose names it knows, and ask nothing of others, nor
        // anything that costs more than reading them.
        if self.0.catalogue.service().is_open()
            && let Err(foreign) = guard::is_own(uri, headers)
        {
            if question.runs.is_empty() {
                return Err(foreign);
            }
            question.form = PredicateForm::Comparisons;
        }
        self.known_runs(client, question).await
    }

    async fn find_selection(&self, request: &SliceRequest) -> Result<Arc<SliceSelection>, RequestFault> {
        self.0.selections.get_or_select(&self.0.catalogue, request).await
    }

    fn slice_params(request: &SliceRequest, taken: Vec<Taken>) -> SliceParams {
        SliceParams {
            taken,
            topics: request.question.topics.clone(),
            layout: request.question.layout,
            // Reading a run whole takes longer than a viewer waits; what is read is checked by its CRCs.
            check: Check::Ends,
        }
    }

    async fn answer_slice(
        &self,
        request: &SliceRequest,
        selection: &SliceSelection,
        method: &Method,
        headers: &HeaderMap,
    ) -> Result<Response, RequestFault> {
        let described = FileDescription {
            etag: format!("\"{}\"", selection.digest),
            media_type: "application/octet-stream",
            policy: "cross-origin",
        };
        if let Some(instead) = described.condition_answer(headers) {
            return Ok(instead);
        }
        if !needs_length(method, headers) {
            let mut cutting = self.start_cutting(request, selection)?;
            // What fails at once still has a status to say so with.
            let first = cutting.next().await?;
            return Ok(described.stream_response(Body::from_stream(remaining_pieces(first, cutting))));
        }
        let cut = async { self.start_cutting(request, selection) };
        let whole = self.0.spool.get_or_cut(&selection.digest, cut).await?;
        Ok(match described.range_answer(headers, whole.bytes()) {
            RangeAnswer::Answer(answer) => answer,
            RangeAnswer::Part(part) => {
                described.part_response(&part, Body::from_stream(whole.read_range(part.range.clone())))
            }
        })
    }

    fn start_cutting(&self, request: &SliceRequest, selection: &SliceSelection) -> Result<SliceTask, RequestFault> {
        let params = Self::slice_params(request, selection.taken.clone());
        let places = self.0.room.places.clone();
        let place = places.try_acquire_owned().map_err(|_| RequestFault::TooMany { what: "slices", limit: MOST })?;
        let room = SliceResources { place, turns: self.0.room.turns.clone() };
        Ok(SliceTask::begin_cutting(
            self.0.catalogue.service(),
            &request.client,
            request.view.snapshot.clone(),
            params,
            room,
        ))
    }
}

/// The messages of some measurements as an MCAP file.
///
/// Streamed as it is cut; who sends Range, HEAD or Origin is told its length, and it is cut to its end first. CORS as
/// for run files. The same measurements, topics and layout are the same bytes and the same ETag. Needs the scopes sql
/// and files.
#[utoipa::path(
    get,
    path = SLICE,
    tag = "runs",
    params(SliceParameters, ("Range" = Option<String>, Header, nullable = false)),
    responses(
        (status = 200, description = "The slice", body = inline(BinaryContent),
            content_type = "application/octet-stream", headers(("ETag" = String))),
        (status = 206, description = "The range", body = inline(BinaryContent),
            content_type = "application/octet-stream"),
        (status = 304, description = "Not changed since the ETag of If-None-Match")
    ),
    extensions(("x-sql" = json!(["select run_id, pair_id, attempt, log_time_ns from measurements where (...)"])))
)]
async fn slice(
    State(slices): State<SliceService>,
    QueryParams(params): QueryParams<SliceParameters>,
    method: Method,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let request = slices.read_request(params, &uri, &headers).await?;
    let selection = slices.find_selection(&request).await?;
    if request.question.id.as_ref().is_some_and(|id| *id != selection.digest) {
        return Err(RequestFault::Gone { what: "this slice", hint: "ask for the manifest again" }.into());
    }
    let answer = slices.answer_slice(&request, &selection, &method, &headers).await?;
    let mut runs: Vec<_> = selection.taken.iter().map(|taken| &taken.run).collect();
    runs.dedup();
    Ok(name_runs(answer, &runs))
}

// Adds the names of a slice's runs to its answer, up to a number of bytes.
fn name_runs(mut answer: Response, runs: &[&RunId]) -> Response {
    let mut names = String::new();
    for (index, run) in runs.iter().enumerate() {
        if names.len() + run.as_str().len() > NAMED_BYTES {
            names += &format!(" and {} more", runs.len() - index);
            break;
        }
        if index > 0 {
            names.push(' ');
        }
        names += run.as_str();
    }
    if let Ok(names) = HeaderValue::try_from(names) {
        answer.headers_mut().insert(SLICED_RUNS, names);
    }
    answer
}

// A failure on the way breaks the connection off: a short slice would look like a whole one.
fn remaining_pieces(
    first: Option<bytes::Bytes>,
    cutting: SliceTask,
) -> impl stream::Stream<Item = Result<bytes::Bytes, RequestFault>> + Send {
    stream::try_unfold((first, cutting), |(first, mut cutting)| async move {
        let piece = match first {
            Some(piece) => Some(piece),
            None => cutting.next().await?,
        };
        Ok(piece.map(|piece| (piece, (None, cutting))))
    })
}
