//! Why a recording cannot be recovered or gone on with.

use std::io;
use std::path::PathBuf;

use echolake_recording::PrefixError;
use echolake_schema::ErrorCause;

/// Why a recording cannot be recovered or gone on with. The recording itself is as it was.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The system refused to read it.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Somebody records it.
    #[error("`{}` is being recorded; hint: stop that `echolake acquire` first", path.display())]
    Busy {
        /// The file.
        path: PathBuf,
    },
    /// It holds nothing that could be kept.
    #[error("`{}` holds no run: {source}; hint: nothing was measured into it, measure anew", path.display())]
    Headless {
        /// The file.
        path: PathBuf,
        /// What is missing, or the damage.
        source: ErrorCause,
    },
    /// It does not say how to go on.
    #[error("`{}` cannot be resumed: {source}; hint: `echolake recover` makes a run of what it holds", path.display())]
    NoPlan {
        /// The file.
        path: PathBuf,
        /// The missing or damaged plan.
        source: ErrorCause,
    },
    /// The run was finished or recovered before.
    #[error("`{}` is there already, made of this recording; hint: delete it if the recording is to be resumed", path.display())]
    Finished {
        /// The run's file.
        path: PathBuf,
    },
    /// The name is taken.
    #[error("`{}` is there already; hint: give another with -o", path.display())]
    Exists {
        /// The file that would have been written.
        path: PathBuf,
    },
    /// The system refused to write.
    #[error("cannot write `{}`: {source}; hint: is the disk full or read-only?", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's or the writer's error.
        source: ErrorCause,
    },
    /// What was written is not what was read; it was removed again.
    #[error("what was written to `{}` is not what was read: {source}; hint: is the disk sound?", path.display())]
    Unproven {
        /// The file that was removed.
        path: PathBuf,
        /// The difference.
        source: ErrorCause,
    },
}

impl From<PrefixError> for Error {
    fn from(error: PrefixError) -> Self {
        match error {
            PrefixError::Read { path, source } => Self::Read { path, source },
            PrefixError::Headless { path, bytes } => {
                Self::Headless { path, source: format!("it is no MCAP file, or only {bytes} bytes of one").into() }
            }
        }
    }
}
