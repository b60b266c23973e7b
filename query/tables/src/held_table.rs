//! A small table of one snapshot, whose rows this process holds once a query has read them.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::compute::concat_batches;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::datasource::physical_plan::FileScanConfig;
use datafusion::error::{DataFusionError, Result};
use echolake_lake::DataFile;
use echolake_schema::tables::Table;
use object_store::path::Path;
use tokio::sync::OnceCell;

use crate::small_tables::SmallTables;

/// All files of a small table, with all of their rows: those of hidden parts, too, which a scan's own filters leave
/// out.
#[derive(Debug)]
pub(crate) struct HeldTable {
    table: Table,
    /// The cached columns.
    schema: SchemaRef,
    files: Vec<Arc<DataFile>>,
    places: HashMap<Path, usize>,
    /// The rows of all files, if a query read them together.
    whole: OnceCell<RecordBatch>,
}

impl HeldTable {
    /// Makes a table of its files; None if it is not small.
    pub fn from_files(table: Table, schema: &SchemaRef, files: &[Arc<DataFile>]) -> Result<Option<Self>> {
        let Some(columns) = SmallTables::cached_columns(table, schema, files.iter().map(|file| &**file)) else {
            return Ok(None);
        };
        let schema = Arc::new(schema.project(&columns)?);
        let places = files.iter().enumerate().map(|(place, file)| (file.path.clone(), place)).collect();
        Ok(Some(Self { table, schema, files: files.to_vec(), places, whole: OnceCell::new() }))
    }

    /// Returns which table it is.
    pub fn table(&self) -> Table {
        self.table
    }

    /// Returns the columns that are held.
    pub fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    /// Returns the places of a scan's files among those of the table, by partition. None if a file is another's, or is
    /// read in part: its parts may be read by different processes, of which not all hold it.
    pub fn find_places(&self, scan: &FileScanConfig) -> Option<Vec<Vec<usize>>> {
        let mut next = 0;
        let mut find_place = |path: &Path| {
            // Scans mostly have the table's order.
            let place = match self.files.get(next) {
                Some(file) if file.path == *path => next,
                _ => *self.places.get(path)?,
            };
            next = place + 1;
            Some(place)
        };
        let groups = scan.file_groups.iter().map(|group| {
            let places = group.files().iter().map(|file| match file.range {
                Some(_) => None,
                None => find_place(&file.object_meta.location),
            });
            places.collect::<Option<Vec<_>>>()
        });
        groups.collect()
    }

    /// Returns the rows of some of its files, with these columns.
    ///
    /// # Errors
    /// If a file does not agree with its log.
    pub async fn read_rows(&self, small: &SmallTables, places: &[usize], columns: &[usize]) -> Result<RecordBatch> {
        let is_whole = places.len() == self.files.len() && places.iter().enumerate().all(|(at, place)| at == *place);
        if is_whole {
            let read = async || {
                let rows = self.read_files(small, places).await?;
                Ok::<_, DataFusionError>(concat_batches(&self.schema, &rows)?)
            };
            return Ok(self.whole.get_or_try_init(read).await?.project(columns)?);
        }
        let rows = self.read_files(small, places).await?;
        let rows = rows.iter().map(|rows| rows.project(columns)).collect::<std::result::Result<Vec<_>, _>>()?;
        Ok(concat_batches(&Arc::new(self.schema.project(columns)?), &rows)?)
    }

    async fn read_files(&self, small: &SmallTables, places: &[usize]) -> Result<Vec<RecordBatch>> {
        let files: Vec<_> = places.iter().filter_map(|place| self.files.get(*place)).map(|file| &**file).collect();
        small.read_files(self.table, &self.schema, &files, self.files.len()).await
    }
}
