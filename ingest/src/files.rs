//! Places of run files: new ones in `inbox/`, ingested ones under `runs/`, refused ones under `quarantine/`.

use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;

use echolake_lake::{Lake, StoreError, digest_record, digest_record_path, object_sha256, read_digest_record};
use echolake_recording::FileIntegrity;
use echolake_schema::{Rig, RunId};
use futures::TryStreamExt as _;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _, WriteMultipart};

use crate::error::{Error, Result};
use crate::run_content::Head;

/// Folder of runs that are not ingested yet.
const INBOX: &str = "inbox";
/// Folder of closed runs.
const RUNS: &str = "runs";
/// Folder of refused files.
const QUARANTINE: &str = "quarantine";
/// Suffix of a recording's name until the file is complete.
const PARTIAL: &str = ".partial";
/// Maximum length of a refused file's name, bytes. File systems allow 255.
const LONGEST_NAME: usize = 200;
/// Bytes per copied part.
const PART: u64 = 8 << 20;
/// Parts on their way at once.
const PARTS_AT_ONCE: usize = 2;
/// Largest object that S3 copies in one request.
const LARGEST_COPY: u64 = 5 << 30;

/// Location of a run's file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RunSource {
    /// In the lake: under `inbox/` or `runs/`.
    Lake(Path),
    /// Anywhere else on this machine.
    File(PathBuf),
}

impl std::fmt::Display for RunSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Lake(path) => path.fmt(f),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// A source that is opened for reading.
pub(crate) struct Opened {
    pub(crate) store: Arc<dyn ObjectStore>,
    pub(crate) path: Path,
    /// Name for messages.
    pub(crate) name: String,
}

impl RunSource {
    pub(crate) fn open(&self, lake: &Lake) -> Result<Opened> {
        let name = self.to_string();
        match self {
            Self::Lake(path) => Ok(Opened { store: lake.store(), path: path.clone(), name }),
            Self::File(file) if !file.is_file() => Err(Error::NoRun { given: name }),
            Self::File(file) => {
                let path = absolute(file)?;
                Ok(Opened { store: Arc::new(LocalFileSystem::new()), path, name })
            }
        }
    }

    /// Name of the work on it, for claims: that of its file, which most often stays the same when it is moved.
    pub(crate) fn work_name(&self) -> &str {
        let name = match self {
            Self::Lake(path) => path.filename(),
            Self::File(path) => path.file_name().and_then(|name| name.to_str()),
        };
        name.unwrap_or_default()
    }

    /// The run whose place in the lake it is; None if it is elsewhere.
    pub(crate) fn run_in_place(&self) -> Option<RunId> {
        let Self::Lake(path) = self else { return None };
        path.filename()?.strip_suffix(".mcap")?.parse().ok().filter(|_| !self.is_in_inbox())
    }

    fn is_in_inbox(&self) -> bool {
        matches!(self, Self::Lake(path) if path.parts().next().is_some_and(|p| p.as_ref() == INBOX))
    }
}

/// Lists the run files that are in no table yet: all of `inbox/`, and those of `runs/` that table `runs` does not name.
///
/// # Errors
/// [`Error::Lake`] if the snapshot cannot be read, [`Error::Read`] if a folder cannot be listed.
pub async fn pending(lake: &Lake) -> Result<Vec<RunSource>> {
    let snapshot = lake.snapshot().await?;
    let mut found = Vec::new();
    for folder in [INBOX, RUNS] {
        let listed: Vec<_> =
            lake.store().list(Some(&Path::from(folder))).try_collect().await.map_err(|e| Error::read(folder, e))?;
        found.extend(listed.into_iter().map(|meta| meta.location));
    }
    found.sort();
    let known = |path: &Path| {
        let run = path.filename().and_then(|n| n.strip_suffix(".mcap")).and_then(|n| n.parse::<RunId>().ok());
        run.and_then(|r| snapshot.run(&r)).is_some_and(|r| Lake::run_path(&r.surface, &r.run) == *path)
    };
    found.retain(|p| p.extension() == Some("mcap") && !known(p));
    Ok(found.into_iter().map(RunSource::Lake).collect())
}

