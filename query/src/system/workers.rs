//! `system.workers`: the workers over which heavy queries are spread. Those that were not asked for a while are asked.

use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, StringArray, TimestampMicrosecondArray};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::Result;

use super::{SystemRows, build_batch, build_schema, column_field, time_type};
use crate::spread::{WorkerCluster, WorkerFigures, WorkerState};

#[derive(Debug)]
pub(super) struct ClusterWorkers {
    /// None if queries run here alone.
    pub cluster: Option<Arc<WorkerCluster>>,
}

#[async_trait]
impl SystemRows for ClusterWorkers {
    fn schema(&self) -> SchemaRef {
        let count = |name, unit, comment| column_field(name, DataType::Int64, true, unit, comment);
        build_schema([
            column_field("address", DataType::Utf8, false, "", "Address of the worker"),
            column_field("state", DataType::Utf8, false, "", "used, or not used"),
            column_field("problem", DataType::Utf8, true, "", "Reason for which it is not used"),
            column_field("build", DataType::Utf8, true, "", "Its program; null if it has not answered yet"),
            column_field("last_seen", time_type(), true, "", "Time of its last answer, UTC"),
            count("running_tasks", "1", "Tasks that ran then; a query has one for each stage"),
            count("tasks", "1", "Tasks that were over since the start of the worker"),
            count("read_bytes", "B", "Bytes of files that they read"),
            count("store_requests", "1", "Requests to the object store since the start of the worker"),
        ])
    }

    async fn read_rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        let workers = match &self.cluster {
            Some(cluster) => cluster.fresh_states().await,
            None => Vec::new(),
        };
        let texts = |value: fn(&WorkerState) -> Option<&str>| -> ArrayRef {
            Arc::new(workers.iter().map(value).collect::<StringArray>())
        };
        let counts = |value: fn(&WorkerFigures) -> u64| -> ArrayRef {
            let figures = workers.iter().map(|worker| worker.figures.as_ref());
            Arc::new(figures.map(|figures| figures.map(|figures| value(figures) as i64)).collect::<Int64Array>())
        };
        let seen: TimestampMicrosecondArray = workers.iter().map(|worker| worker.last_seen_micros).collect();
        let columns = vec![
            texts(|worker| Some(&worker.url)),
            texts(|worker| Some(if worker.problem.is_none() { "used" } else { "not used" })),
            texts(|worker| worker.problem.as_deref()),
            texts(|worker| worker.build.as_deref()),
            Arc::new(seen.with_timezone("UTC")),
            counts(|figures| figures.running),
            counts(|figures| figures.tasks),
            counts(|figures| figures.read_bytes),
            counts(|figures| figures.store_requests),
        ];
        build_batch(self.schema(), columns)
    }
}
