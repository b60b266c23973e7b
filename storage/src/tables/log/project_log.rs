//! The commit log as a reader of some projects sees it.
//!
//! `runs` decides what readers see, so this is the one place that leaves out runs of other projects: their rows in
//! `runs` are in no version here, and therefore no snapshot shows a file of theirs. A run's project stands in the log
//! itself, in the statistics of its row.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use echolake_schema::tables::Table;
use echolake_schema::{ProjectName, RunId, SurfaceId};

use super::delta::DeltaLog;
use crate::tables::run_parts::list_pointers;
use crate::{
    CommitLog, CommitOutcome, DataFile, Error, FileHistory, LakeSnapshot, NewFile, Result, TableChange, TableCommit,
    TableVersion, TableView,
};

/// A log without the runs of other projects.
#[derive(Debug, Clone)]
pub(crate) struct ProjectLog {
    log: Arc<DeltaLog>,
    projects: BTreeSet<ProjectName>,
    /// Surfaces that all projects see: each one's rows rest on them.
    common: [SurfaceId; 2],
}

impl ProjectLog {
    pub fn new(log: Arc<DeltaLog>, projects: BTreeSet<ProjectName>, common: [SurfaceId; 2]) -> Self {
        Self { log, projects, common }
    }

    /// The projects whose runs are seen.
    pub fn visible_projects(&self) -> &BTreeSet<ProjectName> {
        &self.projects
    }

    // Files of the other tables are seen if a run's row names them. Predictions are of a surface, whose name other
    // projects may use, too.
    fn keep_visible(&self, table: Table, files: &mut Vec<Arc<DataFile>>) {
        files.retain_mut(|file| match table {
            Table::Runs => {
                let hidden = self.hidden_runs(file);
                DataFile::hide_runs(file, hidden);
                !list_pointers(file).is_empty()
            }
            Table::Predictions => {
                let hidden = self.hidden_runs(file);
                DataFile::hide_runs(file, hidden);
                file.visible_parts().next().is_some()
            }
            _ => true,
        });
    }

    fn hidden_runs(&self, file: &DataFile) -> Vec<RunId> {
        if file.project().is_some_and(|project| self.projects.contains(&project)) {
            return Vec::new();
        }
        let runs = list_pointers(file).into_iter().map(|row| (row.run.surface, row.run.run));
        let parts = file.parts.iter().map(|part| (part.surface.clone(), part.run.clone()));
        runs.chain(parts).filter(|(surface, _)| !self.common.contains(surface)).map(|(_, run)| run).collect()
    }

    fn refuse_action<T>(table: Table, action: &'static str) -> Result<T> {
        Err(Error::Restricted { table: table.name(), action })
    }
}

#[async_trait]
impl CommitLog for ProjectLog {
    async fn ensure_table(&self, table: Table) -> Result<()> {
        Self::refuse_action(table, "made")
    }

    async fn view_table(&self, table: Table) -> Result<Option<TableView>> {
        let mut view = self.log.view_table(table).await?;
        if let Some(view) = &mut view {
            self.keep_visible(table, &mut view.files);
        }
        Ok(view)
    }

    async fn known_version(&self, table: Table) -> Option<u64> {
        self.log.known_version(table).await
    }

    async fn newest_version(&self, table: Table) -> Result<Option<u64>> {
        self.log.newest_version(table).await
    }

    async fn has_after(&self, table: Table, version: u64) -> Result<bool> {
        self.log.has_after(table, version).await
    }

    async fn commit_tag(&self, table: Table, version: u64) -> Result<Option<String>> {
        self.log.commit_tag(table, version).await
    }

    // Up to the one that added the newest row that is seen: how many came after it is a matter of other projects.
    async fn list_versions(&self, table: Table) -> Result<Vec<TableVersion>> {
        let files = self.list_files(Table::Runs).await?;
        let newest = files.iter().flat_map(|file| list_pointers(file)).map(|row| row.version).max();
        let mut versions = self.log.list_versions(table).await?;
        if table == Table::Runs {
            versions.retain(|version| newest.is_some_and(|newest| version.version <= newest));
        }
        Ok(versions)
    }

    // The versions that added what is seen now. A commit may change files of several projects.
    async fn list_changes(&self, table: Table) -> Result<Vec<TableChange>> {
        let snapshot = LakeSnapshot::take_from(self, &Table::ALL).await?;
        let mut added = BTreeMap::<u64, (u64, u64)>::new();
        for file in snapshot.files(table) {
            let (files, rows) = added.entry(file.log_version).or_default();
            *files += 1;
            *rows += file.visible_rows();
        }
        let versions = self.log.list_versions(table).await?.into_iter();
        let seen = versions.filter_map(|version| {
            let (files_added, rows_added) = *added.get(&version.version)?;
            let rows_added = Some(rows_added);
            let files_removed = 0;
            let rows_removed = None;
            Some(TableChange { version, operation: None, files_added, files_removed, rows_added, rows_removed })
        });
        Ok(seen.collect())
    }

    async fn view_at(&self, table: Table, version: u64) -> Result<Option<TableView>> {
        let mut view = self.log.view_at(table, version).await?;
        if let Some(view) = &mut view {
            self.keep_visible(table, &mut view.files);
        }
        Ok(view)
    }

    async fn files_of_all_versions(&self, table: Table) -> Result<Vec<Arc<DataFile>>> {
        let mut files = self.log.files_of_all_versions(table).await?;
        self.keep_visible(table, &mut files);
        Ok(files)
    }

    async fn has_file(&self, table: Table, _: &str) -> Result<bool> {
        Self::refuse_action(table, "searched for names")
    }

    async fn file_history(&self, table: Table) -> Result<Option<FileHistory>> {
        Self::refuse_action(table, "searched for names")
    }

    async fn append_files(&self, table: Table, _: u64, _: &[NewFile], _: Option<u64>) -> Result<bool> {
        Self::refuse_action(table, "written")
    }

    async fn show_version(&self, table: Table, _: u64) -> Result<u64> {
        Self::refuse_action(table, "written")
    }

    async fn commit_change(&self, table: Table, _: &TableCommit) -> Result<Vec<CommitOutcome>> {
        Self::refuse_action(table, "written")
    }
}
