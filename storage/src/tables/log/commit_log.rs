//! Commit log of a lake's tables, as a trait. Delta implements it; see `delta.rs`.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::ops::Range;
use std::sync::Arc;

use async_trait::async_trait;
use chrono::{DateTime, Utc};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use object_store::path::Path;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::Result;
use crate::contributions::ShownVersions;
use crate::tables::file_name::FileName;

/// A Parquet file of a table. Its entry in the log is decoded once, and shared by all snapshots that have it.
#[derive(Debug, Clone, PartialEq)]
pub struct DataFile {
    /// Path in the lake.
    pub path: Path,
    /// Its name, parsed; None if another program gave it.
    pub name: Option<FileName>,
    /// Size.
    pub bytes: u64,
    /// Rows.
    pub rows: u64,
    /// The version of its table's log that added it; 0 if an earlier version of the program did.
    pub log_version: u64,
    /// The version of `runs` that its author had seen: what came later, its author did not know. 0 if the log does not
    /// say.
    pub seen_runs: u64,
    /// Least and greatest values, if the log has them.
    pub stats: Option<FileStats>,
    /// If it has rows of several runs: their parts, in the order of their rows, which are contiguous.
    pub parts: Vec<RunPart>,
    /// The runs of parts that a snapshot does not show; empty as the log gives it.
    pub hidden: Vec<RunId>,
    /// Of a run's row in `runs`: the rows that its other tables have. None if an earlier version of the program wrote
    /// it.
    pub row_counts: Option<RunRowCounts>,
}

/// Numbers of a run's rows, by table.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RunRowCounts(BTreeMap<String, u64>);

impl RunRowCounts {
    /// Sets the number of rows in a table.
    pub fn set_rows(&mut self, table: Table, rows: u64) {
        self.0.insert(table.name().to_owned(), rows);
    }

    /// The number of rows in a table; None if it does not say.
    pub fn rows_of(&self, table: Table) -> Option<u64> {
        self.0.get(table.name()).copied()
    }
}

/// The rows of one run in a file that was merged from several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunPart {
    /// The run's surface.
    pub surface: SurfaceId,
    /// The run.
    pub run: RunId,
    /// Digest of what the rows were made from; of a row of `runs` both digests of its name.
    pub derivation: String,
    /// Number of its rows.
    pub rows: u64,
    /// Of a row of `runs`, and of rows that users add: the version of the table that added it, whichever file it was in
    /// then.
    pub row_version: Option<u64>,
    /// Of a row of `runs`: as [`DataFile::row_counts`].
    pub row_counts: Option<RunRowCounts>,
}

impl DataFile {
    /// Makes it the file whose parts of these runs are hidden, and of no others.
    pub(crate) fn hide_runs(file: &mut Arc<Self>, hidden: Vec<RunId>) {
        if file.hidden != hidden {
            Arc::make_mut(file).hidden = hidden;
        }
    }

    /// The file as its log's present version has it.
    pub fn logged_file(&self) -> LoggedFile {
        LoggedFile { name: self.path.filename().unwrap_or_default().to_owned(), log_version: self.log_version }
    }

    /// Rows that readers see.
    pub fn visible_rows(&self) -> u64 {
        let hidden = self.parts.iter().filter(|p| self.hidden.contains(&p.run)).map(|p| p.rows).sum();
        self.rows.saturating_sub(hidden)
    }

    /// The parts that readers see, each with the range of its rows in the file.
    pub fn visible_parts(&self) -> impl Iterator<Item = (&RunPart, Range<u64>)> {
        let mut end = 0;
        let placed = self.parts.iter().map(move |part| {
            let start = end;
            end += part.rows;
            (part, start..end)
        });
        placed.filter(|(part, _)| !self.hidden.contains(&part.run))
    }

    /// The ranges of the rows that readers see, neighbouring parts as one.
    pub fn visible_ranges(&self) -> Vec<Range<u64>> {
        if self.parts.is_empty() {
            return std::iter::once(0..self.rows).collect();
        }
        let mut ranges: Vec<Range<u64>> = Vec::new();
        for (_, range) in self.visible_parts() {
            match ranges.last_mut() {
                Some(last) if last.end == range.start => last.end = range.end,
                _ => ranges.push(range),
            }
        }
        ranges
    }
}

/// A file of a table as one version of the log added it: the same name added again is another.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoggedFile {
    /// Name in the table's folder.
    pub name: String,
    /// The version that added it.
    pub log_version: u64,
}

