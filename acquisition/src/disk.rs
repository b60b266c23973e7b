//! Disk primitives: free space, sync, and files that users name.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// Most bytes that are read of what is no plain file: a device may never end.
const MOST_PIPED: u64 = 64 << 20;

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

/// Opens a file that must be a plain one: a pipe blocks, and a device may never end.
///
/// # Errors
/// The system's, or that it is no plain file.
pub fn open_plain_file(path: &Path) -> io::Result<File> {
    match std::fs::metadata(path)?.is_file() {
        true => File::open(path),
        false => Err(io::Error::new(io::ErrorKind::InvalidInput, "it is no plain file")),
    }
}

/// A file, or 64 MiB of what is none, as a pipe: more is an error.
#[derive(Debug)]
pub struct BoundedFile {
    file: File,
    left: u64,
}

impl BoundedFile {
    /// Opens a file, a pipe or a device.
    ///
    /// # Errors
    /// The system's.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let left = if file.metadata()?.is_file() { u64::MAX } else { MOST_PIPED };
        Ok(Self { file, left })
    }
}

impl Read for BoundedFile {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        if self.left == 0 {
            let what = format!("it is no plain file, and does not end within {MOST_PIPED} bytes");
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, what));
        }
        let most = usize::try_from(self.left).unwrap_or(usize::MAX).min(into.len());
        let count = self.file.read(&mut into[..most])?;
        self.left -= count as u64;
        Ok(count)
    }
}

/// Reads the text of a [`BoundedFile`].
///
/// # Errors
/// The system's, or that it does not end, or is no UTF-8.
pub fn read_text_file(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    BoundedFile::open(path)?.read_to_string(&mut text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// E26: what never ends is refused; a pipe that ends is read.
    #[test]
    fn devices_and_pipes_are_bounded() {
        let device = Path::new("/dev/zero");
        let error = read_text_file(device).expect_err("endless").to_string();
        assert_eq!(error, "it is no plain file, and does not end within 67108864 bytes");
        assert_eq!(open_plain_file(device).expect_err("a device").to_string(), "it is no plain file");
        let (reader, mut writer) = io::pipe().expect("a pipe");
        io::Write::write_all(&mut writer, b"surface,").expect("written");
        drop(writer);
        let path = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&reader));
        assert_eq!(read_text_file(Path::new(&path)).expect("a text"), "surface,");
    }

    #[test]
    fn every_file_has_a_folder_that_can_be_synced() {
        for (path, folder) in [("run.mcap", "."), ("a/run.mcap", "a"), ("/run.mcap", "/")] {
            assert_eq!(folder_of(Path::new(path)), Path::new(folder), "{path}");
        }
    }
}
