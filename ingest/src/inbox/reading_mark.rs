//! Marks on the files that ingests read, so that a file that ends the process is found by the next ingest.
//!
//! A mark is a locked file; the system releases the lock when the process ends, however it ends. A mark without a lock
//! makes its file a suspect and proves nothing: several files are read at once, and a power cut or an operator's kill
//! is not the fault of a file. Suspects are therefore ingested one at a time, each by a process of its own. Only deaths
//! of that process that a living parent observes count against the file.

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use echolake_lake::Lake;

use super::pending_files::pending_runs;
use super::quarantine::quarantine_file;
use super::run_source::RunSource;
use crate::error::{Error, Result};
use crate::references::digest_parts;
use crate::report::FileReport;

/// Folder of the marks. Deleting `tables/` deletes them, too.
const FOLDER: &str = "tables/_reading";
/// Number of processes that must die of a suspect before it is refused. One may be killed together with its parent.
const MOST_DEATHS: usize = 2;

/// A mark on a file that is being read. It stays if a panic ends the reading.
pub(crate) struct ReadingMark {
    path: PathBuf,
    _lock: File,
}

impl ReadingMark {
    /// Marks a file. None if it is not in the lake, if another ingest reads it, or if the disk is full: a missing mark
    /// must not fail the ingest.
    pub fn new(lake: &Lake, source: &RunSource) -> Option<Self> {
        let path = mark_path(lake, source)?;
        fs::create_dir_all(path.parent()?).ok()?;
        let lock = OpenOptions::new().append(true).create(true).open(&path).ok()?;
        lock.try_lock().ok()?;
        Some(Self { path, _lock: lock })
    }
}

impl Drop for ReadingMark {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            // A mark that stays only costs a separate process for its file.
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// A file that an ingest was reading when it died.
#[derive(Debug)]
pub struct SuspectFile {
    source: RunSource,
    mark: PathBuf,
    /// Endings of the processes that ingested this file alone.
    endings: Vec<String>,
}

impl SuspectFile {
    /// Returns the suspect if the file has an unlocked mark; None for a file that is being read now.
    pub fn from_source(lake: &Lake, source: &RunSource) -> Option<Self> {
        let mark = mark_path(lake, source)?;
        let is_read = File::open(&mark).ok()?.try_lock_shared().is_err();
        let endings = fs::read_to_string(&mark).unwrap_or_default().lines().map(str::to_owned).collect();
        (!is_read).then(|| Self { source: source.clone(), mark, endings })
    }

    /// The file.
    pub fn source(&self) -> &RunSource {
        &self.source
    }

    /// Returns the suspects among the files that are in no table yet.
    ///
    /// # Errors
    /// As of [`pending_runs`].
    pub async fn find_pending(lake: &Lake) -> Result<Vec<Self>> {
        Ok(pending_runs(lake).await?.iter().filter_map(|source| Self::from_source(lake, source)).collect())
    }

    /// Records the death of a process that ingested this file alone; `ending` describes it. If the process had moved
    /// the file to its place, it is the suspect that is not among those of `before` the process.
    ///
    /// # Errors
    /// As of [`pending_runs`]; [`Error::Read`] if the mark cannot be written.
    pub async fn add_death(&mut self, lake: &Lake, ending: &str, before: &[Self]) -> Result<()> {
        self.endings.push(ending.to_owned());
        let mut suspects = Self::find_pending(lake).await?;
        if suspects.iter().all(|suspect| suspect.source != self.source) {
            suspects.retain(|suspect| before.iter().all(|known| known.source != suspect.source));
            if let Some(moved) = suspects.pop() {
                let _ = fs::remove_file(&self.mark);
                (self.source, self.mark) = (moved.source, moved.mark);
            }
        }
        // Writes all endings, because the process has recreated the mark.
        let mark = OpenOptions::new().write(true).truncate(true).open(&self.mark);
        match mark.and_then(|mut mark| writeln!(mark, "{}", self.endings.join("\n"))) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(Error::read_failure(self.mark.display(), e)),
            _ => Ok(()),
        }
    }

    /// Refuses the file if enough processes died of it.
    ///
    /// # Errors
    /// Errors of the lake.
    pub async fn refuse_if_deadly(&self, lake: &Lake) -> Result<Option<FileReport>> {
        if self.endings.len() < MOST_DEATHS {
            return Ok(None);
        }
        let file = self.source.to_string();
        let mark = self.mark.display().to_string();
        let why = Error::Deadly { file, endings: self.endings.join(", "), mark };
        let moved = quarantine_file(lake, &self.source, &why).await?;
        // The file of an ingested run is not moved, and its mark stays.
        if moved.is_some() {
            let _ = fs::remove_file(&self.mark);
        }
        Ok(Some(FileReport::Refused { source: self.source.clone(), why, moved }))
    }
}

