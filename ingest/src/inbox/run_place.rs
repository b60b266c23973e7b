//! Moves a run's file to its place under `runs/`, before any row names it.

use std::path::Path as FsPath;

use echolake_lake::{Lake, StoreError, digest_record, digest_record_path, object_sha256};
use echolake_recording::FileIntegrity;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, WriteMultipart};

use super::file_state::{FileState, ReadFile, recorded_digest};
use super::run_source::{INBOX, RunSource, absolute_path};
use crate::error::{Error, Result};

/// Bytes per copied part.
const PART: u64 = 8 << 20;
/// Parts on their way at once.
const PARTS_AT_ONCE: usize = 2;
/// Largest object that S3 copies in one request.
const LARGEST_COPY: u64 = 5 << 30;

/// Content of a run's place.
#[derive(PartialEq, Eq)]
enum PlaceContent {
    Empty,
    Same,
    /// Another file: its SHA-256, or its size.
    Other(String),
}

/// Moves or copies a run's file to its place, before any row names it. `is_known` says that rows name this content, so
/// that another one in its place is damage.
///
/// # Errors
/// [`Error::OtherContent`] if another file is there, [`Error::Changed`] if the file is not what was read,
/// [`Error::Gone`] if it is no more, [`Error::Read`] if the copy is not what was read, or an error of the lake.
pub(crate) async fn move_to_place(
    lake: &Lake,
    source: &RunSource,
    to: &Path,
    file: &ReadFile<'_>,
    is_known: bool,
) -> Result<()> {
    let checked = FileState::check_state(file.state, lake, source);
    if matches!(source, RunSource::Lake(from) if from == to) {
        return checked;
    }
    match checked {
        // Another ingest may have moved it.
        Err(Error::Gone { .. }) => {}
        checked => checked?,
    }
    let there = look_at_place(lake, to, file.integrity).await?;
    if let PlaceContent::Other(there) = &there {
        // A folder's file may be what a power cut left of a copy.
        let is_left_over = matches!(source, RunSource::File(_)) && !lake.is_remote();
        if !is_known && !is_left_over {
            let run = to.filename().unwrap_or_default().trim_end_matches(".mcap").to_owned();
            let (file, given, there) = (source.to_string(), file.integrity.sha256.clone(), there.clone());
            return Err(Error::OtherContent { run, file, given, there });
        }
    }
    match source {
        RunSource::File(_) if there == PlaceContent::Same => Ok(()),
        RunSource::File(from) => {
            copy_in(lake, from, to, &mut || FileState::check_state(file.state, lake, source)).await
        }
        RunSource::Lake(from) => {
            move_record(lake, from, to, file).await.map_err(|e| write_error(to, e))?;
            if there == PlaceContent::Same {
                return delete_object(lake, from).await.map_err(|e| write_error(from, e));
            }
            match move_object(lake, from, to, file.integrity.bytes, Some(file)).await {
                // Another ingest has moved it.
                Err(StoreFault::Store(object_store::Error::NotFound { .. })) if lake.store().head(to).await.is_ok() => {
                    return Ok(());
                }
                Err(StoreFault::Store(object_store::Error::NotFound { .. })) => {
                    return Err(Error::Gone { file: source.to_string() });
                }
                moved => moved.map_err(|fault| fault.into_error(to))?,
            }
            // Who has it open writes on, under whatever name.
            if let Err(changed) = FileState::check_state(file.state, lake, &RunSource::Lake(to.clone())) {
                lake.store().rename(to, from).await.map_err(|e| write_error(from, e))?;
                return Err(changed);
            }
            Ok(())
        }
    }
}

/// Puts a file into the place of a shorter one that has its beginning, or of a damaged one, after the commit of its
/// rows: if the process ends before, the next ingest finds the file and its rows, and does the same.
///
/// # Errors
/// An error of the lake.
pub(crate) async fn replace_partial(lake: &Lake, source: &RunSource, to: &Path) -> Result<()> {
    let from = match source {
        RunSource::Lake(from) if from == to => return Ok(()),
        RunSource::Lake(from) => from,
        RunSource::File(from) => return copy_in(lake, from, to, &mut || Ok(())).await,
    };
    if let Some(sha256) = recorded_digest(lake, source).await? {
        let record = digest_record_path(to);
        lake.store().put(&record, digest_record(&sha256, to).into()).await.map_err(|e| write_error(&record, e))?;
        delete_object(lake, &digest_record_path(from)).await.map_err(|e| write_error(from, e))?;
    }
    let bytes = lake.store().head(from).await.map_err(|e| write_error(from, e))?.size;
    move_object(lake, from, to, bytes, None).await.map_err(|fault| fault.into_error(to))
}

