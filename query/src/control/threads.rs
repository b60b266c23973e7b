//! Threads that plan and run queries, separate from those that serve connections.

use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};

/// Stack size of a thread, bytes: twice the need of the longest accepted chain of operators.
const STACK_BYTES: usize = 16 << 20;

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
