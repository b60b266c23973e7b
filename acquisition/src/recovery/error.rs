//! Why a recording cannot be recovered or resumed.

use std::path::PathBuf;

use echolake_recording::ResyncError;
use echolake_schema::ErrorCause;

/// Why a recording cannot be recovered or resumed. The recording itself is as it was.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The system refused to read it.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: ErrorCause,
    },
    /// Somebody records it.
    #[error("`{}` is being recorded; hint: stop that `echolake acquire` first", path.display())]
    Busy {
        /// The file.
        path: PathBuf,
    },
    /// Nothing was measured into it, or nothing of that can be read.
    #[error("`{}` holds no run: {source}; hint: no measurement in it can be read, measure again", path.display())]
    Headless {
        /// The file.
        path: PathBuf,
        /// What is missing, or the damage.
        source: ErrorCause,
    },
    /// There are whole measurements in it, but no run can be made of them.
    #[error(
        "no run can be made of `{}`: {source}; hint: keep the file, and look for another copy of it",
        path.display()
    )]
    Unusable {
        /// The file.
        path: PathBuf,
        /// What is missing or damaged, and what is whole.
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
    #[error(
        "`{}` is there already, made of this recording; hint: delete it if the recording is to be resumed",
        path.display()
    )]
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

impl From<ResyncError> for Error {
    fn from(error: ResyncError) -> Self {
        match error {
            ResyncError::Read { file, source } => Self::Read { path: file.into(), source },
            ResyncError::Gone { file } => Self::Read { path: file.into(), source: "it is gone".into() },
            ResyncError::NotMcap { file, actual } => Self::Headless {
                path: file.into(),
                source: format!("it is no MCAP file: it begins with {actual}").into(),
            },
        }
    }
}
