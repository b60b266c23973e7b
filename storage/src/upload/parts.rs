//! Sends a run file to an object store in parts.

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::Path as FsPath;

use futures::{StreamExt as _, TryStreamExt as _, stream};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStoreExt as _};

use super::journal::UploadJournal;
use super::{RunUpload, UploadProgress, UploadStep};
use crate::remote::PartStore;
use crate::{Error, Lake, Result};

/// Bytes of a part, but for files that would have too many.
const PART: u64 = 8 << 20;
/// Most parts of an object of S3.
const MOST_PARTS: u64 = 10_000;
/// Parts on their way at once.
pub(crate) const PARTS_AT_ONCE: usize = 2;
/// Granularity of the parts of large files.
const PART_STEP: u64 = 1 << 20;

/// Failure of one attempt.
enum SendFault {
    /// The store does not know the upload any more.
    Forgotten(StoreError),
    Failed(Error),
}

impl From<Error> for SendFault {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

// All parts of a file but the last have the same size, which follows from the file's alone.
pub(crate) fn part_bytes(bytes: u64) -> u64 {
    PART.max(bytes.div_ceil(MOST_PARTS).next_multiple_of(PART_STEP))
}

/// Sends what is missing of a file, and makes the object.
///
/// # Errors
/// [`Error::UploadFile`], or what the store says. What was sent is in the journal.
pub(super) async fn send_parts(
    lake: &Lake,
    store: &PartStore,
    journal: &mut UploadJournal,
    run: &RunUpload,
    to: &Path,
    progress: UploadProgress<'_>,
) -> Result<()> {
    if journal.is_begun() {
        match try_send(lake, store, journal, run, to, progress).await {
            // The store has aborted the upload, as its rule may say after a day.
            Err(SendFault::Forgotten(_)) => journal.restart_upload()?,
            done => return done.map_err(|fault| fault.into_error(to)),
        }
    }
    try_send(lake, store, journal, run, to, progress).await.map_err(|fault| fault.into_error(to))
}

async fn try_send(
    lake: &Lake,
    store: &PartStore,
    journal: &mut UploadJournal,
    run: &RunUpload,
    to: &Path,
    progress: UploadProgress<'_>,
) -> std::result::Result<(), SendFault> {
    let upload = match journal.upload_id() {
        Some(upload) => upload.to_owned(),
        None => {
            let upload =
                store.begin_upload(to).await.map_err(|e| Error::store_failure("begin the upload of", to, e))?;
            journal.begin_upload(upload.clone())?;
            upload
        }
    };
    let size = part_bytes(run.bytes);
    let count = run.bytes.div_ceil(size) as usize;
    let range = |number: usize| {
        let begin = number as u64 * size;
        begin..(begin + size).min(run.bytes)
    };
    let mut sent: u64 =
        journal.part_ids().keys().map(|number| range(*number)).map(|r| r.end.saturating_sub(r.start)).sum();
    progress(UploadStep::Send, sent);
    let missing: Vec<_> = (0..count).filter(|number| !journal.part_ids().contains_key(number)).collect();
    let send_one = |number: usize| {
        let upload = &upload;
        let range = range(number);
        async move {
            let part = read_part(&run.file, range).await?;
            let id = store.put_part(to, upload, number, part.into()).await.map_err(|e| fault_of("write", to, e))?;
            Ok::<_, SendFault>((number, id))
        }
    };
    let mut parts = stream::iter(missing).map(send_one).buffer_unordered(PARTS_AT_ONCE);
    while let Some((number, id)) = parts.try_next().await? {
        journal.add_part(number, id)?;
        let range = range(number);
        sent += range.end - range.start;
        progress(UploadStep::Send, sent);
    }
    let parts = journal.part_ids().values().take(count).cloned().collect();
    let Err(error) = store.complete_upload(to, &upload, parts).await else { return Ok(()) };
    // Its answer may have been lost, now or before a kill: then the store has the object, and not the upload any more.
    match lake.store().head(to).await {
        Ok(meta) if meta.size == run.bytes => Ok(()),
        _ => Err(fault_of("complete the upload of", to, error)),
    }
}

pub(crate) async fn read_part(file: &FsPath, range: std::ops::Range<u64>) -> Result<Vec<u8>> {
    let path = file.to_owned();
    let read = move || {
        let mut part = vec![0; (range.end - range.start) as usize];
        File::open(path)?.read_exact_at(&mut part, range.start)?;
        Ok(part)
    };
    let read = tokio::task::spawn_blocking(read).await.map_err(std::io::Error::other).flatten();
    read.map_err(|source| Error::UploadFile { action: "read", file: file.to_owned(), source, hint: "" })
}

fn fault_of(action: &'static str, to: &Path, error: StoreError) -> SendFault {
    match error {
        StoreError::NotFound { .. } => SendFault::Forgotten(error),
        error => SendFault::Failed(Error::store_failure(action, to, error)),
    }
}

impl SendFault {
    fn into_error(self, to: &Path) -> Error {
        match self {
            Self::Forgotten(error) => Error::store_failure("upload", to, error),
            Self::Failed(error) => error,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_file_has_more_parts_than_a_store_takes() {
        for (bytes, expected) in [(1, PART), (3_000_000_000, PART), (PART * MOST_PARTS, PART), (1 << 40, 105 << 20)] {
            assert_eq!(part_bytes(bytes), expected, "{bytes}");
            assert!(bytes.div_ceil(part_bytes(bytes)) <= MOST_PARTS, "{bytes}");
        }
    }
}