/// The files of one version of a table.
#[derive(Debug, Clone, Default)]
pub struct TableView {
    /// The version.
    pub version: u64,
    /// The id that the table was given when it was made.
    pub id: String,
    /// Its files, by path.
    pub files: Vec<Arc<DataFile>>,
    /// Of `runs`: what the version shows of the tables of users.
    pub shown: ShownVersions,
    /// Of a table of users: the highest number of an object of the lake's earlier form that is in it.
    pub copied: u64,
    /// Of `runs`: rows may be missing, because it is being made again or another program has changed it.
    pub is_rebuilding: bool,
}

/// Least and greatest values of a file's columns, by name, as in Delta's log.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FileStats {
    /// Least values.
    pub min: Map<String, Value>,
    /// Greatest values.
    pub max: Map<String, Value>,
}

/// A file about to be registered; its bytes are already in the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewFile {
    /// Name in the table's folder.
    pub name: String,
    /// Size.
    pub bytes: u64,
    /// Delta's statistics, JSON.
    pub stats: String,
    /// The files that it replaces: those of one place, or of a place for each of its parts.
    pub replaces: Vec<ReplacedFiles>,
    /// The parts, if it has rows of several runs.
    pub parts: Vec<RunPart>,
    /// The version of `runs` that its author had seen.
    pub seen_runs: u64,
    /// The version of `runs` that added the row of its run which its author had seen, of several the newest; 0 if there
    /// was none. If the file is in the log already, but its author had not seen that row, it is added again.
    pub run_version: u64,
    /// Of a run's row in `runs`: the rows that its other tables have.
    pub row_counts: Option<RunRowCounts>,
}

/// The files that a new one replaces. If other files have taken their place, the new one is not added. A file of
/// several runs in a place with a beginning stays, because it has other runs' rows: the newer row of the run counts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReplacedFiles {
    /// Beginning of the names of all files in that place; None if the names alone are the place.
    pub prefix: Option<String>,
    /// The files that are expected there; those of the place go with the same commit.
    pub files: Vec<LoggedFile>,
}

impl ReplacedFiles {
    /// The files that go.
    pub(crate) fn removed_files(&self) -> impl Iterator<Item = &LoggedFile> {
        let is_of_place = |name: &str| self.prefix.as_deref().is_none_or(|prefix| name.starts_with(prefix));
        self.files.iter().filter(move |file| is_of_place(&file.name))
    }
}

/// Effect of a commit on a reader that follows a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CommitEffect {
    /// Rows come or go.
    #[default]
    Rows,
    /// The same rows are in other files.
    Layout,
}

/// One change of one table: all of it or nothing.
#[derive(Debug, Clone, Default)]
pub struct TableCommit {
    /// Files that come.
    pub add: Vec<NewFile>,
    /// Files that go; one that is already gone, or was added again, is passed over.
    pub remove: Vec<LoggedFile>,
    /// Its effect on readers.
    pub effect: CommitEffect,
    /// If it removes runs: which, and who asked for it.
    pub removal: Option<RemovalRecord>,
}

impl From<CommitEffect> for TableCommit {
    fn from(effect: CommitEffect) -> Self {
        Self { effect, ..Self::default() }
    }
}

/// What a log says of a removal of runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemovalRecord {
    /// The runs.
    pub runs: BTreeSet<RunId>,
    /// The user who removed them.
    pub by: String,
}

/// The names of a table's files, as the log knows them.
#[derive(Debug, Clone, Default)]
pub struct FileHistory {
    /// Those that are in the table.
    pub current: HashSet<String>,
    /// Those that were, and when they went. The log forgets them after a week.
    pub removed: HashMap<String, DateTime<Utc>>,
}

/// One version of a table, and when it was committed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TableVersion {
    /// Its number.
    pub version: u64,
    /// Time of its commit, or of an earlier version's if that writer's clock was ahead.
    pub committed: DateTime<Utc>,
}

/// A version of a table, and what its commit changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TableChange {
    /// The version.
    pub version: TableVersion,
    /// The operation by its author's word, if it says one.
    pub operation: Option<String>,
    /// Files that came.
    pub files_added: u64,
    /// Files that went.
    pub files_removed: u64,
    /// Rows of the files that came; None if one of them does not say.
    pub rows_added: Option<u64>,
    /// Rows of the files that went; None if one of them came before the oldest version that the log holds.
    pub rows_removed: Option<u64>,
}

/// Outcome of adding a new file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommitOutcome {
    /// It is in the log now.
    Now,
    /// It was there before.
    Before,
    /// It was to replace what is no longer there, and is not in the log.
    Outdated,
}

