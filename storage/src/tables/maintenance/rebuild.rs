//! Empties tables that are damaged, so that ingest derives their rows again from the run files.

use echolake_schema::tables::Table;
use futures::TryStreamExt as _;

use crate::{DataFile, Error, Lake, Result, TableCommit};

/// The rows of users that were given up.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GivenUpRows {
    /// Their number in these files.
    pub rows: u64,
    /// Paths of the files.
    pub files: Vec<String>,
    /// The table's log was lost, and with it all its rows.
    pub is_whole_log: bool,
}

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

    /// Gives up the rows of a table of users that are lost: those of files that cannot be read, or all of them if its
    /// log is lost. What can be read stays.
    ///
    /// # Errors
    /// What the store says.
    pub async fn give_up_lost(&self, table: Table) -> Result<GivenUpRows> {
        let snapshot = self.snapshot().await?;
        let newest = match self.commit_log().view_table(table).await {
            Err(Error::Log { .. }) => None,
            view => view?.filter(|view| view.version >= snapshot.shown_versions().of_table(table).table),
        };
        let Some(view) = newest else {
            self.delta_log().begin_log_again(table).await?;
            return Ok(GivenUpRows { is_whole_log: true, ..GivenUpRows::default() });
        };
        let mut given_up = GivenUpRows::default();
        let mut remove = Vec::new();
        for file in &view.files {
            match self.check_file(table, file).await {
                Err(Error::DataFile { .. }) => {
                    given_up.rows += file.rows;
                    given_up.files.push(file.path.to_string());
                    remove.push(file.logged_file());
                }
                checked => checked?,
            }
        }
        self.commit_log().commit_change(table, &TableCommit { remove, ..TableCommit::default() }).await?;
        self.settle_contributions().await?;
        Ok(given_up)
    }

    /// Checks that a file of a table can be read as a whole and is as its log says.
    ///
    /// # Errors
    /// [`Error::DataFile`] if it is not, or what the store says.
    pub async fn check_file(&self, table: Table, file: &DataFile) -> Result<()> {
        self.check_size(file).await?;
        let mut batches = self.read_rows(table, file, &[], 0..file.rows).await?;
        let mut rows = 0;
        // A batch at a time: a merged file has more rows than memory should hold.
        while let Some(batch) = batches.try_next().await? {
            rows += batch.num_rows() as u64;
        }
        match rows == file.rows {
            true => Ok(()),
            false => {
                let source = format!("it has {rows} rows, its log says {}", file.rows).into();
                Err(Error::DataFile { file: file.path.to_string(), source })
            }
        }
    }

    async fn empty_table(&self, table: Table) -> Result<()> {
        let Some(view) = self.commit_log().view_table(table).await? else { return Ok(()) };
        if table == Table::Runs {
            self.delta_log().set_rebuilding(true).await?;
        }
        let remove = view.files.iter().map(|file| file.logged_file()).collect();
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
