//! From a whole recording to one that stands under its name, whatever happens to the power in between.

use std::path::{Path, PathBuf};

use super::Error;
use crate::disk::{folder_of, sync_to_disk};

/// A recording that is whole and on the disk as `<path>.partial`. Dropped, it stays there.
#[derive(Debug)]
pub struct Sealed {
    path: PathBuf,
    partial: PathBuf,
}

impl Sealed {
    pub(super) fn new(path: PathBuf, partial: PathBuf) -> Self {
        Self { path, partial }
    }

    /// Where it will stand.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives it its name; returns its path.
    ///
    /// # Errors
    /// [`Error::Exists`] where the name was taken meanwhile, or [`Error::Write`].
    pub fn publish(self) -> Result<PathBuf, Error> {
        if self.path.exists() {
            return Err(Error::Exists { path: self.path });
        }
        let renamed = std::fs::rename(&self.partial, &self.path);
        match renamed.and_then(|()| sync_to_disk(folder_of(&self.path))) {
            Ok(()) => Ok(self.path),
            Err(e) => Err(Error::Write { path: self.path, partial: self.partial, source: e.into() }),
        }
    }
}
