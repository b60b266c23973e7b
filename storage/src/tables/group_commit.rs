//! Commits the rows of a group of runs: a table gets one file of them, whose parts are the runs.
//!
//! A file has rows of one project and of surfaces with the same references, as one that is merged later. Rows that the
//! log has already are left out, so that a commit that was cut off is resumed in whatever groups its runs come again.

use std::collections::{BTreeMap, HashSet};
use std::panic::resume_unwind;
use std::sync::Arc;

use echolake_schema::tables::Table;
use echolake_schema::{ProjectName, RunId, SurfaceId};
use futures::future::{join_all, try_join_all};

use super::maintenance::{group_name, part_key};
use super::run_parts::run_of_file;
use crate::{
    CommitOutcome, DataFile, EncodedRows, FileEncoder, Lake, LakeSnapshot, NewFile, ReferenceNames, ReferenceSurfaces,
    Result, RunPart, RunRowCounts, StagedFile, TableCommit, VisibleRun,
};

/// The runs whose rows may share a file.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct FileGroup {
    project: Option<ProjectName>,
    /// Readers of all projects see the lake's references.
    is_reference: bool,
    references: ReferenceNames,
}

/// A run's rows of one table on their way into a file, which no reader sees before a commit.
#[derive(Debug)]
pub struct StagedRows {
    /// Their entry in the log, if they have a file of their own.
    file: StagedFile,
    part: RunPart,
    rows: EncodedRows,
    group: FileGroup,
}

/// Rows that are to share a file, each with its number in the commit.
type RowGroup = Vec<(usize, StagedRows)>;

/// Rows of a run that a table's log has.
struct LoggedRows {
    part: RunPart,
    seen_runs: u64,
}

impl FileGroup {
    /// The group of a run whose surface names these references.
    pub fn new(
        surface: &SurfaceId,
        project: Option<&ProjectName>,
        references: ReferenceNames,
        defaults: &ReferenceSurfaces,
    ) -> Self {
        let is_reference = [&defaults.flat, &defaults.foam].contains(&surface);
        Self { project: project.cloned(), is_reference, references }
    }
}

impl StagedRows {
    /// Rows that come from a run, or from a run with its references, of one derivation.
    pub fn new(
        table: Table,
        (surface, run): (SurfaceId, RunId),
        derivation: String,
        rows: EncodedRows,
        group: &FileGroup,
    ) -> Self {
        let part = RunPart { surface, run, derivation, rows: rows.row_count(), row_version: None, row_counts: None };
        let file = StagedFile::from_name(table, part.file_name(), part.rows);
        Self { file, part, rows, group: group.clone() }
    }

    /// A run's row in `runs`.
    pub fn of_pointer(run: &VisibleRun, rows: EncodedRows, group: &FileGroup) -> Self {
        Self::new(Table::Runs, (run.surface.clone(), run.run.clone()), run.joined_derivations(), rows, group)
    }

    /// As [`StagedFile::made_from`].
    #[must_use]
    pub fn made_from(mut self, snapshot: &LakeSnapshot) -> Self {
        self.file = self.file.made_from(snapshot);
        self
    }

    /// As [`StagedFile::with_row_counts`].
    #[must_use]
    pub fn with_row_counts<'a>(mut self, counts: RunRowCounts, others: impl IntoIterator<Item = &'a Self>) -> Self {
        self.file = self.file.with_row_counts(counts, others.into_iter().map(|other| &other.file));
        self
    }

    /// As [`StagedFile::with_replaced_rows`].
    #[must_use]
    pub fn with_replaced_rows<'a>(mut self, run: &VisibleRun, old: impl IntoIterator<Item = &'a DataFile>) -> Self {
        self.file = self.file.with_replaced_rows(run, old);
        self
    }

    /// The table that they are for.
    pub fn table(&self) -> Table {
        self.file.table
    }

    /// Their size in memory, bytes.
    pub fn memory_bytes(&self) -> usize {
        self.rows.memory_bytes()
    }

    // None if they are encoded, which those of `runs` never are.
    fn try_copy(&self) -> Option<Self> {
        let rows = self.rows.copy_waiting()?;
        Some(Self { file: self.file.clone(), part: self.part.clone(), rows, group: self.group.clone() })
    }

    // A row of `runs` is there if it is the newest of its run; other rows are if their author saw the run's present
    // row, without which they may be cleaned up at any moment.
    fn is_logged(&self, logged: &[LoggedRows]) -> bool {
        let of_run = logged.iter().filter(|rows| rows.part.run == self.part.run);
        let is_same = |rows: &LoggedRows| rows.part.file_name() == self.file.file.name;
        match self.table() {
            Table::Runs => of_run.max_by_key(|rows| rows.part.row_version).is_some_and(is_same),
            _ => of_run.filter(|rows| rows.seen_runs >= self.file.file.run_version).any(is_same),
        }
    }
}

impl Lake {
    /// Commits the rows of a group of runs: every table once, and `runs` last, as [`Lake::commit_staged`] does. Returns
    /// the outcome of each, in the given order. Repeating it with the same rows adds nothing, in whatever groups.
    ///
    /// # Errors
    /// Errors of the store. Tables that were committed before stay so, unseen by readers; repeating the call resumes.
    pub async fn commit_rows(&self, staged: Vec<StagedRows>) -> Result<Vec<CommitOutcome>> {
        let mut outcomes = vec![CommitOutcome::Before; staged.len()];
        let numbered = staged.into_iter().enumerate();
        let (pointers, others): (Vec<_>, Vec<_>) = numbered.partition(|(_, rows)| rows.table() == Table::Runs);
        for mut rows in [others, pointers] {
            let of_tables = Table::ALL.into_iter().map(|table| {
                let of_table = rows.extract_if(.., |(_, rows)| rows.table() == table).collect();
                self.commit_table_rows(table, of_table)
            });
            // Each runs to its end, even if another fails.
            for done in join_all(of_tables.collect::<Vec<_>>()).await {
                done?.into_iter().for_each(|(number, outcome)| outcomes[number] = outcome);
            }
        }
        Ok(outcomes)
    }

