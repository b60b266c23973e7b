//! Places of run files: new ones in `inbox/`, ingested ones under `runs/`, refused ones under `quarantine/`.

use std::collections::BTreeSet;
use std::fs::{self, Metadata};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;

use chrono::{DateTime, Utc};
use echolake_lake::{
    Lake, LakeSnapshot, StoreError, UnusableEntry, digest_record, digest_record_path, object_sha256, read_digest_record,
};
use echolake_recording::{FILE_END_BYTES, FileIntegrity, MAGIC, has_file_end};
use echolake_schema::tables::{Source, Table};
use echolake_schema::{Rig, RunId};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, WriteMultipart};

use crate::error::{Error, Result};
use crate::run_content::Head;

/// Folder of runs that are not ingested yet.
const INBOX: &str = "inbox";
/// Folder of closed runs.
const RUNS: &str = "runs";
/// Folder of refused files.
const QUARANTINE: &str = "quarantine";
/// End of a recording's name until the file is complete.
const PARTIAL: &str = ".mcap.partial";
/// End of the name of the reason beside a refused file.
const REASON: &str = ".reason.txt";
/// Maximum length of a refused file's name, bytes.
const LONGEST_NAME: usize = 200;
/// Maximum length of a file's name on most file systems, bytes.
const LONGEST_FILE_NAME: usize = 255;
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

/// What is in no table yet.
#[derive(Debug, Default)]
pub struct PendingFiles {
    /// Run files.
    pub runs: Vec<ObjectMeta>,
    /// Recordings in the inbox that have not been finished.
    pub recordings: Vec<UnfinishedRecording>,
    /// Entries that nothing opens.
    pub unusable: Vec<UnusableEntry>,
}

/// A recording in the inbox that has not been finished.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnfinishedRecording {
    /// Its path in the lake.
    pub path: Path,
    /// Its size.
    pub bytes: u64,
    /// What can become of it.
    pub state: RecordingState,
}

/// What can become of an unfinished recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordingState {
    /// Its recorder is at work.
    Running,
    /// `acquire --resume` resumes it.
    Resumable,
    /// The import that wrote it is to be repeated.
    Import,
    /// Its recorder died; `recover` makes a run of what it holds.
    CutOff,
}

impl PendingFiles {
    /// Returns the run files as sources of an ingest.
    pub fn sources(&self) -> Vec<RunSource> {
        self.runs.iter().map(|run| RunSource::Lake(run.location.clone())).collect()
    }
}

/// Lists what is in no table yet: all of `inbox/`, and the run files of `runs/` that table `runs` does not name or whose
/// rows are missing.
///
/// # Errors
/// [`Error::Lake`] if the snapshot or a folder cannot be read.
pub async fn list_pending(lake: &Lake) -> Result<PendingFiles> {
    let snapshot = lake.snapshot().await?;
    let mut pending = list_arrivals(lake).await?;
    let mut runs = lake.list_folder(RUNS).await?;
    let of_run = Table::ALL.into_iter().filter(|table| table.source() == Source::Run);
    let lacking: BTreeSet<_> = of_run.flat_map(|table| snapshot.lacking(table)).map(|of| &of.run).collect();
    let is_whole = |path: &Path| known_run(&snapshot, path).is_some_and(|run| !lacking.contains(run));
    runs.files.retain(|meta| is_run_file(meta) && !is_whole(&meta.location));
    pending.runs.append(&mut runs.files);
    pending.unusable.append(&mut runs.unusable);
    // What was made of it is in the lake.
    pending
        .recordings
        .retain(|recording| run_named(&recording.path, PARTIAL).is_none_or(|r| snapshot.run(&r).is_none()));
    Ok(pending)
}

/// Lists the run files that are in no table yet.
///
/// # Errors
/// As of [`list_pending`].
pub async fn pending(lake: &Lake) -> Result<Vec<RunSource>> {
    Ok(list_pending(lake).await?.sources())
}

