//! Lists what is in no table yet, and finds run files by their names.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path as FsPath;
use std::sync::Arc;

use echolake_lake::{Lake, LakeSnapshot, UnusableEntry};
use echolake_schema::tables::{Source, Table};
use echolake_schema::{Rig, RunId};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt as _};

use super::run_source::{INBOX, OpenedRun, RunSource, absolute_path, local_file};
use crate::error::{Error, Result};
use crate::reading::RunHead;

/// Folder of closed runs.
const RUNS: &str = "runs";
/// End of a recording's name until the file is complete.
const PARTIAL: &str = ".mcap.partial";

/// Files of the lake that are in no table yet.
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
    pub fn run_sources(&self) -> Vec<RunSource> {
        self.runs.iter().map(|run| RunSource::Lake(run.location.clone())).collect()
    }
}

/// Lists what is in no table yet: all of `inbox/`, and the run files of `runs/` that table `runs` does not name or
/// whose rows are missing.
///
/// # Errors
/// [`Error::Lake`] if the snapshot or a folder cannot be read.
pub async fn list_pending(lake: &Lake) -> Result<PendingFiles> {
    let snapshot = lake.snapshot().await?;
    let mut pending = list_arrivals(lake).await?;
    let mut runs = lake.list_folder(RUNS).await?;
    let of_run = Table::ALL.into_iter().filter(|table| table.source() == Source::Run);
    let lacking: BTreeSet<_> = of_run.flat_map(|table| snapshot.lacking_rows(table)).map(|of| &of.run).collect();
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
pub async fn pending_runs(lake: &Lake) -> Result<Vec<RunSource>> {
    Ok(list_pending(lake).await?.run_sources())
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
        let surface = run.as_ref().and_then(|run| run.untagged_name().split_once('-')?.1.parse().ok());
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
        Err(e) => Err(Error::read_failure(path, e)),
    }
}

/// Reads the rig of a run file of this machine, for a lake that is made for it; None if the file does not begin as a
/// run.
///
/// # Errors
/// [`Error::NoRun`] if there is no such file.
pub async fn rig_of_run(file: &FsPath) -> Result<Option<Rig>> {
    if !file.is_file() {
        return Err(Error::NoRun { given: file.display().to_string() });
    }
    let path = absolute_path(file)?;
    let name = file.display().to_string();
    let opened = OpenedRun { store: Arc::new(LocalFileSystem::new()), path, name };
    Ok(RunHead::read_from(&opened).await.and_then(|head| head.rig))
}

async fn recording_state(lake: &Lake, partial: &Path) -> RecordingState {
    let Some(file) = local_file(lake, partial) else { return RecordingState::CutOff };
    if is_being_recorded(&file) {
        return RecordingState::Running;
    }
    let opened = OpenedRun { store: lake.store(), path: partial.clone(), name: partial.to_string() };
    match RunHead::read_from(&opened).await {
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
