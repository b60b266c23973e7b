//! The part of a lake that a reader may see: a frozen view of every table, cut down to what `runs` names.
//!
//! Delta commits one table at a time, so a run's rows are committed before its `runs` row. The file of that
//! row carries in its name the derivations that are current; files of other derivations are not seen.

use std::cmp::Reverse;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::{Arc, OnceLock};

use echolake_schema::tables::{Source, Table};
use echolake_schema::{ProjectName, RunId, SurfaceId};
use futures::future::{try_join, try_join_all};
use object_store::path::Path;

use crate::contributions::ShownVersions;
use crate::tables::current_runs::{CurrentRun, CurrentRuns, NewestRuns};
use crate::tables::file_name::{FileName, VisibleRun};
use crate::tables::run_parts::run_of_file;
use crate::tables::table_fault::{LackingRows, TableFault};
use crate::{CommitLog, DataFile, Error, Result, RunPart, RunRowCounts, TableView};

/// A frozen view of all tables.
#[derive(Debug, Clone, Default)]
pub struct LakeSnapshot {
    files: HashMap<Table, SeenFiles>,
    runs: CurrentRuns,
    newest: NewestRuns,
    hidden: HashMap<Table, Vec<Arc<DataFile>>>,
    outgrown: HashMap<Table, Vec<Arc<DataFile>>>,
    foreign: HashMap<Table, Vec<Arc<DataFile>>>,
    lacking: HashMap<Table, Vec<LackingRows>>,
    faults: HashMap<Table, TableFault>,
    versions: HashMap<Table, u64>,
    tables_id: String,
    shown: ShownVersions,
    copied: HashMap<Table, u64>,
    is_restricted: bool,
}

/// The files of a table that readers see.
#[derive(Debug, Clone, Default)]
struct SeenFiles {
    files: Vec<Arc<DataFile>>,
    /// The places of the files that show rows of a run, once somebody asks for those of one.
    of_run: OnceLock<HashMap<RunId, Vec<usize>>>,
}

impl SeenFiles {
    fn files_of(&self, run: &RunId) -> impl Iterator<Item = &DataFile> {
        let places = self.of_run.get_or_init(|| {
            let mut places = HashMap::<RunId, Vec<usize>>::new();
            for (place, file) in self.files.iter().enumerate() {
                for run in file.shown_runs() {
                    let of_run = places.entry(run).or_default();
                    // A file of users may have several parts of a run.
                    if of_run.last() != Some(&place) {
                        of_run.push(place);
                    }
                }
            }
            places
        });
        let places = places.get(run).map_or(&[] as &[usize], Vec::as_slice);
        places.iter().filter_map(|place| self.files.get(*place)).map(|file| &**file)
    }
}

impl From<Vec<Arc<DataFile>>> for SeenFiles {
    fn from(files: Vec<Arc<DataFile>>) -> Self {
        Self { files, of_run: OnceLock::new() }
    }
}

/// Snapshots that are taken until one is not overtaken by a commit of `runs`.
const TAKE_TRIES: usize = 10;

/// A table's view, or the fault of its log.
pub(crate) type ReadView = std::result::Result<Option<TableView>, TableFault>;

async fn views_of_others(log: &dyn CommitLog, tables: &[Table]) -> Result<Vec<(Table, ReadView)>> {
    let others = tables.iter().copied().filter(|table| *table != Table::Runs);
    let read = others.map(|table| async move {
        match log.view_table(table).await {
            Err(Error::Log { source, .. }) => Ok((table, Err(TableFault::unreadable(table, source.to_string())))),
            view => view.map(|view| (table, Ok(view))),
        }
    });
    try_join_all(read).await
}

/// A table of users as its readers see it: of the version that `runs` shows.
pub(crate) async fn shown_view(log: &dyn CommitLog, table: Table, view: ReadView, shown: u64) -> Result<ReadView> {
    match view {
        // Another writer adds rows at this moment, or ended before they were shown.
        Ok(Some(view)) if view.version > shown => Ok(Ok(log.view_at(table, shown).await?)),
        Ok(found) if found.as_ref().map_or(0, |view| view.version) < shown => {
            Ok(Err(TableFault::lost_version(table, shown, found.map(|view| view.version))))
        }
        view => Ok(view),
    }
}

impl LakeSnapshot {
    /// Takes a view of `runs` and these tables. They are read after the version of `runs` was there, so that they hold
    /// whatever it names: all at once if it is still the version of the last look.
    ///
    /// If `runs` has a newer version than a view that lacks rows, ingest has replaced them meanwhile: the view is taken
    /// again.
    pub(crate) async fn take_from(log: &dyn CommitLog, tables: &[Table]) -> Result<Self> {
        for _ in 0..TAKE_TRIES {
            let snapshot = Self::take_once(log, tables).await?;
            if snapshot.faults.is_empty() || log.newest_version(Table::Runs).await? == snapshot.log_version(Table::Runs)
            {
                return Ok(snapshot);
            }
        }
        Self::take_once(log, tables).await
    }

