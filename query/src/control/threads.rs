//! Threads of their own: those that plan and run queries are separate from those that serve connections.

use std::sync::{Arc, Mutex, PoisonError};
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
        builder.max_blocking_threads(blocking_threads(cores));
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

/// Returns the address space of the stacks of the threads of so many statements, bytes.
pub fn stack_bytes(statements: usize) -> usize {
    let cores = count_cores();
    statements * (cores + blocking_threads(cores)) * STACK_BYTES
}

fn blocking_threads(cores: usize) -> usize {
    (2 * cores).clamp(LEAST_BLOCKING, MOST_BLOCKING)
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
        let Some(runtime) = self.0.take() else { return };
        let kept = Arc::new(Mutex::new(Some(runtime)));
        let dropped = kept.clone();
        match std::thread::Builder::new().spawn(move || drop(take_runtime(&dropped))) {
            // Its handle is kept, so that it is not detached either.
            Ok(thread) => std::mem::forget(thread),
            // The system gives no more threads: better a crash now and then than one now.
            Err(_) => take_runtime(&kept).into_iter().for_each(Runtime::shutdown_background),
        }
    }
}

fn take_runtime(kept: &Mutex<Option<Runtime>>) -> Option<Runtime> {
    kept.lock().unwrap_or_else(PoisonError::into_inner).take()
}

#[cfg(test)]
mod tests {
    use echolake_testing::run_command;
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

    use super::*;

    // The limit is that of the process, so the test is a process of its own: it starts this program again.
    #[test]
    fn without_threads_a_runtime_ends_in_the_background() {
        const OWN_PROCESS: &str = "ECHOLAKE_TEST_WITHOUT_THREADS";
        if std::env::var_os(OWN_PROCESS).is_none() {
            let name = "control::threads::tests::without_threads_a_runtime_ends_in_the_background";
            let mut command = std::process::Command::new(std::env::current_exe().expect("this program"));
            let ended = run_command(command.args([name, "--exact"]).env(OWN_PROCESS, "1")).expect("it runs");
            let text = String::from_utf8_lossy(&ended.stderr).into_owned();
            assert!(ended.status.success() && String::from_utf8_lossy(&ended.stdout).contains("1 passed"), "{text}");
            return;
        }
        let outer = QueryThreads::new("outer", 1).expect("threads");
        let threads = outer.handle().expect("it runs").clone();
        let left = QueryThreads::new("left", 1).expect("threads");
        let Rlimit { maximum, .. } = getrlimit(Resource::Data);
        // Small values still find memory, the stack of a thread does not.
        let statm = std::fs::read_to_string("/proc/self/statm").expect("what the process has");
        let pages: u64 = statm.split(' ').nth(5).and_then(|pages| pages.parse().ok()).expect("data pages");
        let most = pages * rustix::param::page_size() as u64 + (1 << 20);
        setrlimit(Resource::Data, Rlimit { current: Some(most), maximum }).expect("a lower limit");
        let ended = std::thread::Builder::new().spawn(|| ());
        let dropped = threads.block_on(async { tokio::spawn(async move { drop(left) }).await });
        setrlimit(Resource::Data, Rlimit { current: maximum, maximum }).expect("the limit of before");
        assert!(ended.is_err(), "the system gives no threads");
        dropped.expect("no panic");
    }
}
