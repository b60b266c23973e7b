//! Uploads of closed run files to a lake's inbox, which continue after any cut.
//!
//! 1. The run must not be in the lake yet, in `inbox/` or `runs/`.
//! 2. A record of the file's SHA-256 is created beside its place in `inbox/`. It keeps the name: of two different
//!    files, one alone can have it. Ingest compares what it reads with the record.
//! 3. The file goes up: to an object store in parts, whose ids a journal beside the file keeps (`parts.rs`); to a
//!    folder by appending to a staged file (`folder.rs`). What is there when the upload is cut off is not sent again.
//! 4. What arrived is read back and its SHA-256 compared. Only then is the journal deleted.

mod folder;
mod journal;
mod parts;

use std::path::PathBuf;

use echolake_schema::{RunId, SurfaceId};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStoreExt as _};

use crate::remote::create_object;
use crate::run_digest::{digest_record, digest_record_path, object_sha256, read_digest_record};
use crate::{Error, Lake, Result};
use journal::UploadJournal;
#[cfg(feature = "tables")]
pub(crate) use parts::{PARTS_AT_ONCE, part_bytes, read_part};

/// Folder of runs that are not ingested yet.
const INBOX: &str = "inbox";

/// A closed run file of this machine, to be uploaded.
#[derive(Debug, Clone)]
pub struct RunUpload {
    /// The file.
    pub file: PathBuf,
    /// The run's surface.
    pub surface: SurfaceId,
    /// The run, which gives the object its name.
    pub run: RunId,
    /// Size of the file.
    pub bytes: u64,
    /// SHA-256 of the file, in hex.
    pub sha256: String,
}

/// Step of an upload, for its progress in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UploadStep {
    /// Bytes of the file are sent; those of an earlier attempt count.
    Send,
    /// Bytes are read back and compared.
    Compare,
}

/// Outcome of an upload that did not fail.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum UploadOutcome {
    /// The run is in the lake now, at this path.
    Uploaded(Path),
    /// It was there before, with the same SHA-256.
    Present(Path),
}

/// Callback that is called with the bytes that a step is done with.
type UploadProgress<'a> = &'a mut (dyn FnMut(UploadStep, u64) + Send);

impl Lake {
    /// Uploads a run file to `inbox/`, unless the lake has the same file already. The call may be cancelled or killed
    /// at any moment; the next one continues where it was.
    ///
    /// # Errors
    /// [`Error::OtherUpload`] if the lake has another file of this name, [`Error::UploadBusy`] if another process is
    /// uploading it, [`Error::UploadDamaged`] if something else arrived, [`Error::UploadFile`], or what the store says.
    pub async fn upload_run(&self, run: &RunUpload, progress: UploadProgress<'_>) -> Result<UploadOutcome> {
        self.ensure_exclusive().await?;
        let inbox = Path::from(format!("{INBOX}/{}.mcap", run.run));
        let ingested = Self::run_path(&run.surface, &run.run);
        if self.holds_run(run, &ingested).await? {
            return Ok(UploadOutcome::Present(ingested));
        }
        let mut journal = match self.part_store() {
            Some(_) => Some(UploadJournal::open(run, self.location(), &inbox)?),
            None => None,
        };
        if self.holds_run(run, &inbox).await? {
            // Without a journal, whoever uploaded it has compared it.
            if journal.as_ref().is_none_or(|journal| !journal.is_begun()) {
                return finish_upload(journal, UploadOutcome::Present(inbox));
            }
        } else {
            self.reserve_name(run, &inbox).await?;
            match (self.part_store(), &mut journal) {
                (Some(store), Some(journal)) => parts::send_parts(self, store, journal, run, &inbox, progress).await?,
                _ => folder::send_to_folder(self, run, &inbox, progress).await?,
            }
        }
        let outcome = self.compare_upload(run, &inbox, &ingested, progress).await;
        match outcome {
            // What is there is deleted, so that the next upload begins anew.
            Err(error @ Error::UploadDamaged { .. }) => {
                journal.map_or(Ok(()), UploadJournal::delete_journal).and(Err(error))
            }
            Err(error) => Err(error),
            Ok(outcome) => finish_upload(journal, outcome),
        }
    }

