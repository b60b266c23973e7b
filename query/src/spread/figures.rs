//! Figures of a worker: what its tasks did since it started.

use std::sync::Arc;

use datafusion::physical_plan::ExecutionPlan;
use serde::{Deserialize, Serialize};

/// The path at which a worker answers its figures as JSON.
pub const WORKER_FIGURES_PATH: &str = "/figures";

/// Metrics of scans: bytes that they read of table files and of run files.
const READ_BYTES: [&str; 2] = ["bytes_scanned", "bytes_read"];

/// Figures of a worker since its start. What a task read is counted when it is over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerFigures {
    /// Tasks that run now.
    pub running: u64,
    /// Tasks that are over.
    pub tasks: u64,
    /// Those of them that read something.
    pub reading_tasks: u64,
    /// Bytes of files that they read.
    pub read_bytes: u64,
    /// Requests to the object store of the whole process, for what its cache did not have.
    pub store_requests: u64,
}

impl WorkerFigures {
    /// Counts a task that is over, by the leaves of its plan.
    pub(super) fn add_task(&mut self, leaves: &[Arc<dyn ExecutionPlan>]) {
        let sum = |name: &str| leaves.iter().map(|leaf| metric(leaf, name)).sum::<u64>();
        let bytes: u64 = READ_BYTES.into_iter().map(sum).sum();
        self.tasks += 1;
        self.reading_tasks += u64::from(bytes > 0);
        self.read_bytes += bytes;
    }
}

fn metric(leaf: &Arc<dyn ExecutionPlan>, name: &str) -> u64 {
    let metrics = leaf.metrics();
    metrics.and_then(|metrics| metrics.sum_by_name(name)).map_or(0, |value| value.as_usize() as u64)
}