async fn look_at_place(lake: &Lake, to: &Path, file: &FileIntegrity) -> Result<PlaceContent> {
    let store = lake.store();
    let bytes = match store.head(to).await {
        Ok(meta) => meta.size,
        Err(object_store::Error::NotFound { .. }) => return Ok(PlaceContent::Empty),
        Err(e) => return Err(write_error(to, e)),
    };
    if bytes != file.bytes {
        return Ok(PlaceContent::Other(format!("{bytes} bytes")));
    }
    let sha256 = object_sha256(store.as_ref(), to, bytes, &mut |_| {}).await.map_err(|e| Error::read_failure(to, e))?;
    Ok(if sha256 == file.sha256 { PlaceContent::Same } else { PlaceContent::Other(sha256) })
}

// The record of an uploaded run's digest stays beside it.
async fn move_record(lake: &Lake, from: &Path, to: &Path, file: &ReadFile<'_>) -> object_store::Result<()> {
    if file.recorded.is_none() {
        return Ok(());
    }
    let text = digest_record(&file.integrity.sha256, to);
    lake.store().put(&digest_record_path(to), text.into()).await?;
    delete_object(lake, &digest_record_path(from)).await
}

/// Deletes an object that may be gone already.
pub(super) async fn delete_object(lake: &Lake, path: &Path) -> object_store::Result<()> {
    match lake.store().delete(path).await {
        Err(object_store::Error::NotFound { .. }) => Ok(()),
        deleted => deleted,
    }
}

/// A failed move.
pub(super) enum StoreFault {
    Store(object_store::Error),
    /// The copy is not what was read.
    Changed {
        expected: String,
        actual: String,
    },
}

impl From<object_store::Error> for StoreFault {
    fn from(error: object_store::Error) -> Self {
        Self::Store(error)
    }
}

impl StoreFault {
    pub fn into_error(self, to: &Path) -> Error {
        match self {
            Self::Store(error) => write_error(to, error),
            Self::Changed { expected, actual } => Error::read_failure(
                to,
                format!("its copy has {actual}, expected {expected}; hint: the copy is deleted, run the command again"),
            ),
        }
    }
}

/// Moves an object: a folder renames it; an object store copies it, and only what is there as it was read is deleted
/// where it came from.
pub(super) async fn move_object(
    lake: &Lake,
    from: &Path,
    to: &Path,
    bytes: u64,
    read: Option<&ReadFile<'_>>,
) -> std::result::Result<(), StoreFault> {
    let store = lake.store();
    if !lake.is_remote() {
        return Ok(store.rename(from, to).await?);
    }
    if bytes <= LARGEST_COPY {
        store.copy(from, to).await?;
    } else {
        copy_parts(store.as_ref(), from, bytes, store.as_ref(), to).await?;
    }
    if let Some((expected, actual)) = find_change(store.as_ref(), to, bytes, read).await? {
        delete_object(lake, to).await?;
        return Err(StoreFault::Changed { expected, actual });
    }
    Ok(delete_object(lake, from).await?)
}

// Compares a copy with what was read: by the store's own tag, which an object keeps as long as its content is the same,
// or by its SHA-256. Stores may give a copy another tag.
async fn find_change(
    store: &dyn ObjectStore,
    copy: &Path,
    bytes: u64,
    read: Option<&ReadFile<'_>>,
) -> object_store::Result<Option<(String, String)>> {
    let there = store.head(copy).await?;
    if there.size != bytes {
        return Ok(Some((format!("{bytes} bytes"), format!("{} bytes", there.size))));
    }
    let Some(read) = read else { return Ok(None) };
    if there.e_tag.as_ref().is_some_and(|tag: &String| !tag.starts_with("W/")) && there.e_tag == read.e_tag {
        return Ok(None);
    }
    let (actual, expected) = (object_sha256(store, copy, bytes, &mut |_| {}).await?, &read.integrity.sha256);
    Ok((actual != *expected).then(|| (format!("SHA-256 {expected}"), format!("SHA-256 {actual}"))))
}

/// Deletes a run's file and the record of its digest, if they are there.
///
/// # Errors
/// An error of the lake.
pub(crate) async fn delete_run(lake: &Lake, path: &Path) -> Result<()> {
    for path in [path, &digest_record_path(path)] {
        delete_object(lake, path).await.map_err(|e| write_error(path, e))?;
    }
    Ok(())
}

