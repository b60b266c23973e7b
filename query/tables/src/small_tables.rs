//! Cache of the rows of small tables: `runs`, `surfaces` and `surface_stats` have one file per run until they are
//! merged, and most queries read them. A file never changes, so its rows are read once per process, many files
//! concurrently.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use arrow::compute::concat_batches;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::error::{DataFusionError, Result};
use echolake_lake::{DataFile, Lake};
use echolake_schema::RunId;
use echolake_schema::tables::Table;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use tokio::sync::Mutex as AsyncMutex;

/// Maximum rows of a small table: some ten megabytes of the widest one.
const SMALL_ROWS: u64 = 20_000;
/// Number of files that are read concurrently from a folder.
const TOGETHER: usize = 16;
/// The same from an object store, where waiting costs nothing else: six rounds for 350 runs.
const TOGETHER_REMOTE: usize = 64;

/// The cached rows by table and file.
#[derive(Debug)]
pub struct SmallTables {
    lake: Lake,
    files: Mutex<HashMap<Table, HashMap<Path, KnownRows>>>,
    /// Held by who reads files of a table, so that no two queries fetch the same ones.
    reading: Mutex<HashMap<Table, Arc<AsyncMutex<()>>>>,
}

/// The rows of a file that readers see.
#[derive(Debug, Clone)]
struct KnownRows {
    /// The runs whose rows are left out.
    hidden: Vec<RunId>,
    rows: RecordBatch,
}

impl SmallTables {
    /// Creates an empty cache for a lake.
    pub fn new(lake: &Lake) -> Self {
        Self { lake: lake.clone(), files: Mutex::default(), reading: Mutex::default() }
    }

    /// Returns the columns of a table that are cached; None if it is not small: few rows, no lists. Of `surface_stats`,
    /// which has a curve in each row, the other columns are cached.
    pub fn cached_columns<'a>(
        table: Table,
        schema: &SchemaRef,
        files: impl Iterator<Item = &'a DataFile>,
    ) -> Option<Vec<usize>> {
        let is_cached = |i: &usize| !schema.field(*i).data_type().is_nested();
        let columns: Vec<_> = (0..schema.fields().len()).filter(is_cached).collect();
        let is_narrow = table == Table::SurfaceStats || columns.len() == schema.fields().len();
        (is_narrow && files.map(DataFile::visible_rows).sum::<u64>() <= SMALL_ROWS).then_some(columns)
    }

    /// Returns the rows of these files that readers see, with the columns of `schema`. They must be all files of the
    /// table, and the columns those that are cached.
    ///
    /// # Errors
    /// If a file does not agree with its log.
    pub async fn read_rows(&self, table: Table, schema: &SchemaRef, files: &[&DataFile]) -> Result<RecordBatch> {
        let mut rows = self.known_rows(table, files);
        let reading = self.reading.lock().unwrap_or_else(PoisonError::into_inner).entry(table).or_default().clone();
        let _reading = if rows.len() < files.len() {
            let turn = reading.lock().await;
            rows = self.known_rows(table, files);
            Some(turn)
        } else {
            None
        };
        let missing: Vec<DataFile> =
            files.iter().filter(|f| !rows.contains_key(&f.path)).map(|f| (*f).clone()).collect();
        let read: Vec<_> = missing.into_iter().map(|file| self.read_file(table, schema, file)).collect();
        let together = if self.lake.is_remote() { TOGETHER_REMOTE } else { TOGETHER };
        let read: Vec<_> = futures::stream::iter(read).buffered(together).try_collect().await?;
        rows.extend(read);
        let all = concat_batches(schema, files.iter().filter_map(|f| Some(&rows.get(&f.path)?.rows)))?;
        let mut known = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.entry(table).or_default();
        // Evicts removed files once they outnumber the table's files; not sooner, because queries of past versions
        // alternate with those of the current one.
        if known.len() > 2 * files.len() {
            known.clear();
        }
        known.extend(rows);
        Ok(all)
    }

    fn known_rows(&self, table: Table, files: &[&DataFile]) -> HashMap<Path, KnownRows> {
        let known = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.get(&table);
        let rows = |file: &&DataFile| {
            let rows = known?.get(&file.path).filter(|rows| rows.hidden == file.hidden)?;
            Some((file.path.clone(), rows.clone()))
        };
        files.iter().filter_map(rows).collect()
    }

    async fn read_file(&self, table: Table, schema: &SchemaRef, file: DataFile) -> Result<(Path, KnownRows)> {
        let failed = |e: echolake_lake::Error| DataFusionError::External(Box::new(e));
        let columns: Vec<_> = schema.fields().iter().map(|field| field.name().as_str()).collect();
        let mut batches = Vec::new();
        for range in file.visible_ranges() {
            let stream = self.lake.read_rows(table, &file, &columns, range).await.map_err(failed)?;
            batches.extend(stream.try_collect::<Vec<_>>().await.map_err(failed)?);
        }
        let rows = concat_batches(schema, &batches)?;
        Ok((file.path, KnownRows { hidden: file.hidden, rows }))
    }
}
