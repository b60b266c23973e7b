//! Threads that plan and run queries, apart from those that answer connections.

use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};

/// Stack of a thread that plans and runs: twice what the longest chain of operators takes that is let in.
const STACK_BYTES: usize = 16 << 20;

/// A runtime that may be dropped anywhere.
pub struct Threads(Option<Runtime>);

impl Threads {
    /// `count` threads of a name.
    ///
    /// # Errors
    /// Where the system gives no threads.
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

    /// One thread a core.
    ///
    /// # Errors
    /// As [`Threads::new`].
    pub fn per_core(name: &str) -> std::io::Result<Self> {
        Self::new(name, std::thread::available_parallelism().map_or(1, usize::from))
    }

    /// Where work is given to them; None while they end.
    pub fn handle(&self) -> Option<&Handle> {
        self.0.as_ref().map(Runtime::handle)
    }
}

impl Drop for Threads {
    // A runtime's own drop waits for its threads, which asynchronous code must not.
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}