    async fn take_once(log: &dyn CommitLog, tables: &[Table]) -> Result<Self> {
        let known = log.known_version(Table::Runs).await;
        let (pointers, mut views) = try_join(log.view_table(Table::Runs), views_of_others(log, tables)).await?;
        if known.is_none() || pointers.as_ref().map(|view| view.version) != known {
            views = views_of_others(log, tables).await?;
        }
        let mut snapshot = Self::from_pointers(pointers.as_ref().map_or(&[], |view| view.files.as_slice()));
        let is_rebuilding = pointers.as_ref().is_some_and(|view| view.is_rebuilding);
        snapshot.tables_id = pointers.as_ref().map(|view| view.id.clone()).unwrap_or_default();
        snapshot.shown = pointers.as_ref().map(|view| view.shown).unwrap_or_default();
        for (table, mut view) in views.into_iter().chain([(Table::Runs, Ok(pointers))]) {
            if table.source() == Source::Users {
                view = shown_view(log, table, view, snapshot.shown.of_table(table).table).await?;
            }
            match view {
                Ok(view) => {
                    snapshot.versions.extend(view.as_ref().map(|view| (table, view.version)));
                    snapshot.take_view(table, view.unwrap_or_default());
                }
                Err(fault) => snapshot.set_fault(fault),
            }
        }
        if is_rebuilding {
            snapshot.set_fault(TableFault::unfinished());
        }
        Ok(snapshot)
    }

    // Without the files of any table.
    fn from_pointers(pointers: &[Arc<DataFile>]) -> Self {
        let runs = CurrentRuns::from_files(pointers);
        Self { newest: NewestRuns::from_runs(runs.iter(), VisibleRun::is_rejected), runs, ..Self::default() }
    }

    fn take_view(&mut self, table: Table, view: TableView) {
        self.copied.insert(table, view.copied);
        self.sort_in(table, view.files);
    }

    /// The view of a table of users that a version of `runs` gives.
    pub(crate) fn from_user_view(pointers: &TableView, table: Table, view: ReadView) -> Self {
        let mut snapshot = Self { shown: pointers.shown, ..Self::from_pointers(&pointers.files) };
        match view {
            Ok(view) => snapshot.take_view(table, view.unwrap_or_default()),
            Err(fault) => snapshot.set_fault(fault),
        }
        snapshot
    }

    /// The view of one table that a version of `runs` gives, its files as the log had them then.
    pub(crate) fn from_table_files(pointers: &[Arc<DataFile>], table: Table, files: Vec<Arc<DataFile>>) -> Self {
        let mut snapshot = Self::from_pointers(pointers);
        snapshot.sort_in(table, files);
        snapshot
    }

    /// Checks that a table has all rows that `runs` names, and no others.
    ///
    /// # Errors
    /// [`Error::Incomplete`], or [`Error::Log`] if its log is damaged.
    pub fn check_table(&self, table: Table) -> Result<()> {
        self.check_own_fault(table)?;
        let of_runs = self.faults.get(&Table::Runs).filter(|_| table.source() != Source::Rig);
        of_runs.map_or(Ok(()), |fault| Err(fault.to_error()))
    }

    // Checks a table but not `runs`, on which it rests.
    pub(crate) fn check_own_fault(&self, table: Table) -> Result<()> {
        self.faults.get(&table).map_or(Ok(()), |fault| Err(fault.to_error()))
    }

    /// Checks all tables but those of users, on which no other rests.
    ///
    /// # Errors
    /// As [`LakeSnapshot::check_table`].
    pub fn check_run_tables(&self) -> Result<()> {
        let mut of_runs = Table::ALL.into_iter().filter(|table| table.source() != Source::Users);
        of_runs.try_for_each(|table| self.check_table(table))
    }

    /// Returns whether no table has a fault.
    pub fn is_whole(&self) -> bool {
        self.faults.is_empty()
    }

    pub(crate) fn set_fault(&mut self, fault: TableFault) {
        self.faults.insert(fault.table, fault);
    }

    /// The runs that have other rows in a table than `runs` names.
    pub fn lacking_rows(&self, table: Table) -> &[LackingRows] {
        self.lacking.get(&table).map_or(&[], Vec::as_slice)
    }

    /// Returns whether a run lacks rows in one of the tables of a source.
    pub fn lacks_rows(&self, run: &RunId, source: Source) -> bool {
        let of_source = Table::ALL.into_iter().filter(|table| table.source() == source);
        of_source.flat_map(|table| self.lacking_rows(table)).any(|lacking| lacking.run == *run)
    }

