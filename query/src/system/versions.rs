//! `system.versions`: the versions of all tables that their logs still hold.

use std::sync::Arc;

use arrow::array::{Int64Array, StringArray, TimestampMicrosecondArray};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::{DataFusionError, Result};
use echolake_lake::{Lake, TableChange};
use echolake_schema::tables::Table;
use futures::future::try_join_all;

use super::{SystemRows, build_batch, build_schema, column_field, time_type};

#[derive(Debug)]
pub(super) struct LakeVersions {
    pub lake: Lake,
}

/// The columns of the table.
pub(super) fn table_schema() -> SchemaRef {
    build_schema([
        column_field("table", DataType::Utf8, false, "", "The table"),
        column_field("version", DataType::Int64, false, "1", "Version, for VERSION AS OF; the lake's is that of runs"),
        column_field("committed", time_type(), false, "", "Time of its commit, UTC"),
        column_field("operation", DataType::Utf8, true, "", "What the writer says it did"),
        column_field("files_added", DataType::Int64, false, "1", "Files that came"),
        column_field("files_removed", DataType::Int64, false, "1", "Files that went"),
        column_field(
            "rows_added",
            DataType::Int64,
            true,
            "1",
            "Rows of the files that came; null if a file does not say",
        ),
        column_field(
            "rows_removed",
            DataType::Int64,
            true,
            "1",
            "Rows of the files that went; null if one of them is older than the log",
        ),
    ])
}

#[async_trait]
impl SystemRows for LakeVersions {
    fn schema(&self) -> SchemaRef {
        table_schema()
    }

    async fn read_rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        let log = self.lake.commit_log();
        let changes = Table::ALL.into_iter().map(|table| async move {
            let changes = log.list_changes(table).await.map_err(|e| DataFusionError::External(Box::new(e)))?;
            Ok::<_, DataFusionError>(changes.into_iter().map(move |change| (table, change)))
        });
        let changes: Vec<(Table, TableChange)> = try_join_all(changes).await?.into_iter().flatten().collect();
        let long = |value: &dyn Fn(&TableChange) -> Option<u64>| {
            let values = changes.iter().map(|(_, change)| value(change).map(|value| value as i64));
            Arc::new(values.collect::<Int64Array>())
        };
        let table = StringArray::from_iter_values(changes.iter().map(|(table, _)| table.name()));
        let times = changes.iter().map(|(_, change)| change.version.committed.timestamp_micros());
        let operation: StringArray = changes.iter().map(|(_, change)| change.operation.as_deref()).collect();
        build_batch(
            self.schema(),
            vec![
                Arc::new(table),
                long(&|change| Some(change.version.version)),
                Arc::new(TimestampMicrosecondArray::from_iter_values(times).with_timezone("UTC")),
                Arc::new(operation),
                long(&|change| Some(change.files_added)),
                long(&|change| Some(change.files_removed)),
                long(&|change| change.rows_added),
                long(&|change| change.rows_removed),
            ],
        )
    }
}
