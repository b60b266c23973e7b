//! Threads that plan and run queries, separate from those that serve connections.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};
use tokio::task::JoinHandle;

/// Stack size of a thread, bytes: twice the need of the longest accepted chain of operators.
const STACK_BYTES: usize = 16 << 20;

/// Most groups of threads of an engine, so that one query fewer may hold all threads of its group.
const MOST_GROUPS: usize = 8;

/// A Tokio runtime that may be dropped anywhere, even in asynchronous code.
pub struct QueryThreads(Option<Runtime>);

impl QueryThreads {
    /// Starts `count` threads with this name.
    ///
    /// # Errors
    /// If the system cannot start the threads.
    pub fn new(name: &str, count: usize) -> std::io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(count)
            .thread_name(name)
            .thread_stack_size(STACK_BYTES)
            .max_blocking_threads(16)
            .thread_keep_alive(Duration::from_secs(60))
            .enable_all()
            .build()?;
        Ok(Self(Some(runtime)))
    }

    /// Starts one thread per core.
    ///
    /// # Errors
    /// As [`QueryThreads::new`].
    pub fn per_core(name: &str) -> std::io::Result<Self> {
        Self::new(name, std::thread::available_parallelism().map_or(1, usize::from))
    }

    /// Returns the handle for spawning work; None during shutdown.
    pub fn handle(&self) -> Option<&Handle> {
        self.0.as_ref().map(Runtime::handle)
    }
}

impl Drop for QueryThreads {
    // A runtime's own drop waits for its threads, which asynchronous code must not.
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}

/// Groups of threads, one thread per core each, of which a query gets one without other work: an operator that does not
/// wait, such as a join without rows, holds all threads of its group, and whatever else needs them waits for its end.
pub(crate) struct QueryThreadGroups {
    name: &'static str,
    groups: Mutex<Vec<QueryThreads>>,
}

impl QueryThreadGroups {
    /// Starts one group; others are started when they are needed, and are kept.
    ///
    /// # Errors
    /// As [`QueryThreads::new`].
    pub(crate) fn new(name: &'static str) -> std::io::Result<Self> {
        Ok(Self { name, groups: Mutex::new(vec![QueryThreads::per_core(name)?]) })
    }

    /// Spawns work on a group without other work; on the one with the least if there are no more groups, or the system
    /// has no more threads. None during shutdown.
    pub(crate) fn spawn<T: Send + 'static>(
        &self,
        work: impl Future<Output = T> + Send + 'static,
    ) -> Option<JoinHandle<T>> {
        let mut groups = self.groups.lock().unwrap_or_else(PoisonError::into_inner);
        let tasks = |handle: &&Handle| handle.metrics().num_alive_tasks();
        let least = groups.iter().filter_map(QueryThreads::handle).min_by_key(tasks)?;
        if tasks(&least) == 0 || groups.len() == MOST_GROUPS {
            return Some(least.spawn(work));
        }
        let Ok(another) = QueryThreads::per_core(self.name) else { return Some(least.spawn(work)) };
        let spawned = another.handle().map(|handle| handle.spawn(work));
        groups.push(another);
        spawned
    }
}
