//! Folders of a server: engines' sockets, which only its user may reach, and temporary files, on the lake's disk.

use std::io;
use std::path::{Path, PathBuf};

use echolake_lake::Lake;
use rustix::fs::{statfs, statvfs};
use tempfile::{Builder, TempDir};

use crate::Error;
use crate::metrics::DiskSpace;

/// The folder in the lake for temporary files, if no other is given.
const IN_LAKE: &str = "temp";
/// Prefix of a server's folder, before its process's number.
const PREFIX: &str = "serve-";
/// The number that statfs tells of a file system in memory (`TMPFS_MAGIC` in linux/magic.h).
const TMPFS: u64 = 0x0102_1994;

/// The folders of a server; they are removed when this is dropped.
pub(super) struct ServerFolders {
    pub(super) sockets: TempDir,
    pub(super) spills: TempDir,
}

impl ServerFolders {
    /// Makes them. What servers left that were killed is removed first.
    ///
    /// # Errors
    /// [`Error::Temp`].
    pub(super) fn new(lake: &Lake, temp: Option<&Path>) -> Result<Self, Error> {
        let system = std::env::temp_dir();
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| Error::Temp { path, source }
        };
        // A socket's path has some hundred bytes at most, so that the lake's own would often be too long.
        let sockets = Builder::new().prefix("echolake-").tempdir().map_err(failed(&system))?;
        let spills = match (temp, lake.folder()) {
            (Some(temp), _) => spill_folder(temp).map_err(failed(temp))?,
            (None, Some(lake)) => match spill_folder(&lake.join(IN_LAKE)) {
                Ok(folder) => folder,
                Err(refused) => {
                    tracing::warn!(
                        error = &refused as &dyn std::error::Error,
                        "temporary files are in `{}`, because the lake's folder takes none",
                        system.display()
                    );
                    spill_folder(&system).map_err(failed(&system))?
                }
            },
            (None, None) => spill_folder(&system).map_err(failed(&system))?,
        };
        if statfs(spills.path()).is_ok_and(|system| u64::try_from(system.f_type) == Ok(TMPFS)) {
            tracing::warn!("temporary files in `{}` are in memory; hint: --temp DIR", spills.path().display());
        }
        Ok(Self { sockets, spills })
    }
}

/// Space of the file system that a folder is on; None if the system does not tell.
pub(super) fn disk_space(folder: &Path) -> Option<DiskSpace> {
    let system = statvfs(folder).ok()?;
    Some(DiskSpace { free_bytes: system.f_bavail * system.f_frsize, bytes: system.f_blocks * system.f_frsize })
}

fn spill_folder(parent: &Path) -> io::Result<TempDir> {
    std::fs::create_dir_all(parent)?;
    for left in left_folders(parent)? {
        // Another server may be removing it, too.
        let _ = std::fs::remove_dir_all(left);
    }
    Builder::new().prefix(&format!("{PREFIX}{}-", std::process::id())).tempdir_in(parent)
}

fn left_folders(parent: &Path) -> io::Result<Vec<PathBuf>> {
    let mut left = Vec::new();
    for entry in std::fs::read_dir(parent)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let process = name.strip_prefix(PREFIX).and_then(|rest| rest.split('-').next()?.parse::<u32>().ok());
        if process.is_some_and(|process| !Path::new(&format!("/proc/{process}")).exists()) {
            left.push(entry.path());
        }
    }
    Ok(left)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_dead_servers_are_removed() {
        let parent = tempfile::tempdir().expect("a folder");
        // No process has this number: it is above the most that Linux gives.
        let dead = parent.path().join("serve-99999999-abc");
        let other = parent.path().join("somebody-else");
        std::fs::create_dir_all(dead.join("engine-1")).expect("a folder");
        std::fs::create_dir(&other).expect("a folder");
        let live = spill_folder(parent.path()).expect("a folder");
        let second = spill_folder(parent.path()).expect("a folder");
        assert!(!dead.exists() && other.exists() && live.path().exists() && second.path().exists());
    }
}