    // Returns whether the same file is there; another one is an error.
    async fn holds_run(&self, run: &RunUpload, path: &Path) -> Result<bool> {
        let failed = |e| Error::store_failure("read", path, e);
        let store = self.store();
        let bytes = match store.head(path).await {
            Ok(meta) => meta.size,
            Err(StoreError::NotFound { .. }) => return Ok(false),
            Err(e) => return Err(failed(e)),
        };
        if bytes != run.bytes {
            return Err(self.other_upload(path, format!("{bytes} bytes"), format!("{} bytes", run.bytes)));
        }
        let there = match read_digest_record(store.as_ref(), path).await.map_err(failed)? {
            Some(recorded) => recorded,
            None => match object_sha256(store.as_ref(), path, bytes, &mut |_| {}).await {
                Ok(digest) => digest,
                // An ingest has just moved it.
                Err(StoreError::NotFound { .. }) => return Ok(false),
                Err(e) => return Err(failed(e)),
            },
        };
        match there == run.sha256 {
            true => Ok(true),
            false => Err(self.other_upload(path, format!("SHA-256 {there}"), format!("SHA-256 {}", run.sha256))),
        }
    }

    // Creates the digest's record, or finds the same one there.
    async fn reserve_name(&self, run: &RunUpload, inbox: &Path) -> Result<()> {
        let store = self.store();
        let record = digest_record_path(inbox);
        let text = digest_record(&run.sha256, inbox);
        let created = create_object(store.as_ref(), &record, text.into()).await;
        if created.map_err(|e| Error::store_failure("write", &record, e))? {
            return Ok(());
        }
        match read_digest_record(store.as_ref(), inbox).await.map_err(|e| Error::store_failure("read", &record, e))? {
            Some(other) if other != run.sha256 => {
                Err(self.other_upload(inbox, format!("SHA-256 {other}"), format!("SHA-256 {}", run.sha256)))
            }
            _ => Ok(()),
        }
    }

    async fn compare_upload(
        &self,
        run: &RunUpload,
        inbox: &Path,
        ingested: &Path,
        progress: UploadProgress<'_>,
    ) -> Result<UploadOutcome> {
        let store = self.store();
        progress(UploadStep::Compare, 0);
        let mut compared = |bytes| progress(UploadStep::Compare, bytes);
        match object_sha256(store.as_ref(), inbox, run.bytes, &mut compared).await {
            Ok(actual) if actual == run.sha256 => Ok(UploadOutcome::Uploaded(inbox.clone())),
            Ok(actual) => {
                store.delete(inbox).await.map_err(|e| Error::store_failure("delete", inbox, e))?;
                let location = self.location().to_owned();
                let path = inbox.to_string();
                let expected = run.sha256.clone();
                Err(Error::UploadDamaged { location, path, expected, actual })
            }
            // An ingest has compared it, and moved it.
            Err(StoreError::NotFound { .. }) if self.holds_run(run, ingested).await? => {
                Ok(UploadOutcome::Uploaded(ingested.clone()))
            }
            Err(StoreError::NotFound { .. }) => {
                Err(Error::UploadGone { location: self.location().to_owned(), path: inbox.to_string() })
            }
            Err(e) => Err(Error::store_failure("read back", inbox, e)),
        }
    }

    fn other_upload(&self, path: &Path, there: String, given: String) -> Error {
        Error::OtherUpload { location: self.location().to_owned(), path: path.to_string(), there, given }
    }
}

fn finish_upload(journal: Option<UploadJournal>, outcome: UploadOutcome) -> Result<UploadOutcome> {
    journal.map_or(Ok(()), UploadJournal::delete_journal)?;
    Ok(outcome)
}

#[cfg(test)]
mod tests;
