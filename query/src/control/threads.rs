//! Threads of their own: those that plan and run queries are separate from those that serve connections.

use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};

/// Stack size of a thread, bytes: twice the need of the longest accepted chain of operators.
const STACK_BYTES: usize = 16 << 20;

/// Threads beside them that read files, for a statement and for all else; each has a stack.
const LEAST_BLOCKING: usize = 4;
const MOST_BLOCKING: usize = 16;

/// A Tokio runtime that may be dropped anywhere, even in asynchronous code.
pub struct QueryThreads(Option<Runtime>);

impl QueryThreads {
    /// Starts `count` threads with this name.
    ///
    /// # Errors
    /// If the system cannot start the threads.
    pub fn new(name: &str, count: usize) -> std::io::Result<Self> {
        Self::build(&mut thread_builder(name, count))
    }

    /// Starts one thread per core.
    ///
    /// # Errors
    /// As [`QueryThreads::new`].
    pub fn per_core(name: &str) -> std::io::Result<Self> {
        Self::new(name, count_cores())
    }

    /// Starts one thread per core. Each thread, also one for blocking work, calls `begin` first and `end` last.
    pub(super) fn with_hooks(
        name: &str,
        begin: impl Fn() + Send + Sync + 'static,
        end: impl Fn() + Send + Sync + 'static,
    ) -> std::io::Result<Self> {
        let cores = count_cores();
        let mut builder = thread_builder(name, cores);
        builder.max_blocking_threads((2 * cores).clamp(LEAST_BLOCKING, MOST_BLOCKING));
        Self::build(builder.on_thread_start(begin).on_thread_stop(end))
    }

    fn build(builder: &mut Builder) -> std::io::Result<Self> {
        Ok(Self(Some(builder.build()?)))
    }

    /// Returns the handle for spawning work; None during shutdown.
    pub fn handle(&self) -> Option<&Handle> {
        self.0.as_ref().map(Runtime::handle)
    }
}

/// Returns the number of cores that the process may use.
pub(crate) fn count_cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn thread_builder(name: &str, count: usize) -> Builder {
    let mut builder = Builder::new_multi_thread();
    builder
        .worker_threads(count)
        .thread_name(name)
        .thread_stack_size(STACK_BYTES)
        .max_blocking_threads(MOST_BLOCKING)
        .thread_keep_alive(Duration::from_secs(60))
        .enable_all();
    builder
}

impl Drop for QueryThreads {
    // A runtime's own drop waits for its threads, which asynchronous code must not. `shutdown_background` detaches
    // threads that are just ending, at which glibc crashes now and then (its bug 19951).
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            // Its handle is kept, so that it is not detached either.
            std::mem::forget(std::thread::spawn(move || drop(runtime)));
        }
    }
}
