//! Folders of a server, which only its user may look into: engines' sockets, and temporary files, on the lake's disk.

use std::fs::{File, OpenOptions, Permissions};
use std::io;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::Path;

use echolake_lake::Lake;
use echolake_service::Error;
use rustix::fs::{statfs, statvfs};
use rustix::process::geteuid;
use tempfile::{Builder, TempDir};

use crate::metrics::DiskSpace;

/// The folder in the lake for temporary files, if no other is given.
const IN_LAKE: &str = "temp";
/// Start of the names of servers' folders: for spilled rows, and for sockets.
const SPILLS_PREFIX: &str = "serve-";
const SOCKETS_PREFIX: &str = "echolake-serve-";
/// The file in a server's folder that it holds locked, so that servers of other machines or containers can tell, too.
const LOCK_FILE: &str = "echolake.lock";
/// A folder that only its user may look into: sockets answer without a token, and spilled rows are of any client.
const PRIVATE_MODE: u32 = 0o700;
/// The number that statfs tells of a file system in memory (`TMPFS_MAGIC` in linux/magic.h).
const TMPFS: u64 = 0x0102_1994;

/// The folders of a server; they are removed when this is dropped.
pub(super) struct ServerFolders {
    pub sockets: LockedFolder,
    pub spills: LockedFolder,
}

/// A folder whose process lives: its lock file is locked. It is removed when this is dropped.
pub(super) struct LockedFolder {
    folder: TempDir,
    // Let go after the folder is removed.
    _lock: File,
}

impl ServerFolders {
    /// Makes them. What servers left that were killed is removed first.
    ///
    /// # Errors
    /// [`Error::Temp`].
    pub fn new(lake: &Lake, temp: Option<&Path>) -> Result<Self, Error> {
        let system = std::env::temp_dir();
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| Error::Temp { path, source }
        };
        // A socket's path has some hundred bytes at most, so that the lake's own would often be too long.
        let sockets = LockedFolder::new(&system, SOCKETS_PREFIX).map_err(failed(&system))?;
        let spills = match (temp, lake.folder()) {
            (Some(temp), _) => LockedFolder::new(temp, SPILLS_PREFIX).map_err(failed(temp))?,
            (None, Some(lake)) => match LockedFolder::new(&lake.join(IN_LAKE), SPILLS_PREFIX) {
                Ok(folder) => folder,
                Err(refused) => {
                    tracing::warn!(
                        error = &refused as &dyn std::error::Error,
                        "temporary files are in `{}`, because the lake's folder takes none",
                        system.display()
                    );
                    LockedFolder::new(&system, SPILLS_PREFIX).map_err(failed(&system))?
                }
            },
            (None, None) => LockedFolder::new(&system, SPILLS_PREFIX).map_err(failed(&system))?,
        };
        if statfs(spills.path()).is_ok_and(|system| u64::try_from(system.f_type) == Ok(TMPFS)) {
            tracing::warn!("temporary files in `{}` are in memory; hint: --temp DIR", spills.path().display());
        }
        Ok(Self { sockets, spills })
    }
}

impl LockedFolder {
    fn new(parent: &Path, prefix: &str) -> io::Result<Self> {
        std::fs::create_dir_all(parent)?;
        remove_left_folders(parent, prefix)?;
        let private = Permissions::from_mode(PRIVATE_MODE);
        loop {
            let folder = Builder::new().prefix(prefix).permissions(private.clone()).tempdir_in(parent)?;
            let lock = File::create_new(folder.path().join(LOCK_FILE))?;
            // Where a file system has no locks, what is left stays.
            let _ = lock.lock();
            // Another server may have taken it for a left one before it was locked.
            if lock.metadata()?.nlink() > 0 {
                return Ok(Self { folder, _lock: lock });
            }
        }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

fn remove_left_folders(parent: &Path, prefix: &str) -> io::Result<()> {
    for entry in std::fs::read_dir(parent)? {
        let entry = entry?;
        if !entry.file_name().as_encoded_bytes().starts_with(prefix.as_bytes()) {
            continue;
        }
        // Others' folders in the system's are not looked into.
        if !entry.metadata().is_ok_and(|entry| entry.is_dir() && entry.uid() == geteuid().as_raw()) {
            continue;
        }
        let lock = OpenOptions::new().write(true).open(entry.path().join(LOCK_FILE));
        if lock.as_ref().is_ok_and(|lock| lock.try_lock().is_ok()) {
            // Another server may be removing it, too.
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
    Ok(())
}

/// Space of the file system that a folder is on; None if the system does not tell.
pub(super) fn disk_space(folder: &Path) -> Option<DiskSpace> {
    let system = statvfs(folder).ok()?;
    Some(DiskSpace { free_bytes: system.f_bavail * system.f_frsize, bytes: system.f_blocks * system.f_frsize })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_dead_servers_are_removed() {
        let parent = tempfile::tempdir().expect("a folder");
        let dead = parent.path().join("serve-dead");
        let unlocked = parent.path().join("serve-unlocked");
        let other = parent.path().join("somebody-else");
        for folder in [&dead, &unlocked, &other] {
            std::fs::create_dir_all(folder.join("engine-1")).expect("a folder");
        }
        for folder in [&dead, &other] {
            std::fs::write(folder.join(LOCK_FILE), "").expect("a file");
        }
        let live = LockedFolder::new(parent.path(), SPILLS_PREFIX).expect("a folder");
        let second = LockedFolder::new(parent.path(), SPILLS_PREFIX).expect("a folder");
        assert!(!dead.exists() && unlocked.exists() && other.exists());
        assert!(second.path().exists());
        assert_eq!(live.path().metadata().expect("a folder").mode() & 0o777, PRIVATE_MODE);
        drop(live);
        let left: Vec<_> = std::fs::read_dir(parent.path()).expect("a folder").collect();
        assert_eq!(left.len(), 3, "{left:?}");
    }
}
