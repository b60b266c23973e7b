//! Takes runs out of the tables, on somebody's request.
//!
//! The rows of `runs` go first: from that commit on no reader sees the runs, and the other rows mean nothing. Earlier
//! versions of the lake still show them until `vacuum` deletes their files.

use std::collections::BTreeSet;

use echolake_schema::RunId;
use echolake_schema::tables::{Source, Table};

use crate::tables::run_parts::run_of_file;
use crate::{DataFile, Error, Lake, RemovalRecord, Result, TableCommit};

/// Looks at one table, each after another writer changed a file at the same moment.
const ROUNDS: usize = 20;

impl Lake {
    /// Removes all rows of some runs; repeating it resumes what was cut off. Returns the number of files that went or
    /// were written without these rows.
    ///
    /// # Errors
    /// What the store says. Tables that were changed before stay so.
    pub async fn remove_runs(&self, removal: &RemovalRecord) -> Result<usize> {
        let mut count = self.remove_rows(Table::Runs, removal).await?;
        for table in Table::ALL.into_iter().filter(|table| is_of_runs(*table) && *table != Table::Runs) {
            count += self.remove_rows(table, removal).await?;
        }
        Ok(count)
    }

    /// Returns whether a table's log has a file with rows of a run, seen or not.
    ///
    /// # Errors
    /// [`Error::Log`] if a log is damaged.
    pub async fn has_rows_of(&self, run: &RunId) -> Result<bool> {
        let runs = BTreeSet::from([run.clone()]);
        for table in Table::ALL.into_iter().filter(|table| is_of_runs(*table)) {
            if self.commit_log().list_files(table).await?.iter().any(|file| !parts_of(file, &runs).is_empty()) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    async fn remove_rows(&self, table: Table, removal: &RemovalRecord) -> Result<usize> {
        let mut count = 0;
        for _ in 0..ROUNDS {
            let files = self.commit_log().list_files(table).await?;
            let mut whole = Vec::new();
            let mut shared = Vec::new();
            for file in files {
                match parts_of(&file, &removal.runs) {
                    of if of.is_empty() => {}
                    of if of.len() < file.parts.len() => {
                        shared.push(DataFile { hidden: of, ..DataFile::clone(&file) });
                    }
                    _ => whole.push(file.logged_file()),
                }
            }
            if whole.is_empty() && shared.is_empty() {
                return Ok(count);
            }
            count += whole.len() + shared.len();
            if !whole.is_empty() {
                let removal = Some(removal.clone());
                let commit = TableCommit { remove: whole, removal, ..TableCommit::default() };
                self.commit_log().commit_change(table, &commit).await?;
            }
            for file in &shared {
                self.rewrite_without(table, file, Some(removal.clone())).await?;
            }
        }
        let source = format!("other writers changed its files in {ROUNDS} tries; hint: run the command again").into();
        Err(Error::Log { table: table.name(), action: "written", source })
    }
}

// What users added stays: it cannot be made again, and is not seen without its run.
fn is_of_runs(table: Table) -> bool {
    table.source() != Source::Users
}

// The runs among these whose rows a file has.
fn parts_of(file: &DataFile, runs: &BTreeSet<RunId>) -> Vec<RunId> {
    let of: Vec<_> = match file.parts.is_empty() {
        true => run_of_file(file).cloned().into_iter().collect(),
        false => file.parts.iter().map(|part| part.run.clone()).collect(),
    };
    of.into_iter().filter(|run| runs.contains(run)).collect()
}
