//! Why a run cannot be recorded.

use std::path::PathBuf;

use echolake_schema::ErrorCause;

/// Why a run cannot be recorded.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A recording of this name is there.
    #[error("`{}` is there already; hint: a run is never overwritten", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The recording cannot be begun.
    #[error(
        "cannot create `{}`: {source}; hint: is the folder there, writable, and its disk not full?",
        path.display()
    )]
    Create {
        /// The file.
        path: PathBuf,
        /// The system's or the writer's error.
        source: ErrorCause,
    },
    /// The system refused while the run was recorded.
    #[error(
        "cannot write `{}`: {source}; hint: is the disk full or read-only? What was recorded so far is in `{}`",
        path.display(), partial.display()
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// What is written until it is whole.
        partial: PathBuf,
        /// The system's or the writer's error.
        source: ErrorCause,
    },
    /// A record that has no JSON.
    #[error("the surface's record cannot be written: {source}")]
    Surface {
        /// The encoder's error.
        source: serde_json::Error,
    },
}