/// Lists what is in the inbox alone: one request to an object store, which has files as a whole or not at all.
///
/// # Errors
/// [`Error::Lake`] if the inbox cannot be listed.
pub async fn list_arrivals(lake: &Lake) -> Result<PendingFiles> {
    let mut listing = lake.list_folder(INBOX).await?;
    let mut pending = PendingFiles { unusable: std::mem::take(&mut listing.unusable), ..PendingFiles::default() };
    let names: BTreeSet<Path> = listing.files.iter().map(|meta| meta.location.clone()).collect();
    for meta in listing.files {
        let finished = meta.location.as_ref().strip_suffix(PARTIAL).map(|stem| format!("{stem}.mcap"));
        match finished {
            // It is what a finished or recovered run was made of.
            Some(run) if Path::parse(&run).is_ok_and(|run| names.contains(&run)) => {}
            Some(_) => pending.recordings.push(UnfinishedRecording {
                state: recording_state(lake, &meta.location).await,
                path: meta.location,
                bytes: meta.size,
            }),
            None if is_run_file(&meta) => pending.runs.push(meta),
            None => {}
        }
    }
    Ok(pending)
}

fn is_run_file(meta: &ObjectMeta) -> bool {
    meta.location.extension() == Some("mcap")
}

fn run_named(path: &Path, end: &str) -> Option<RunId> {
    path.filename()?.strip_suffix(end)?.parse().ok()
}

// The run whose rows are those of the file at this path.
fn known_run<'a>(snapshot: &'a LakeSnapshot, path: &Path) -> Option<&'a RunId> {
    let run = snapshot.run(&run_named(path, ".mcap")?)?;
    (Lake::run_path(&run.surface, &run.run) == *path).then_some(&run.run)
}

/// Finds run files in the lake by their names or paths, each None if there is none.
///
/// # Errors
/// [`Error::Lake`] if a folder cannot be listed, [`Error::Read`] if the store does not answer.
pub async fn find_runs(lake: &Lake, names: &[&str]) -> Result<Vec<Option<Path>>> {
    let mut found = Vec::with_capacity(names.len());
    let mut listed = None;
    for name in names {
        let file = if name.ends_with(".mcap") { (*name).to_owned() } else { format!("{name}.mcap") };
        let in_folder = [INBOX, RUNS].iter().any(|folder| file.starts_with(&format!("{folder}/")));
        let run = file.strip_suffix(".mcap").and_then(|run| run.parse::<RunId>().ok());
        // A run's name has its surface: most are found without a listing.
        let surface = run.as_ref().and_then(|run| run.untagged().split_once('-')?.1.parse().ok());
        let places = [
            in_folder.then(|| file.clone()),
            Some(format!("{INBOX}/{file}")),
            surface.zip(run).map(|(surface, run)| Lake::run_path(&surface, &run).to_string()),
        ];
        let mut place = None;
        for candidate in places.into_iter().flatten().filter_map(|place| Path::parse(place).ok()) {
            if place.is_none() && is_there(lake, &candidate).await? {
                place = Some(candidate);
            }
        }
        if place.is_none() {
            if listed.is_none() {
                let mut files = lake.list_folder(INBOX).await?.files;
                files.append(&mut lake.list_folder(RUNS).await?.files);
                listed = Some(files);
            }
            let mut files = listed.iter().flatten().map(|meta| &meta.location);
            place = files.find(|path| path.filename() == Some(file.as_str()) || path.as_ref() == file).cloned();
        }
        found.push(place);
    }
    Ok(found)
}

async fn is_there(lake: &Lake, path: &Path) -> Result<bool> {
    if let Some(file) = local_file(lake, path) {
        return Ok(fs::symlink_metadata(file).is_ok_and(|meta| meta.is_file()));
    }
    match lake.store().head(path).await {
        Ok(_) => Ok(true),
        Err(object_store::Error::NotFound { .. }) => Ok(false),
        Err(e) => Err(Error::read(path, e)),
    }
}

