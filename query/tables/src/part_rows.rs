//! Visible rows of merged files, for a reader who may not see the others: read by their places in the files, so that no
//! plan names or counts what is left out.

use std::sync::Arc;

use arrow::array::RecordBatchOptions;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::stream::RecordBatchStreamAdapter;
use datafusion::physical_plan::streaming::{PartitionStream, StreamingTableExec};
use echolake_lake::{DataFile, Lake};
use echolake_schema::tables::Table;
use futures::{StreamExt as _, TryStreamExt as _};

/// A column that every table with merged files has: read to count rows if no other is wanted.
const RUN: &str = "run_id";

/// Makes a scan of the rows that readers see of merged files.
///
/// # Errors
/// A projection that does not fit the schema.
pub(crate) fn visible_rows_scan(
    lake: &Lake,
    table: Table,
    schema: &SchemaRef,
    files: impl Iterator<Item = DataFile>,
    projection: Option<&Vec<usize>>,
) -> Result<Arc<dyn ExecutionPlan>> {
    let schema = match projection {
        Some(columns) => Arc::new(schema.project(columns)?),
        None => schema.clone(),
    };
    let part = |file| Arc::new(VisibleRows { lake: lake.clone(), table, file, schema: schema.clone() }) as _;
    let parts: Vec<Arc<dyn PartitionStream>> = files.map(part).collect();
    Ok(Arc::new(StreamingTableExec::try_new(schema.clone(), parts, None, [], false, None)?))
}

/// The rows that readers see of a merged file.
struct VisibleRows {
    lake: Lake,
    table: Table,
    file: DataFile,
    /// The wanted columns.
    schema: SchemaRef,
}

// Plans are shown to clients: this says nothing of the file.
impl std::fmt::Debug for VisibleRows {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VisibleRows").field("table", &self.table.name()).finish_non_exhaustive()
    }
}

impl PartitionStream for VisibleRows {
    fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    fn execute(&self, _: Arc<TaskContext>) -> SendableRecordBatchStream {
        let lake = self.lake.clone();
        let table = self.table;
        let file = self.file.clone();
        let schema = self.schema.clone();
        let rows = futures::stream::iter(file.visible_ranges()).then(move |range| {
            let lake = lake.clone();
            let file = file.clone();
            let schema = schema.clone();
            async move {
                let names: Vec<_> = schema.fields().iter().map(|field| field.name().as_str()).collect();
                let columns = if names.is_empty() { vec![RUN] } else { names };
                let batches = lake.read_rows(table, &file, &columns, range).await.map_err(read_error)?;
                let wanted = schema.clone();
                Ok::<_, DataFusionError>(batches.map(move |batch| with_columns(&batch.map_err(read_error)?, &wanted)))
            }
        });
        Box::pin(RecordBatchStreamAdapter::new(self.schema.clone(), rows.try_flatten()))
    }
}

fn read_error(error: echolake_lake::Error) -> DataFusionError {
    DataFusionError::External(Box::new(error))
}

// The columns of a batch in the wanted order.
fn with_columns(batch: &RecordBatch, schema: &SchemaRef) -> Result<RecordBatch> {
    let columns =
        schema.fields().iter().map(|field| Ok(batch.column(batch.schema_ref().index_of(field.name())?).clone()));
    let rows = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
    Ok(RecordBatch::try_new_with_options(schema.clone(), columns.collect::<Result<Vec<_>>>()?, &rows)?)
}