/// Lists the run files of the inbox alone: one request to an object store, which has files as a whole or not at all.
///
/// # Errors
/// [`Error::Read`] if the inbox cannot be listed.
pub async fn arrivals(lake: &Lake) -> Result<Vec<ObjectMeta>> {
    let listed: Vec<_> =
        lake.store().list(Some(&Path::from(INBOX))).try_collect().await.map_err(|e| Error::read(INBOX, e))?;
    Ok(listed.into_iter().filter(|meta| meta.location.extension() == Some("mcap")).collect())
}

/// Reads the rig of a run file of this machine, for a lake that is made for it; None if the file does not begin as a run.
///
/// # Errors
/// [`Error::NoRun`] if there is no such file.
pub async fn rig_of_run(file: &FsPath) -> Result<Option<Rig>> {
    if !file.is_file() {
        return Err(Error::NoRun { given: file.display().to_string() });
    }
    let (path, name) = (absolute(file)?, file.display().to_string());
    let opened = Opened { store: Arc::new(LocalFileSystem::new()), path, name };
    Ok(Head::read(&opened).await.and_then(|head| head.rig))
}

/// Renames the recordings in the inbox whose recorder died, so that ingest accepts their complete part; returns them.
/// Recordings that are still being written, that can be resumed, or that come from imports (which are repeated from
/// their files) are left alone.
///
/// # Errors
/// [`Error::Read`] if the inbox cannot be changed.
pub async fn adopt_cut_off(lake: &Lake) -> Result<Vec<Path>> {
    let Some(inbox) = lake.folder().map(|folder| folder.join(INBOX)).filter(|inbox| inbox.is_dir()) else {
        return Ok(Vec::new());
    };
    let mut adopted = Vec::new();
    for entry in std::fs::read_dir(&inbox).map_err(|e| Error::read(inbox.display(), e))? {
        let partial = entry.map_err(|e| Error::read(inbox.display(), e))?.path();
        let Some(name) = partial.file_name().and_then(|n| n.to_str()).and_then(|n| n.strip_suffix(PARTIAL)) else {
            continue;
        };
        let to = inbox.join(name);
        if !name.ends_with(".mcap")
            || to.exists()
            || is_being_recorded(&partial)
            || is_made_whole_otherwise(&partial).await
        {
            continue;
        }
        let failed = |e: std::io::Error| Error::read(partial.display(), e);
        std::fs::rename(&partial, &to).map_err(failed)?;
        std::fs::File::open(&inbox).and_then(|folder| folder.sync_all()).map_err(failed)?;
        adopted.push(Path::from(format!("{INBOX}/{name}")));
    }
    Ok(adopted)
}

// The recorder holds a lock as long as it lives. A file that cannot be opened counts as being recorded.
fn is_being_recorded(partial: &FsPath) -> bool {
    match std::fs::File::open(partial) {
        Ok(file) => file.try_lock_shared().is_err(),
        Err(_) => true,
    }
}

// A resumed run is better than its first part; an import is repeated.
async fn is_made_whole_otherwise(partial: &FsPath) -> bool {
    let Ok(path) = absolute(partial) else { return false };
    let opened = Opened { store: Arc::new(LocalFileSystem::new()), path, name: partial.display().to_string() };
    let is = |head: Head| head.has_plan || head.origin.is_imported();
    Head::read(&opened).await.is_some_and(is)
}

/// A run's file as it was read.
pub(crate) struct ReadFile<'a> {
    pub(crate) integrity: &'a FileIntegrity,
    /// Tag of the object when its reading began, if its store has tags.
    pub(crate) e_tag: Option<String>,
    /// SHA-256 that was recorded when it was uploaded.
    pub(crate) recorded: Option<String>,
}

