//! A lake's tables: rows in, and a view of them.

mod batch_builder;
mod current_runs;
mod data_file;
mod file_name;
mod group_commit;
mod log;
mod maintenance;
mod references;
mod rig_tables;
mod rows;
mod run_parts;
mod snapshot;
mod table_fault;
mod tags;
mod verdicts;
mod versions;

pub use batch_builder::BatchBuilder;
pub use data_file::{EncodedFile, EncodedRows, FileEncoder, encode_batches, encode_run_rows};
pub use file_name::{FileName, VisibleRun};
pub use group_commit::{FileGroup, StagedRows};
pub use log::{
    CommitEffect, CommitLog, CommitOutcome, DataFile, FileHistory, FileStats, LoggedFile, NewFile, RemovalRecord,
    ReplacedFiles, RunPart, RunRowCounts, TableChange, TableCommit, TableVersion, TableView,
};
pub(crate) use log::{DeltaLog, ProjectLog};
pub use maintenance::{
    DeletedFile, DeletionMode, GivenUpRows, KEEP_HOURS, MergeProgress, OptimizeReport, TARGET_BYTES,
    TableOptimizeReport, VacuumReport,
};
pub use references::{ReferenceNames, SurfaceReferences};
pub use rows::{add_missing_columns, reader_metadata, wanted_schema};
pub use snapshot::LakeSnapshot;
pub use table_fault::LackingRows;
pub use tags::{LakeTag, TagName};
pub use verdicts::verdict_mark;
pub use versions::{LakeMoment, NoMoment};

use arrow::record_batch::RecordBatch;
use echolake_schema::tables::{Source, Table};
use futures::future::{join, join_all, try_join_all};
use object_store::ObjectStoreExt as _;

use self::file_name::table_folder;
use self::log::has_run_files;
use self::table_fault::TableFault;
use crate::contributions::pass_table_fault;
use crate::{Error, LAKE_FORMAT, Lake, Result};

/// A file in the store that no commit names yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StagedFile {
    pub(crate) table: Table,
    pub(crate) file: NewFile,
    rows: u64,
}

impl StagedFile {
    // A file that is not in the store yet.
    fn from_name(table: Table, name: String, rows: u64) -> Self {
        let file = NewFile {
            name,
            bytes: 0,
            stats: String::new(),
            replaces: Vec::new(),
            parts: Vec::new(),
            seen_runs: 0,
            run_version: 0,
            row_counts: None,
        };
        Self { table, file, rows }
    }

    /// Records the view of the lake that its rows were made from. What that view did not hold, the rows do not answer
    /// to: a row of `runs` that it lacked supersedes them.
    #[must_use]
    pub fn made_from(mut self, snapshot: &LakeSnapshot) -> Self {
        self.file.seen_runs = snapshot.log_version(Table::Runs).unwrap_or(0);
        self.file.run_version = snapshot.run_version(&self.file.name);
        self
    }

    /// Records the rows that the run's other tables have: those of `counts`, and of these files. Without them its row
    /// of `runs` says no more than that there are some.
    #[must_use]
    pub fn with_row_counts<'a>(mut self, mut counts: RunRowCounts, files: impl IntoIterator<Item = &'a Self>) -> Self {
        files.into_iter().for_each(|file| counts.set_rows(file.table, file.rows));
        self.file.row_counts = Some(counts);
        self
    }

    /// The table that it is for.
    pub fn table(&self) -> Table {
        self.table
    }

    /// Makes a run's row replace its present rows, which are these files or none. If there are others by the time of
    /// the commit, the outcome is [`CommitOutcome::Outdated`].
    #[must_use]
    pub fn with_replaced_rows<'a>(mut self, run: &VisibleRun, old: impl IntoIterator<Item = &'a DataFile>) -> Self {
        let files = old.into_iter().map(DataFile::logged_file).collect();
        self.file.replaces = vec![ReplacedFiles { prefix: Some(run.name_prefix()), files }];
        self
    }
}

