//! `system.workers`: the workers over which heavy queries are spread. Those that were not asked for a while are asked.

use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, StringArray, TimestampMicrosecondArray};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::Result;

use super::{SystemRows, batch, column, schema, time};
use crate::{WorkerCluster, WorkerFigures, WorkerStatus};

#[derive(Debug)]
pub(super) struct ClusterWorkers {
    /// None if queries run here alone.
    pub(super) cluster: Option<Arc<WorkerCluster>>,
}

#[async_trait]
impl SystemRows for ClusterWorkers {
    fn schema(&self) -> SchemaRef {
        let count = |name, unit, comment| column(name, DataType::Int64, true, unit, comment);
        schema([
            column("address", DataType::Utf8, false, "", "Address of the worker"),
            column("state", DataType::Utf8, false, "", "used, or not used"),
            column("problem", DataType::Utf8, true, "", "Reason for which it is not used"),
            column("build", DataType::Utf8, true, "", "Its program; null if it has not answered yet"),
            column("last_seen", time(), true, "", "Time of its last answer, UTC"),
            count("running_tasks", "1", "Tasks that ran then; a query has one for each stage"),
            count("tasks", "1", "Tasks that were over since the start of the worker"),
            count("reading_tasks", "1", "Those of them that read files"),
            count("read_bytes", "B", "Bytes of files that they read"),
            count("store_requests", "1", "Requests to the object store since the start of the worker"),
        ])
    }

    async fn rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        let workers = match &self.cluster {
            Some(cluster) => cluster.checked_workers().await,
            None => Vec::new(),
        };
        let text = |value: fn(&WorkerStatus) -> Option<&str>| -> ArrayRef {
            Arc::new(workers.iter().map(value).collect::<StringArray>())
        };
        let count = |value: fn(&WorkerFigures) -> u64| -> ArrayRef {
            let figures = workers.iter().map(|worker| worker.figures.as_ref());
            Arc::new(figures.map(|figures| figures.map(|figures| value(figures) as i64)).collect::<Int64Array>())
        };
        let seen: TimestampMicrosecondArray = workers.iter().map(|worker| worker.last_seen).collect();
        let columns = vec![
            text(|worker| Some(&worker.url)),
            text(|worker| Some(if worker.problem.is_none() { "used" } else { "not used" })),
            text(|worker| worker.problem.as_deref()),
            text(|worker| worker.build.as_deref()),
            Arc::new(seen.with_timezone("UTC")),
            count(|figures| figures.running),
            count(|figures| figures.tasks),
            count(|figures| figures.reading_tasks),
            count(|figures| figures.read_bytes),
            count(|figures| figures.store_requests),
        ];
        batch(self.schema(), columns)
    }
}
