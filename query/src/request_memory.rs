//! Memory of work that is no query, counted as a query's is.

use std::sync::Arc;

use datafusion::execution::memory_pool::{MemoryConsumer, MemoryPool, MemoryReservation};

use crate::Error;

/// Memory of a request's work: what it reserves counts against the limits of its client, until this is dropped.
pub struct RequestMemory(MemoryReservation);

impl RequestMemory {
    pub(crate) fn new(pool: &Arc<dyn MemoryPool>) -> Self {
        Self(MemoryConsumer::new("the request").register(pool))
    }

    /// Reserves so many bytes more; to be called before they are allocated.
    ///
    /// # Errors
    /// [`Error::MemoryLimit`].
    pub fn reserve(&self, bytes: usize) -> Result<(), Error> {
        self.0.try_grow(bytes).map_err(|e| Error::from_execution("", &e))
    }
}