impl Lake {
    /// Makes the tables that are missing, and the rows that come from the rig alone. Returns what readers saw before.
    ///
    /// # Errors
    /// What the store says.
    pub async fn ensure_tables(&self) -> Result<LakeSnapshot> {
        // The logs are read meanwhile; nothing is written before the store's answer.
        let (exclusive, snapshot) = join(self.ensure_exclusive(), self.snapshot()).await;
        exclusive?;
        try_join_all(Table::ALL.into_iter().map(|table| self.commit_log().ensure_table(table))).await?;
        let grid = self.grid();
        let derivation = || FileName::Rig { derivation: format!("v{LAKE_FORMAT}") };
        let of_rig = Table::ALL.into_iter().filter(|t| t.source() == Source::Rig).map(|table| async move {
            let rows = match table {
                Table::Points => rig_tables::point_rows(self.rig(), grid)?,
                _ => self.pair_rows()?,
            };
            self.append_rows(table, &derivation(), &[rows]).await
        });
        try_join_all(of_rig).await?;
        let snapshot = snapshot?;
        for table in Table::OF_USERS {
            if !snapshot.pending_objects(table).is_empty() {
                self.prepare_contributions(table).await.or_else(pass_table_fault)?;
            }
        }
        Ok(snapshot)
    }

    /// The rows of table `pairs`, which follow from the rig: row i is pair i.
    ///
    /// # Errors
    /// [`Error::Encode`] if the rig has no such columns, which is a mistake in this crate.
    pub fn pair_rows(&self) -> Result<RecordBatch> {
        rig_tables::pair_rows(self.rig(), self.grid())
    }

    /// A frozen view of what readers may see.
    ///
    /// ```
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    /// use echolake_schema::{Rig, tables::Table};
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let snapshot = lake.snapshot().await?;
    /// assert_eq!((snapshot.runs().count(), snapshot.files(Table::Points)[0].visible_rows()), (0, 78));
    /// # Ok::<(), echolake_lake::Error>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// A table that lacks rows, or whose log cannot be read, is a fault of the snapshot: [`LakeSnapshot::check_table`].
    ///
    /// # Errors
    /// [`Error::Log`] if the log of `runs` is damaged, [`Error::NoLake`] if the lake is gone.
    pub async fn snapshot(&self) -> Result<LakeSnapshot> {
        self.snapshot_of(&Table::ALL).await
    }

    /// The same of `runs` and these tables alone: of the others it has neither files nor faults.
    ///
    /// # Errors
    /// As [`Lake::snapshot`].
    pub async fn snapshot_of(&self, tables: &[Table]) -> Result<LakeSnapshot> {
        let snapshot = LakeSnapshot::take_from(self.commit_log(), tables).await?;
        let mut snapshot = snapshot.with_restriction(self.is_restricted());
        if snapshot.log_version(Table::Runs).is_none() {
            self.check_readable().await?;
            if has_run_files(self.store().as_ref()).await? {
                snapshot.set_fault(TableFault::without_log(Table::Runs));
            }
        }
        Ok(snapshot)
    }

    /// The same of a lake all of whose tables are whole, but for those of users.
    ///
    /// # Errors
    /// [`Error::Incomplete`] if one lacks rows; as [`Lake::snapshot`].
    pub async fn whole_snapshot(&self) -> Result<LakeSnapshot> {
        let snapshot = self.snapshot().await?;
        snapshot.check_run_tables()?;
        Ok(snapshot)
    }

    /// Puts a file's bytes into the store, for a commit to name. No reader sees them before that.
    ///
    /// # Errors
    /// What the store says.
    pub async fn stage_file(&self, table: Table, name: &FileName, file: EncodedFile) -> Result<StagedFile> {
        let mut staged = StagedFile::from_name(table, name.compose(), file.rows);
        self.store_file(&mut staged, file).await?;
        Ok(staged)
    }

    async fn store_file(&self, staged: &mut StagedFile, file: EncodedFile) -> Result<()> {
        let path = table_folder(staged.table).join(staged.file.name.as_str());
        staged.file.bytes = file.blocks.iter().map(|block| block.len() as u64).sum();
        staged.file.stats = file.stats;
        let put = self.store().put(&path, file.blocks.into_iter().collect()).await;
        put.map(drop).map_err(|e| Error::store_failure("write", &path, e))
    }

    /// Returns whether a file of this name is in the table.
    ///
    /// # Errors
    /// [`Error::Log`] if the table's log is damaged.
    pub async fn has_file(&self, table: Table, name: &FileName) -> Result<bool> {
        self.commit_log().has_file(table, &name.compose()).await
    }