    /// The files of a table that another program put into its log; empty for readers of some projects.
    pub fn foreign_files(&self, table: Table) -> &[Arc<DataFile>] {
        self.foreign.get(&table).map_or(&[], Vec::as_slice)
    }

    /// The rows of a run by table, as its row in `runs` names them.
    pub fn row_counts(&self, run: &RunId) -> Option<&RunRowCounts> {
        self.runs.get(run)?.row_counts.as_ref()
    }

    /// The same view, of a reader of some projects.
    #[must_use]
    pub(crate) fn with_restriction(mut self, is_restricted: bool) -> Self {
        self.is_restricted = is_restricted;
        if is_restricted {
            // They may be of other projects. Rows of this reader that are in them are missing besides.
            self.foreign.clear();
            self.faults.retain(|_, fault| !fault.is_of_foreign_files);
        }
        self
    }

    /// Returns whether this is a reader's of some projects: what it hides is none of the reader's business.
    pub fn is_restricted(&self) -> bool {
        self.is_restricted
    }

    /// The version of the lake in which readers saw this for the first time, or the present one: how many versions
    /// others added since is shown to nobody else. None if there was no table, and for views of the past.
    pub fn lake_version(&self) -> Option<u64> {
        match self.is_restricted {
            false => self.log_version(Table::Runs),
            true => self.runs.iter().map(|current| current.log_version).max(),
        }
    }

    /// The version of a table's log that the view was taken of; that of `runs` is the lake's. None if there was no
    /// table, and for views of the past.
    pub fn log_version(&self, table: Table) -> Option<u64> {
        self.versions.get(&table).copied()
    }

    /// The id of `runs`: tables that were made again count their versions from 0 again, under another one.
    pub fn tables_id(&self) -> &str {
        &self.tables_id
    }

    /// What it shows of the tables of users.
    pub(crate) fn shown_versions(&self) -> ShownVersions {
        self.shown
    }

    /// The highest number of an object of the lake's earlier form that is in a table of users.
    pub(crate) fn copied_objects(&self, table: Table) -> u64 {
        self.copied.get(&table).copied().unwrap_or(0)
    }

    /// The files of a table that readers see.
    pub fn files(&self, table: Table) -> &[Arc<DataFile>] {
        self.files.get(&table).map_or(&[], |seen| seen.files.as_slice())
    }

    /// The files of a table that its readers may have as they are: for readers of some projects, those without hidden
    /// rows.
    pub fn readable_files(&self, table: Table) -> impl Iterator<Item = &DataFile> {
        let readable = self.files(table).iter().filter(|file| !self.is_restricted || file.hidden.is_empty());
        readable.map(|file| &**file)
    }

    /// The files of a table that belong to a run that readers see, but are no longer seen themselves. Excludes files
    /// whose author had seen the run's present row: that ingest may be about to replace it by one that names them.
    pub fn superseded_files(&self, table: Table) -> &[Arc<DataFile>] {
        self.hidden.get(&table).map_or(&[], Vec::as_slice)
    }

    /// Files of a table that have superseded rows of some runs, and rows of others that are not.
    pub(crate) fn outgrown_files(&self, table: Table) -> &[Arc<DataFile>] {
        self.outgrown.get(&table).map_or(&[], Vec::as_slice)
    }

    /// The runs that readers see, by name and so by time.
    pub fn runs(&self) -> impl DoubleEndedIterator<Item = &VisibleRun> {
        self.runs.iter().map(|current| &current.run)
    }

    /// One run.
    pub fn run(&self, run: &RunId) -> Option<&VisibleRun> {
        self.runs.get(run).map(|current| &current.run)
    }

    /// The run that describes a surface: its newest that is not rejected as a whole, or its newest.
    pub fn newest_run(&self, surface: &SurfaceId) -> Option<&VisibleRun> {
        self.run(self.newest.of_surface.get(surface)?)
    }

    /// The runs that describe a surface, to all readers or to those of one project, if these were all runs and the
    /// rejected ones.
    pub fn describing_runs(
        &self,
        is_there: impl Fn(&VisibleRun) -> bool,
        is_rejected: impl Fn(&VisibleRun) -> bool,
    ) -> BTreeSet<RunId> {
        let there = self.runs.iter().filter(|current| is_there(&current.run));
        let NewestRuns { of_surface, of_project } = NewestRuns::from_runs(there, is_rejected);
        of_surface.into_values().chain(of_project.into_values()).collect()
    }

    /// The project of a run; None if it was given none.
    pub fn project_of(&self, run: &RunId) -> Option<&ProjectName> {
        self.runs.get(run)?.project.as_ref()
    }

    /// The version of `runs` that added a run's present row; None if the run is not seen.
    pub fn row_version(&self, run: &RunId) -> Option<u64> {
        Some(self.runs.get(run)?.log_version)
    }

