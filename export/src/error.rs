//! Errors of an export, by what the caller can do about them.

use std::path::{Path, PathBuf};

use echolake_schema::{ErrorCause, RunId};

/// An error of an export. No partial output is left under its final name.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The output exists already.
    #[error("`{}` is there already; hint: {hint}", path.display())]
    Exists {
        /// The file or folder.
        path: PathBuf,
        /// Advice for the user.
        hint: &'static str,
    },
    /// The system refused to write.
    #[error(
        "cannot write `{}`: {source}; hint: is its folder there and writable, and its disk not full?",
        path.display()
    )]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The error of the system, or of what encodes.
        source: ErrorCause,
    },
    /// There is nothing to export.
    #[error("nothing to export: {reason}")]
    Nothing {
        /// The reason, and advice for the user.
        reason: String,
    },
    /// A dry recording is none of sound, or cannot be read.
    #[error("the dry recording: {source}")]
    Dry {
        /// The reason, and advice for the user.
        source: ErrorCause,
    },
    /// A name that the lake does not have.
    #[error("there is no {kind} `{name}`; hint: there are {known}")]
    Unknown {
        /// Column, topic or surface.
        kind: &'static str,
        /// The requested name.
        name: String,
        /// The known names.
        known: String,
    },
    /// The lake cannot be split that way.
    #[error("the lake cannot be split {by}: {reason}")]
    Split {
        /// The kind of split.
        by: &'static str,
        /// The reason, and advice for the user.
        reason: String,
    },
    /// A file of the lake does not agree with its commit log.
    #[error("`{file}` is damaged: {source}; hint: `echolake doctor` says what is")]
    Damaged {
        /// The file.
        file: String,
        /// The damage.
        source: ErrorCause,
    },
    /// A run's file is not the one that was ingested.
    #[error(
        "`{file}` is not the file that run {run} was ingested from: {source}; hint: bring the original back, `echolake \
         doctor` lists all"
    )]
    Changed {
        /// The run.
        run: RunId,
        /// Its file.
        file: String,
        /// The difference, expected and actual; or the error of the store.
        source: ErrorCause,
    },
    /// A run's file cannot be sliced.
    #[error("run {run} cannot be cut: {reason}")]
    Uncuttable {
        /// The run.
        run: RunId,
        /// The reason, and advice for the user.
        reason: String,
    },
    /// An error of the lake.
    #[error(transparent)]
    Lake(#[from] echolake_lake::Error),
    /// A rig or id that is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
}

/// The result of an export.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    pub(crate) fn write(path: &Path, source: impl Into<ErrorCause>) -> Self {
        Self::Write { path: path.to_owned(), source: source.into() }
    }

    pub(crate) fn damaged(file: impl ToString, source: impl Into<ErrorCause>) -> Self {
        Self::Damaged { file: file.to_string(), source: source.into() }
    }
}