    /// Commits staged files, once per table. All tables commit concurrently except `runs`, which is last: from that
    /// commit on readers see the files. Returns the outcome of each file, in the given order. Repeating the call adds
    /// nothing.
    ///
    /// ```
    /// use echolake_lake::{CommitOutcome, FileName, Lake, ReferenceSurfaces, encode_batches};
    /// use echolake_schema::{Rig, tables::Table};
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let file = encode_batches(Table::Pairs, &Table::Pairs.schema(lake.rig()), &[lake.pair_rows()?])?;
    /// let name = FileName::Rig { derivation: "example".into() };
    /// let staged = [lake.stage_file(Table::Pairs, &name, file).await?];
    /// assert_eq!(lake.commit_staged(&staged).await?, [CommitOutcome::Now]);
    /// assert_eq!(lake.commit_staged(&staged).await?, [CommitOutcome::Before]);
    /// # Ok::<(), echolake_lake::Error>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// What the store says. Tables that were committed before stay so, unseen by readers; repeating the call resumes.
    pub async fn commit_staged(&self, staged: &[StagedFile]) -> Result<Vec<CommitOutcome>> {
        let mut outcomes = vec![CommitOutcome::Before; staged.len()];
        let (pointers, others): (Vec<_>, Vec<_>) = Table::ALL.into_iter().partition(|table| *table == Table::Runs);
        for tables in [others, pointers] {
            // Each runs to its end, even if another fails.
            for done in join_all(tables.into_iter().map(|table| self.commit_table(table, staged))).await {
                done?.into_iter().for_each(|(i, outcome)| outcomes[i] = outcome);
            }
        }
        Ok(outcomes)
    }

    // Returns the outcome of each file of one table, with its index among all.
    async fn commit_table(&self, table: Table, staged: &[StagedFile]) -> Result<Vec<(usize, CommitOutcome)>> {
        let of: Vec<_> = (0..staged.len()).filter(|i| staged[*i].table == table).collect();
        if of.is_empty() {
            return Ok(Vec::new());
        }
        let add = of.iter().map(|i| staged[*i].file.clone()).collect();
        let done = self.commit_log().commit_change(table, &TableCommit { add, ..TableCommit::default() }).await?;
        Ok(of.into_iter().zip(done).collect())
    }

    /// Puts rows into a table, once: repeating it with the same name adds nothing.
    ///
    /// # Errors
    /// [`Error::Encode`] if the rows do not fit the table, or what the store says.
    pub async fn append_rows(&self, table: Table, name: &FileName, batches: &[RecordBatch]) -> Result<CommitOutcome> {
        if self.has_file(table, name).await? {
            return Ok(CommitOutcome::Before);
        }
        let staged = self.stage_file(table, name, encode_batches(table, &table.schema(self.rig()), batches)?).await?;
        Ok(self.commit_staged(&[staged]).await?[0])
    }

    /// Removes from the logs all files that no run's row names any more, and those of other programs; merged files are
    /// rewritten without such rows.
    /// The files themselves stay for readers that hold older views.
    ///
    /// # Errors
    /// What the store says.
    pub async fn remove_superseded(&self) -> Result<usize> {
        self.remove_superseded_in(&self.snapshot().await?).await
    }