// Named by a digest, because a path may be longer than a file name.
fn mark_path(lake: &Lake, source: &RunSource) -> Option<PathBuf> {
    let RunSource::Lake(path) = source else { return None };
    Some(lake.folder()?.join(Path::new(FOLDER)).join(digest_parts(&[path.as_ref()])))
}

#[cfg(test)]
mod tests {
    use echolake_lake::ReferenceSurfaces;
    use echolake_schema::Rig;
    use object_store::ObjectStoreExt as _;
    use object_store::path::Path as ObjectPath;

    use super::*;

    #[tokio::test]
    async fn only_a_file_by_which_two_processes_ended_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        // Too long for the name of the reason's file.
        let name = format!("{}.mcap", "a".repeat(240));
        let source = RunSource::Lake(ObjectPath::from(format!("inbox/{name}")));
        let inbox = folder.path().join("lake/inbox");
        fs::create_dir_all(&inbox).and_then(|()| fs::write(inbox.join(name), "x")).expect("written");
        let is_suspect = || SuspectFile::from_source(&lake, &source).is_some();

        let mark = ReadingMark::new(&lake, &source).expect("a mark");
        assert!(ReadingMark::new(&lake, &source).is_none() && !is_suspect(), "another ingest is reading it");
        drop(mark);
        assert!(!is_suspect(), "its reading ended");

        // The state that a dead process leaves behind.
        let die = || fs::write(mark_path(&lake, &source).expect("a lake in a folder"), "").expect("written");
        die();
        let mut suspect = SuspectFile::from_source(&lake, &source).expect("a suspect");
        assert!(suspect.refuse_if_deadly(&lake).await.expect("asked").is_none(), "nothing was seen of it yet");
        suspect.add_death(&lake, "signal: 6 (SIGABRT)", &[]).await.expect("written");
        assert!(
            suspect.refuse_if_deadly(&lake).await.expect("asked").is_none(),
            "its parent may have been killed with it"
        );
        // The next process looked at the file, then began to read it.
        drop(ReadingMark::new(&lake, &source));
        die();
        suspect.add_death(&lake, "signal: 9 (SIGKILL)", &[]).await.expect("written");
        let report = suspect.refuse_if_deadly(&lake).await.expect("asked").expect("refused");
        let FileReport::Refused { moved: Some(moved), why, .. } = report else { panic!("{report:?}") };
        assert!(why.to_string().contains("signal: 6 (SIGABRT), signal: 9 (SIGKILL)"), "{why}");
        let reason = ObjectPath::from(format!("{moved}.reason.txt"));
        assert!(lake.store().head(&moved).await.is_ok() && lake.store().head(&reason).await.is_ok(), "{moved}");
        assert!(!is_suspect(), "who moves it back has it tried again");
    }

    #[tokio::test]
    async fn a_suspect_is_followed_to_its_place() {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let [first, other, place] = ["inbox/a.mcap", "inbox/b.mcap", "runs/brick/a.mcap"].map(ObjectPath::from);
        for path in [&first, &other] {
            lake.store().put(path, "x".into()).await.expect("written");
            drop(ReadingMark::new(&lake, &RunSource::Lake(path.clone())));
            fs::write(mark_path(&lake, &RunSource::Lake(path.clone())).expect("in a folder"), "").expect("written");
        }
        let before = SuspectFile::find_pending(&lake).await.expect("listed");
        assert_eq!(before.len(), 2);
        let mut suspect = SuspectFile::from_source(&lake, &RunSource::Lake(first.clone())).expect("a suspect");
        suspect.add_death(&lake, "once", &before).await.expect("written");
        assert_eq!(*suspect.source(), RunSource::Lake(first.clone()), "it is where it was");
        // The next process moves it, and ends before the old mark is removed.
        lake.store().rename(&first, &place).await.expect("moved");
        let place = RunSource::Lake(place);
        fs::write(mark_path(&lake, &place).expect("in a folder"), "").expect("written");
        suspect.add_death(&lake, "twice", &before).await.expect("written");
        assert_eq!(*suspect.source(), place);
        assert!(SuspectFile::from_source(&lake, &RunSource::Lake(first)).is_none(), "its old mark is gone");
        let there = SuspectFile::from_source(&lake, &place).expect("a suspect");
        assert_eq!(there.endings, ["once", "twice"], "both count");
    }
}
