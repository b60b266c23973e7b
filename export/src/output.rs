//! Files and folders that get their final name only once they are complete and synced to disk.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use crate::error::{Error, Result};

/// Size of a file's write buffer, bytes.
const BUFFER: usize = 256 * 1024;
const TAKEN: &str = "another export is at work there, or one was killed: then delete it";

/// A folder that is being written. Dropped before [`PendingFolder::publish`], it is removed.
#[derive(Debug)]
pub(crate) struct PendingFolder {
    path: PathBuf,
    partial: PathBuf,
    published: bool,
}

impl PendingFolder {
    /// Creates a partial folder for `path`, where nothing or an empty folder may exist.
    pub fn create(path: &Path) -> Result<Self> {
        let empty = fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
        if path.symlink_metadata().is_ok() && !empty {
            return Err(Error::Exists { path: path.to_owned(), hint: "name a new folder" });
        }
        let partial = partial_of(path);
        match fs::create_dir(&partial) {
            Ok(()) => Ok(Self { path: path.to_owned(), partial, published: false }),
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => Err(Error::Exists { path: partial, hint: TAKEN }),
            Err(e) => Err(Error::write(path, e)),
        }
    }

    /// Creates a file in the folder; `name` may contain folders.
    pub fn create_file(&self, name: &str) -> Result<HashedFile> {
        let path = self.partial.join(name);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(|e| Error::write(&self.path.join(name), e))?;
        }
        HashedFile::create(&path, &self.path.join(name), name)
    }

    /// Writes a small file.
    pub fn write_file(&self, name: &str, content: &[u8]) -> Result<WrittenFile> {
        let mut file = self.create_file(name)?;
        file.write_all(content).map_err(|e| Error::write(&self.path.join(name), e))?;
        file.finish()
    }

    /// Returns the final path of a file, for messages.
    pub fn final_path(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Returns the path of a file while the folder is being written.
    pub fn partial_path(&self, name: &str) -> PathBuf {
        self.partial.join(name)
    }

    /// Syncs the folder and renames it to its final name.
    pub fn publish(mut self) -> Result<()> {
        let named = sync_tree(&self.partial).and_then(|()| fs::rename(&self.partial, &self.path));
        named.and_then(|()| sync_parent(&self.path)).map_err(|e| Error::write(&self.path, e))?;
        self.published = true;
        Ok(())
    }
}

impl Drop for PendingFolder {
    fn drop(&mut self) {
        if !self.published {
            // The caller reports the first failure; this one would hide it.
            let _ = fs::remove_dir_all(&self.partial);
        }
    }
}

/// A file that is being written, hashed on the way.
#[derive(Debug)]
pub(crate) struct HashedFile {
    file: BufWriter<File>,
    named: PathBuf,
    name: String,
    sha: Sha256,
    bytes: u64,
}

/// A file that was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WrittenFile {
    /// Its name in the folder.
    pub name: String,
    /// Its size.
    pub bytes: u64,
    /// SHA-256 of its content, hexadecimal.
    pub sha256: String,
}

impl HashedFile {
    fn create(path: &Path, named: &Path, name: &str) -> Result<Self> {
        let file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| Error::write(named, e))?;
        let file = BufWriter::with_capacity(BUFFER, file);
        Ok(Self { file, named: named.to_owned(), name: name.to_owned(), sha: Sha256::new(), bytes: 0 })
    }

    /// Flushes the file and syncs it to disk.
    pub fn finish(mut self) -> Result<WrittenFile> {
        let synced = self.file.flush().and_then(|()| self.file.get_ref().sync_all());
        synced.map_err(|e| Error::write(&self.named, e))?;
        Ok(WrittenFile { name: self.name, bytes: self.bytes, sha256: hex::encode(self.sha.finalize()) })
    }
}

