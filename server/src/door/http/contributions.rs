//! `POST /api/v1/annotations` and `POST /api/v1/predictions`: what users add to the lake. The client's engine checks a
//! request and encodes rows; the door, which alone may write, adds them to their table.

use axum::Json;
use axum::body::{Body, to_bytes};
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use echolake_http::{AddedContribution, AnnotationsRequest, BinaryContent, PredictionParams, ProblemResponse};
use echolake_lake::ContributedPart;
use echolake_schema::tables::Table;
use echolake_service::{ClientIdentity, ContributionDraft, RequestFault, TokenScope};

use crate::door::audit;
use crate::door::body_reader::read_whole_body;
use crate::door::connection_places::PlaceWork;
use crate::door::forward::EngineProtocol;
use crate::door::server_door::ServerDoor;

/// Bytes of a request.
const LARGEST: usize = 1 << 20;
/// Bytes of a draft: its rows are about as large as their request, and a region of the grid is many pairs.
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
    answer_request(&door, Table::Annotations, request).await
}

/// Adds TNCE that a model predicts.
///
/// The rows are an Arrow stream with `surface_id`, `pair_id` and columns of table `tnce`, linear; 1 MiB at most. All of
/// a request is stored, or nothing. Rows that are sent again are stored once; other values for a model, version, surface
/// and pair that are stored are refused. Needs the scope `annotate`.
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
    answer_request(&door, Table::Predictions, request).await
}

async fn answer_request(door: &ServerDoor, table: Table, request: Request) -> Response {
    add_contribution(door, table, request).await.unwrap_or_else(|fault| {
        door.metrics().record_failure(&fault);
        ProblemResponse(fault).into_response()
    })
}

async fn add_contribution(door: &ServerDoor, table: Table, request: Request) -> Result<Response, RequestFault> {
    let work = request.extensions().get::<PlaceWork>().cloned().ok_or(RequestFault::Internal)?;
    let client = door.identify_client(&work, &request)?;
    client.require_scope(TokenScope::Annotate)?;
    let (mut parts, body) = request.into_parts();
    // The body is sent again, whole.
    parts.headers.remove(header::CONTENT_LENGTH);
    let body = read_whole_body(body, &parts.headers, LARGEST).await?;
    for _ in 0..TRIES {
        door.lake().prepare_contributions(table).await.map_err(refuse_write)?;
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
        let draft = ContributionDraft::decode(draft).map_err(refuse_draft)?;
        let Some(added) = store_draft(door, &client, table, draft).await? else { continue };
        audit::record_contribution(work.peer(), &client.name, table, &added);
        return Ok(Json(added).into_response());
    }
    Err(RequestFault::TooMany { what: "writers at once", limit: TRIES })
}

// None if another writer has added to the table meanwhile.
async fn store_draft(
    door: &ServerDoor,
    client: &ClientIdentity,
    table: Table,
    draft: ContributionDraft,
) -> Result<Option<AddedContribution>, RequestFault> {
    let ContributionDraft { table: drafted, seen, files, annotation_ids } = draft;
    let seen_lake = match &client.projects {
        Some(projects) => door.lake().restricted_to(projects.clone()),
        None => door.lake().clone(),
    };
    let snapshot = seen_lake.snapshot().await.map_err(refuse_write)?;
    let parts = files.iter().flat_map(|file| &file.parts);
    let is_visible = |part: &ContributedPart| snapshot.run(&part.run).is_some_and(|run| run.surface == part.surface);
    if drafted != table || !parts.into_iter().all(is_visible) {
        return Err(refuse_draft("it is of another table or of runs that the client does not see".to_owned()));
    }
    let is_new = !files.is_empty();
    let lake_version = match is_new {
        true => door.lake().add_contribution(table, seen, files).await.map_err(refuse_write)?,
        false => Some(snapshot.lake_version().unwrap_or(0)),
    };
    let Some(lake_version) = lake_version else { return Ok(None) };
    // How many versions others add is none of the business of a token of some projects.
    let lake_version = client.projects.is_none().then_some(lake_version);
    Ok(Some(AddedContribution { lake_version, is_new, annotation_ids }))
}

fn refuse_draft(reason: String) -> RequestFault {
    tracing::error!(reason, "a draft of an engine is refused");
    RequestFault::Internal
}

fn refuse_write(error: echolake_lake::Error) -> RequestFault {
    if error.is_table_fault() {
        return RequestFault::from(echolake_query::Error::from(error));
    }
    tracing::warn!(error = &error as &dyn std::error::Error, "a contribution cannot be written");
    RequestFault::Unwritable
}
