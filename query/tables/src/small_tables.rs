//! Cache of the rows of small tables: `runs`, `surfaces` and `surface_stats` have one file per run until they are
//! merged, and most queries read them. A file never changes, so its rows are read once per process, many files
//! concurrently.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use arrow::compute::concat_batches;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::error::{DataFusionError, Result};
use echolake_lake::{DataFile, Lake};
use echolake_schema::tables::Table;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use tokio::sync::Mutex as AsyncMutex;

use crate::held_table::HeldTable;

/// Maximum rows of a small table: some ten megabytes of the widest one.
const SMALL_ROWS: u64 = 20_000;
/// Number of files that are read concurrently from a folder.
const TOGETHER: usize = 16;
/// The same from an object store, where waiting costs nothing else: six rounds for 350 runs.
const TOGETHER_REMOTE: usize = 64;

/// The cached rows by table and file, and the small tables of the snapshots that are in use.
#[derive(Debug)]
pub struct SmallTables {
    lake: Lake,
    files: Mutex<HashMap<Table, HashMap<Path, RecordBatch>>>,
    /// Held by who reads files of a table, so that no two queries fetch the same ones.
    reading: Mutex<HashMap<Table, Arc<AsyncMutex<()>>>>,
    /// The newest last.
    tables: Mutex<Vec<Weak<HeldTable>>>,
}

impl SmallTables {
    /// Creates an empty cache for a lake.
    pub fn new(lake: &Lake) -> Self {
        Self { lake: lake.clone(), files: Mutex::default(), reading: Mutex::default(), tables: Mutex::default() }
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
        (is_narrow && files.map(|file| file.rows).sum::<u64>() <= SMALL_ROWS).then_some(columns)
    }

    /// Returns the rows of these files that readers see, with the columns of `schema`. They must be files of a small
    /// table, and the columns those that are cached.
    ///
    /// # Errors
    /// If a file does not agree with its log.
    pub async fn read_rows(&self, table: Table, schema: &SchemaRef, files: &[&DataFile]) -> Result<RecordBatch> {
        let rows = self.read_files(table, schema, files, files.len()).await?;
        let visible = files.iter().zip(&rows).flat_map(|(file, rows)| {
            file.visible_ranges()
                .into_iter()
                .map(|range| rows.slice(range.start as usize, range.end.saturating_sub(range.start) as usize))
        });
        Ok(concat_batches(schema, &visible.collect::<Vec<_>>())?)
    }

    /// Returns all rows of each of these files of a small table, which has `table_files`.
    pub(crate) async fn read_files(
        &self,
        table: Table,
        schema: &SchemaRef,
        files: &[&DataFile],
        table_files: usize,
    ) -> Result<Vec<RecordBatch>> {
        let mut rows = self.known_rows(table, files);
        if rows.len() < files.len() {
            let reading = self.reading.lock().unwrap_or_else(PoisonError::into_inner).entry(table).or_default().clone();
            let _turn = reading.lock().await;
            rows = self.known_rows(table, files);
            let missing = files.iter().filter(|f| !rows.contains_key(&f.path)).map(|f| (*f).clone());
            let read: Vec<_> = missing.map(|file| self.read_file(table, schema, file)).collect();
            let together = if self.lake.is_remote() { TOGETHER_REMOTE } else { TOGETHER };
            let read: Vec<_> = futures::stream::iter(read).buffered(together).try_collect().await?;
            let mut known = self.files.lock().unwrap_or_else(PoisonError::into_inner);
            let known = known.entry(table).or_default();
            // Evicts removed files once they outnumber the table's files; not sooner, because queries of past versions
            // alternate with those of the current one.
            if known.len() > 2 * table_files.max(files.len()) {
                known.clear();
            }
            known.extend(read.iter().cloned());
            rows.extend(read);
        }
        Ok(files.iter().filter_map(|file| rows.get(&file.path).cloned()).collect())
    }

    /// Adds a table to those that scans may be of, for as long as somebody holds it.
    pub(crate) fn add_table(&self, table: &Arc<HeldTable>) {
        let mut tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        tables.retain(|table| table.strong_count() > 0);
        tables.push(Arc::downgrade(table));
    }

    /// Returns the small tables of this name, that of the newest snapshot first.
    pub(crate) fn held_tables(&self, table: Table) -> Vec<Arc<HeldTable>> {
        let tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        tables.iter().rev().filter_map(Weak::upgrade).filter(|held| held.table() == table).collect()
    }

    fn known_rows(&self, table: Table, files: &[&DataFile]) -> HashMap<Path, RecordBatch> {
        let known = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.get(&table);
        files.iter().filter_map(|file| known?.get_key_value(&file.path)).map(|(p, r)| (p.clone(), r.clone())).collect()
    }

    async fn read_file(&self, table: Table, schema: &SchemaRef, file: DataFile) -> Result<(Path, RecordBatch)> {
        let failed = |e: echolake_lake::Error| DataFusionError::External(Box::new(e));
        let columns: Vec<_> = schema.fields().iter().map(|field| field.name().as_str()).collect();
        let stream = self.lake.read_rows(table, &file, &columns, 0..file.rows).await.map_err(failed)?;
        let batches: Vec<_> = stream.try_collect().await.map_err(failed)?;
        let rows = concat_batches(schema, &batches)?;
        Ok((file.path, rows))
    }
}
