//! A contribution that an engine has checked, for the door to store: engines have no right to write.

use echolake_lake::ContributionLog;
use serde::{Deserialize, Serialize};

/// A checked contribution.
#[derive(Debug, Serialize, Deserialize)]
pub struct ContributionDraft {
    /// Number of its object.
    pub number: u64,
    /// The object's bytes in base 64; None if the object is there already, with the same contents.
    pub object: Option<String>,
    /// Names of the annotations; none for predictions.
    pub annotation_ids: Vec<String>,
}

/// The path of a log's requests.
pub fn contribution_path(log: ContributionLog) -> &'static str {
    match log {
        ContributionLog::Annotations => "/api/v1/annotations",
        ContributionLog::Predictions => "/api/v1/predictions",
    }
}
