//! Disk primitives: free space, and sync.

use std::fs::File;
use std::io;
use std::path::Path;

/// Returns the bytes that this process may still write in the file system of `path`.
///
/// # Errors
/// The system's error if there is no `path`.
pub fn free_bytes(path: &Path) -> io::Result<u64> {
    let stat = rustix::fs::statvfs(path)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Waits until a file's content, or a folder's entries, are on the disk.
pub(crate) fn sync_to_disk(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Returns a file's folder. A bare name's parent is the empty path, which cannot be opened.
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