impl<'a> ReadFile<'a> {
    /// Compares what was read with what was uploaded, if an upload recorded it.
    ///
    /// # Errors
    /// [`Error::OtherDigest`], or an error of the lake.
    pub(crate) async fn check(
        lake: &Lake,
        source: &RunSource,
        e_tag: Option<String>,
        integrity: &'a FileIntegrity,
    ) -> Result<Self> {
        let recorded = match source {
            RunSource::Lake(path) if source.is_in_inbox() => read_digest_record(lake.store().as_ref(), path).await,
            _ => Ok(None),
        };
        let recorded = recorded.map_err(|e| Error::read(source, e))?;
        match recorded {
            Some(recorded) if recorded != integrity.sha256 => {
                let actual = integrity.sha256.clone();
                Err(Error::OtherDigest { file: source.to_string(), recorded, actual })
            }
            recorded => Ok(Self { integrity, e_tag, recorded }),
        }
    }
}

/// Returns the tag of an object in the inbox of an object store, before it is read.
pub(crate) async fn inbox_tag(lake: &Lake, source: &RunSource) -> Option<String> {
    match source {
        RunSource::Lake(path) if lake.is_remote() && source.is_in_inbox() => lake.store().head(path).await.ok()?.e_tag,
        _ => None,
    }
}

/// Content of a run's place.
#[derive(PartialEq, Eq)]
enum PlaceContent {
    Empty,
    Same,
    /// Another file: its SHA-256, or its size.
    Other(String),
}

/// Moves or copies a run's file to its place, before any row names it. `is_known` says that rows name this content, so that
/// another one in its place is damage.
///
/// # Errors
/// [`Error::OtherContent`] if another file is there, [`Error::Read`] if the copy is not what was read, or an error of the
/// lake.
pub(crate) async fn keep(
    lake: &Lake,
    source: &RunSource,
    to: &Path,
    file: &ReadFile<'_>,
    is_known: bool,
) -> Result<()> {
    if matches!(source, RunSource::Lake(from) if from == to) {
        return Ok(());
    }
    let there = look_at_place(lake, to, file.integrity, is_known).await?;
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
        RunSource::File(from) => copy_in(lake, from, to).await,
        RunSource::Lake(from) => {
            move_record(lake, from, to, file).await.map_err(|e| written(to, e))?;
            if there == PlaceContent::Same {
                return delete(lake, from).await.map_err(|e| written(from, e));
            }
            match move_object(lake, from, to, file.integrity.bytes, Some(file)).await {
                // Another ingest has moved it.
                Err(StoreFault::Store(object_store::Error::NotFound { .. })) if lake.store().head(to).await.is_ok() => {
                    Ok(())
                }
                moved => moved.map_err(|fault| fault.into_error(to)),
            }
        }
    }
}

async fn look_at_place(lake: &Lake, to: &Path, file: &FileIntegrity, is_known: bool) -> Result<PlaceContent> {
    let store = lake.store();
    let bytes = match store.head(to).await {
        Ok(meta) => meta.size,
        Err(object_store::Error::NotFound { .. }) => return Ok(PlaceContent::Empty),
        Err(e) => return Err(written(to, e)),
    };
    if bytes != file.bytes {
        return Ok(PlaceContent::Other(format!("{bytes} bytes")));
    }
    // The digest was compared when the rows were made.
    if is_known {
        return Ok(PlaceContent::Same);
    }
    let sha256 = object_sha256(store.as_ref(), to, bytes, &mut |_| {}).await.map_err(|e| Error::read(to, e))?;
    Ok(if sha256 == file.sha256 { PlaceContent::Same } else { PlaceContent::Other(sha256) })
}

// The record of an uploaded run's digest stays beside it.
async fn move_record(lake: &Lake, from: &Path, to: &Path, file: &ReadFile<'_>) -> object_store::Result<()> {
    if file.recorded.is_none() {
        return Ok(());
    }
    let text = digest_record(&file.integrity.sha256, to);
    lake.store().put(&digest_record_path(to), text.into()).await?;
    delete(lake, &digest_record_path(from)).await
}

async fn delete(lake: &Lake, path: &Path) -> object_store::Result<()> {
    match lake.store().delete(path).await {
        Err(object_store::Error::NotFound { .. }) => Ok(()),
        deleted => deleted,
    }
}

/// A failed move.
enum StoreFault {
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
    fn into_error(self, to: &Path) -> Error {
        match self {
            Self::Store(error) => written(to, error),
            Self::Changed { expected, actual } => Error::read(
                to,
                format!("its copy has {actual}, expected {expected}; hint: the copy is deleted, run the command again"),
            ),
        }
    }
}

