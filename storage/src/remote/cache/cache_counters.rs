//! Counters of a cache: of all that a process reads, or of one scan.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

/// Counters that many readers add to.
#[derive(Debug, Default)]
pub struct CacheCounters {
    memory_hits: AtomicU64,
    disk_hits: AtomicU64,
    misses: AtomicU64,
    requests: AtomicU64,
    fetched_bytes: AtomicU64,
}

/// Values of such counters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CacheCounts {
    /// Blocks that were in memory, or that another reader was about to fetch.
    pub memory_hits: u64,
    /// Blocks that were in the folder.
    pub disk_hits: u64,
    /// Blocks that were in neither.
    pub misses: u64,
    /// Requests to the store for the missing blocks.
    pub requests: u64,
    /// Bytes of the missing blocks.
    pub fetched_bytes: u64,
}

impl CacheCounts {
    /// Returns what was counted since an earlier reading of the same counters.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self {
            memory_hits: self.memory_hits.saturating_sub(earlier.memory_hits),
            disk_hits: self.disk_hits.saturating_sub(earlier.disk_hits),
            misses: self.misses.saturating_sub(earlier.misses),
            requests: self.requests.saturating_sub(earlier.requests),
            fetched_bytes: self.fetched_bytes.saturating_sub(earlier.fetched_bytes),
        }
    }
}

impl CacheCounters {
    /// Adds to the counters.
    pub fn add_counts(&self, counts: &CacheCounts) {
        let pairs = [
            (&self.memory_hits, counts.memory_hits),
            (&self.disk_hits, counts.disk_hits),
            (&self.misses, counts.misses),
            (&self.requests, counts.requests),
            (&self.fetched_bytes, counts.fetched_bytes),
        ];
        for (counter, count) in pairs {
            counter.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// Returns the values.
    pub fn read_counts(&self) -> CacheCounts {
        let value = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        CacheCounts {
            memory_hits: value(&self.memory_hits),
            disk_hits: value(&self.disk_hits),
            misses: value(&self.misses),
            requests: value(&self.requests),
            fetched_bytes: value(&self.fetched_bytes),
        }
    }
}
