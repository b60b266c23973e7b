//! Places of run files: new ones in `inbox/`, ingested ones under `runs/`, refused ones under `quarantine/`.

use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;

use echolake_lake::{Lake, StoreError};
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

/// Moves or copies a run's file to its place, before any row names it.
pub(crate) async fn keep(lake: &Lake, source: &RunSource, to: &Path, bytes: u64) -> Result<()> {
    let store = lake.store();
    let failed = |e: object_store::Error| written(to, e);
    let there = match store.head(to).await {
        Ok(meta) => meta.size == bytes,
        Err(object_store::Error::NotFound { .. }) => false,
        Err(e) => return Err(failed(e)),
    };
    match source {
        RunSource::Lake(from) if from == to => Ok(()),
        // If it has disappeared, another ingest has moved it there.
        RunSource::Lake(from) if there => match store.delete(from).await {
            Err(e) if !matches!(e, object_store::Error::NotFound { .. }) => Err(failed(e)),
            _ => Ok(()),
        },
        RunSource::Lake(from) => match move_object(lake, from, to, bytes).await {
            Err(object_store::Error::NotFound { .. }) if store.head(to).await.is_ok() => Ok(()),
            moved => moved.map_err(failed),
        },
        RunSource::File(_) if there => Ok(()),
        RunSource::File(from) => copy_in(lake, from, to).await,
    }
}

// A folder renames. An object store copies, and only what is there as a whole is deleted where it came from.
async fn move_object(lake: &Lake, from: &Path, to: &Path, bytes: u64) -> object_store::Result<()> {
    let store = lake.store();
    if !lake.is_remote() {
        return store.rename(from, to).await;
    }
    if bytes <= LARGEST_COPY {
        store.copy(from, to).await?;
    } else {
        copy_parts(store.as_ref(), from, bytes, store.as_ref(), to).await?;
    }
    let copied = store.head(to).await?.size;
    if copied != bytes {
        let source = format!("{copied} bytes of `{from}` arrived of {bytes}; hint: run the command again").into();
        return Err(object_store::Error::Generic { store: "copy", source });
    }
    match store.delete(from).await {
        Err(object_store::Error::NotFound { .. }) => Ok(()),
        deleted => deleted,
    }
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
    let moved = async { move_object(lake, from, &to, store.head(from).await?.size).await };
    match moved.await {
        // Another ingest refused it, too.
        Err(object_store::Error::NotFound { .. }) => Ok(None),
        moved => moved.map(|()| Some(to)).map_err(|e| written(from, e)),
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