/// Returns the path of a lake's file on this machine; None for a lake on an object store.
fn local_file(lake: &Lake, path: &Path) -> Option<PathBuf> {
    Some(lake.folder()?.join(path.as_ref()))
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

async fn recording_state(lake: &Lake, partial: &Path) -> RecordingState {
    let Some(file) = local_file(lake, partial) else { return RecordingState::CutOff };
    if is_being_recorded(&file) {
        return RecordingState::Running;
    }
    let opened = Opened { store: lake.store(), path: partial.clone(), name: partial.to_string() };
    match Head::read(&opened).await {
        Some(head) if head.has_plan => RecordingState::Resumable,
        Some(head) if head.origin.is_imported() => RecordingState::Import,
        _ => RecordingState::CutOff,
    }
}

// The recorder holds a lock as long as it lives. A file that cannot be opened counts as being recorded.
fn is_being_recorded(partial: &FsPath) -> bool {
    match fs::File::open(partial) {
        Ok(file) => file.try_lock_shared().is_err(),
        Err(_) => true,
    }
}

/// Returns whether a run file of the lake ends as a closed file does.
///
/// # Errors
/// What the store says.
pub async fn has_end(lake: &Lake, path: &Path) -> object_store::Result<bool> {
    has_end_at(lake.store().as_ref(), path, lake.store().head(path).await?.size).await
}

/// Returns whether the first `bytes` bytes of a file end as a closed file does.
pub(crate) async fn has_end_at(store: &dyn ObjectStore, path: &Path, bytes: u64) -> object_store::Result<bool> {
    if bytes < FILE_END_BYTES {
        return Ok(false);
    }
    Ok(has_file_end(&store.get_range(path, bytes - FILE_END_BYTES..bytes).await?))
}

/// Checks that a file ends as a closed file does. What is no MCAP file at all is left to its reader.
///
/// # Errors
/// [`Error::Unfinished`], [`Error::Gone`], [`Error::Read`].
pub(crate) async fn check_end(opened: &Opened) -> Result<()> {
    let failed = |e: object_store::Error| match e {
        object_store::Error::NotFound { .. } => Error::Gone { file: opened.name.clone() },
        e => Error::read(&opened.name, e),
    };
    let bytes = opened.store.head(&opened.path).await.map_err(failed)?.size;
    if has_end_at(opened.store.as_ref(), &opened.path, bytes).await.map_err(failed)? {
        return Ok(());
    }
    let first = match bytes.min(MAGIC.len() as u64) {
        0 => bytes::Bytes::new(),
        length => opened.store.get_range(&opened.path, 0..length).await.map_err(failed)?,
    };
    // A copy of which nothing is written yet may have its size already.
    let is_begun = MAGIC.starts_with(&first) || first.iter().all(|byte| *byte == 0);
    if is_begun { Err(Error::Unfinished { file: opened.name.clone(), bytes }) } else { Ok(()) }
}

/// A file of this machine at a moment: what changes if another program writes it or replaces it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FileState {
    inode: u64,
    bytes: u64,
    changed: DateTime<Utc>,
}

impl FileState {
    /// Returns the state of a source on this machine; None on an object store.
    ///
    /// # Errors
    /// [`Error::Gone`], or [`Error::Read`] if it is no plain file.
    pub(crate) fn read(lake: &Lake, source: &RunSource) -> Result<Option<Self>> {
        let found = match source {
            // No link in the lake is followed, also if it has just taken a file's place.
            RunSource::Lake(path) => match local_file(lake, path) {
                Some(file) => fs::symlink_metadata(file),
                None => return Ok(None),
            },
            RunSource::File(file) => fs::metadata(file),
        };
        let meta = found.map_err(|e| match e.kind() {
            ErrorKind::NotFound => Error::Gone { file: source.to_string() },
            _ => Error::read(source, e),
        })?;
        if !meta.is_file() {
            return Err(Error::read(source, io::Error::new(ErrorKind::InvalidInput, "it is no plain file")));
        }
        Ok(Some(Self::from_metadata(&meta)))
    }

    fn from_metadata(meta: &Metadata) -> Self {
        let changed = meta.modified().map(DateTime::<Utc>::from).unwrap_or_default();
        Self { inode: meta.ino(), bytes: meta.len(), changed }
    }

    /// Checks that the file is as it was.
    ///
    /// # Errors
    /// [`Error::Changed`], [`Error::Gone`].
    fn check(before: Option<Self>, lake: &Lake, source: &RunSource) -> Result<()> {
        let (Some(before), Some(after)) = (before, Self::read(lake, source)?) else { return Ok(()) };
        if before == after {
            return Ok(());
        }
        Err(Error::Changed { file: source.to_string(), before: before.to_string(), after: after.to_string() })
    }
}

