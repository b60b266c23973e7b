//! Where a run's file is, and whether it is whole.

use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;

use echolake_lake::Lake;
use echolake_recording::{FILE_END_BYTES, MAGIC, has_file_end};
use echolake_schema::RunId;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};

use crate::error::{Error, Result};

/// Folder of runs that are not ingested yet.
pub(super) const INBOX: &str = "inbox";

/// Location of a run's file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RunSource {
    /// In the lake: under `inbox/` or `runs/`.
    Lake(Path),
    /// Anywhere else on this machine.
    File(PathBuf),
}

impl std::fmt::Display for RunSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Lake(path) => path.fmt(f),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// A source that is opened for reading.
pub(crate) struct OpenedRun {
    pub store: Arc<dyn ObjectStore>,
    pub path: Path,
    /// Name for messages.
    pub name: String,
}

impl RunSource {
    pub(crate) fn open_run(&self, lake: &Lake) -> Result<OpenedRun> {
        let name = self.to_string();
        match self {
            Self::Lake(path) => Ok(OpenedRun { store: lake.store(), path: path.clone(), name }),
            Self::File(file) if !file.is_file() => Err(Error::NoRun { given: name }),
            Self::File(file) => {
                let path = absolute_path(file)?;
                Ok(OpenedRun { store: Arc::new(LocalFileSystem::new()), path, name })
            }
        }
    }

    /// Name of the work on it, for claims: that of its file, which most often stays the same when it is moved.
    pub(crate) fn work_name(&self) -> &str {
        let name = match self {
            Self::Lake(path) => path.filename(),
            Self::File(path) => path.file_name().and_then(|name| name.to_str()),
        };
        name.unwrap_or_default()
    }

    /// The run whose place in the lake it is; None if it is elsewhere.
    pub(crate) fn run_in_place(&self) -> Option<RunId> {
        let Self::Lake(path) = self else { return None };
        path.filename()?.strip_suffix(".mcap")?.parse().ok().filter(|_| !self.is_in_inbox())
    }

    /// Whether another program may still be copying it: an object appears as a whole, and ingest itself fills `runs/`.
    pub(crate) fn may_be_copied(&self, lake: &Lake) -> bool {
        match self {
            Self::Lake(_) => self.is_in_inbox() && !lake.is_remote(),
            Self::File(_) => true,
        }
    }

    pub(super) fn is_in_inbox(&self) -> bool {
        matches!(self, Self::Lake(path) if path.parts().next().is_some_and(|p| p.as_ref() == INBOX))
    }
}

/// Returns the path of a lake's file on this machine; None for a lake on an object store.
pub(super) fn local_file(lake: &Lake, path: &Path) -> Option<PathBuf> {
    Some(lake.folder()?.join(path.as_ref()))
}

/// Returns whether a run file of the lake ends as a closed file does.
///
/// # Errors
/// What the store says.
pub async fn has_end(lake: &Lake, path: &Path) -> object_store::Result<bool> {
    has_end_at(lake.store().as_ref(), path, lake.store().head(path).await?.size).await
}

/// Returns whether the first `bytes` bytes of a file end as a closed file does.
pub(crate) async fn has_end_at(store: &dyn ObjectStore, path: &Path, bytes: u64) -> object_store::Result<bool> {
    if bytes < FILE_END_BYTES {
        return Ok(false);
    }
    Ok(has_file_end(&store.get_range(path, bytes - FILE_END_BYTES..bytes).await?))
}

/// Checks that a file ends as a closed file does. What is no MCAP file at all is left to its reader.
///
/// # Errors
/// [`Error::Unfinished`], [`Error::Gone`], [`Error::Read`].
pub(crate) async fn check_end(opened: &OpenedRun) -> Result<()> {
    let failed = |e: object_store::Error| match e {
        object_store::Error::NotFound { .. } => Error::Gone { file: opened.name.clone() },
        e => Error::read_failure(&opened.name, e),
    };
    let bytes = opened.store.head(&opened.path).await.map_err(failed)?.size;
    if has_end_at(opened.store.as_ref(), &opened.path, bytes).await.map_err(failed)? {
        return Ok(());
    }
    let first = match bytes.min(MAGIC.len() as u64) {
        0 => bytes::Bytes::new(),
        length => opened.store.get_range(&opened.path, 0..length).await.map_err(failed)?,
    };
    // A copy of which nothing is written yet may have its size already.
    let is_begun = MAGIC.starts_with(&first) || first.iter().all(|byte| *byte == 0);
    if is_begun { Err(Error::Unfinished { file: opened.name.clone(), bytes }) } else { Ok(()) }
}

/// Returns the absolute path of a file of this machine, for its store.
pub(super) fn absolute_path(file: &FsPath) -> Result<Path> {
    let absolute = std::path::absolute(file).map_err(|e| Error::read_failure(file.display(), e))?;
    Path::from_absolute_path(absolute).map_err(|e| Error::read_failure(file.display(), e))
}
