//! Clients of an engine: what each may use at once, and its permits.

use std::sync::Arc;
use std::time::Duration;

use datafusion::execution::memory_pool::MemoryPool;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::Error;
use crate::control::pool::{HeldMemory, PartialPool};

/// A client with its quota. All sessions of a token share one.
///
/// ```
/// use echolake_query::{EngineClient, QueryQuota};
///
/// let client = EngineClient::new("guest", QueryQuota { concurrent: Some(1), ..QueryQuota::default() });
/// let permit = client.acquire_place()?;
/// assert!(client.acquire_place().is_err());
/// drop(permit);
/// assert!(client.acquire_place().is_ok());
/// # Ok::<(), echolake_query::Error>(())
/// ```
#[derive(Debug)]
pub struct EngineClient {
    name: Arc<str>,
    quota: QueryQuota,
    places: Option<Arc<Semaphore>>,
    is_program: bool,
    /// Bytes that operators of its queries have reserved.
    held: Arc<HeldMemory>,
}

impl EngineClient {
    /// Creates a client.
    pub fn new(name: impl Into<Arc<str>>, quota: QueryQuota) -> Self {
        let places = quota.concurrent.map(|places| Arc::new(Semaphore::new(places)));
        Self { name: name.into(), quota, places, is_program: false, held: Arc::default() }
    }

    /// Creates the program as a client: its threads are not as nice as those of statements from outside.
    pub fn new_program(name: impl Into<Arc<str>>, quota: QueryQuota) -> Self {
        Self { is_program: true, ..Self::new(name, quota) }
    }

    /// Returns the name for logs and error messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the name to be shared.
    pub(crate) fn shared_name(&self) -> Arc<str> {
        self.name.clone()
    }

    /// Returns whether it is the program itself.
    pub(crate) fn is_program(&self) -> bool {
        self.is_program
    }

    /// Returns the limits on the client's queries.
    pub fn quota(&self) -> &QueryQuota {
        &self.quota
    }

    /// Returns the client's share of the memory pool of all queries.
    pub(crate) fn memory_pool(&self, all: Arc<dyn MemoryPool>) -> Arc<dyn MemoryPool> {
        match self.quota.memory {
            Some(limit) => Arc::new(PartialPool::new(all, "the client's queries hold", limit, self.held.clone())),
            None => all,
        }
    }

    /// Acquires one of the client's concurrency permits, for a query or for other work that its requests cause.
    ///
    /// # Errors
    /// [`Error::Busy`] if all are taken.
    pub fn acquire_place(&self) -> Result<QueryPermit, Error> {
        let Some(places) = &self.places else { return Ok(QueryPermit(None)) };
        let place = places.clone().try_acquire_owned().map_err(|_| self.busy_error())?;
        Ok(QueryPermit(Some(place)))
    }

    /// Acquires a permit like [`EngineClient::acquire_place`], but waits up to `wait` if all are taken; first come,
    /// first served.
    ///
    /// # Errors
    /// [`Error::Busy`] if none becomes free within `wait`.
    pub async fn place_within(&self, wait: Duration) -> Result<QueryPermit, Error> {
        let Some(places) = &self.places else { return Ok(QueryPermit(None)) };
        match tokio::time::timeout(wait, places.clone().acquire_owned()).await {
            Ok(Ok(place)) => Ok(QueryPermit(Some(place))),
            // The semaphore is never closed, so this is the timeout.
            _ => Err(self.busy_error()),
        }
    }

    fn busy_error(&self) -> Error {
        Error::Busy { client: self.name.to_string(), limit: self.quota.concurrent.unwrap_or(0) }
    }
}

/// A permit for one of the queries that a client may run at once; released on drop.
#[derive(Debug)]
pub struct QueryPermit(#[expect(dead_code, reason = "it is held")] Option<OwnedSemaphorePermit>);

/// Limits on the queries of one client; None means no limit.
#[derive(Debug, Clone, Default)]
pub struct QueryQuota {
    /// Maximum time from a query's start to its last row.
    pub time: Option<Duration>,
    /// Maximum memory of all its queries, bytes.
    pub memory: Option<usize>,
    /// Maximum rows of one answer; a longer one ends with an error, it is not silently truncated.
    pub rows: Option<u64>,
    /// Maximum number of concurrent queries; more are refused.
    pub concurrent: Option<usize>,
}
