//! Empties tables that are damaged, so that ingest derives their rows again from the run files.

use echolake_schema::tables::Table;

use crate::{DataFile, Error, Lake, Result, TableCommit};

impl Lake {
    /// Removes all rows of these tables, or their logs if these cannot be read or written. Until ingest has derived the
    /// rows again, readers of the tables are refused.
    ///
    /// # Errors
    /// What the store says.
    pub async fn begin_rebuild(&self, tables: &[Table]) -> Result<()> {
        if self.is_restricted() {
            return Err(Error::Restricted { table: Table::Runs.name(), action: "made again" });
        }
        // From its mark on, all other tables are refused, too.
        let (pointers, others): (Vec<Table>, Vec<Table>) =
            tables.iter().copied().partition(|table| *table == Table::Runs);
        for table in pointers.into_iter().chain(others) {
            match self.empty_table(table).await {
                Err(Error::Log { .. }) => self.delta_log().delete_log(table).await?,
                emptied => emptied?,
            }
        }
        Ok(())
    }

    async fn empty_table(&self, table: Table) -> Result<()> {
        let Some(view) = self.commit_log().view_table(table).await? else { return Ok(()) };
        if table == Table::Runs {
            self.delta_log().set_rebuilding(true).await?;
        }
        let remove = view.files.iter().map(DataFile::logged_file).collect();
        self.commit_log().commit_change(table, &TableCommit { remove, ..TableCommit::default() }).await.map(drop)
    }

    /// Ends a rebuild of `runs`, of which the caller knows that all run files are in it again, or refused.
    ///
    /// # Errors
    /// What the store says.
    pub async fn finish_rebuild(&self) -> Result<()> {
        self.delta_log().set_rebuilding(false).await
    }

    /// Versions of a table's log since its newest checkpoint, if there should have been one long ago.
    ///
    /// # Errors
    /// What the store says.
    pub async fn overdue_checkpoint(&self, table: Table) -> Result<Option<u64>> {
        self.delta_log().overdue_checkpoint(table).await
    }
}
