//! The runs of one import get their names together, or none of them does.

use std::path::{Path, PathBuf};

use echolake_acquisition::run::recorder::{Error, Recorder, RunStart, Sealed};
use echolake_schema::manifest::RunEnd;

/// Runs that are written and not yet named. Dropped before [`ImportBatch::publish_all`] has named all, it removes its
/// files, and only its own.
#[derive(Default)]
pub(crate) struct ImportBatch {
    sealed: Vec<Sealed>,
    ours: Vec<PathBuf>,
}

impl ImportBatch {
    /// Begins one of the runs.
    pub fn create_run(&mut self, path: &Path, start: &RunStart<'_>) -> Result<Recorder, Error> {
        let recorder = Recorder::create(path, start)?;
        self.ours.push(recorder.partial().to_owned());
        Ok(recorder)
    }

    /// Ends one of the runs: it is whole and on the disk.
    pub fn seal_run(&mut self, recorder: Recorder, end: &RunEnd) -> Result<(), Error> {
        self.sealed.push(recorder.seal(end)?);
        Ok(())
    }

    /// Gives all runs their names.
    pub fn publish_all(mut self) -> Result<(), Error> {
        // Conflicts that can be known are found before the first run has its name.
        if let Some(taken) = self.sealed.iter().find(|run| run.path().exists()) {
            return Err(Error::Exists { path: taken.path().to_owned() });
        }
        for run in std::mem::take(&mut self.sealed) {
            let path = run.path().to_owned();
            let named = run.publish();
            // A name that was taken meanwhile is another program's file.
            if !matches!(named, Err(Error::Exists { .. })) {
                self.ours.push(path);
            }
            named?;
        }
        self.ours.clear();
        Ok(())
    }
}

impl Drop for ImportBatch {
    fn drop(&mut self) {
        for path in &self.ours {
            // Most partial files have been renamed; if one cannot be removed, the import's own error explains it.
            let _ = std::fs::remove_file(path);
        }
    }
}
