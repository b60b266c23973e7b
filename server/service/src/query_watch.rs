//! A query as its engine watches it: what it is, how it goes, how it ended.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use arrow::array::Array as _;
use arrow::record_batch::RecordBatch;
use chrono::Utc;

use crate::activity::{QueryEnd, QueryStart};
use crate::engine_report::EngineReport;
use crate::fault::{FaultCode, RequestFault};
use crate::server_protocol::ServerProtocol;
use crate::stop_signal::StopSignal;

/// Characters of a statement that are kept.
const STATEMENT_CHARS: usize = 2_000;

/// Queries that run in an engine.
#[derive(Default)]
pub(crate) struct RunningWatches {
    last: AtomicU64,
    running: Mutex<HashMap<u64, StopSignal>>,
    /// Time from which a query is logged as slow.
    slow: Option<Duration>,
}

/// A query that runs, as far as it has come.
pub struct QueryWatch {
    number: u64,
    statement: String,
    begun: Instant,
    planned: OnceLock<Duration>,
    first_row: OnceLock<Duration>,
    rows: AtomicU64,
    bytes: AtomicU64,
    memory: AtomicU64,
    // None in it if the query was answered.
    outcome: OnceLock<Option<FaultCode>>,
}

/// Reports the end of a query when it is dropped.
pub struct QueryTimer {
    watch: Arc<QueryWatch>,
    watches: Arc<RunningWatches>,
}

impl RunningWatches {
    /// Logs queries from `slow` on.
    pub fn new(slow: Option<Duration>) -> Self {
        Self { slow, ..Self::default() }
    }

    /// Watches a query of a client that begins, until the timer is dropped.
    pub fn begin_watch(
        self: &Arc<Self>,
        protocol: ServerProtocol,
        client: &str,
        statement: &str,
        stop: &StopSignal,
    ) -> QueryTimer {
        let number = self.last.fetch_add(1, Ordering::Relaxed);
        self.lock_running().insert(number, stop.clone());
        let watch = QueryWatch {
            number,
            statement: statement.chars().take(STATEMENT_CHARS).collect(),
            begun: Instant::now(),
            planned: OnceLock::new(),
            first_row: OnceLock::new(),
            rows: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            memory: AtomicU64::new(0),
            outcome: OnceLock::new(),
        };
        let statement = watch.statement.clone();
        let started = Utc::now().timestamp_micros();
        let client = client.to_owned();
        EngineReport::Started(QueryStart { number, client, protocol, statement, started }).queue_line();
        QueryTimer { watch: Arc::new(watch), watches: self.clone() }
    }

    /// Cancels a query, if it runs.
    pub fn cancel_query(&self, number: u64) {
        if let Some(stop) = self.lock_running().get(&number) {
            stop.stop();
        }
    }

    fn lock_running(&self) -> MutexGuard<'_, HashMap<u64, StopSignal>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl QueryTimer {
    /// The query.
    pub fn watch(&self) -> &Arc<QueryWatch> {
        &self.watch
    }
}

impl Drop for QueryTimer {
    fn drop(&mut self) {
        self.watches.lock_running().remove(&self.watch.number);
        let end = self.watch.query_end();
        if self.watches.slow.is_some_and(|slow| end.seconds >= slow.as_secs_f64()) {
            tracing::warn!(
                seconds = end.seconds,
                plan_seconds = end.plan_seconds,
                first_row_seconds = end.first_row_seconds,
                rows = end.rows,
                bytes = end.bytes,
                memory = end.memory,
                outcome = end.failure.map_or("answered", FaultCode::name),
                statement = self.watch.statement,
                "a slow query"
            );
        }
        EngineReport::Ended(end).queue_line();
    }
}

impl QueryWatch {
    /// Records that it is planned.
    pub(crate) fn record_planned(&self) {
        let _ = self.planned.set(self.begun.elapsed());
    }

    /// Counts rows of its answer.
    pub(crate) fn count_rows(&self, batch: &RecordBatch) {
        let _ = self.first_row.set(self.begun.elapsed());
        let bytes = batch.columns().iter().map(|column| column.to_data().get_slice_memory_size().unwrap_or(0));
        self.rows.fetch_add(batch.num_rows() as u64, Ordering::Relaxed);
        self.bytes.fetch_add(bytes.sum::<usize>() as u64, Ordering::Relaxed);
    }

    /// Records the memory that its operators held.
    pub(crate) fn record_memory(&self, bytes: usize) {
        self.memory.fetch_max(bytes as u64, Ordering::Relaxed);
    }

    /// Records its outcome, a failure or none; the first counts. A query without one was abandoned by its client.
    pub fn record_outcome(&self, failure: Option<&RequestFault>) {
        let _ = self.outcome.set(failure.map(RequestFault::code));
    }

    fn query_end(&self) -> QueryEnd {
        let seconds = |time: &OnceLock<Duration>| time.get().map(Duration::as_secs_f64);
        QueryEnd {
            number: self.number,
            failure: self.outcome.get().copied().unwrap_or(Some(FaultCode::Cancelled)),
            plan_seconds: seconds(&self.planned),
            first_row_seconds: seconds(&self.first_row),
            seconds: self.begun.elapsed().as_secs_f64(),
            rows: self.rows.load(Ordering::Relaxed),
            bytes: self.bytes.load(Ordering::Relaxed),
            memory: self.memory.load(Ordering::Relaxed),
        }
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;

    use super::*;

    #[test]
    fn an_abandoned_query_was_cancelled() {
        let watches = Arc::new(RunningWatches::default());
        let timer = watches.begin_watch(ServerProtocol::Http, "ann", "select 1", &StopSignal::new());
        assert_eq!(timer.watch().query_end().failure, Some(FaultCode::Cancelled));
        timer.watch().record_outcome(None);
        timer.watch().record_outcome(Some(&RequestFault::Internal));
        assert_eq!(timer.watch().query_end().failure, None, "the first outcome counts");
    }

    #[test]
    fn a_query_is_cancelled_by_its_number() {
        let watches = Arc::new(RunningWatches::default());
        let stop = StopSignal::new();
        let timer = watches.begin_watch(ServerProtocol::Http, "ann", "select 1", &stop);
        watches.cancel_query(timer.watch().number + 1);
        assert!(stop.wait_for_stop().now_or_never().is_none());
        watches.cancel_query(timer.watch().number);
        assert!(stop.wait_for_stop().now_or_never().is_some());
        drop(timer);
        assert!(watches.lock_running().is_empty());
    }
}
