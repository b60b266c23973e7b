//! A query that runs: computed and encoded on threads of its own, handed over as it is fetched, ended when it is
//! dropped.

use std::sync::Arc;
use std::time::Duration;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::Span;

use crate::engine_report::EngineReport;
use crate::fault::RequestFault;
use crate::query_watch::QueryWatch;
use crate::stop_signal::StopSignal;

/// Bytes of rows that are encoded at once: what an answer holds in memory is a few of these.
const PART_BYTES: usize = 4 << 20;
/// Parts that wait while the client reads.
pub const WAITING: usize = 2;

/// Makes of rows what a protocol sends.
pub trait AnswerEncoder: Send + 'static {
    /// The encoded unit that is sent.
    type Item: Send + 'static;

    /// Encodes rows.
    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<Self::Item>, RequestFault>;

    /// Encodes the end of the answer, after the last row.
    fn encode_end(self) -> Result<Vec<Self::Item>, RequestFault>;
}

/// Rows as they are.
pub struct BatchEncoder;

impl AnswerEncoder for BatchEncoder {
    type Item = RecordBatch;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<RecordBatch>, RequestFault> {
        Ok(vec![batch])
    }

    fn encode_end(self) -> Result<Vec<RecordBatch>, RequestFault> {
        Ok(Vec::new())
    }
}

/// A query that runs. Dropping it ends it.
pub struct RunningQuery<T> {
    /// The columns.
    pub schema: SchemaRef,
    pub(crate) items: mpsc::Receiver<T>,
    pub(crate) task: JoinSet<Result<(), RequestFault>>,
    /// Stops it from another task.
    pub stop: StopSignal,
    /// The session's own limit of time.
    pub limit: Option<SessionTimeLimit>,
    pub(crate) watch: Arc<QueryWatch>,
    pub(crate) span: Span,
}

/// A session's own limit of time.
#[derive(Debug, Clone, Copy)]
pub struct SessionTimeLimit {
    time: Duration,
    end: Instant,
}

impl SessionTimeLimit {
    /// This long, from now.
    pub fn from_now(time: Duration) -> Self {
        Self { time, end: Instant::now() + time }
    }
}

impl<T: Send + 'static> RunningQuery<T> {
    /// Ends the query, whose further rows nobody wants: it was answered.
    pub fn finish_early(mut self) {
        self.watch.record_outcome(None);
        self.task.abort_all();
    }

    /// The next part; None after the last.
    ///
    /// # Errors
    /// What ended the query before its end.
    pub async fn next_part(&mut self) -> Result<Option<T>, RequestFault> {
        let limit = self.limit;
        tokio::select! {
            biased;
            fault = wait_for_fault(&self.stop, limit) => {
                self.watch.record_outcome(Some(&fault));
                self.task.abort_all();
                self.span.in_scope(|| EngineReport::record_failure(&fault));
                return Err(fault);
            }
            item = self.items.recv() => if let Some(item) = item {
                return Ok(Some(item));
            }
        }
        finish_task(&mut self.task).await.map(|()| None)
    }
}

/// Waits until the query is stopped or its session's time limit is reached; returns the matching fault.
pub async fn wait_for_fault(stop: &StopSignal, limit: Option<SessionTimeLimit>) -> RequestFault {
    match limit {
        None => {
            stop.wait_for_stop().await;
            RequestFault::Cancelled
        }
        Some(limit) => tokio::select! {
            () = stop.wait_for_stop() => RequestFault::Cancelled,
            () = tokio::time::sleep_until(limit.end) => RequestFault::Timeout { limit: limit.time },
        },
    }
}

/// Returns the result of a task that sends nothing more.
pub async fn finish_task(task: &mut JoinSet<Result<(), RequestFault>>) -> Result<(), RequestFault> {
    match task.join_next().await {
        None => Ok(()),
        Some(Ok(done)) => done,
        Some(Err(failed)) => Err(RequestFault::defect("a query ended its task")(failed)),
    }
}

/// Rows in parts that are cheap to hold.
pub(crate) fn split_batch(batch: &RecordBatch) -> impl Iterator<Item = RecordBatch> {
    let rows = batch.num_rows();
    let row_bytes = batch.get_array_memory_size() / rows.max(1);
    let step = (PART_BYTES / row_bytes.max(1)).max(1);
    (0..rows).step_by(step).map(move |at| batch.slice(at, step.min(rows - at)))
}

#[cfg(test)]
mod tests {
    use arrow::array::{ArrayRef, Int64Array};

    use super::*;

    #[test]
    fn parts_are_all_rows_in_order() {
        let numbers: ArrayRef = Arc::new(Int64Array::from_iter_values(0..1_500_000));
        let batch = RecordBatch::try_from_iter([("n", numbers)]).expect("a batch");
        let parts: Vec<_> = split_batch(&batch).collect();
        assert!(parts.len() > 1);
        assert_eq!(arrow::compute::concat_batches(&batch.schema(), &parts).expect("together"), batch);
        assert_eq!(super::split_batch(&batch.slice(0, 0)).count(), 0);
    }
}
