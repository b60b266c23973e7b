//! The answer to a query: batches that are computed as they are fetched.

use std::sync::{Arc, Weak};

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::error::DataFusionError;
use futures::StreamExt as _;
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use tokio::task::JoinHandle;

use crate::Error;
use crate::client::QueryPermit;
use crate::control::{QueryTicket, StopReason};
use crate::engine::{self, QueryEngine};
use crate::spread::attempts::QueryAttempts;

/// A stream of answer batches. Dropping it cancels the query.
pub struct QueryAnswer {
    /// Its columns.
    pub schema: SchemaRef,
    pub(super) batches: mpsc::Receiver<Result<RecordBatch, DataFusionError>>,
    pub(super) query: Option<JoinHandle<()>>,
    pub(super) ticket: Arc<QueryTicket>,
    /// The text, for places of errors.
    pub(super) sql: String,
    pub(super) rows: u64,
    pub(super) limit: Option<u64>,
    // Keeps the query's threads alive while the answer is read, even if the session is dropped.
    pub(super) _engine: QueryEngine,
}

/// Cancels a query from another task.
#[derive(Clone)]
pub struct CancelHandle(Weak<QueryTicket>);

impl CancelHandle {
    /// Cancels the query; its answer fails with [`Error::Cancelled`]. Has no effect on a finished query.
    pub fn cancel(&self) {
        if let Some(ticket) = self.0.upgrade() {
            ticket.stop(StopReason::Cancelled);
        }
    }
}

impl QueryAnswer {
    /// Returns the next rows; None after the last.
    ///
    /// # Errors
    /// [`Error::Execution`] if the query fails while it runs; [`Error::Cancelled`], [`Error::TimeLimit`],
    /// [`Error::MemoryLimit`] or [`Error::RowLimit`] if it may not continue.
    pub async fn next(&mut self) -> Result<Option<RecordBatch>, Error> {
        let batch = tokio::select! {
            biased;
            batch = self.batches.recv() => batch,
            why = self.ticket.wait_for_stop() => return Err(Error::from_stop(&why)),
        };
        let Some(batch) = batch else { return self.end_query().await };
        let batch = batch.map_err(|e| Error::from_execution(&self.sql, &e))?;
        self.rows += batch.num_rows() as u64;
        if let Some(limit) = self.limit.filter(|limit| self.rows > *limit) {
            self.ticket.stop(StopReason::Cancelled);
            return Err(Error::RowLimit { limit });
        }
        Ok(Some(batch))
    }

    /// Returns the most memory that its operators have held, bytes.
    pub fn peak_memory(&self) -> usize {
        self.ticket.held_memory().peak_bytes()
    }

    /// Returns a handle that cancels this answer's query.
    pub fn cancel_handle(&self) -> CancelHandle {
        CancelHandle(Arc::downgrade(&self.ticket))
    }

    // Without this, an answer whose query panicked would look complete.
    async fn end_query(&mut self) -> Result<Option<RecordBatch>, Error> {
        let Some(query) = self.query.take() else { return Ok(None) };
        match query.await {
            Ok(()) => self.ticket.stop_reason().map_or(Ok(None), |why| Err(Error::from_stop(why))),
            Err(_) => Err(engine::defect_error()),
        }
    }
}

impl Drop for QueryAnswer {
    fn drop(&mut self) {
        self.ticket.stop(StopReason::Cancelled);
    }
}

// Runs a query. It holds its permit until its operators are dropped, even if the reader is gone; then turn and seat are
// free, even if the reader has rows to fetch.
pub(super) async fn drive_query(
    attempts: QueryAttempts,
    send: mpsc::Sender<Result<RecordBatch, DataFusionError>>,
    engine: QueryEngine,
    ticket: Arc<QueryTicket>,
    _place: QueryPermit,
) {
    tokio::select! {
        biased;
        _ = ticket.wait_for_stop() => {}
        () = send_batches(attempts, &send, &engine, &ticket) => {}
    }
    ticket.end_computing();
}

// An error of `send` means that the answer was dropped. While the reader does not fetch, others have the turn.
async fn send_batches(
    attempts: QueryAttempts,
    send: &mpsc::Sender<Result<RecordBatch, DataFusionError>>,
    engine: &QueryEngine,
    ticket: &QueryTicket,
) {
    let mut batches = std::pin::pin!(attempts.into_batches());
    while let Some(batch) = batches.next().await {
        let has_failed = batch.is_err();
        match send.try_send(batch) {
            Ok(()) => {}
            Err(TrySendError::Closed(_)) => return,
            Err(TrySendError::Full(batch)) => {
                ticket.pause_computing();
                if send.send(batch).await.is_err() {
                    return;
                }
                if !has_failed {
                    engine.resume_computing(ticket).await;
                }
            }
        }
        if has_failed {
            return;
        }
    }
}
