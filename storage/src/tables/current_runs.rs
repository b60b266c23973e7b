//! The runs that readers of a snapshot see, as their rows in `runs` tell, and which of them describe surfaces.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use echolake_schema::{ProjectName, RunId, SurfaceId};

use crate::tables::file_name::VisibleRun;
use crate::tables::run_parts::{RunPointer, list_pointers};
use crate::{DataFile, RunRowCounts};

/// The runs, by name and so by time.
#[derive(Debug, Clone, Default)]
pub(super) struct CurrentRuns {
    runs: Vec<CurrentRun>,
    places: HashMap<RunId, usize>,
}

impl CurrentRuns {
    /// Lists the runs that files of `runs` show. A row replaces its predecessor, in the same commit unless that one is
    /// in a merged file; of two the newer one counts.
    pub fn from_files(files: &[Arc<DataFile>]) -> Self {
        let mut rows: Vec<_> =
            files.iter().flat_map(|file| list_pointers(file).into_iter().map(move |row| (row, &**file))).collect();
        rows.sort_by_cached_key(|(row, _)| (row.version, row.run.joined_derivations()));
        let current = |(row, file): (RunPointer<'_>, &DataFile)| CurrentRun {
            log_version: row.version,
            project: file.project(),
            row_counts: row.row_counts.cloned(),
            run: row.run,
        };
        let by_name: BTreeMap<_, _> = rows.into_iter().map(current).map(|row| (row.run.run.clone(), row)).collect();
        let places = by_name.keys().cloned().enumerate().map(|(place, run)| (run, place)).collect();
        Self { runs: by_name.into_values().collect(), places }
    }

    /// Returns a run's row; None if it is not seen.
    pub fn get(&self, run: &RunId) -> Option<&CurrentRun> {
        self.runs.get(self.place_of(run)?)
    }

    /// Returns the place of a run among all.
    pub fn place_of(&self, run: &RunId) -> Option<usize> {
        self.places.get(run).copied()
    }

    /// Returns the rows in order.
    pub fn iter(&self) -> std::slice::Iter<'_, CurrentRun> {
        self.runs.iter()
    }

    /// Returns the number of runs.
    pub fn len(&self) -> usize {
        self.runs.len()
    }
}

/// A run's row in `runs`, and the version of `runs` that added it.
#[derive(Debug, Clone)]
pub(super) struct CurrentRun {
    pub run: VisibleRun,
    pub log_version: u64,
    pub project: Option<ProjectName>,
    pub row_counts: Option<RunRowCounts>,
}

/// The run that describes each surface: of all its runs, and of those of a project.
#[derive(Debug, Clone, Default)]
pub(super) struct NewestRuns {
    pub of_surface: HashMap<SurfaceId, RunId>,
    pub of_project: HashMap<(SurfaceId, ProjectName), RunId>,
}

impl NewestRuns {
    /// Of several runs the newest counts that is not rejected as a whole; if all of them are, the newest.
    pub fn from_runs<'a>(
        runs: impl Iterator<Item = &'a CurrentRun>,
        is_rejected: impl Fn(&VisibleRun) -> bool,
    ) -> Self {
        let mut newest = Self::default();
        let (rejected, others): (Vec<_>, Vec<_>) = runs.partition(|current| is_rejected(&current.run));
        for CurrentRun { run, project, .. } in rejected.into_iter().chain(others) {
            newest.of_surface.insert(run.surface.clone(), run.run.clone());
            if let Some(project) = project {
                newest.of_project.insert((run.surface.clone(), project.clone()), run.run.clone());
            }
        }
        newest
    }
}