impl std::fmt::Display for FileState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} bytes of {} (inode {})", self.bytes, self.changed.format("%H:%M:%S%.6f"), self.inode)
    }
}

/// A run's file as it was read.
pub(crate) struct ReadFile<'a> {
    pub(crate) integrity: &'a FileIntegrity,
    /// Tag of the object when its reading began, if its store has tags.
    pub(crate) e_tag: Option<String>,
    /// Its state when its reading began, if it is on this machine.
    pub(crate) state: Option<FileState>,
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
        FileVersion { e_tag, state }: FileVersion,
        integrity: &'a FileIntegrity,
    ) -> Result<Self> {
        let recorded = recorded_digest(lake, source).await?;
        match recorded {
            Some(recorded) if recorded != integrity.sha256 => {
                let actual = integrity.sha256.clone();
                Err(Error::OtherDigest { file: source.to_string(), recorded, actual })
            }
            recorded => Ok(Self { integrity, e_tag, state, recorded }),
        }
    }
}

async fn recorded_digest(lake: &Lake, source: &RunSource) -> Result<Option<String>> {
    match source {
        RunSource::Lake(path) if source.is_in_inbox() && can_have_record(path) => {
            read_digest_record(lake.store().as_ref(), path).await.map_err(|e| Error::read(source, e))
        }
        _ => Ok(None),
    }
}

// No file has a name that is too long for a file.
fn can_have_record(path: &Path) -> bool {
    digest_record_path(path).filename().is_some_and(|name| name.len() <= LONGEST_FILE_NAME)
}

/// What tells whether a file changed since its reading began.
pub(crate) struct FileVersion {
    e_tag: Option<String>,
    state: Option<FileState>,
}

