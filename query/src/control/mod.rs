//! Keeps queries within their limits, and ends them at once when they must end.
//!
//! DataFusion alone cannot: a join whose rows all fail its condition never returns to the scheduler, and dropping a
//! stream only ends it where it waits. So every operator's stream, and every condition of a join, asks a [`Ticket`]
//! whether the query may go on, and fails where it may not ([`watched`]). Functions that could make more than memory
//! holds of little input are refused it beforehand ([`guard`]). What a query's operators keep is counted
//! ([`pool`]), what they do not count is seen in the process's size ([`governor`]), and queries that need much are
//! run a few at a time, on threads of their own ([`lanes`]).

pub(crate) mod governor;
pub(crate) mod guard;
pub(crate) mod lanes;
pub(crate) mod pool;
pub(crate) mod watched;

use std::fmt;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use datafusion::error::DataFusionError;
use tokio::sync::Notify;

/// Why a query was ended before its end.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Stop {
    /// Whoever asked does not want it any more.
    #[error("cancelled")]
    Cancelled,
    /// It took too long.
    #[error("out of time")]
    Time(Duration),
    /// The process had grown over its limit, and this query was the largest.
    #[error("out of memory")]
    Memory,
}

/// Whether one query may go on. Everything that works for the query holds it.
pub(crate) struct Ticket {
    stop: OnceLock<Stop>,
    stopped: Notify,
    /// Bytes that its operators say they hold.
    held: AtomicUsize,
}

impl Ticket {
    pub(crate) fn new() -> Self {
        Self { stop: OnceLock::new(), stopped: Notify::new(), held: AtomicUsize::new(0) }
    }

    /// Ends the query; the first reason counts.
    pub(crate) fn stop(&self, why: Stop) {
        let _ = self.stop.set(why);
        self.stopped.notify_waiters();
    }

    /// Why the query ends, if it does.
    pub(crate) fn why(&self) -> Option<&Stop> {
        self.stop.get()
    }

    /// An error where the query must end: cheap enough for every batch.
    pub(crate) fn check(&self) -> Result<(), DataFusionError> {
        match self.stop.get() {
            None => Ok(()),
            Some(why) => Err(DataFusionError::External(Box::new(why.clone()))),
        }
    }

    /// Waits until the query must end.
    pub(crate) async fn stopped(&self) -> Stop {
        loop {
            // Listening begins before the look, or a stop between them would be missed.
            let stopped = self.stopped.notified();
            if let Some(why) = self.stop.get() {
                return why.clone();
            }
            stopped.await;
        }
    }

    pub(crate) fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }
}

impl fmt::Debug for Ticket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ticket").field("stop", &self.stop.get()).field("held", &self.held()).finish_non_exhaustive()
    }
}