impl Write for HashedFile {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let count = self.file.write(data)?;
        self.sha.update(&data[..count]);
        self.bytes += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// A single file that is being written. Dropped before [`PendingFile::publish`], it is removed.
#[derive(Debug)]
pub struct PendingFile {
    file: Option<BufWriter<File>>,
    path: PathBuf,
    partial: PathBuf,
}

impl PendingFile {
    /// Creates a partial file for `path`, where nothing may exist.
    ///
    /// # Errors
    /// [`Error::Exists`] or [`Error::Write`].
    pub fn create(path: &Path) -> Result<Self> {
        if path.symlink_metadata().is_ok() {
            return Err(Error::Exists { path: path.to_owned(), hint: "name a new file" });
        }
        let partial = partial_of(path);
        match OpenOptions::new().write(true).create_new(true).open(&partial) {
            Ok(file) => {
                let file = Some(BufWriter::with_capacity(BUFFER, file));
                Ok(Self { file, path: path.to_owned(), partial })
            }
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => Err(Error::Exists { path: partial, hint: TAKEN }),
            Err(e) => Err(Error::write(path, e)),
        }
    }

    /// Returns the path while the file is being written, for libraries that open files themselves.
    pub fn partial_path(&self) -> &Path {
        &self.partial
    }

    /// Appends data to the file.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn write(&mut self, data: &[u8]) -> Result<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        file.write_all(data).map_err(|e| Error::write(&self.path, e))
    }

    /// Syncs the file to disk and renames it to its final name.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn publish(mut self) -> Result<()> {
        let ended = match self.file.take() {
            Some(file) => file.into_inner().map_err(io::IntoInnerError::into_error),
            None => File::open(&self.partial),
        };
        let synced = ended.and_then(|_| File::open(&self.partial)).and_then(|file| file.sync_all());
        let named = synced.and_then(|()| fs::rename(&self.partial, &self.path)).and_then(|()| sync_parent(&self.path));
        named.map_err(|e| Error::write(&self.path, e))
    }
}

impl Drop for PendingFile {
    fn drop(&mut self) {
        // After publishing there is no such file; before it, the caller reports the first failure.
        let _ = fs::remove_file(&self.partial);
    }
}

fn partial_of(path: &Path) -> PathBuf {
    let plain: PathBuf = path.components().collect();
    let mut name = plain.into_os_string();
    name.push(".partial");
    name.into()
}

fn sync_tree(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_tree(&entry.path())?;
        }
    }
    File::open(folder)?.sync_all()
}

// A bare name's parent is the empty path, which cannot be opened.
fn sync_parent(path: &Path) -> io::Result<()> {
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(parent)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_published_leaves_nothing() {
        let home = tempfile::tempdir().expect("a folder");
        let path = home.path().join("set");
        let folder = PendingFolder::create(&path).expect("begun");
        folder.write_file("a/b.txt", b"x").expect("written");
        assert!(matches!(PendingFolder::create(&path), Err(Error::Exists { .. })), "two at once");
        drop(folder);
        let mut file = PendingFile::create(&home.path().join("one.mcap")).expect("begun");
        file.write(b"half").expect("written");
        drop(file);
        assert_eq!(fs::read_dir(home.path()).expect("listed").count(), 0);
    }

    #[test]
    fn what_is_there_is_never_overwritten() {
        let home = tempfile::tempdir().expect("a folder");
        let path = home.path().join("set");
        fs::create_dir(&path).expect("an empty folder");
        let folder = PendingFolder::create(&path).expect("an empty folder will do");
        let written = folder.write_file("a.txt", b"abc").expect("written");
        assert_eq!(written.sha256, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        folder.publish().expect("named");
        assert_eq!(fs::read(path.join("a.txt")).expect("there"), b"abc");
        let again = PendingFolder::create(&path).expect_err("taken").to_string();
        assert!(again.contains("is there already"), "{again}");
        let taken = PendingFile::create(&path.join("a.txt")).expect_err("taken").to_string();
        assert!(taken.contains("is there already"), "{taken}");
    }
}
