//! Why messages of an MCAP file cannot be given as rows.

use datafusion::error::DataFusionError;
use echolake_schema::{ErrorCause, escape_controls};
use object_store::path::Path;

use super::encodings::Malformed;

/// What is wrong, with the file and the place in it.
#[derive(Debug, thiserror::Error)]
pub(super) enum Fault {
    /// The call is not right.
    #[error("{what}")]
    Call { what: String, hint: String },
    /// The store does not give the file.
    #[error("cannot read `{file}`: {source}")]
    Read { file: String, source: ErrorCause },
    /// A record of the file is damaged.
    #[error("`{file}` is damaged at byte {offset}: {what}")]
    Damaged { file: String, offset: u64, what: String },
    /// A channel's schema cannot be made columns of.
    #[error("`{file}`: topic `{topic}` has no columns: {what}; hint: mcap_messages gives its messages as they are")]
    Schema { file: String, topic: String, what: String },
    /// Two files have columns of one name and different types.
    #[error("`{column}` of topic `{topic}` is {one} in `{file}` and {other} in others; hint: ask for them one by one")]
    Conflict { file: String, topic: String, column: String, one: String, other: String },
    /// A message is not what its schema says.
    #[error(
        "`{file}`: message {sequence} of topic `{topic}` in the chunk at byte {offset} does not fit its schema: {what}"
    )]
    Message { file: String, topic: String, sequence: u32, offset: u64, what: Malformed },
}

impl Fault {
    /// Makes the error of a file's damage.
    pub fn damaged(file: &Path, offset: u64, what: impl Into<String>) -> Self {
        Self::Damaged { file: file.to_string(), offset, what: what.into() }
    }

    /// Makes the error of a call.
    pub fn invalid_call(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Call { what: what.into(), hint: hint.into() }
    }
}

impl From<Fault> for DataFusionError {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Call { what, hint } => Self::Plan(escape_controls(&format!("{what}; hint: {hint}"))),
            other => Self::Execution(escape_controls(&other.to_string())),
        }
    }
}
