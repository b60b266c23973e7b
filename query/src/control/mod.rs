//! Limits of queries: a [`Ticket`] says whether a query may continue, [`pool`] counts the memory of its operators.
//!
//! DataFusion ends a query only where it waits, and allocates between two looks at its pool. What does not end soon after
//! its ticket was stopped is found here ([`RunningQueries::overdue`]); a server then ends the whole process, which is one
//! client's alone.

pub(crate) mod pool;
pub(crate) mod threads;

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, Weak};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

/// Why a query was ended before its end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Stop {
    /// Whoever asked does not want it any more.
    Cancelled,
    /// It took too long.
    Time(Duration),
}

/// Whether one query may go on.
pub(crate) struct Ticket {
    stop: OnceLock<(Stop, Instant)>,
    stopped: Notify,
    /// Bytes that its operators say they hold.
    held: Arc<AtomicUsize>,
    /// Guards of work that is being done for it.
    working: AtomicUsize,
}

/// Work that is being done for a query, until this is dropped on the thread that does it.
pub(crate) struct WorkGuard(Arc<Ticket>);

impl WorkGuard {
    pub(crate) fn ticket(&self) -> &Ticket {
        &self.0
    }
}

impl Drop for WorkGuard {
    fn drop(&mut self) {
        self.0.working.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Ticket {
    pub(crate) fn new() -> Self {
        Self { stop: OnceLock::new(), stopped: Notify::new(), held: Arc::default(), working: AtomicUsize::new(0) }
    }

    /// Ends the query; the first reason counts.
    pub(crate) fn stop(&self, why: Stop) {
        let _ = self.stop.set((why, Instant::now()));
        self.stopped.notify_waiters();
    }

    /// Why the query ends, if it does.
    pub(crate) fn why(&self) -> Option<&Stop> {
        self.stop.get().map(|(why, _)| why)
    }

    /// Waits until the query must end.
    pub(crate) async fn stopped(&self) -> Stop {
        loop {
            // Listening begins before the look, or a stop between them would be missed.
            let stopped = self.stopped.notified();
            if let Some(why) = self.why() {
                return why.clone();
            }
            stopped.await;
        }
    }

    /// Bytes that its operators say they hold.
    pub(crate) fn held(&self) -> &Arc<AtomicUsize> {
        &self.held
    }

    /// Marks the begin of work for the query.
    pub(crate) fn begin_work(self: &Arc<Self>) -> WorkGuard {
        self.working.fetch_add(1, Ordering::Relaxed);
        WorkGuard(self.clone())
    }

    // Time for which work has continued after the query was ended.
    fn overdue(&self) -> Option<Duration> {
        let (_, at) = self.stop.get()?;
        (self.working.load(Ordering::Relaxed) > 0).then(|| at.elapsed())
    }
}

impl fmt::Debug for Ticket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ticket").field("stop", &self.why()).field("held", &self.held).finish_non_exhaustive()
    }
}

/// The queries of an engine.
#[derive(Debug, Default)]
pub(crate) struct RunningQueries(Mutex<Vec<Weak<Ticket>>>);

impl RunningQueries {
    pub(crate) fn add(&self, ticket: &Arc<Ticket>) {
        let mut tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.retain(|t| t.strong_count() > 0);
        tickets.push(Arc::downgrade(ticket));
    }

    /// Counts the queries that run or wait.
    pub(crate) fn count(&self) -> usize {
        self.live().iter().filter(|t| t.why().is_none()).count()
    }

    /// Returns the longest time for which work has continued after its query was ended; None if there is none.
    pub(crate) fn overdue(&self) -> Option<Duration> {
        self.live().iter().filter_map(|t| t.overdue()).max()
    }

    fn live(&self) -> Vec<Arc<Ticket>> {
        let tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.iter().filter_map(Weak::upgrade).collect()
    }
}
