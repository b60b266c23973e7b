//! Memory that a query's operators hold, counted against its own limit and that of all queries together.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use datafusion::common::Result;
use datafusion::error::DataFusionError;
use datafusion::execution::memory_pool::{MemoryConsumer, MemoryLimit, MemoryPool, MemoryReservation};

use super::Ticket;

/// The part of the common pool that one query may have. What would pass the limit is refused: sorts and
/// aggregations then go to disk, all else fails.
#[derive(Debug)]
pub(crate) struct QueryPool {
    all: Arc<dyn MemoryPool>,
    limit: usize,
    ticket: Arc<Ticket>,
}

impl QueryPool {
    pub(crate) fn new(all: Arc<dyn MemoryPool>, limit: usize, ticket: Arc<Ticket>) -> Self {
        Self { all, limit, ticket }
    }

    fn refused(&self, consumer: &str, bytes: usize, held: usize) -> DataFusionError {
        let mib = |bytes: usize| bytes.div_ceil(1 << 20);
        DataFusionError::ResourcesExhausted(format!(
            "{consumer} needs {} MiB more; the query holds {} of its {} MiB",
            mib(bytes),
            mib(held),
            mib(self.limit)
        ))
    }
}

impl std::fmt::Display for QueryPool {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "query({} of {})", self.ticket.held(), self.limit)
    }
}

impl MemoryPool for QueryPool {
    fn name(&self) -> &str {
        "query"
    }

    fn register(&self, consumer: &MemoryConsumer) {
        self.all.register(consumer);
    }

    fn unregister(&self, consumer: &MemoryConsumer) {
        self.all.unregister(consumer);
    }

    fn grow(&self, reservation: &MemoryReservation, additional: usize) {
        self.ticket.held.fetch_add(additional, Ordering::Relaxed);
        self.all.grow(reservation, additional);
    }

    fn shrink(&self, reservation: &MemoryReservation, shrink: usize) {
        self.ticket.held.fetch_sub(shrink, Ordering::Relaxed);
        self.all.shrink(reservation, shrink);
    }

    fn try_grow(&self, reservation: &MemoryReservation, additional: usize) -> Result<()> {
        let within = |held: usize| held.checked_add(additional).filter(|sum| *sum <= self.limit);
        let consumer = reservation.consumer().name();
        let counted = self.ticket.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, within);
        counted.map_err(|held| self.refused(consumer, additional, held))?;
        self.all.try_grow(reservation, additional).inspect_err(|_| {
            self.ticket.held.fetch_sub(additional, Ordering::Relaxed);
        })
    }

    fn reserved(&self) -> usize {
        self.ticket.held()
    }

    fn memory_limit(&self) -> MemoryLimit {
        MemoryLimit::Finite(self.limit)
    }
}