    /// The same, of what a view shows to be superseded. What came later stays.
    ///
    /// # Errors
    /// What the store says.
    pub async fn remove_superseded_in(&self, snapshot: &LakeSnapshot) -> Result<usize> {
        let mut count = 0;
        for table in Table::ALL {
            let gone = snapshot.superseded_files(table).iter().chain(snapshot.foreign_files(table));
            let remove: Vec<_> = gone.map(|file| file.logged_file()).collect();
            if !remove.is_empty() {
                count += remove.len();
                self.commit_log().commit_change(table, &TableCommit { remove, ..TableCommit::default() }).await?;
            }
            for file in snapshot.outgrown_files(table) {
                self.rewrite_file(table, file).await?;
                count += 1;
            }
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow::array::{Array as _, ArrayRef, AsArray as _, Int32Array, StringArray, new_null_array};
    use arrow::datatypes::{DataType, Field, Int32Type, Schema};
    use echolake_schema::Rig;
    use futures::TryStreamExt as _;

    use super::*;
    use crate::ReferenceSurfaces;

    async fn paper(url: &str) -> Result<Lake> {
        Lake::open_or_create(url, &Rig::paper(), &ReferenceSurfaces::default()).await
    }

    #[tokio::test]
    async fn the_same_rows_twice_are_added_once() {
        let lake = paper("memory://").await.expect("made");
        let grid = lake.rig().build_grid().expect("a grid");
        let rows = || vec![rig_tables::point_rows(lake.rig(), &grid).expect("rows")];
        let name = || FileName::Rig { derivation: "test".into() };
        assert_eq!(lake.append_rows(Table::Points, &name(), &rows()).await.expect("added"), CommitOutcome::Now);
        assert_eq!(lake.append_rows(Table::Points, &name(), &rows()).await.expect("known"), CommitOutcome::Before);
        assert_eq!(lake.commit_log().list_files(Table::Points).await.expect("files").len(), 2);
    }

    // A lake of a version whose surface_stats had one column less.
    #[tokio::test]
    async fn a_column_that_a_table_lacks_is_added_and_null_in_older_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let made = paper(&url).await.expect("made");
        let (table, added) = (Table::SurfaceStats, "unbiased_p90_mean_db");
        let log = folder.path().join("lake/tables/surface_stats/_delta_log");
        let first = log.join("00000000000000000000.json");
        let text = std::fs::read_to_string(&first).expect("a commit");
        let next = r#",{\"metadata\""#;
        let named = text.find(&format!(r#"\"{added}\""#)).expect("the column");
        let begin = text[..named].rfind(next).expect("its begin");
        let end = named + text[named..].find(next).expect("the one behind it");
        std::fs::write(&first, [&text[..begin], &text[end..]].concat()).expect("written");
        let schema = table.schema(made.rig());
        let older: Vec<_> = schema.fields().iter().filter(|f| f.name() != added).cloned().collect();
        let older = Arc::new(Schema::new(older));
        let column = |field: &Arc<Field>| -> ArrayRef {
            match field.data_type() {
                DataType::Utf8 => Arc::new(StringArray::from(vec!["x"])),
                DataType::Int32 => Arc::new(Int32Array::from(vec![7])),
                kind => new_null_array(kind, 1),
            }
        };
        let batch = RecordBatch::try_new(older.clone(), older.fields().iter().map(column).collect()).expect("a row");
        let name = FileName::Rig { derivation: "older".into() };
        let lake = Lake::open(&url).await.expect("opened");
        let file = encode_batches(table, &older, std::slice::from_ref(&batch)).expect("encoded");
        lake.commit_staged(&[lake.stage_file(table, &name, file).await.expect("staged")]).await.expect("committed");

        lake.ensure_tables().await.expect("added");
        lake.ensure_tables().await.expect("there already");
        assert_eq!(lake.commit_log().newest_version(table).await.expect("a log"), Some(2));
        let commit = std::fs::read_to_string(log.join("00000000000000000002.json")).expect("a commit");
        assert!(commit.contains("ADD COLUMNS") && commit.contains("spread_db") && commit.contains(added), "{commit}");
        let files = lake.commit_log().list_files(table).await.expect("files");
        for columns in [&[] as &[&str], &["measurements", added]] {
            let rows = lake.read_rows(table, &files[0], columns, 0..1).await.expect("rows");
            let rows: Vec<_> = rows.try_collect().await.expect("a batch");
            assert_eq!(rows[0].schema(), wanted_schema(&schema, columns));
            let value = rows[0].column_by_name("measurements").expect("there").as_primitive::<Int32Type>().value(0);
            assert_eq!((value, rows[0].column_by_name(added).expect("there").null_count()), (7, 1));
        }
        // A column that may not be null does not come from nowhere.
        let lost = add_missing_columns(&batch.project(&[0]).expect("one column"), &schema).expect_err("refused");
        assert!(lost.to_string().contains("run_id"), "{lost}");
    }

    #[tokio::test]
    async fn two_writers_lose_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lakes = [paper(&url).await.expect("made"), paper(&url).await.expect("opened")];
        let grid = lakes[0].rig().build_grid().expect("a grid");
        let write = |lake: Lake, writer: usize| {
            let rows = rig_tables::point_rows(lake.rig(), &grid).expect("rows");
            tokio::spawn(async move {
                for i in 0..10 {
                    let name = FileName::Rig { derivation: format!("{writer}x{i}") };
                    lake.append_rows(Table::Points, &name, std::slice::from_ref(&rows)).await.expect("committed");
                }
            })
        };
        let [a, b] = lakes.clone();
        let (a, b) = tokio::join!(write(a, 0), write(b, 1));
        a.and(b).expect("both done");
        assert_eq!(lakes[0].commit_log().list_files(Table::Points).await.expect("files").len(), 21);
    }
}