    async fn commit_table_rows(&self, table: Table, staged: RowGroup) -> Result<Vec<(usize, CommitOutcome)>> {
        if staged.is_empty() {
            return Ok(Vec::new());
        }
        let files = self.commit_log().list_files(table).await?;
        let (mut outcomes, mut groups) = group_rows(staged, &files);
        while !groups.is_empty() {
            // A file of several rows of `runs` is refused if one of them has another successor by now: each is then
            // tried by itself.
            let copies: Vec<RowGroup> = groups.iter().map(|group| copy_pointers(table, group)).collect();
            let numbers: Vec<Vec<_>> =
                groups.iter().map(|group| group.iter().map(|(number, _)| *number).collect()).collect();
            let add = try_join_all(groups.drain(..).map(|group| self.store_group(table, group))).await?;
            let done = self.commit_log().commit_change(table, &TableCommit { add, ..TableCommit::default() }).await?;
            for ((copies, numbers), outcome) in copies.into_iter().zip(numbers).zip(done) {
                match outcome {
                    CommitOutcome::Outdated if !copies.is_empty() => {
                        groups.extend(copies.into_iter().map(|copy| vec![copy]));
                    }
                    outcome => outcomes.extend(numbers.into_iter().map(|number| (number, outcome))),
                }
            }
        }
        Ok(outcomes)
    }

    // Puts one file with these rows into the store.
    async fn store_group(&self, table: Table, mut group: RowGroup) -> Result<NewFile> {
        group.sort_by(|(_, a), (_, b)| part_key(&a.part).cmp(&part_key(&b.part)));
        let files: Vec<_> = group.iter().map(|(_, rows)| &rows.file.file).collect();
        let parts: Vec<_> = group
            .iter()
            .map(|(_, rows)| RunPart { row_counts: rows.file.file.row_counts.clone(), ..rows.part.clone() })
            .collect();
        let mut staged = StagedFile::from_name(table, group_name(&parts), 0);
        staged.file.seen_runs = files.iter().map(|file| file.seen_runs).min().unwrap_or(0);
        staged.file.run_version = files.iter().map(|file| file.run_version).max().unwrap_or(0);
        staged.file.replaces = files.iter().flat_map(|file| file.replaces.clone()).collect();
        staged.file.parts = parts;
        if let [(_, only)] = group.as_slice() {
            staged = only.file.clone();
        }
        let mut encoder = FileEncoder::new(table, table.schema(self.rig()));
        let encode = move || {
            group.into_iter().try_for_each(|(_, rows)| encoder.append_run(rows.rows))?;
            encoder.finish()
        };
        let encoded = tokio::task::spawn_blocking(encode).await.unwrap_or_else(|e| resume_unwind(e.into_panic()));
        self.store_file(&mut staged, encoded?).await?;
        Ok(staged.file)
    }
}

// The rows of a file of several rows of `runs`; none of other files.
fn copy_pointers(table: Table, group: &[(usize, StagedRows)]) -> RowGroup {
    let is_shared = table == Table::Runs && group.len() > 1;
    let rows = group.iter().filter(|_| is_shared);
    rows.filter_map(|(number, rows)| Some((*number, rows.try_copy()?))).collect()
}

// Sorts rows into files; those that are in the log, or come twice, are there before. A file has one part of a run.
fn group_rows(staged: RowGroup, files: &[Arc<DataFile>]) -> (Vec<(usize, CommitOutcome)>, Vec<RowGroup>) {
    let runs: HashSet<_> = staged.iter().map(|(_, rows)| rows.part.run.clone()).collect();
    let logged: Vec<_> = files.iter().flat_map(|file| logged_rows(file, &runs)).collect();
    let mut outcomes = Vec::new();
    let mut groups = BTreeMap::<_, RowGroup>::new();
    for (number, rows) in staged {
        let earlier = |other: &&(usize, StagedRows)| other.1.part.run == rows.part.run;
        let same = groups.values().flatten().filter(earlier).map(|(_, other)| &other.file.file.name);
        let same: Vec<_> = same.collect();
        if rows.is_logged(&logged) || same.contains(&&rows.file.file.name) {
            outcomes.push((number, CommitOutcome::Before));
            continue;
        }
        let key = (rows.group.clone(), rows.file.file.seen_runs, same.len());
        groups.entry(key).or_default().push((number, rows));
    }
    (outcomes, groups.into_values().collect())
}

// The rows of these runs in a file.
fn logged_rows(file: &DataFile, runs: &HashSet<RunId>) -> Vec<LoggedRows> {
    let seen_runs = file.seen_runs;
    let parts: Vec<_> = match run_of_file(file) {
        Some(run) => RunPart::of_file(file).filter(|_| runs.contains(run)).into_iter().collect(),
        None => file.parts.iter().filter(|part| runs.contains(&part.run)).cloned().collect(),
    };
    parts.into_iter().map(|part| LoggedRows { part, seen_runs }).collect()
}

#[cfg(test)]
mod tests;
