//! `system.ingests`: how each run came into the snapshot, by its row in `runs`.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, Int64Array, TimestampMicrosecondArray};
use arrow::compute::concat_batches;
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::datasource::TableProvider;
use datafusion::error::{DataFusionError, Result};
use datafusion::physical_plan::collect;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_lake_tables::{FileReaders, rewrite_local_scans};
use echolake_schema::tables::Table;

use super::{SystemRows, build_batch, build_schema, column_field, time_type};

/// Columns of `runs` that are among those of `system.ingests`.
const OF_RUNS: [&str; 9] =
    ["surface_id", "run_id", "state", "origin", "measurements", "damaged", "file_bytes", "recorded_by", "code_version"];

#[derive(Debug)]
pub(super) struct LakeIngests {
    pub lake: Lake,
    pub snapshot: Arc<LakeSnapshot>,
    pub runs: Arc<dyn TableProvider>,
    pub readers: FileReaders,
}

/// The columns of the table, by those of `runs`.
pub(super) fn table_schema(runs: &SchemaRef) -> SchemaRef {
    let own = [
        column_field(
            "version",
            DataType::Int64,
            true,
            "1",
            "Version of the lake in which the run has its present rows",
        ),
        column_field("ingested", time_type(), true, "", "Time of that version, UTC; null if the log no longer has it"),
    ];
    let of_runs = OF_RUNS.iter().filter_map(|name| runs.field_with_name(name).ok().cloned());
    build_schema(own.into_iter().chain(of_runs))
}

#[async_trait]
impl SystemRows for LakeIngests {
    fn schema(&self) -> SchemaRef {
        table_schema(&self.runs.schema())
    }

    async fn read_rows(&self, session: &dyn Session) -> Result<RecordBatch> {
        let runs = self.runs.schema();
        let columns = OF_RUNS.iter().map(|name| Ok(runs.index_of(name)?)).collect::<Result<Vec<_>>>()?;
        let plan = self.runs.scan(session, Some(&columns), &[], None).await?;
        let schema = plan.schema();
        let plan = rewrite_local_scans(plan, &self.readers)?;
        let rows = concat_batches(&schema, &collect(plan, session.task_ctx()).await?)?;
        let failed = |e: echolake_lake::Error| DataFusionError::External(Box::new(e));
        let times = self.lake.commit_log().list_versions(Table::Runs).await.map_err(failed)?;
        let times: HashMap<_, _> = times.iter().map(|v| (v.version, v.committed.timestamp_micros())).collect();
        let names = rows.column(1).as_string_opt::<i32>();
        let names = names.ok_or_else(|| DataFusionError::Internal("names of runs are texts".to_owned()))?;
        let version = || names.iter().map(|name| self.snapshot.row_version(&name?.parse().ok()?));
        let mut columns: Vec<ArrayRef> = vec![
            Arc::new(version().map(|version| version.map(|version| version as i64)).collect::<Int64Array>()),
            Arc::new(
                version()
                    .map(|version| times.get(&version?).copied())
                    .collect::<TimestampMicrosecondArray>()
                    .with_timezone("UTC"),
            ),
        ];
        columns.extend(rows.columns().iter().cloned());
        build_batch(self.schema(), columns)
    }
}