    /// The files of one run in a table, and the merged ones that show its rows.
    pub fn files_of<'a>(&'a self, table: Table, run: &'a RunId) -> impl Iterator<Item = &'a DataFile> {
        self.files.get(&table).into_iter().flat_map(move |seen| seen.files_of(run))
    }

    /// The runs whose rows are in the files of a table that readers see.
    pub(crate) fn shown_runs(&self, table: Table) -> HashSet<RunId> {
        self.files(table).iter().flat_map(|file| file.shown_runs()).collect()
    }

    fn sort_in(&mut self, table: Table, mut files: Vec<Arc<DataFile>>) {
        if table.source() == Source::Users {
            return self.sort_in_users(table, files);
        }
        let mut sorted = SortedFiles::with_runs(self.runs.len());
        // An ingest that did not know of a file may have added the same rows again. Of both, the rows count whose
        // author saw more: they are the last ones that any snapshot takes for superseded.
        files.sort_by_key(|file| (Reverse(file.seen_runs), !file.parts.is_empty()));
        for file in files {
            match file.parts.is_empty() {
                true => self.sort_single(table, file, &mut sorted),
                false => self.sort_shared(table, file, &mut sorted),
            }
        }
        sorted.seen.sort_by(|a, b| a.path.cmp(&b.path));
        let is_without_rig = table.source() == Source::Rig && sorted.seen.is_empty() && self.runs.len() > 0;
        let lacking = self.compare_rows(table, &sorted.logged);
        let fault = match (lacking.is_empty(), sorted.foreign.first()) {
            (false, _) => Some(TableFault::from_lacking(table, &lacking)),
            (true, Some(file)) => Some(TableFault::from_foreign(table, file)),
            (true, None) => is_without_rig.then(|| TableFault::without_rig(table)),
        };
        fault.into_iter().for_each(|fault| self.set_fault(fault));
        self.files.insert(table, sorted.seen.into());
        self.hidden.insert(table, sorted.hidden);
        self.outgrown.insert(table, sorted.outgrown);
        self.foreign.insert(table, sorted.foreign);
        self.lacking.insert(table, lacking);
    }

    fn sort_single(&self, table: Table, file: Arc<DataFile>, sorted: &mut SortedFiles) {
        let place = self.file_place(table, &file);
        let run = run_of_file(&file).and_then(|run| self.runs.place_of(run));
        if let (RowsPlace::Seen | RowsPlace::OfProject, Some(run)) = (place, run) {
            sorted.logged[run].get_or_insert(file.rows);
        }
        match place {
            RowsPlace::Seen if run.is_some_and(|run| std::mem::replace(&mut sorted.shown[run], true)) => {
                sorted.hidden.push(file);
            }
            RowsPlace::Seen => sorted.seen.push(file),
            RowsPlace::Superseded if self.is_file_superseded(table, &file) => sorted.hidden.push(file),
            RowsPlace::Foreign => sorted.foreign.push(file),
            RowsPlace::Superseded | RowsPlace::OfProject | RowsPlace::Unseen => {}
        }
    }

    // Rows of users are seen with their run, predictions with any run of their surface: those of removed runs stay.
    fn sort_in_users(&mut self, table: Table, files: Vec<Arc<DataFile>>) {
        let (mut seen, foreign): (Vec<_>, Vec<_>) = files.into_iter().partition(|file| !file.parts.is_empty());
        for file in &mut seen {
            let is_seen = |surface: &SurfaceId, run: &RunId| match table {
                Table::Predictions => self.newest.of_surface.contains_key(surface),
                _ => self.runs.get(run).is_some(),
            };
            let unseen = file.parts.iter().filter(|part| !is_seen(&part.surface, &part.run));
            let unseen = unseen.map(|part| part.run.clone());
            let mut hidden: Vec<_> = file.hidden.iter().cloned().chain(unseen).collect();
            hidden.sort();
            hidden.dedup();
            DataFile::hide_runs(file, hidden);
        }
        seen.retain(|file| file.visible_parts().next().is_some());
        foreign.first().into_iter().for_each(|file| self.set_fault(TableFault::from_foreign(table, file)));
        self.files.insert(table, seen.into());
        self.foreign.insert(table, foreign);
    }

