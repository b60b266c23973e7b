//! Threads of their own: those that plan and run queries are separate from those that serve connections.

use std::sync::mpsc::{self, Sender};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};

/// Stack size of a thread, bytes: twice the need of the longest accepted chain of operators.
const STACK_BYTES: usize = 16 << 20;

/// Threads beside them that read files, for a statement and for all else; each has a stack.
const LEAST_BLOCKING: usize = 4;
const MOST_BLOCKING: usize = 16;
/// Time to wait for the threads of one runtime: a thread that reads from a disk that does not answer ends later.
const END_LIMIT: Duration = Duration::from_secs(10);

/// A Tokio runtime that may be dropped anywhere, even in asynchronous code.
pub struct QueryThreads {
    runtime: Option<Runtime>,
    ending: Sender<Runtime>,
}

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
        let ending = ending_thread()?;
        Ok(Self { runtime: Some(builder.build()?), ending })
    }

    /// Returns the handle for spawning work; None during shutdown.
    pub fn handle(&self) -> Option<&Handle> {
        self.runtime.as_ref().map(Runtime::handle)
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
    // threads that are just ending, at which glibc crashes now and then (its bug 19951). So one thread of the process
    // waits for all: one for each runtime would be detached, too, or keep its stack after its end.
    fn drop(&mut self) {
        let Some(runtime) = self.runtime.take() else { return };
        // It is gone if it panicked: better a crash now and then than one now.
        if let Err(unsent) = self.ending.send(runtime) {
            unsent.0.shutdown_background();
        }
    }
}

/// Returns the thread of the process that waits for the threads of runtimes that end. It is started with the first
/// runtime, so that it finds memory, and is not as nice as a statement's threads.
fn ending_thread() -> std::io::Result<Sender<Runtime>> {
    static STARTED: Mutex<Option<Sender<Runtime>>> = Mutex::new(None);
    let mut started = STARTED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(ending) = started.as_ref() {
        return Ok(ending.clone());
    }
    let (ending, runtimes) = mpsc::channel::<Runtime>();
    let end_all = move || runtimes.into_iter().for_each(|runtime| runtime.shutdown_timeout(END_LIMIT));
    std::thread::Builder::new().name("end-threads".into()).spawn(end_all)?;
    Ok(started.insert(ending).clone())
}

#[cfg(test)]
mod tests {
    use echolake_testing::run_command;
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

    use super::*;

    // Each had left the stack of the thread that waited for it: 2 MiB, of 4000 of which an engine ended.
    #[test]
    fn runtimes_that_ended_leave_no_stacks() {
        if !is_alone("runtimes_that_ended_leave_no_stacks") {
            return;
        }
        let end_some = |count: usize| {
            for _ in 0..count {
                drop(QueryThreads::new("short", 1).expect("threads"));
            }
            // Those before have ended once this one has, which is the last.
            let last = QueryThreads::new("last", 1).expect("threads");
            let (end, ended) = mpsc::channel::<()>();
            last.handle().expect("it runs").spawn(async move {
                let _end = end;
                std::future::pending::<()>().await;
            });
            drop(last);
            assert!(ended.recv().is_err(), "it is dropped with its runtime");
        };
        end_some(10);
        let before = data_pages();
        end_some(300);
        let mib = (data_pages().saturating_sub(before) * rustix::param::page_size() as u64) >> 20;
        assert!(mib < 300, "{mib} MiB more of address space");
    }

    // Whether no other test runs in this process: otherwise the test was run by this program, started again.
    fn is_alone(test: &str) -> bool {
        const OWN_PROCESS: &str = "ECHOLAKE_TEST_ALONE";
        if std::env::var_os(OWN_PROCESS).is_some() {
            return true;
        }
        let name = format!("control::threads::tests::{test}");
        let mut command = std::process::Command::new(std::env::current_exe().expect("this program"));
        let ended = run_command(command.args([&name, "--exact"]).env(OWN_PROCESS, "1")).expect("it runs");
        let text = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert!(ended.status.success() && String::from_utf8_lossy(&ended.stdout).contains("1 passed"), "{text}");
        false
    }

    fn data_pages() -> u64 {
        let statm = std::fs::read_to_string("/proc/self/statm").expect("what the process has");
        statm.split(' ').nth(5).and_then(|pages| pages.parse().ok()).expect("data pages")
    }

    // The limit is that of the process, so the test is a process of its own.
    #[test]
    fn without_threads_a_runtime_ends_in_the_background() {
        if !is_alone("without_threads_a_runtime_ends_in_the_background") {
            return;
        }
        let outer = QueryThreads::new("outer", 1).expect("threads");
        let threads = outer.handle().expect("it runs").clone();
        let left = QueryThreads::new("left", 1).expect("threads");
        let Rlimit { maximum, .. } = getrlimit(Resource::Data);
        // Small values still find memory, the stack of a thread does not.
        let most = data_pages() * rustix::param::page_size() as u64 + (1 << 20);
        setrlimit(Resource::Data, Rlimit { current: Some(most), maximum }).expect("a lower limit");
        let ended = std::thread::Builder::new().spawn(|| ());
        let dropped = threads.block_on(async { tokio::spawn(async move { drop(left) }).await });
        setrlimit(Resource::Data, Rlimit { current: maximum, maximum }).expect("the limit of before");
        assert!(ended.is_err(), "the system gives no threads");
        dropped.expect("no panic");
    }
}
