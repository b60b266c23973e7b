//! Memory that operators hold, counted against the limits of their query, of their client, and of all queries together.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use datafusion::common::Result;
use datafusion::error::DataFusionError;
use datafusion::execution::memory_pool::{MemoryConsumer, MemoryLimit, MemoryPool, MemoryReservation};

/// The share of another pool that one query, or all queries of a client, may use. Allocations beyond the limit are
/// refused: sorts and aggregations then spill to disk, all other operators fail.
#[derive(Debug)]
pub(crate) struct PartialPool {
    all: Arc<dyn MemoryPool>,
    /// The holder of the share, for error messages.
    holder: &'static str,
    limit: usize,
    held: Arc<HeldMemory>,
}

/// Bytes that operators hold, and the most that they held.
#[derive(Debug, Default)]
pub(crate) struct HeldMemory {
    now: AtomicUsize,
    peak: AtomicUsize,
}

impl HeldMemory {
    /// Returns the most that was held, bytes.
    pub fn peak_bytes(&self) -> usize {
        self.peak.load(Ordering::Relaxed)
    }

    /// Returns what is held now, bytes.
    pub fn current_bytes(&self) -> usize {
        self.now.load(Ordering::Relaxed)
    }

    fn grow(&self, additional: usize) {
        let before = self.now.fetch_add(additional, Ordering::Relaxed);
        self.peak.fetch_max(before.saturating_add(additional), Ordering::Relaxed);
    }

    fn shrink(&self, bytes: usize) {
        self.now.fetch_sub(bytes, Ordering::Relaxed);
    }

    // The error is what is held already.
    fn try_grow(&self, additional: usize, limit: usize) -> std::result::Result<(), usize> {
        let within = |held: usize| held.checked_add(additional).filter(|sum| *sum <= limit);
        let before = self.now.fetch_update(Ordering::Relaxed, Ordering::Relaxed, within)?;
        self.peak.fetch_max(before + additional, Ordering::Relaxed);
        Ok(())
    }
}

impl PartialPool {
    pub fn new(all: Arc<dyn MemoryPool>, holder: &'static str, limit: usize, held: Arc<HeldMemory>) -> Self {
        Self { all, holder, limit, held }
    }

    fn exhausted_error(&self, consumer: &str, bytes: usize, held: usize) -> DataFusionError {
        let mib = |bytes: usize| bytes.div_ceil(1 << 20);
        DataFusionError::ResourcesExhausted(format!(
            "{consumer} needs {} MiB more; {} {} of its {} MiB",
            mib(bytes),
            self.holder,
            mib(held),
            mib(self.limit)
        ))
    }
}

impl std::fmt::Display for PartialPool {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}({} of {})", self.holder, self.reserved(), self.limit)
    }
}

impl MemoryPool for PartialPool {
    fn name(&self) -> &str {
        self.holder
    }

    fn register(&self, consumer: &MemoryConsumer) {
        self.all.register(consumer);
    }

    fn unregister(&self, consumer: &MemoryConsumer) {
        self.all.unregister(consumer);
    }

    fn grow(&self, reservation: &MemoryReservation, additional: usize) {
        self.held.grow(additional);
        self.all.grow(reservation, additional);
    }

    fn shrink(&self, reservation: &MemoryReservation, shrink: usize) {
        self.held.shrink(shrink);
        self.all.shrink(reservation, shrink);
    }

    fn try_grow(&self, reservation: &MemoryReservation, additional: usize) -> Result<()> {
        let consumer = reservation.consumer().name();
        let counted = self.held.try_grow(additional, self.limit);
        counted.map_err(|held| self.exhausted_error(consumer, additional, held))?;
        self.all.try_grow(reservation, additional).inspect_err(|_| self.held.shrink(additional))
    }

    fn reserved(&self) -> usize {
        self.held.current_bytes()
    }

    fn memory_limit(&self) -> MemoryLimit {
        MemoryLimit::Finite(self.limit)
    }
}

#[cfg(test)]
mod tests {
    use datafusion::execution::memory_pool::GreedyMemoryPool;

    use super::*;

    #[test]
    fn queries_share_what_their_client_and_all_may_hold() {
        let all: Arc<dyn MemoryPool> = Arc::new(GreedyMemoryPool::new(25));
        let client_held = Arc::<HeldMemory>::default();
        let reserve = |held: &Arc<HeldMemory>| {
            let client = Arc::new(PartialPool::new(all.clone(), "the client's queries hold", 10, held.clone()));
            let query: Arc<dyn MemoryPool> = Arc::new(PartialPool::new(client, "the query holds", 8, Arc::default()));
            MemoryConsumer::new("sort").register(&query)
        };
        let (first, second, other) = (reserve(&client_held), reserve(&client_held), reserve(&Arc::default()));
        let refused = first.try_grow(9).expect_err("more than a query's").to_string();
        assert!(refused.contains("the query holds"), "{refused}");
        first.try_grow(6).expect("within all three");
        let refused = second.try_grow(6).expect_err("more than the client's").to_string();
        assert!(refused.contains("the client's queries hold"), "{refused}");
        assert_eq!(second.size(), 0, "nothing is counted that was refused");
        other.try_grow(8).expect("another client has its own part");
        first.free();
        second.try_grow(6).expect("what is given back is free");
        assert_eq!(all.reserved(), 14);
        assert_eq!((client_held.current_bytes(), client_held.peak_bytes()), (6, 6));
    }
}
