//! Where run files stand: found in the inbox, kept under `runs/`, refused ones under `quarantine/`.

use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;

use echolake_lake::{Lake, StoreError};
use echolake_schema::RunId;
use futures::TryStreamExt as _;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, WriteMultipart};

use crate::error::{Error, Result};
use crate::run_content::Head;

/// Folder of runs that are not taken in yet.
const INBOX: &str = "inbox";
/// Folder of closed runs.
const RUNS: &str = "runs";
/// Folder of refused files.
const QUARANTINE: &str = "quarantine";
/// What the name of a recording ends in until it is whole.
const PARTIAL: &str = ".partial";
/// Longest name of a refused file. File systems allow 255 bytes.
const LONGEST_NAME: usize = 200;
/// Bytes that are copied at a time.
const PART: u64 = 8 << 20;

/// Where a run's file is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// In the lake: under `inbox/` or `runs/`.
    Lake(Path),
    /// Anywhere else on this machine.
    File(PathBuf),
}

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Lake(path) => path.fmt(f),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// A source as something to read.
pub(crate) struct Opened {
    pub(crate) store: Arc<dyn ObjectStore>,
    pub(crate) path: Path,
    /// For people.
    pub(crate) name: String,
}

impl Source {
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

/// The run files of the lake that are in no table yet: all of `inbox/`, and those of `runs/` that `runs` does not name.
///
/// # Errors
/// [`Error::Lake`] where the lake cannot be listed.
pub async fn pending(lake: &Lake) -> Result<Vec<Source>> {
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
    Ok(found.into_iter().map(Source::Lake).collect())
}

/// Makes runs of the recordings in the inbox whose recorder died, so that ingest takes in what was complete; returns
/// them. Those that are still being recorded stay, those that can be gone on with, and those of imports, which are made
/// again from their files.
///
/// # Errors
/// [`Error::Read`] where the inbox cannot be changed.
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

// Its recorder holds a lock as long as it lives. What cannot be asked counts as alive.
fn is_being_recorded(partial: &FsPath) -> bool {
    match std::fs::File::open(partial) {
        Ok(file) => file.try_lock_shared().is_err(),
        Err(_) => true,
    }
}

// A run that is gone on with becomes a better one than its first part; an import is made again.
async fn is_made_whole_otherwise(partial: &FsPath) -> bool {
    let Ok(path) = absolute(partial) else { return false };
    let opened = Opened { store: Arc::new(LocalFileSystem::new()), path, name: partial.display().to_string() };
    let is = |head: Head| head.has_plan || head.origin.is_imported();
    Head::read(&opened).await.is_some_and(is)
}

/// Brings a run's file to its place, before any row names it.
pub(crate) async fn keep(lake: &Lake, source: &Source, to: &Path, bytes: u64) -> Result<()> {
    let store = lake.store();
    let failed = |e: object_store::Error| written(to, e);
    let there = match store.head(to).await {
        Ok(meta) => meta.size == bytes,
        Err(object_store::Error::NotFound { .. }) => false,
        Err(e) => return Err(failed(e)),
    };
    match source {
        Source::Lake(from) if from == to => Ok(()),
        // Where it is gone, another ingest has brought it there.
        Source::Lake(from) if there => match store.delete(from).await {
            Err(e) if !matches!(e, object_store::Error::NotFound { .. }) => Err(failed(e)),
            _ => Ok(()),
        },
        Source::Lake(from) => match store.rename(from, to).await {
            Err(object_store::Error::NotFound { .. }) if store.head(to).await.is_ok() => Ok(()),
            renamed => renamed.map_err(failed),
        },
        Source::File(_) if there => Ok(()),
        Source::File(from) => copy_in(lake, from, to).await,
    }
}

/// Puts a refused file of the inbox aside, the reason first; returns where it is. Other people's files stay.
pub(crate) async fn quarantine(lake: &Lake, source: &Source, why: &Error) -> Result<Option<Path>> {
    let Source::Lake(from) = source else { return Ok(None) };
    // What cannot be read now may be readable later.
    if !source.is_in_inbox() || matches!(why, Error::Read { .. }) {
        return Ok(None);
    }
    let store = lake.store();
    let name = from.filename().unwrap_or("run");
    // The end of a long one, because the reason's name is longer.
    let start = (name.len().saturating_sub(LONGEST_NAME)..name.len()).find(|at| name.is_char_boundary(*at));
    let to = free_name(lake, &name[start.unwrap_or(0)..]).await?;
    let reason = Path::from(format!("{to}.reason.txt"));
    store.put(&reason, format!("{why}\n").into()).await.map_err(|e| written(&reason, e))?;
    match store.rename(from, &to).await {
        // Another ingest refused it, too.
        Err(object_store::Error::NotFound { .. }) => Ok(None),
        renamed => renamed.map(|()| Some(to)).map_err(|e| written(from, e)),
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

// Under another name first, so that a run is under its own name whole or not at all.
async fn copy_in(lake: &Lake, from: &FsPath, to: &Path) -> Result<()> {
    let store = lake.store();
    let failed = |e: object_store::Error| written(to, e);
    let unread = |e: object_store::Error| Error::read(from.display(), e);
    let staged = Path::from(format!("{INBOX}/{}.copying", to.filename().unwrap_or("run")));
    let mut writer = WriteMultipart::new(store.put_multipart(&staged).await.map_err(failed)?);
    let source: Arc<dyn ObjectStore> = Arc::new(LocalFileSystem::new());
    let path = absolute(from)?;
    let size = source.head(&path).await.map_err(unread)?.size;
    let mut at = 0;
    while at < size {
        let end = (at + PART).min(size);
        writer.put(source.get_range(&path, at..end).await.map_err(unread)?);
        writer.wait_for_capacity(2).await.map_err(failed)?;
        at = end;
    }
    writer.finish().await.map_err(failed)?;
    store.rename(&staged, to).await.map_err(failed)
}

// The lake itself cannot be written, which is no fault of the run.
fn written(path: &Path, cause: object_store::Error) -> Error {
    let cause = StoreError(cause);
    Error::Lake(echolake_lake::Error::Store { action: "write", path: path.to_string(), cause })
}

fn absolute(file: &FsPath) -> Result<Path> {
    let failed = |e: &dyn std::fmt::Display| Error::read(file.display(), e);
    Path::from_absolute_path(std::path::absolute(file).map_err(|e| failed(&e))?).map_err(|e| failed(&e))
}
