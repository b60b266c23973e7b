//! Requests of users to add to the lake. An engine checks them and turns them into a draft; the door
//! stores it.

mod annotations;
mod arrow_body;
mod new_rows;
mod predictions;

use std::sync::Arc;

use axum::Router;
use axum::extract::rejection::BytesRejection;
use axum::http::header;
use axum::response::{IntoResponse as _, Response};
use axum::routing::post;
use bytes::Bytes;
use echolake_query::RequestMemory;
use echolake_schema::tables::Table;
use echolake_service::{ContributionDraft, RequestFault, TokenScope};
use serde::Serialize;
use utoipa::ToSchema;

use super::catalogue::{LakeCatalogue, SnapshotView};
use super::problem::ProblemResponse;
use super::request_protocol::request_protocol;
use super::sql::whole_body;
pub use annotations::AnnotationsRequest;
pub use predictions::PredictionParams;

/// Longest name of an author, in characters.
const LONGEST_AUTHOR: usize = 100;

/// Bytes that are reserved per byte of a request: its rows, read, sorted, compared with those that are stored, and
/// encoded with the texts that all of them share.
const MEMORY_PER_BYTE: usize = 64;

/// What was stored.
#[derive(Debug, Serialize, ToSchema)]
pub struct AddedContribution {
    /// The version of the lake that shows it; null for tokens of projects.
    pub lake_version: Option<u64>,
    /// False if all of it was there before.
    pub is_new: bool,
    /// Names of the annotations, in the order of the request; none for predictions.
    pub annotation_ids: Vec<String>,
}

/// Routes of an engine. They change nothing, so the contract has the door's.
pub(super) fn draft_routes(catalogue: &LakeCatalogue) -> Router {
    Router::new()
        .route("/api/v1/annotations", post(annotations::draft_annotations))
        .route("/api/v1/predictions", post(predictions::draft_predictions))
        .with_state(catalogue.clone())
}

/// A request's body, and what its work may have.
struct ContributionBody {
    bytes: Bytes,
    /// Most rows of a request of this client.
    most_rows: usize,
    /// What this holds is the request's until it is dropped.
    memory: RequestMemory,
}

// Checks what a client sends under the limits of its queries: its permits, time, memory and rows. Leaving ends it.
async fn answer_draft<F>(
    catalogue: &LakeCatalogue,
    listed_as: &'static str,
    body: Result<Bytes, BytesRejection>,
    draft: impl FnOnce(ContributionBody) -> F + Send + 'static,
) -> Result<Response, ProblemResponse>
where
    F: Future<Output = Result<ContributionDraft, RequestFault>> + Send + 'static,
{
    let service = catalogue.service();
    let client = service.authorised_client(TokenScope::Annotate)?;
    let bytes = whole_body(body)?;
    let most_rows = client.quota().rows.map_or(usize::MAX, |rows| usize::try_from(rows).unwrap_or(usize::MAX));
    let run = move |memory: RequestMemory| async move {
        memory.reserve(bytes.len().saturating_mul(MEMORY_PER_BYTE))?;
        draft(ContributionBody { bytes, most_rows, memory }).await
    };
    let drafted = service.run_request(request_protocol(), &client, listed_as, run).await?;
    Ok(([(header::CONTENT_TYPE, ContributionDraft::MEDIA_TYPE)], drafted.encode()).into_response())
}

// The lake as it is at this moment, and the version of a table of users in it: rows are added to no other.
async fn newest_view(catalogue: &LakeCatalogue, table: Table) -> Result<(Arc<SnapshotView>, u64), RequestFault> {
    if let Ok(view) = catalogue.current_view().await {
        view.session.expire_snapshot();
    }
    let view = catalogue.current_view().await?;
    let fault = |error: echolake_lake::Error| RequestFault::from(echolake_query::Error::from(error));
    view.snapshot.check_table(table).map_err(fault)?;
    let version = view.snapshot.log_version(table).unwrap_or(0);
    Ok((view, version))
}

fn refuse_encoding(error: echolake_lake::Error) -> RequestFault {
    RequestFault::defect("rows that were checked are not encoded")(error)
}

// With tokens the author is the token's name; without, who asks may say who they are.
fn choose_author(catalogue: &LakeCatalogue, given: Option<&str>) -> Result<String, RequestFault> {
    let service = catalogue.service();
    let name = service.client_name();
    match given.map(str::trim).filter(|given| !given.is_empty()) {
        None => Ok(name.to_owned()),
        Some(given) if !service.is_open() && given != name => Err(RequestFault::bad_request(format!(
            "`author` is `{given}`, expected `{name}`, the token's name; hint: leave it out"
        ))),
        Some(given) if given.chars().count() > LONGEST_AUTHOR => Err(RequestFault::bad_request(format!(
            "`author` has {} characters, expected {LONGEST_AUTHOR} at most",
            given.chars().count()
        ))),
        Some(given) => Ok(given.to_owned()),
    }
}