    // What each run's row says that the table has of it, against what its log has.
    fn compare_rows(&self, table: Table, logged: &[Option<u64>]) -> Vec<LackingRows> {
        let named = self.runs.iter().zip(logged).filter(|(current, _)| match table.source() {
            Source::Rig | Source::Pointer | Source::Users => false,
            Source::Run => true,
            Source::References => current.run.reference_derivation.is_some(),
        });
        let needed = named.filter(|(current, _)| self.run_place(table, current) != RowsPlace::Superseded);
        let compared = needed.filter_map(|(current, actual)| {
            let expected = current.row_counts.as_ref().and_then(|counts| counts.rows_of(table));
            let is_whole = match (expected, &current.row_counts) {
                (Some(expected), _) => actual.unwrap_or(0) == expected,
                (None, Some(_)) => true,
                // An earlier version of the program wrote the row: all tables but this one have a file of each run.
                (None, None) => actual.is_some() || table == Table::Heightmaps,
            };
            let run = current.run.run.clone();
            (!is_whole).then(|| LackingRows { run, expected, actual: actual.unwrap_or(0) })
        });
        compared.collect()
    }

    // Each part is placed as a file of its own would be.
    fn sort_shared(&self, table: Table, mut file: Arc<DataFile>, sorted: &mut SortedFiles) {
        let mut superseded = Vec::new();
        let mut hidden = Vec::new();
        for part in &file.parts {
            let place = self.rows_place(table, &part.run, &part.derivation);
            let is_superseded = match place {
                RowsPlace::Seen => true,
                RowsPlace::Superseded => self.are_rows_superseded(table, &part.run, &part.derivation, file.seen_runs),
                RowsPlace::OfProject | RowsPlace::Unseen | RowsPlace::Foreign => false,
            };
            if let (RowsPlace::Seen | RowsPlace::OfProject, Some(run)) = (place, self.runs.place_of(&part.run)) {
                sorted.logged[run].get_or_insert(part.rows);
                if place == RowsPlace::Seen && !std::mem::replace(&mut sorted.shown[run], true) {
                    continue;
                }
            }
            if is_superseded {
                superseded.push(part.run.clone());
            }
            hidden.push(part.run.clone());
        }
        DataFile::hide_runs(&mut file, hidden);
        if superseded.len() == file.parts.len() {
            sorted.hidden.push(file);
        } else {
            if !superseded.is_empty() {
                sorted.outgrown.push(Arc::new(DataFile { hidden: superseded, ..DataFile::clone(&file) }));
            }
            if file.hidden.len() < file.parts.len() {
                sorted.seen.push(file);
            }
        }
    }

    fn file_place(&self, table: Table, file: &DataFile) -> RowsPlace {
        match &file.name {
            Some(FileName::Rig { .. }) if table.source() == Source::Rig => RowsPlace::Seen,
            Some(FileName::Pointer(pointer)) if self.run(&pointer.run) == Some(pointer) => RowsPlace::Seen,
            Some(FileName::Pointer(_)) => RowsPlace::Superseded,
            Some(FileName::Rows { run, derivation, .. }) => self.rows_place(table, run, derivation),
            Some(FileName::Rig { .. } | FileName::Merged { .. }) => RowsPlace::Unseen,
            None => RowsPlace::Foreign,
        }
    }

    fn rows_place(&self, table: Table, run: &RunId, derivation: &str) -> RowsPlace {
        let Some(current) = self.runs.get(run) else { return RowsPlace::Unseen };
        match is_named(table, &current.run, derivation) {
            true => self.run_place(table, current),
            false => RowsPlace::Superseded,
        }
    }

    // A surface that was measured twice is still one surface: of the runs that a reader sees, the newest describes it
    // that no verdict rejects.
    fn run_place(&self, table: Table, current: &CurrentRun) -> RowsPlace {
        let VisibleRun { surface, run, .. } = &current.run;
        if !table.key().contains(&"surface_id") || self.newest.of_surface.get(surface) == Some(run) {
            return RowsPlace::Seen;
        }
        let of_project = current.project.clone().map(|project| (surface.clone(), project));
        match of_project.and_then(|key| self.newest.of_project.get(&key)) == Some(run) {
            true => RowsPlace::OfProject,
            false => RowsPlace::Superseded,
        }
    }

    // An author that had not seen the run's present row cannot replace it, so that no row will ever name its file as
    // the log has it now. Rows that are named and describe no surface: an author that had seen the row of the run that
    // does describe it is about to remove or to reject that one. No clock is asked.
    fn are_rows_superseded(&self, table: Table, run: &RunId, derivation: &str, seen_runs: u64) -> bool {
        let Some(current) = self.runs.get(run) else { return false };
        let describing = self.newest.of_surface.get(&current.run.surface).and_then(|run| self.runs.get(run));
        let other = describing.filter(|_| is_named(table, &current.run, derivation));
        seen_runs < other.map_or(0, |other| other.log_version).max(current.log_version)
    }

    fn is_file_superseded(&self, table: Table, file: &DataFile) -> bool {
        let part = RunPart::of_file(file);
        part.is_some_and(|part| self.are_rows_superseded(table, &part.run, &part.derivation, file.seen_runs))
    }

