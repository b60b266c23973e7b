//! Limits of queries: a [`QueryTicket`] signals whether a query may continue, [`pool`] counts the memory of its
//! operators.
//!
//! DataFusion ends a query only at an await, and allocates between two checks of its pool.
//! [`RunningQueries::longest_overdue`] finds work that does not end soon after its ticket was stopped; a server then
//! ends the whole process, which serves one client alone.

pub(crate) mod pool;
pub(crate) mod threads;

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, Weak};
use std::time::{Duration, Instant};

use tokio::sync::Notify;
use tokio::task::AbortHandle;

use pool::HeldMemory;

/// Reason for which a query was stopped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StopReason {
    /// The client cancelled it.
    Cancelled,
    /// It took too long.
    Time(Duration),
}

/// Cancellation state and accounting of one query.
pub(crate) struct QueryTicket {
    stop: OnceLock<(StopReason, Instant)>,
    stopped: Notify,
    /// Bytes that its operators have reserved.
    held: Arc<HeldMemory>,
    /// Number of live work guards.
    working: AtomicUsize,
    /// The task that stops the query at its timeout; it ends with the ticket.
    timer: OnceLock<AbortHandle>,
}

impl Drop for QueryTicket {
    fn drop(&mut self) {
        if let Some(timer) = self.timer.get() {
            timer.abort();
        }
    }
}

/// A guard for work on a query, dropped on the thread that does the work.
pub(crate) struct WorkGuard(Arc<QueryTicket>);

impl Drop for WorkGuard {
    fn drop(&mut self) {
        self.0.working.fetch_sub(1, Ordering::Relaxed);
    }
}

impl QueryTicket {
    pub fn new() -> Self {
        Self {
            stop: OnceLock::new(),
            stopped: Notify::new(),
            held: Arc::default(),
            working: AtomicUsize::new(0),
            timer: OnceLock::new(),
        }
    }

    /// Sets the task that stops the query at its timeout.
    pub fn set_timer(&self, timer: AbortHandle) {
        let _ = self.timer.set(timer);
    }

    /// Stops the query; the first reason counts.
    pub fn stop(&self, why: StopReason) {
        let _ = self.stop.set((why, Instant::now()));
        self.stopped.notify_waiters();
    }

    /// Returns the reason for which the query was stopped, if it was.
    pub fn stop_reason(&self) -> Option<&StopReason> {
        self.stop.get().map(|(why, _)| why)
    }

    /// Waits until the query must end.
    pub async fn wait_for_stop(&self) -> StopReason {
        loop {
            // Subscribes before the check, or a stop between them would be missed.
            let stopped = self.stopped.notified();
            if let Some(why) = self.stop_reason() {
                return why.clone();
            }
            stopped.await;
        }
    }

    /// Bytes that its operators have reserved.
    pub fn held_memory(&self) -> &Arc<HeldMemory> {
        &self.held
    }

    /// Registers work for the query.
    pub fn begin_work(self: &Arc<Self>) -> WorkGuard {
        self.working.fetch_add(1, Ordering::Relaxed);
        WorkGuard(self.clone())
    }

    // Time for which work has continued after the query was ended.
    fn overdue_time(&self) -> Option<Duration> {
        let (_, at) = self.stop.get()?;
        (self.working.load(Ordering::Relaxed) > 0).then(|| at.elapsed())
    }
}

impl fmt::Debug for QueryTicket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("QueryTicket")
            .field("stop", &self.stop_reason())
            .field("held", &self.held)
            .finish_non_exhaustive()
    }
}

/// The queries of an engine.
#[derive(Debug, Default)]
pub(crate) struct RunningQueries(Mutex<Vec<Weak<QueryTicket>>>);

impl RunningQueries {
    pub fn add_ticket(&self, ticket: &Arc<QueryTicket>) {
        let mut tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.retain(|t| t.strong_count() > 0);
        tickets.push(Arc::downgrade(ticket));
    }

    /// Counts the queries that run or wait.
    pub fn count_running(&self) -> usize {
        self.live_tickets().iter().filter(|t| t.stop_reason().is_none()).count()
    }

    /// Returns the longest time for which work has continued after its query was ended; None if there is none.
    pub fn longest_overdue(&self) -> Option<Duration> {
        self.live_tickets().iter().filter_map(|t| t.overdue_time()).max()
    }

    fn live_tickets(&self) -> Vec<Arc<QueryTicket>> {
        let tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.iter().filter_map(Weak::upgrade).collect()
    }
}
