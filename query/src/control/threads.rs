//! Threads that plan and run queries, separate from those that serve connections.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};
use tokio::task::JoinHandle;

/// Stack size of a thread, bytes: twice the need of the longest accepted chain of operators.
const STACK_BYTES: usize = 16 << 20;

/// Most groups of threads of an engine: while all of one fewer are held, the next query still runs.
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
    groups: Mutex<Vec<Arc<QueryThreads>>>,
}

impl QueryThreadGroups {
    /// Starts one group; others are started when they are needed, and are kept.
    ///
    /// # Errors
    /// As [`QueryThreads::new`].
    pub(crate) fn new(name: &'static str) -> std::io::Result<Self> {
        Ok(Self { name, groups: Mutex::new(vec![Arc::new(QueryThreads::per_core(name)?)]) })
    }

    /// Spawns work on a group without other work; on the one with the least if there are no more groups, or the system
    /// has no more threads. None during shutdown.
    pub(crate) fn spawn<T: Send + 'static>(
        &self,
        work: impl Future<Output = T> + Send + 'static,
    ) -> Option<JoinHandle<T>> {
        let group = self.least_loaded()?;
        let threads = group.handle()?.clone();
        Some(threads.spawn(async move {
            let _group = group;
            work.await
        }))
    }

    fn least_loaded(&self) -> Option<Arc<QueryThreads>> {
        // Work holds its group. Tasks are also connections to stores and workers, and what is left of ended work.
        let load = |group: &&Arc<QueryThreads>| {
            let tasks = group.handle().map_or(0, |threads| threads.metrics().num_alive_tasks());
            (Arc::strong_count(group) - 1, tasks)
        };
        let mut groups = self.groups.lock().unwrap_or_else(PoisonError::into_inner);
        let least = groups.iter().min_by_key(load)?;
        if load(&least) == (0, 0) || groups.len() == MOST_GROUPS {
            return Some(least.clone());
        }
        let Ok(another) = QueryThreads::per_core(self.name) else { return Some(least.clone()) };
        let another = Arc::new(another);
        groups.push(another.clone());
        Some(another)
    }
}