    /// The version of `runs` that added the row of a file's run; 0 if the name is no run's rows, or the run is not
    /// seen.
    pub(crate) fn run_version(&self, name: &str) -> u64 {
        match FileName::parse(&Path::from(name)) {
            Some(FileName::Rows { run, .. }) => self.runs.get(&run).map_or(0, |current| current.log_version),
            _ => 0,
        }
    }
}

// Returns whether a run's row names this derivation of its rows in a table.
fn is_named(table: Table, run: &VisibleRun, derivation: &str) -> bool {
    match table.source() {
        Source::References => run.reference_derivation.as_deref() == Some(derivation),
        Source::Pointer => run.joined_derivations() == derivation,
        _ => run.run_derivation == derivation,
    }
}

/// Place of logged rows in a snapshot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RowsPlace {
    /// Readers see them.
    Seen,
    /// No reader will see them again.
    Superseded,
    /// Readers see a newer run of the surface, but those of this run's project alone do not.
    OfProject,
    /// They belong to a run that readers of this snapshot do not see, which another ingest may be about to name.
    Unseen,
    /// Another program put them into the log.
    Foreign,
}

/// A table's files on their way into a snapshot.
#[derive(Default)]
struct SortedFiles {
    seen: Vec<Arc<DataFile>>,
    hidden: Vec<Arc<DataFile>>,
    outgrown: Vec<Arc<DataFile>>,
    foreign: Vec<Arc<DataFile>>,
    /// Whether a file shows rows of a run already, for each run.
    shown: Vec<bool>,
    /// The rows of each run that the table's log has, of the derivation that `runs` names.
    logged: Vec<Option<u64>>,
}

