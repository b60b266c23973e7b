//! Sizes of runs' files as `runs` has them, so that an object store is not asked for each.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::AsArray as _;
use arrow::datatypes::{Int64Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_lake_tables::ColumnStore;
use echolake_schema::tables::Table;
use object_store::path::Path;

/// The sizes in `runs`, in memory.
#[derive(Debug)]
pub(super) struct RunSizes {
    columns: Arc<ColumnStore>,
    schema: SchemaRef,
}

impl RunSizes {
    pub fn new(lake: &Lake, columns: &Arc<ColumnStore>) -> Self {
        Self { columns: columns.clone(), schema: Table::Runs.schema(lake.rig()) }
    }

    /// Returns the sizes that are known. A file that is missing here is asked for its size.
    pub async fn read_sizes(&self, snapshot: &LakeSnapshot) -> HashMap<Path, u64> {
        let rows = self.columns.read_rows(&self.schema, snapshot.files(Table::Runs), &["file", "file_bytes"]).await;
        rows.ok().and_then(|rows| sizes_by_path(&rows)).unwrap_or_default()
    }
}

fn sizes_by_path(rows: &RecordBatch) -> Option<HashMap<Path, u64>> {
    let files = rows.column_by_name("file")?.as_string_opt::<i32>()?;
    let bytes = rows.column_by_name("file_bytes")?.as_primitive_opt::<Int64Type>()?;
    let known = files.iter().zip(bytes).filter_map(|(file, bytes)| {
        let bytes = u64::try_from(bytes?).ok().filter(|bytes| *bytes > 0)?;
        Some((Path::from(file?), bytes))
    });
    Some(known.collect())
}
