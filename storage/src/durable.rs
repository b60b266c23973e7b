//! The local file system as an object store whose writes survive a power cut.
//!
//! `object_store`'s own `LocalFileSystem` syncs nothing, and links a file under its name before its data
//! are on the disk. Here data are synced first, then the name appears, then the folder is synced.

use std::fmt;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::ops::Range;
use std::path::{Path as FsPath, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use async_trait::async_trait;
use bytes::Bytes;
use futures::stream::BoxStream;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMode,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions, Result,
};

/// Distinguishes the temporary files of one process.
static NEXT_TEMPORARY: AtomicU64 = AtomicU64::new(0);

/// Folders of a lake that anybody may put files into.
const OPEN_FOLDERS: [&str; 2] = ["inbox", "quarantine"];

/// The whole local file system; paths are absolute.
#[derive(Debug)]
pub(crate) struct DurableFileSystem {
    inner: LocalFileSystem,
    /// The lake that is read and written by it.
    lake: PathBuf,
}

impl DurableFileSystem {
    pub fn new(lake: &FsPath) -> Self {
        Self { inner: LocalFileSystem::new(), lake: lake.to_owned() }
    }

    // Opening a named pipe waits for its other end. A link in a folder that anybody may put files into is not followed:
    // it would show files that are none of the lake's.
    fn refuse_special(&self, location: &Path) -> Result<()> {
        let path = self.inner.path_to_filesystem(location)?;
        let what = match fs::metadata(&path) {
            Ok(meta) if !meta.is_file() && !meta.is_dir() => "is no file",
            Ok(_) if self.is_behind_link(&path) => "is a symbolic link, or below one, which is not followed",
            _ => return Ok(()),
        };
        let source = io::Error::new(ErrorKind::InvalidInput, format!("`{}` {what}", path.display()));
        Err(Error::Generic { store: "DurableFileSystem", source: Box::new(source) })
    }

    fn is_behind_link(&self, path: &FsPath) -> bool {
        let Ok(within) = path.strip_prefix(&self.lake) else { return false };
        let mut parts = within.components();
        let Some(top) = parts.next().filter(|top| OPEN_FOLDERS.iter().any(|open| top.as_os_str() == *open)) else {
            return false;
        };
        let mut at = self.lake.join(top);
        parts.any(|part| {
            at.push(part);
            at.is_symlink()
        })
    }

    // One renamed or copied file is as durable as its folder's entry.
    async fn sync_entry(&self, location: &Path) -> Result<()> {
        let path = self.inner.path_to_filesystem(location)?;
        run_blocking(move || File::open(&path)?.sync_all().and_then(|()| sync_folder(&path)), location).await
    }
}

impl fmt::Display for DurableFileSystem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("DurableFileSystem")
    }
}

#[async_trait]
impl ObjectStore for DurableFileSystem {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> Result<PutResult> {
        let path = self.inner.path_to_filesystem(location)?;
        match opts.mode {
            PutMode::Overwrite => run_blocking(move || write_synced(&path, &payload, fs::rename), location).await?,
            PutMode::Create => run_blocking(move || write_synced(&path, &payload, link_into_place), location).await?,
            PutMode::Update(_) => return self.inner.put_opts(location, payload, opts).await,
        }
        Ok(PutResult { e_tag: None, version: None })
    }

    async fn put_multipart_opts(&self, location: &Path, opts: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, opts).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.refuse_special(location)?;
        self.inner.get_opts(location, options).await
    }

    // Reads all ranges with the file open once, and nothing between them; the trait's default would request each by
    // itself and read the bytes between near ones.
    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.refuse_special(location)?;
        self.inner.get_ranges(location, ranges).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await?;
        self.sync_entry(to).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.inner.rename_opts(from, to, options).await?;
        self.sync_entry(to).await
    }
}

async fn run_blocking(work: impl FnOnce() -> io::Result<()> + Send + 'static, location: &Path) -> Result<()> {
    let done = tokio::task::spawn_blocking(work).await.map_err(|source| Error::JoinError { source })?;
    done.map_err(|source| {
        let path = location.to_string();
        match source.kind() {
            ErrorKind::AlreadyExists => Error::AlreadyExists { path, source: Box::new(source) },
            ErrorKind::NotFound => Error::NotFound { path, source: Box::new(source) },
            _ => Error::Generic { store: "DurableFileSystem", source: Box::new(source) },
        }
    })
}

