//! `POST /api/v1/annotations` and `POST /api/v1/predictions`: what users add to the lake. The engine of statements
//! checks a request and encodes rows; the door, which alone may write, adds them to their table.

use axum::Json;
use axum::body::{Body, to_bytes};
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use echolake_http::{AddedContribution, AnnotationsRequest, BinaryContent, PredictionParams, ProblemResponse};
use echolake_lake::{ContributedPart, LakeSnapshot};
use echolake_schema::tables::Table;
use echolake_service::{ClientIdentity, ContributionDraft, EngineRole, RequestFault, TokenScope};

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
/// a request is stored, or nothing. Rows that are sent again are stored once; other values for a model, version,
/// surface and pair that are stored are refused. Needs the scope `annotate`.
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
        let role = EngineRole::Statements;
        let answer = engines.forward_request(role, &client, again, EngineProtocol::Http, Some(&work)).await?;
        let answer = answer.map(Body::new);
        if answer.status() != StatusCode::OK {
            return Ok(answer);
        }
        let draft = to_bytes(answer.into_body(), LARGEST_DRAFT).await;
        let draft = draft.map_err(RequestFault::defect("an engine broke off a draft"))?;
        let draft = ContributionDraft::decode(draft).map_err(refuse_draft)?;
        let Some(added) = store_draft(door, &client, table, draft).await? else { continue };
        door.answers().expire_check();
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
    let snapshot = client.visible_lake(door.lake()).snapshot_of(&[]).await.map_err(refuse_write)?;
    check_draft(&draft, table, &snapshot)?;
    let ContributionDraft { seen, files, annotation_ids, .. } = draft;
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

// A draft is of the table of the request, and of runs that the client sees.
fn check_draft(draft: &ContributionDraft, table: Table, seen: &LakeSnapshot) -> Result<(), RequestFault> {
    let is_visible = |part: &ContributedPart| seen.run(&part.run).is_some_and(|run| run.surface == part.surface);
    match draft.table == table && draft.files.iter().flat_map(|file| &file.parts).all(is_visible) {
        true => Ok(()),
        false => Err(refuse_draft("it is of another table or of runs that the client does not see".to_owned())),
    }
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

#[cfg(test)]
mod tests {
    use echolake_lake::{ContributedFile, Lake, ReferenceSurfaces};
    use echolake_schema::Rig;

    use super::*;

    /// E11: an engine names a table and runs, and the door stores what the request and its client may.
    #[tokio::test]
    async fn a_draft_of_another_table_or_of_other_runs_is_refused() {
        let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await;
        let snapshot = lake.expect("a lake").snapshot_of(&[]).await.expect("a view");
        let part = ContributedPart {
            surface: "flat".parse().expect("an id"),
            run: "20260105T080000Z-flat-7c1e".parse().expect("an id"),
            rows: 1,
        };
        let file = ContributedFile { parts: vec![part], stats: String::new(), bytes: "x".into() };
        let draft = |files| ContributionDraft { table: Table::Annotations, seen: 1, files, annotation_ids: Vec::new() };
        assert!(check_draft(&draft(Vec::new()), Table::Annotations, &snapshot).is_ok());
        assert!(check_draft(&draft(Vec::new()), Table::Predictions, &snapshot).is_err(), "another table");
        assert!(check_draft(&draft(vec![file]), Table::Annotations, &snapshot).is_err(), "a run that nobody sees");
    }
}
