//! `POST /api/v1/annotations` and `POST /api/v1/predictions`: what users add to the lake. The client's engine checks a
//! request and drafts the object; the door, which alone may write, creates it under the next number and commits it.

use axum::Json;
use axum::body::{Body, Bytes, to_bytes};
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use echolake_http::{AddedContribution, AnnotationsRequest, BinaryContent, PredictionParams, ProblemResponse};
use echolake_lake::ContributionLog;
use echolake_service::{ClientIdentity, ContributionDraft, RequestFault, TokenScope};

use crate::door::audit;
use crate::door::body_reader::read_whole_body;
use crate::door::connection_places::PlaceWork;
use crate::door::forward::EngineProtocol;
use crate::door::server_door::ServerDoor;

/// Bytes of a request.
const LARGEST: usize = 1 << 20;
/// Bytes of a draft: base 64 of an object that is about as large as its request.
const LARGEST_DRAFT: usize = 8 << 20;
/// Tries against other writers of the same number.
const TRIES: usize = 50;

/// Adds labels, verdicts and notes on runs, measurements or regions of the grid.
///
/// All of a request is stored, or nothing. An answer means that it is on disk and that queries see it. An annotation
/// that is sent again with its `annotation_id` is stored once. Needs the scope `annotate`.
#[utoipa::path(
    post,
    path = "/api/v1/annotations",
    operation_id = "annotate",
    tag = "contributions",
    request_body = AnnotationsRequest,
    responses((status = 200, description = "Stored", body = AddedContribution))
)]
pub(super) async fn post_annotations(State(door): State<ServerDoor>, request: Request) -> Response {
    answer_request(&door, ContributionLog::Annotations, request).await
}

/// Adds TNCE that a model predicts.
///
/// The rows are an Arrow stream with `surface_id`, `pair_id` and columns of table `tnce`, linear; 1 MiB at most. All of
/// a request is stored, or nothing. Rows that are sent again are stored once; others for the same model, version and
/// surface are refused. Needs the scope `annotate`.
#[utoipa::path(
    post,
    path = "/api/v1/predictions",
    operation_id = "predict",
    tag = "contributions",
    params(PredictionParams),
    request_body(content = inline(BinaryContent), content_type = "application/vnd.apache.arrow.stream"),
    responses((status = 200, description = "Stored", body = AddedContribution))
)]
pub(super) async fn post_predictions(State(door): State<ServerDoor>, request: Request) -> Response {
    answer_request(&door, ContributionLog::Predictions, request).await
}

async fn answer_request(door: &ServerDoor, log: ContributionLog, request: Request) -> Response {
    add_contribution(door, log, request).await.unwrap_or_else(|fault| {
        door.metrics().record_failure(&fault);
        ProblemResponse(fault).into_response()
    })
}

async fn add_contribution(door: &ServerDoor, log: ContributionLog, request: Request) -> Result<Response, RequestFault> {
    let work = request.extensions().get::<PlaceWork>().cloned().ok_or(RequestFault::Internal)?;
    let client = door.identify_client(&work, &request)?;
    client.require_scope(TokenScope::Annotate)?;
    let (mut parts, body) = request.into_parts();
    // The body is sent again, whole.
    parts.headers.remove(header::CONTENT_LENGTH);
    let body = read_whole_body(body, &parts.headers, LARGEST).await?;
    for _ in 0..TRIES {
        let mut again = Request::new(Body::from(body.clone()));
        *again.method_mut() = Method::POST;
        *again.uri_mut() = parts.uri.clone();
        *again.headers_mut() = parts.headers.clone();
        let engines = door.engines();
        let answer = engines.forward_request(&client, again, EngineProtocol::Http, Some(&work)).await?.map(Body::new);
        if answer.status() != StatusCode::OK {
            return Ok(answer);
        }
        let draft = to_bytes(answer.into_body(), LARGEST_DRAFT).await;
        let draft = draft.map_err(RequestFault::defect("an engine broke off a draft"))?;
        let draft: ContributionDraft =
            serde_json::from_slice(&draft).map_err(RequestFault::defect("a draft is not as expected"))?;
        let Some(added) = store_draft(door, &client, log, draft).await? else { continue };
        audit::record_contribution(work.peer(), &client.name, log, &added);
        return Ok(Json(added).into_response());
    }
    Err(RequestFault::TooMany { what: "writers at once", limit: TRIES })
}

// None if another writer took the number.
async fn store_draft(
    door: &ServerDoor,
    client: &ClientIdentity,
    log: ContributionLog,
    draft: ContributionDraft,
) -> Result<Option<AddedContribution>, RequestFault> {
    let ContributionDraft { number, object, annotation_ids } = draft;
    let is_new = object.is_some();
    if let Some(object) = object {
        let object = STANDARD.decode(object).map_err(RequestFault::defect("a draft is no base 64"))?;
        if !door.lake().create_contribution(log, number, Bytes::from(object)).await.map_err(refuse_write)? {
            return Ok(None);
        }
    }
    let lake_version = door.lake().commit_contributions(log, number).await.map_err(refuse_write)?;
    // How many versions others add is none of the business of a token of some projects.
    let lake_version = client.projects.is_none().then_some(lake_version);
    Ok(Some(AddedContribution { lake_version, is_new, annotation_ids }))
}

fn refuse_write(error: echolake_lake::Error) -> RequestFault {
    tracing::warn!(error = &error as &dyn std::error::Error, "a contribution cannot be written");
    RequestFault::Unwritable
}