// Data, then name, then folder: at no moment does the name refer to less than the whole file.
fn write_synced(
    path: &FsPath,
    payload: &PutPayload,
    publish: fn(PathBuf, PathBuf) -> io::Result<()>,
) -> io::Result<()> {
    let folder = path.parent().ok_or(ErrorKind::InvalidInput)?;
    create_folders(folder)?;
    let temporary = temporary_beside(path);
    let written = (|| {
        let mut file = OpenOptions::new().write(true).create_new(true).open(&temporary)?;
        payload.iter().try_for_each(|part| file.write_all(part))?;
        file.sync_all()?;
        publish(temporary.clone(), path.to_owned())
    })();
    if written.is_err() {
        // The first error is the one to report.
        let _ = fs::remove_file(&temporary);
    }
    written.and_then(|()| sync_folder(path))
}

// A hard link fails if the name is taken, a rename does not.
fn link_into_place(from: PathBuf, to: PathBuf) -> io::Result<()> {
    fs::hard_link(&from, to)?;
    fs::remove_file(from)
}

// LocalFileSystem leaves out of its listings what ends in `#` and digits.
fn temporary_beside(path: &FsPath) -> PathBuf {
    let number = NEXT_TEMPORARY.fetch_add(1, Ordering::Relaxed);
    let mut name = path.as_os_str().to_owned();
    name.push(format!("#{}{number:06}", std::process::id()));
    name.into()
}

fn create_folders(folder: &FsPath) -> io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    if let Some(parent) = folder.parent() {
        create_folders(parent)?;
    }
    match fs::create_dir(folder) {
        Err(e) if e.kind() != ErrorKind::AlreadyExists => Err(e),
        _ => sync_folder(folder),
    }
}

fn sync_folder(path: &FsPath) -> io::Result<()> {
    path.parent().map_or(Ok(()), |folder| File::open(folder)?.sync_all())
}

#[cfg(test)]
mod tests {
    use futures::TryStreamExt as _;
    use object_store::ObjectStoreExt as _;

    use super::*;

    fn at(folder: &tempfile::TempDir, name: &str) -> Path {
        Path::from_absolute_path(folder.path().join(name)).expect("a path")
    }

    #[tokio::test]
    async fn create_refuses_a_taken_name_and_leaves_nothing_behind() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = DurableFileSystem::new(folder.path());
        let path = at(&folder, "a/b/c");
        store.put_opts(&path, "first".into(), PutMode::Create.into()).await.expect("new");
        let again = store.put_opts(&path, "second".into(), PutMode::Create.into()).await;
        assert!(matches!(again, Err(Error::AlreadyExists { .. })), "{again:?}");
        assert_eq!(store.get(&path).await.expect("there").bytes().await.expect("bytes"), "first");
        store.put(&path, "third".into()).await.expect("overwritten");
        assert_eq!(store.get(&path).await.expect("there").bytes().await.expect("bytes"), "third");
        assert_eq!(fs::read_dir(folder.path().join("a/b")).expect("a folder").count(), 1);
    }

    #[tokio::test]
    async fn links_in_the_inbox_are_not_followed_and_those_of_the_owner_are() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = DurableFileSystem::new(folder.path());
        for name in ["elsewhere/secret", "moved/run", "inbox/plain"] {
            store.put(&at(&folder, name), "x".into()).await.expect("written");
        }
        let link = |to: &str, name: &str| {
            std::os::unix::fs::symlink(folder.path().join(to), folder.path().join(name)).expect("linked");
        };
        link("elsewhere/secret", "inbox/link");
        link("elsewhere", "inbox/folder");
        link("moved", "runs");
        let read = async |name: &str| store.get(&at(&folder, name)).await.map(|_| ());
        for name in ["inbox/link", "inbox/folder/secret"] {
            let refused = read(name).await.expect_err(name).to_string();
            assert!(refused.contains("which is not followed"), "{refused}");
            let ranges = store.get_ranges(&at(&folder, name), std::slice::from_ref(&(0..1))).await;
            assert!(ranges.is_err(), "{name}");
        }
        for name in ["inbox/plain", "runs/run"] {
            read(name).await.expect(name);
        }
    }

    #[tokio::test]
    async fn temporary_files_are_not_listed() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = DurableFileSystem::new(folder.path());
        store.put(&at(&folder, "seen"), "x".into()).await.expect("written");
        fs::write(temporary_beside(&folder.path().join("lost")), "half").expect("written");
        let listed: Vec<_> = store.list(Some(&at(&folder, ""))).try_collect().await.expect("listed");
        assert_eq!(listed.len(), 1, "{listed:?}");
    }
}
