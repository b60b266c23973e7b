//! Why a run cannot be recorded.

use std::path::PathBuf;

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
    #[error("cannot create `{}`: {reason}; hint: is the folder there, writable, and its disk not full?", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// The system's or the writer's words.
        reason: String,
    },
    /// The system refused while the run was recorded.
    #[error("cannot write `{}`: {reason}; hint: is the disk full or read-only? What was recorded so far is in `{}`", path.display(), partial.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What is written until it is whole.
        partial: PathBuf,
        /// The system's or the writer's words.
        reason: String,
    },
    /// A record that has no JSON.
    #[error("the surface's record cannot be written: {reason}")]
    Surface {
        /// Why.
        reason: String,
    },
}