// A folder renames. An object store copies, and only what is there as it was read is deleted where it came from.
async fn move_object(
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
        delete(lake, to).await?;
        return Err(StoreFault::Changed { expected, actual });
    }
    Ok(delete(lake, from).await?)
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
    let is_strong = |tag: &String| !tag.starts_with("W/");
    if there.e_tag.as_ref().is_some_and(is_strong) && there.e_tag == read.e_tag {
        return Ok(None);
    }
    let (actual, expected) = (object_sha256(store, copy, bytes, &mut |_| {}).await?, &read.integrity.sha256);
    Ok((actual != *expected).then(|| (format!("SHA-256 {expected}"), format!("SHA-256 {actual}"))))
}

/// Moves a refused file of the inbox to `quarantine/`, the reason first; returns its path. Files outside the inbox
/// stay.
pub(crate) async fn quarantine(lake: &Lake, source: &RunSource, why: &Error) -> Result<Option<Path>> {
    let RunSource::Lake(from) = source else { return Ok(None) };
    // A file that cannot be read now may be readable later.
    if !source.is_in_inbox() || matches!(why, Error::Read { .. }) {
        return Ok(None);
    }
    let store = lake.store();
    let name = from.filename().unwrap_or("run");
    // Only the end of a long name, because the name of the reason's file is longer.
    let start = (name.len().saturating_sub(LONGEST_NAME)..name.len()).find(|at| name.is_char_boundary(*at));
    let to = free_name(lake, &name[start.unwrap_or(0)..]).await?;
    let reason = Path::from(format!("{to}.reason.txt"));
    store.put(&reason, format!("{why}\n").into()).await.map_err(|e| written(&reason, e))?;
    // The name is free for another upload.
    delete(lake, &digest_record_path(from)).await.map_err(|e| written(from, e))?;
    let moved = async { move_object(lake, from, &to, store.head(from).await?.size, None).await };
    match moved.await {
        // Another ingest refused it, too.
        Err(StoreFault::Store(object_store::Error::NotFound { .. })) => Ok(None),
        moved => moved.map(|()| Some(to)).map_err(|fault| fault.into_error(from)),
    }
}

async fn free_name(lake: &Lake, name: &str) -> Result<Path> {
    let mut number = 1;
    loop {
        let path = match number {
            1 => Path::from(format!("{QUARANTINE}/{name}")),
            _ => Path::from(format!("{QUARANTINE}/{number}-{name}")),
        };
        match lake.store().head(&path).await {
            Err(object_store::Error::NotFound { .. }) => return Ok(path),
            Err(e) => return Err(written(&path, e)),
            Ok(_) => number += 1,
        }
    }
}

async fn copy_in(lake: &Lake, from: &FsPath, to: &Path) -> Result<()> {
    let (store, source) = (lake.store(), LocalFileSystem::new());
    let failed = |e: object_store::Error| written(to, e);
    let path = absolute(from)?;
    let size = source.head(&path).await.map_err(|e| Error::read(from.display(), e))?.size;
    // An object appears as a whole; a file is under another name first, so that a run's own name never holds part of it.
    if lake.is_remote() {
        return copy_parts(&source, &path, size, store.as_ref(), to).await.map_err(failed);
    }
    let staged = Path::from(format!("{INBOX}/{}.copying", to.filename().unwrap_or("run")));
    copy_parts(&source, &path, size, store.as_ref(), &staged).await.map_err(failed)?;
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

// The lake itself cannot be written: an error of the lake, not of the run.
fn written(path: &Path, cause: object_store::Error) -> Error {
    let source = StoreError(cause);
    Error::Lake(echolake_lake::Error::Store { action: "write", path: path.to_string(), source })
}

fn absolute(file: &FsPath) -> Result<Path> {
    let absolute = std::path::absolute(file).map_err(|e| Error::read(file.display(), e))?;
    Path::from_absolute_path(absolute).map_err(|e| Error::read(file.display(), e))
}
