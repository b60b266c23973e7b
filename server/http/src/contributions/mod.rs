//! Requests of users to add to the lake. An engine checks them and turns them into a draft; the door
//! stores it.

mod annotations;
mod predictions;

use axum::Router;
use axum::routing::post;
use echolake_lake::ContributionLog;
use echolake_service::{RequestFault, contribution_path};
use serde::Serialize;
use utoipa::ToSchema;

use super::catalogue::LakeCatalogue;
pub use annotations::AnnotationsRequest;
pub use predictions::PredictionParams;

/// Longest name of an author, in characters.
const LONGEST_AUTHOR: usize = 100;

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
        .route(contribution_path(ContributionLog::Annotations), post(annotations::draft_annotations))
        .route(contribution_path(ContributionLog::Predictions), post(predictions::draft_predictions))
        .with_state(catalogue.clone())
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