impl SortedFiles {
    fn with_runs(runs: usize) -> Self {
        Self { shown: vec![false; runs], logged: vec![None; runs], ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::file_name::table_folder;
    use crate::tables::run_parts::{decode_parts, encode_parts};

    /// A file whose number is the version of `runs` that its author had seen; of a run's row, that added it.
    fn file(table: Table, name: &str, version: u64) -> Arc<DataFile> {
        let path = table_folder(table).join(name);
        let log_version = if table == Table::Runs { version } else { 0 };
        let seen_runs = version - log_version.min(1);
        let (stats, parts, hidden, row_counts) = (None, Vec::new(), Vec::new(), None);
        let name = FileName::parse(&path);
        Arc::new(DataFile { path, name, bytes: 1, rows: 1, log_version, seen_runs, stats, parts, hidden, row_counts })
    }

    fn view(files: &[(Table, &str, u64)]) -> LakeSnapshot {
        let of = |table| files.iter().filter(|f| f.0 == table).map(|f| file(f.0, f.1, f.2)).collect::<Vec<_>>();
        let mut snapshot = LakeSnapshot::from_pointers(&of(Table::Runs));
        Table::ALL.into_iter().for_each(|table| snapshot.sort_in(table, of(table)));
        snapshot
    }

    fn names(files: &[Arc<DataFile>]) -> Vec<&str> {
        files.iter().filter_map(|f| f.path.filename()).collect()
    }

    #[test]
    fn rows_are_seen_once_runs_names_them() {
        let before = view(&[(Table::Measurements, "flat.r1.ab.parquet", 1)]);
        assert!(before.files(Table::Measurements).is_empty());
        assert!(before.superseded_files(Table::Measurements).is_empty(), "its ingest may still be going on");
        let after = view(&[
            (Table::Measurements, "flat.r1.ab.parquet", 1),
            (Table::Nce, "flat.r1.cd.parquet", 1),
            (Table::Nce, "flat.r1.old.parquet", 0),
            (Table::Nce, "flat.r1.ef.parquet", 2),
            (Table::Runs, "flat.r1.ab.cd.parquet", 2),
        ]);
        assert_eq!(names(after.files(Table::Measurements)), ["flat.r1.ab.parquet"]);
        assert_eq!(names(after.files(Table::Nce)), ["flat.r1.cd.parquet"]);
        assert_eq!(names(after.superseded_files(Table::Nce)), ["flat.r1.old.parquet"]);
    }

    #[test]
    fn the_newer_of_two_pointers_counts() {
        let both = view(&[
            (Table::Runs, "flat.r1.ab.none.parquet", 1),
            (Table::Runs, "flat.r1.ab.cd.parquet", 2),
            (Table::Tnce, "flat.r1.cd.parquet", 1),
        ]);
        assert_eq!(names(both.files(Table::Runs)), ["flat.r1.ab.cd.parquet"]);
        assert_eq!(names(both.superseded_files(Table::Runs)), ["flat.r1.ab.none.parquet"]);
        assert_eq!(names(both.files(Table::Tnce)), ["flat.r1.cd.parquet"]);
    }

    #[test]
    fn a_surface_has_one_row_however_often_it_was_measured() {
        let twice = view(&[
            (Table::Runs, "flat.r1.ab.none.parquet", 1),
            (Table::Runs, "flat.r2.cd.none.parquet", 2),
            (Table::Surfaces, "flat.r1.ab.parquet", 1),
            (Table::Surfaces, "flat.r2.cd.parquet", 2),
            (Table::Measurements, "flat.r1.ab.parquet", 1),
            (Table::Measurements, "flat.r2.cd.parquet", 2),
        ]);
        assert_eq!(names(twice.files(Table::Surfaces)), ["flat.r2.cd.parquet"]);
        assert_eq!(twice.files(Table::Measurements).len(), 2);
    }

    fn counting(file: Arc<DataFile>, counts: &[(Table, u64)]) -> Arc<DataFile> {
        let mut rows = RunRowCounts::default();
        counts.iter().for_each(|(table, count)| rows.set_rows(*table, *count));
        Arc::new(DataFile { row_counts: Some(rows), ..DataFile::clone(&file) })
    }

    fn lacking(snapshot: &LakeSnapshot, table: Table) -> Vec<(String, Option<u64>, u64)> {
        let rows = snapshot.lacking_rows(table).iter();
        rows.map(|lacking| (lacking.run.to_string(), lacking.expected, lacking.actual)).collect()
    }

    #[test]
    fn rows_of_each_run_are_compared_with_what_its_row_names() {
        let row = counting(file(Table::Runs, "flat.r1.ab.cd.parquet", 5), &[(Table::Nce, 4), (Table::Events, 0)]);
        let older = file(Table::Runs, "wood.r2.ab.none.parquet", 5);
        let of = |table, files| LakeSnapshot::from_table_files(&[row.clone(), older.clone()], table, files);
        let with_rows =
            |rows| Arc::new(DataFile { rows, ..DataFile::clone(&file(Table::Nce, "flat.r1.cd.parquet", 5)) });
        let four = with_rows(4);
        assert!(
            of(Table::Nce, vec![four.clone()]).check_table(Table::Nce).is_ok(),
            "the older run waits for references"
        );
        let three = of(Table::Nce, vec![with_rows(3)]);
        assert_eq!(lacking(&three, Table::Nce), [("r1".to_owned(), Some(4), 3)]);
        let error = three.check_table(Table::Nce).expect_err("refused").to_string();
        assert!(error.contains("`nce`") && error.contains("run `r1` has 3 rows, expected 4"), "{error}");
        assert_eq!(lacking(&of(Table::Nce, Vec::new()), Table::Nce), [("r1".to_owned(), Some(4), 0)]);
        let other = of(Table::Nce, vec![file(Table::Nce, "flat.r1.ef.parquet", 5)]);
        assert_eq!(lacking(&other, Table::Nce), [("r1".to_owned(), Some(4), 0)]);
        let merged = of(Table::Nce, vec![merged(Table::Nce, &[("flat.r1.cd.parquet", 4), ("x.r9.cd.parquet", 3)])]);
        assert!(merged.check_table(Table::Nce).is_ok());
        // A row that does not count the others still has some of each.
        assert_eq!(lacking(&of(Table::Events, Vec::new()), Table::Events), [("r2".to_owned(), None, 0)]);
        assert!(of(Table::Heightmaps, Vec::new()).check_table(Table::Heightmaps).is_ok());
    }

    /// E13: a run that is rejected as a whole describes its surface if no other run can.
    #[test]
    fn the_newest_run_that_is_not_rejected_describes_a_surface() {
        let check = |marks: [&str; 3], expected: &str| {
            let rows = ["r1", "r2", "r3"].iter().zip(marks);
            let pointers: Vec<_> = rows.map(|(run, mark)| format!("wood.{run}.ab.none{mark}.parquet")).collect();
            let mut files: Vec<_> = pointers.iter().map(|name| (Table::Runs, name.as_str(), 5)).collect();
            let described = ["wood.r1.ab.parquet", "wood.r2.ab.parquet", "wood.r3.ab.parquet"];
            files.extend(described.map(|name| (Table::Surfaces, name, 1)));
            let snapshot = view(&files);
            assert_eq!(names(snapshot.files(Table::Surfaces)), [format!("wood.{expected}.ab.parquet")], "{marks:?}");
            assert_eq!(snapshot.superseded_files(Table::Surfaces).len(), 2, "{marks:?}");
            let wood = "wood".parse().expect("an id");
            assert_eq!(snapshot.newest_run(&wood).expect("a run").run.as_str(), expected, "{marks:?}");
        };
        let [none, some, all] = ["", "-1f00ab", "-rejected"];
        check([none, none, none], "r3");
        check([none, none, some], "r3");
        check([none, some, all], "r2");
        check([none, all, all], "r1");
        check([all, all, all], "r3");
    }

    #[test]
    fn a_removed_run_and_an_older_one_of_a_surface_lack_nothing() {
        let counts = [(Table::Surfaces, 1), (Table::Measurements, 2)];
        let row = |name: &str| counting(file(Table::Runs, name, 5), &counts);
        let rows = [row("flat.r1.ab.none.parquet"), row("flat.r2.ab.none.parquet")];
        let newest = file(Table::Surfaces, "flat.r2.ab.parquet", 5);
        assert!(
            LakeSnapshot::from_table_files(&rows, Table::Surfaces, vec![newest]).check_table(Table::Surfaces).is_ok()
        );
        let older = file(Table::Surfaces, "flat.r1.ab.parquet", 5);
        let snapshot = LakeSnapshot::from_table_files(&rows, Table::Surfaces, vec![older]);
        assert_eq!(lacking(&snapshot, Table::Surfaces), [("r2".to_owned(), Some(1), 0)]);
        assert!(LakeSnapshot::from_table_files(&[], Table::Measurements, Vec::new()).is_whole());
    }

    #[test]
    fn files_of_other_programs_are_a_fault_that_readers_of_some_projects_do_not_meet() {
        let row = counting(file(Table::Runs, "flat.r1.ab.none.parquet", 5), &[(Table::Measurements, 1)]);
        let rows = file(Table::Measurements, "flat.r1.ab.parquet", 5);
        let foreign = file(Table::Measurements, "part-00000-c528.zstd.parquet", 0);
        let snapshot = LakeSnapshot::from_table_files(&[row], Table::Measurements, vec![rows, foreign]);
        let error = snapshot.check_table(Table::Measurements).expect_err("refused").to_string();
        assert!(error.contains("another program put `tables/measurements/part-00000-c528.zstd.parquet`"), "{error}");
        assert_eq!(names(snapshot.foreign_files(Table::Measurements)), ["part-00000-c528.zstd.parquet"]);
        let seen = snapshot.with_restriction(true);
        assert!(seen.check_table(Table::Measurements).is_ok() && seen.foreign_files(Table::Measurements).is_empty());
    }

    fn merged(table: Table, parts: &[(&str, u64)]) -> Arc<DataFile> {
        let text = serde_json::to_string(parts).expect("text");
        let parts = decode_parts(&text).expect("parts");
        assert_eq!(encode_parts(&parts), text);
        let file = DataFile::clone(&file(table, "merged.aa.parquet", 0));
        Arc::new(DataFile { rows: parts.iter().map(|p| p.rows).sum(), parts, ..file })
    }

    #[test]
    fn parts_are_seen_and_superseded_as_files_were() {
        let runs = |wood: &str| {
            let pointers = ["flat.r1.ab.cd.parquet".to_owned(), format!("wood.r2.ab.{wood}.parquet")];
            let mut snapshot = LakeSnapshot::from_pointers(&pointers.map(|name| file(Table::Runs, &name, 5)));
            let files = vec![
                file(Table::Nce, "flat.r1.cd.parquet", 9),
                merged(Table::Nce, &[("flat.r1.cd.parquet", 4), ("wood.r2.ef.parquet", 3)]),
                file(Table::Nce, "wood.r2.gh.parquet", 9),
            ];
            snapshot.sort_in(Table::Nce, files);
            snapshot
        };
        let run = |name: &str| name.parse::<RunId>().expect("a run");
        let (r1, r2) = (run("r1"), run("r2"));
        let both = runs("ef");
        assert_eq!(names(both.files(Table::Nce)), ["flat.r1.cd.parquet", "merged.aa.parquet"]);
        let partly = &both.files(Table::Nce)[1];
        assert_eq!((partly.visible_rows(), &partly.hidden), (3, &vec![r1.clone()]), "the same rows once more");
        let visible: Vec<_> = partly.visible_parts().map(|(part, rows)| (part.run.clone(), rows)).collect();
        assert_eq!(visible, [(r2.clone(), 4..7)]);
        assert!(both.superseded_files(Table::Nce).is_empty());
        assert_eq!(names(both.outgrown_files(Table::Nce)), ["merged.aa.parquet"]);
        assert_eq!(both.files_of(Table::Nce, &r2).count(), 1);

        let count_of =
            |run: &RunId| both.files(Table::Nce).iter().filter(|file| file.shown_runs().contains(run)).count();
        for run in [&r1, &r2, &run("r3")] {
            assert_eq!(both.files_of(Table::Nce, run).count(), count_of(run), "{run}");
        }
        assert_eq!(both.files_of(Table::Tnce, &r1).count(), 0);

        let replaced = runs("gh");
        assert_eq!(names(replaced.files(Table::Nce)), ["flat.r1.cd.parquet", "wood.r2.gh.parquet"]);
        assert_eq!(names(replaced.superseded_files(Table::Nce)), ["merged.aa.parquet"]);
    }
}
