//! The state of a run's file when its reading began, against which every later step checks it.

use std::fs::{self, Metadata};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt as _;

use chrono::{DateTime, Utc};
use echolake_lake::{Lake, digest_record_path, read_digest_record};
use echolake_recording::FileIntegrity;
use object_store::ObjectStoreExt as _;
use object_store::path::Path;

use super::run_source::{RunSource, local_file};
use crate::error::{Error, Result};

/// Maximum length of a file's name on most file systems, bytes.
const LONGEST_FILE_NAME: usize = 255;

/// A file of this machine at a moment: what changes if another program writes it or replaces it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FileState {
    inode: u64,
    bytes: u64,
    changed: DateTime<Utc>,
}

impl FileState {
    /// Returns the state of a source on this machine; None on an object store.
    ///
    /// # Errors
    /// [`Error::Gone`], or [`Error::Read`] if it is no plain file.
    pub fn from_source(lake: &Lake, source: &RunSource) -> Result<Option<Self>> {
        let found = match source {
            // No link in the lake is followed, also if it has just taken a file's place.
            RunSource::Lake(path) => match local_file(lake, path) {
                Some(file) => fs::symlink_metadata(file),
                None => return Ok(None),
            },
            RunSource::File(file) => fs::metadata(file),
        };
        let meta = found.map_err(|e| match e.kind() {
            ErrorKind::NotFound => Error::Gone { file: source.to_string() },
            _ => Error::read_failure(source, e),
        })?;
        if !meta.is_file() {
            return Err(Error::read_failure(source, io::Error::new(ErrorKind::InvalidInput, "it is no plain file")));
        }
        Ok(Some(Self::from_metadata(&meta)))
    }

    fn from_metadata(meta: &Metadata) -> Self {
        let changed = meta.modified().map(DateTime::<Utc>::from).unwrap_or_default();
        Self { inode: meta.ino(), bytes: meta.len(), changed }
    }

    /// Checks that the file is as it was.
    ///
    /// # Errors
    /// [`Error::Changed`], [`Error::Gone`].
    pub fn check_state(before: Option<Self>, lake: &Lake, source: &RunSource) -> Result<()> {
        let (Some(before), Some(after)) = (before, Self::from_source(lake, source)?) else { return Ok(()) };
        if before == after {
            return Ok(());
        }
        Err(Error::Changed { file: source.to_string(), before: before.to_string(), after: after.to_string() })
    }
}

impl std::fmt::Display for FileState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} bytes of {} (inode {})", self.bytes, self.changed.format("%H:%M:%S%.6f"), self.inode)
    }
}

/// A run's file as it was read.
pub(crate) struct ReadFile<'a> {
    pub integrity: &'a FileIntegrity,
    /// Tag of the object when its reading began, if its store has tags.
    pub e_tag: Option<String>,
    /// Its state when its reading began, if it is on this machine.
    pub state: Option<FileState>,
    /// SHA-256 that was recorded when it was uploaded.
    pub recorded: Option<String>,
}

impl<'a> ReadFile<'a> {
    /// Compares what was read with what was uploaded, if an upload recorded it.
    ///
    /// # Errors
    /// [`Error::OtherDigest`], or an error of the lake.
    pub async fn check_digest(
        lake: &Lake,
        source: &RunSource,
        FileVersion { e_tag, state }: FileVersion,
        integrity: &'a FileIntegrity,
    ) -> Result<Self> {
        let recorded = recorded_digest(lake, source).await?;
        match recorded {
            Some(recorded) if recorded != integrity.sha256 => {
                let actual = integrity.sha256.clone();
                Err(Error::OtherDigest { file: source.to_string(), recorded, actual })
            }
            recorded => Ok(Self { integrity, e_tag, state, recorded }),
        }
    }
}

/// Reads the SHA-256 that was recorded when a file of the inbox was uploaded.
pub(super) async fn recorded_digest(lake: &Lake, source: &RunSource) -> Result<Option<String>> {
    match source {
        RunSource::Lake(path) if source.is_in_inbox() && can_have_record(path) => {
            read_digest_record(lake.store().as_ref(), path).await.map_err(|e| Error::read_failure(source, e))
        }
        _ => Ok(None),
    }
}

/// Returns whether a record of its digest may be beside a file: no file has a name that is too long for one.
pub(super) fn can_have_record(path: &Path) -> bool {
    digest_record_path(path).filename().is_some_and(|name| name.len() <= LONGEST_FILE_NAME)
}

/// ETag and state of a file, by which a change since its reading began is noticed.
pub(crate) struct FileVersion {
    e_tag: Option<String>,
    state: Option<FileState>,
}

impl FileVersion {
    /// Reads the version of a source, before it is read itself.
    ///
    /// # Errors
    /// As of [`FileState::from_source`].
    pub async fn from_source(lake: &Lake, source: &RunSource) -> Result<Self> {
        let e_tag = match source {
            RunSource::Lake(path) if lake.is_remote() && source.is_in_inbox() => {
                lake.store().head(path).await.ok().and_then(|meta| meta.e_tag)
            }
            _ => None,
        };
        Ok(Self { e_tag, state: FileState::from_source(lake, source)? })
    }
}

/// Checks that a file is as it was when its reading began.
///
/// # Errors
/// [`Error::Changed`], [`Error::Gone`].
pub(crate) fn check_unchanged(lake: &Lake, source: &RunSource, file: &ReadFile<'_>) -> Result<()> {
    FileState::check_state(file.state, lake, source)
}
