//! Copies a run file into the inbox of a lake in a folder, such as a network's.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write as _;
use std::os::unix::fs::FileExt as _;
use std::path::{Path as FsPath, PathBuf};

use echolake_schema::ErrorCause;
use object_store::ObjectStoreExt as _;
use object_store::path::Path;

use super::{INBOX, RunUpload, UploadProgress, UploadStep};
use crate::run_digest::file_sha256;
use crate::{Error, Lake, Result};

/// Suffix of a file's name until it is whole. Its length says what is there already.
const STAGED: &str = "uploading";
/// Bytes that are copied at a time.
const BLOCK: u64 = 8 << 20;

/// Appends what is missing to the staged file, compares it, and gives it its name.
///
/// # Errors
/// [`Error::UploadBusy`], [`Error::UploadDamaged`] if what an earlier attempt left is not the file's beginning,
/// [`Error::UploadFile`], or what the store says.
pub(super) async fn send_to_folder(
    lake: &Lake,
    run: &RunUpload,
    to: &Path,
    progress: UploadProgress<'_>,
) -> Result<()> {
    let folder = lake.folder().ok_or_else(|| {
        let source = ErrorCause::from("it is neither a folder nor an object store");
        Error::Location { location: lake.location().to_owned(), source }
    })?;
    let staged = folder.join(INBOX).join(format!("{}.mcap.{STAGED}", run.run));
    let mut copy = open_staged(&staged, run)?;
    while copy.done < run.bytes {
        progress(UploadStep::Send, copy.done);
        copy = on_a_thread(&staged, move || copy.copy_block()).await?;
    }
    progress(UploadStep::Send, copy.done);
    let path = staged.clone();
    let digest = move || {
        copy.to.sync_all()?;
        file_sha256(&path, &mut |_| {})
    };
    let (actual, _) = on_a_thread(&staged, digest).await?;
    if actual != run.sha256 {
        std::fs::remove_file(&staged).map_err(|e| staged_error(&staged, e))?;
        let location = lake.location().to_owned();
        let path = to.to_string();
        let expected = run.sha256.clone();
        return Err(Error::UploadDamaged { location, path, expected, actual });
    }
    let from = Path::from(format!("{INBOX}/{}.mcap.{STAGED}", run.run));
    lake.store().rename(&from, to).await.map_err(|e| Error::store_failure("write", to, e))
}

/// A copy in progress.
struct FileCopy {
    from: File,
    to: File,
    done: u64,
    bytes: u64,
}

impl FileCopy {
    fn copy_block(mut self) -> std::io::Result<Self> {
        let mut block = vec![0; BLOCK.min(self.bytes - self.done) as usize];
        self.from.read_exact_at(&mut block, self.done)?;
        self.to.write_all(&block)?;
        self.done += block.len() as u64;
        Ok(self)
    }
}

fn open_staged(staged: &FsPath, run: &RunUpload) -> Result<FileCopy> {
    let failed = |source| Error::UploadFile { action: "read", file: run.file.clone(), source, hint: "" };
    let from = File::open(&run.file).map_err(failed)?;
    let failed = |source| staged_error(staged, source);
    let to = OpenOptions::new().append(true).create(true).open(staged).map_err(failed)?;
    match to.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Err(Error::UploadBusy { file: run.file.clone() }),
        Err(TryLockError::Error(source)) => return Err(failed(source)),
    }
    let mut done = to.metadata().map_err(failed)?.len();
    if done > run.bytes {
        to.set_len(0).map_err(failed)?;
        done = 0;
    }
    Ok(FileCopy { from, to, done, bytes: run.bytes })
}

async fn on_a_thread<T: Send + 'static>(
    staged: &FsPath,
    work: impl FnOnce() -> std::io::Result<T> + Send + 'static,
) -> Result<T> {
    let done = tokio::task::spawn_blocking(work).await.map_err(std::io::Error::other).flatten();
    done.map_err(|e| staged_error(staged, e))
}

fn staged_error(staged: &FsPath, source: std::io::Error) -> Error {
    let hint = "; hint: what is copied stays; run the command again to resume";
    Error::UploadFile { action: "copy to", file: PathBuf::from(staged), source, hint }
}