impl FileVersion {
    /// Reads the version of a source, before it is read itself.
    ///
    /// # Errors
    /// As of [`FileState::read`].
    pub(crate) async fn read(lake: &Lake, source: &RunSource) -> Result<Self> {
        let e_tag = match source {
            RunSource::Lake(path) if lake.is_remote() && source.is_in_inbox() => {
                lake.store().head(path).await.ok().and_then(|meta| meta.e_tag)
            }
            _ => None,
        };
        Ok(Self { e_tag, state: FileState::read(lake, source)? })
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
/// [`Error::OtherContent`] if another file is there, [`Error::Changed`] if the file is not what was read, [`Error::Gone`] if
/// it is no more, [`Error::Read`] if the copy is not what was read, or an error of the lake.
pub(crate) async fn keep(
    lake: &Lake,
    source: &RunSource,
    to: &Path,
    file: &ReadFile<'_>,
    is_known: bool,
) -> Result<()> {
    let checked = FileState::check(file.state, lake, source);
    if matches!(source, RunSource::Lake(from) if from == to) {
        return checked;
    }
    match checked {
        // Another ingest may have moved it.
        Err(Error::Gone { .. }) => {}
        checked => checked?,
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
        RunSource::File(from) => copy_in(lake, from, to, &mut || FileState::check(file.state, lake, source)).await,
        RunSource::Lake(from) => {
            move_record(lake, from, to, file).await.map_err(|e| written(to, e))?;
            if there == PlaceContent::Same {
                return delete(lake, from).await.map_err(|e| written(from, e));
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
            if let Err(changed) = FileState::check(file.state, lake, &RunSource::Lake(to.clone())) {
                lake.store().rename(to, from).await.map_err(|e| written(from, e))?;
                return Err(changed);
            }
            Ok(())
        }
    }
}

/// Checks that a file is as it was when its reading began.
///
/// # Errors
/// [`Error::Changed`], [`Error::Gone`].
pub(crate) fn check_unchanged(lake: &Lake, source: &RunSource, file: &ReadFile<'_>) -> Result<()> {
    FileState::check(file.state, lake, source)
}

/// Puts a file into the place of a shorter one that has its beginning, after the commit of its rows: if the process ends
/// before, the next ingest finds the file and its rows, and does the same.
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
        lake.store().put(&record, digest_record(&sha256, to).into()).await.map_err(|e| written(&record, e))?;
        delete(lake, &digest_record_path(from)).await.map_err(|e| written(from, e))?;
    }
    let bytes = lake.store().head(from).await.map_err(|e| written(from, e))?.size;
    move_object(lake, from, to, bytes, None).await.map_err(|fault| fault.into_error(to))
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
/// stay, and those that may be read later.
pub(crate) async fn quarantine(lake: &Lake, source: &RunSource, why: &Error) -> Result<Option<Path>> {
    let RunSource::Lake(from) = source else { return Ok(None) };
    if !source.is_in_inbox() || why.keeps_place() {
        return Ok(None);
    }
    set_aside(lake, from, &why.to_string()).await
}

/// Moves a file of the lake to `quarantine/`, the reason first; returns its path, or None if the file is gone.
///
/// # Errors
/// An error of the lake.
pub(crate) async fn set_aside(lake: &Lake, from: &Path, reason: &str) -> Result<Option<Path>> {
    let store = lake.store();
    let bytes = match store.head(from).await {
        Ok(meta) => meta.size,
        Err(object_store::Error::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(written(from, e)),
    };
    let name = from.filename().unwrap_or("run");
    // Only the end of a long name, because the name of the reason's file is longer.
    let start = (name.len().saturating_sub(LONGEST_NAME)..name.len()).find(|at| name.is_char_boundary(*at));
    let to = reserve_name(lake, &name[start.unwrap_or(0)..], reason).await?;
    // The name is free for another upload.
    if can_have_record(from) {
        delete(lake, &digest_record_path(from)).await.map_err(|e| written(from, e))?;
    }
    match move_object(lake, from, &to, bytes, None).await {
        // Another process moved it.
        Err(StoreFault::Store(object_store::Error::NotFound { .. })) => {
            delete(lake, &reason_path(&to)).await.map_err(|e| written(&to, e))?;
            Ok(None)
        }
        moved => moved.map(|()| Some(to)).map_err(|fault| fault.into_error(from)),
    }
}

/// Deletes a run's file and the record of its digest, if they are there.
///
/// # Errors
/// An error of the lake.
pub(crate) async fn delete_run(lake: &Lake, path: &Path) -> Result<()> {
    for path in [path, &digest_record_path(path)] {
        delete(lake, path).await.map_err(|e| written(path, e))?;
    }
    Ok(())
}

fn reason_path(refused: &Path) -> Path {
    let text = format!("{refused}{REASON}");
    // A path is encoded already.
    Path::parse(&text).unwrap_or_else(|_| Path::from(text))
}

// Of several processes that create a reason's file, one succeeds: two refused files of one name get two names.
async fn reserve_name(lake: &Lake, name: &str, reason: &str) -> Result<Path> {
    let store = lake.store();
    let mut number = 1;
    loop {
        let text = match number {
            1 => format!("{QUARANTINE}/{name}"),
            _ => format!("{QUARANTINE}/{number}-{name}"),
        };
        let path = Path::parse(&text).unwrap_or_else(|_| Path::from(text));
        number += 1;
        match store.head(&path).await {
            Err(object_store::Error::NotFound { .. }) => {}
            Err(e) => return Err(written(&path, e)),
            Ok(_) => continue,
        }
        let reserved = PutOptions::from(PutMode::Create);
        match store.put_opts(&reason_path(&path), format!("{reason}\n").into(), reserved).await {
            Err(object_store::Error::AlreadyExists { .. }) => {}
            Err(e) => return Err(written(&path, e)),
            Ok(_) => return Ok(path),
        }
    }
}

// `check` is called when everything is copied, before the copy has the run's name.
async fn copy_in(lake: &Lake, from: &FsPath, to: &Path, check: &mut (dyn FnMut() -> Result<()> + Send)) -> Result<()> {
    let (store, source) = (lake.store(), LocalFileSystem::new());
    let failed = |e: object_store::Error| written(to, e);
    let path = absolute(from)?;
    let size = source.head(&path).await.map_err(|e| Error::read(from.display(), e))?.size;
    // An object appears as a whole; a file is under another name first, so that a run's own name never holds part of it.
    if lake.is_remote() {
        copy_parts(&source, &path, size, store.as_ref(), to).await.map_err(failed)?;
        if let Err(changed) = check() {
            delete(lake, to).await.map_err(failed)?;
            return Err(changed);
        }
        return Ok(());
    }
    let staged = Path::from(format!("{INBOX}/{}.copying", to.filename().unwrap_or("run")));
    copy_parts(&source, &path, size, store.as_ref(), &staged).await.map_err(failed)?;
    if let Err(changed) = check() {
        delete(lake, &staged).await.map_err(failed)?;
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

// The lake itself cannot be written: an error of the lake, not of the run.
fn written(path: &Path, cause: object_store::Error) -> Error {
    let source = StoreError(cause);
    Error::Lake(echolake_lake::Error::Store { action: "write", path: path.to_string(), source })
}

fn absolute(file: &FsPath) -> Result<Path> {
    let absolute = std::path::absolute(file).map_err(|e| Error::read(file.display(), e))?;
    Path::from_absolute_path(absolute).map_err(|e| Error::read(file.display(), e))
}

#[cfg(test)]
mod tests {
    use echolake_lake::ReferenceSurfaces;
    use object_store::memory::InMemory;

    use super::*;

    async fn lake_in(store: Arc<dyn ObjectStore>) -> Lake {
        let made = Lake::open_or_create_in(store, "a lake", &Rig::paper(), &ReferenceSurfaces::default()).await;
        made.expect("a lake")
    }

    #[tokio::test]
    async fn two_refused_files_of_one_name_get_two_names() {
        let store = Arc::new(InMemory::new());
        let lake = lake_in(store.clone()).await;
        let paths = ["a", "b", "c"].map(|folder| Path::from(format!("inbox/{folder}/x.mcap")));
        for path in &paths {
            store.put(path, path.to_string().into()).await.expect("written");
        }
        let [a, b, c] = &paths;
        let (a, b, c) =
            tokio::join!(set_aside(&lake, a, "why a"), set_aside(&lake, b, "why b"), set_aside(&lake, c, "why c"));
        let mut names = Vec::new();
        for (moved, letter) in [(a, "a"), (b, "b"), (c, "c")] {
            let moved = moved.expect("moved").expect("it was there");
            let text = async |path: &Path| store.get(path).await.expect("there").bytes().await.expect("bytes");
            assert_eq!(text(&moved).await, format!("inbox/{letter}/x.mcap"));
            assert_eq!(text(&reason_path(&moved)).await, format!("why {letter}\n"));
            names.push(moved.to_string());
        }
        names.sort();
        assert_eq!(names, ["quarantine/2-x.mcap", "quarantine/3-x.mcap", "quarantine/x.mcap"]);
        assert_eq!(set_aside(&lake, &paths[0], "again").await.expect("nothing to do"), None);
    }

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
            let (damage, lost, is_data_whole) = (Vec::new(), Vec::new(), true);
            let integrity = FileIntegrity { bytes: 5, sha256, closed: true, damage, lost, is_data_whole };
            fs::write(file, "12345").expect("written");
            let version = FileVersion::read(&lake, &source).await.expect("there");
            let read = ReadFile::check(&lake, &source, version, &integrity).await.expect("read");
            fs::write(file, "123456").expect("written");
            let changed = keep(&lake, &source, &to, &read, false).await.expect_err("it is another file");
            assert!(matches!(changed, Error::Changed { .. }) && changed.to_string().contains("6 bytes"), "{changed}");
            assert!(file.exists() && lake.store().head(&to).await.is_err(), "{source}");
            fs::remove_file(file).expect("removed");
            let gone = keep(&lake, &source, &to, &read, false).await.expect_err("it is gone");
            assert!(gone.is_refusal(), "{gone}");
            // A link in its place is not followed.
            std::os::unix::fs::symlink("/etc/passwd", file).expect("linked");
            let followed = FileVersion::read(&lake, &source).await.is_ok();
            assert_eq!(followed, matches!(source, RunSource::File(_)));
            fs::remove_file(file).expect("removed");
        }
    }
}