/// A log of each table's files, with atomic commits of one table.
#[async_trait]
pub trait CommitLog: Send + Sync + std::fmt::Debug {
    /// Makes the table if it is missing.
    async fn ensure_table(&self, table: Table) -> Result<()>;
    /// The table as of now; None if there is no table.
    async fn view_table(&self, table: Table) -> Result<Option<TableView>>;
    /// The table's files as of now; none if there is no table.
    async fn list_files(&self, table: Table) -> Result<Vec<Arc<DataFile>>> {
        Ok(self.view_table(table).await?.unwrap_or_default().files)
    }
    /// The version that an earlier look found, without a look; None if there was none.
    async fn known_version(&self, table: Table) -> Option<u64>;
    /// The table's newest version; None if there is no table.
    async fn newest_version(&self, table: Table) -> Result<Option<u64>>;
    /// Returns whether there is a version after this one, in one request to the store; if the log was cleaned up since,
    /// it may not see what [`CommitLog::newest_version`] sees.
    async fn has_after(&self, table: Table, version: u64) -> Result<bool>;

    /// Returns what tells a version's commit from one of the same number in a table that was made again; None if it is
    /// not there.
    ///
    /// # Errors
    /// [`crate::Error::Store`].
    async fn commit_tag(&self, table: Table, version: u64) -> Result<Option<String>>;
    /// The versions that the log still holds, oldest first.
    async fn list_versions(&self, table: Table) -> Result<Vec<TableVersion>>;
    /// The versions that the log still holds with their changes, oldest first: a request to the store for each.
    async fn list_changes(&self, table: Table) -> Result<Vec<TableChange>>;
    /// The table as of a version that the log still holds, or its newest if that is older; None if there is no table.
    async fn view_at(&self, table: Table, version: u64) -> Result<Option<TableView>>;
    /// The table's files as of a version that the log still holds.
    async fn files_at(&self, table: Table, version: u64) -> Result<Vec<Arc<DataFile>>> {
        Ok(self.view_at(table, version).await?.unwrap_or_default().files)
    }
    /// The files of all versions that the log still holds; none if there is no table.
    async fn files_of_all_versions(&self, table: Table) -> Result<Vec<Arc<DataFile>>>;
    /// Returns whether a file of this name is in the log.
    async fn has_file(&self, table: Table, name: &str) -> Result<bool>;
    /// Names of the current and the removed files; None if there is no log.
    async fn file_history(&self, table: Table) -> Result<Option<FileHistory>>;
    /// Adds files to a table as the version after `seen`; false if another writer has taken it. `copied` is the highest
    /// number of an object of the lake's earlier form whose rows are among them.
    async fn append_files(&self, table: Table, seen: u64, files: &[NewFile], copied: Option<u64>) -> Result<bool>;
    /// Shows a version of a table of users to readers, by a version of `runs`, which is returned.
    async fn show_version(&self, table: Table, version: u64) -> Result<u64>;
    /// Makes a change; returns the outcome of each new file, in order. Repeating the same change adds nothing.
    async fn commit_change(&self, table: Table, commit: &TableCommit) -> Result<Vec<CommitOutcome>>;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_are_read_at_once_and_hidden_rows_never() {
        let part = |run: &str, rows| RunPart {
            surface: "flat".parse().expect("an id"),
            run: run.parse().expect("an id"),
            derivation: "d".to_owned(),
            rows,
            row_version: None,
            row_counts: None,
        };
        let mut file = DataFile {
            path: "tables/nce/merged.x.parquet".into(),
            name: Some(FileName::Merged { digest: "x".to_owned() }),
            bytes: 1,
            rows: 15,
            log_version: 1,
            seen_runs: 1,
            stats: None,
            parts: vec![part("a", 1), part("b", 2), part("c", 4), part("d", 8)],
            hidden: Vec::new(),
            row_counts: None,
        };
        let check = |file: &DataFile, expected: &[(u64, u64)]| {
            let ranges: Vec<_> = file.visible_ranges().iter().map(|range| (range.start, range.end)).collect();
            assert_eq!(ranges, expected);
        };
        check(&file, &[(0, 15)]);
        file.hidden = vec!["b".parse().expect("an id")];
        check(&file, &[(0, 1), (3, 15)]);
        file.hidden = ["a", "c", "d"].map(|run| run.parse().expect("an id")).to_vec();
        check(&file, &[(1, 3)]);
    }
}
