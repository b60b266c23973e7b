//! From a whole recording to one that stands under its name, whatever happens to the power in between.

use std::fs::File;
use std::path::{Path, PathBuf};

use super::Error;

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
        let renamed = std::fs::rename(&self.partial, &self.path).map_err(|e| e.to_string());
        match renamed.and_then(|()| sync(folder_of(&self.path))) {
            Ok(()) => Ok(self.path),
            Err(reason) => Err(Error::Write { path: self.path, partial: self.partial, reason }),
        }
    }
}

/// Waits until a file's content, or a folder's entries, are on the disk.
pub(crate) fn sync(path: &Path) -> Result<(), String> {
    File::open(path).and_then(|f| f.sync_all()).map_err(|e| e.to_string())
}

/// The folder that a file stands in. A bare name's parent is the empty path, which nobody can open.
pub(crate) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_has_a_folder_that_can_be_synced() {
        for (path, folder) in [("run.mcap", "."), ("a/run.mcap", "a"), ("/run.mcap", "/")] {
            assert_eq!(folder_of(Path::new(path)), Path::new(folder), "{path}");
        }
    }
}