// `check` is called when everything is copied, before the copy has the run's name.
async fn copy_in(lake: &Lake, from: &FsPath, to: &Path, check: &mut (dyn FnMut() -> Result<()> + Send)) -> Result<()> {
    let store = lake.store();
    let source = LocalFileSystem::new();
    let failed = |e: object_store::Error| write_error(to, e);
    let path = absolute_path(from)?;
    let size = source.head(&path).await.map_err(|e| Error::read_failure(from.display(), e))?.size;
    // An object appears as a whole; a file is under another name first, so that a run's own name never holds part of
    // it.
    if lake.is_remote() {
        copy_parts(&source, &path, size, store.as_ref(), to).await.map_err(failed)?;
        if let Err(changed) = check() {
            delete_object(lake, to).await.map_err(failed)?;
            return Err(changed);
        }
        return Ok(());
    }
    let staged = Path::from(format!("{INBOX}/{}.copying", to.filename().unwrap_or("run")));
    copy_parts(&source, &path, size, store.as_ref(), &staged).await.map_err(failed)?;
    if let Err(changed) = check() {
        delete_object(lake, &staged).await.map_err(failed)?;
        return Err(changed);
    }
    store.rename(&staged, to).await.map_err(failed)
}

async fn copy_parts(
    source: &dyn ObjectStore,
    from: &Path,
    bytes: u64,
    store: &dyn ObjectStore,
    to: &Path,
) -> object_store::Result<()> {
    let mut writer = WriteMultipart::new(store.put_multipart(to).await?);
    let mut at = 0;
    while at < bytes {
        let end = (at + PART).min(bytes);
        let part = async {
            let part = source.get_range(from, at..end).await?;
            writer.put(part);
            writer.wait_for_capacity(PARTS_AT_ONCE).await
        };
        if let Err(error) = part.await {
            // What was uploaded of it costs money until the upload is aborted.
            let _ = writer.abort().await;
            return Err(error);
        }
        at = end;
    }
    writer.finish().await.map(drop)
}

/// Returns the error of a lake that cannot be written: it is not the run's.
pub(super) fn write_error(path: &Path, cause: object_store::Error) -> Error {
    let source = StoreError(cause);
    Error::Lake(echolake_lake::Error::Store { action: "write", path: path.to_string(), source })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use echolake_lake::ReferenceSurfaces;
    use echolake_schema::Rig;

    use super::*;
    use crate::inbox::FileVersion;

    #[tokio::test]
    async fn a_file_that_changed_or_went_since_it_was_read_is_not_moved() {
        let place = tempfile::tempdir().expect("a folder");
        let url = place.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        fs::create_dir(place.path().join("lake/inbox")).expect("made");
        let outside = place.path().join("outside.mcap");
        let inside = place.path().join("lake/inbox/x.mcap");
        let to = Path::from("runs/flat/x.mcap");
        for (source, file) in
            [(RunSource::Lake(Path::from("inbox/x.mcap")), &inside), (RunSource::File(outside.clone()), &outside)]
        {
            let sha256 = "7".repeat(64);
            let (damage, lost) = (Vec::new(), Vec::new());
            let (closed, is_data_whole, has_wrong_crc) = (true, true, false);
            let integrity = FileIntegrity { bytes: 5, sha256, closed, damage, lost, is_data_whole, has_wrong_crc };
            fs::write(file, "12345").expect("written");
            let version = FileVersion::from_source(&lake, &source).await.expect("there");
            let read = ReadFile::check_digest(&lake, &source, version, &integrity).await.expect("read");
            fs::write(file, "123456").expect("written");
            let changed = move_to_place(&lake, &source, &to, &read, false).await.expect_err("it is another file");
            assert!(matches!(changed, Error::Changed { .. }) && changed.to_string().contains("6 bytes"), "{changed}");
            assert!(file.exists() && lake.store().head(&to).await.is_err(), "{source}");
            fs::remove_file(file).expect("removed");
            let gone = move_to_place(&lake, &source, &to, &read, false).await.expect_err("it is gone");
            assert!(gone.is_refusal(), "{gone}");
            // A link in its place is not followed.
            std::os::unix::fs::symlink("/etc/passwd", file).expect("linked");
            let followed = FileVersion::from_source(&lake, &source).await.is_ok();
            assert_eq!(followed, matches!(source, RunSource::File(_)));
            fs::remove_file(file).expect("removed");
        }
    }
}
