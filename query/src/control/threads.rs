//! Threads that plan and run queries, separate from those that serve connections.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures::future::BoxFuture;
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time::timeout;

/// Stack size of a thread, bytes: twice the need of the longest accepted chain of operators.
const STACK_BYTES: usize = 16 << 20;

/// Groups of threads of an engine: one fewer can be held, and queries still run. Each thread allocates between two
/// looks at the memory that is left, so that there are few.
const GROUPS: usize = 3;

/// Time in which a group begins work; then another may, too.
const RESPONSE_LIMIT: Duration = Duration::from_millis(20);

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
    // A runtime's own drop waits for its threads, which asynchronous code must not. `shutdown_background` detaches
    // threads that are just ending, at which glibc crashes now and then (its bug 19951).
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            // Its handle is kept, so that it is not detached either.
            std::mem::forget(std::thread::spawn(move || drop(runtime)));
        }
    }
}

/// Groups of threads, one thread per core each. An operator that does not wait, such as a join without rows, holds all
/// threads of its group; other work then begins on another group.
pub(crate) struct QueryThreadGroups(Vec<ThreadGroup>);

struct ThreadGroup {
    threads: QueryThreads,
    /// Work on the group holds a copy.
    work: Arc<()>,
}

impl QueryThreadGroups {
    /// Starts all groups.
    ///
    /// # Errors
    /// As [`QueryThreads::new`].
    pub fn per_core(name: &str) -> std::io::Result<Self> {
        let group = || Ok(ThreadGroup { threads: QueryThreads::per_core(name)?, work: Arc::default() });
        Ok(Self(std::iter::repeat_with(group).take(GROUPS).collect::<std::io::Result<_>>()?))
    }

    /// Begins work on the group with the least of it, or on another if its threads do not respond; returns its task,
    /// whose output is always `Some`. None during shutdown. If the caller stops waiting, the work has begun already or
    /// is dropped.
    pub async fn begin_work<T: Send + 'static>(&self, work: BoxFuture<'static, T>) -> Option<JoinHandle<Option<T>>> {
        let mut groups: Vec<_> = self.0.iter().collect();
        groups.sort_by_cached_key(|group| group.current_load());
        let mut groups = groups.into_iter();
        let (begin, mut begun) = oneshot::channel();
        let offer = WorkOffer(Arc::new(Mutex::new(Some((work, begin)))));
        let mut tasks = Vec::new();
        let number = loop {
            let Some(group) = groups.next() else { break begun.await };
            tasks.push(group.threads.handle()?.spawn(accept_work(offer.0.clone(), tasks.len(), group.work.clone())));
            if let Ok(number) = timeout(RESPONSE_LIMIT, &mut begun).await {
                break number;
            }
        };
        number.ok().map(|number| tasks.swap_remove(number))
    }
}

impl ThreadGroup {
    // Tasks are also connections to stores, and what is left of ended work.
    fn current_load(&self) -> (usize, usize) {
        let tasks = self.threads.handle().map_or(0, |threads| threads.metrics().num_alive_tasks());
        (Arc::strong_count(&self.work) - 1, tasks)
    }
}

/// Work that several groups may begin, and what tells which one has.
type UnbegunWork<T> = Arc<Mutex<Option<(BoxFuture<'static, T>, oneshot::Sender<usize>)>>>;

/// Withdraws work when it is dropped, unless a group has begun it.
struct WorkOffer<T>(UnbegunWork<T>);

impl<T> Drop for WorkOffer<T> {
    fn drop(&mut self) {
        let unbegun = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        drop(unbegun);
    }
}

// Returns None if another group has begun the work, or it was withdrawn.
async fn accept_work<T>(offer: UnbegunWork<T>, number: usize, _counted: Arc<()>) -> Option<T> {
    let (work, begin) = offer.lock().unwrap_or_else(PoisonError::into_inner).take()?;
    begin.send(number).ok()?;
    Some(work.await)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use futures::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn work_that_nobody_waits_for_is_dropped_before_it_begins() {
        let groups = QueryThreadGroups::per_core("test").expect("threads");
        let (release, released) = mpsc::channel::<()>();
        let released = Arc::new(Mutex::new(released));
        let (begin, begun) = mpsc::channel();
        for group in &groups.0 {
            let threads = group.threads.handle().expect("it runs");
            for _ in 0..threads.metrics().num_workers() {
                let (released, begin) = (released.clone(), begin.clone());
                threads.spawn(async move {
                    begin.send(()).expect("somebody counts");
                    let _ = released.lock().expect("no panic").recv();
                });
                begun.recv().expect("a thread is free");
            }
        }
        let place = Arc::new(());
        let held = place.clone();
        let work = async move { drop(held) }.boxed();
        let waiting = timeout(RESPONSE_LIMIT * 10, groups.begin_work(work)).await;
        assert!(waiting.is_err(), "all threads are held");
        assert_eq!(Arc::strong_count(&place), 1);
        drop(release);
    }
}
