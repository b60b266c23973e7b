//! Jobs done by a few workers at once, and their files committed in groups.
//!
//! A commit costs the same for one run as for many, and a table's log grows with every commit; so whatever is ready
//! while one commit is under way goes into the next together. Queues are bounded: what waits in memory is a few
//! lists of staged files, not rows.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use echolake_lake::{Committed, Lake, Staged};
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;

use crate::error::{Error, Result};

/// Jobs whose files go into one commit at most: a crash loses that much work, and nothing else.
const GROUP: usize = 16;

/// The machine's cores, shared by all that computes.
#[derive(Debug, Clone)]
pub(crate) struct Cores {
    count: usize,
    free: Arc<Semaphore>,
}

/// What a job brings to the commit.
pub(crate) struct Ready<R> {
    /// Files in the store; the last one decides over the job.
    pub(crate) staged: Vec<Staged>,
    pub(crate) report: R,
}

/// A job, with what came of it: its report and what became of its last file, None where it had no files.
pub(crate) type Ended<J, R> = (J, Result<(R, Option<Committed>)>);

impl Cores {
    pub(crate) fn all() -> Self {
        let count = std::thread::available_parallelism().map_or(2, usize::from);
        Self { count, free: Arc::new(Semaphore::new(count)) }
    }

    pub(crate) fn count(&self) -> usize {
        self.count
    }

    /// Computes on a core of its own, once one is free.
    pub(crate) async fn compute<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> T {
        // The semaphore is never closed; without a permit the work is only less well spread.
        let permit = self.free.clone().acquire_owned().await.ok();
        let task = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            work()
        });
        match task.await {
            Ok(done) => done,
            Err(e) => match e.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                // Blocking work is cancelled only where the whole runtime ends.
                Err(_) => std::future::pending().await,
            },
        }
    }
}

/// Does all jobs, one a core at a time and one more that reads meanwhile. `ended` hears of each once its files are
/// committed, or that it failed; an error that it returns ends everything. What is under way when `stop` is set is
/// brought to its end.
///
/// # Errors
/// [`Error::Stopped`] where jobs are left, what `ended` returned, or what the lake says to a commit.
pub(crate) async fn run<J, R, W, F>(
    lake: &Lake,
    cores: &Cores,
    jobs: Vec<J>,
    stop: &AtomicBool,
    work: W,
    ended: &mut (dyn FnMut(Ended<J, R>) -> Result<()> + Send),
) -> Result<()>
where
    J: Send + Clone + 'static,
    R: Send + 'static,
    W: Fn(J) -> F + Clone + Send + 'static,
    F: Future<Output = Result<Ready<R>>> + Send,
{
    let queue = Arc::new(Mutex::new(VecDeque::from(jobs)));
    let next = |queue: &Mutex<VecDeque<J>>| queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
    let (sender, mut ready) = mpsc::channel(GROUP);
    let mut workers = JoinSet::new();
    let halt = Arc::new(AtomicBool::new(false));
    for _ in 0..=cores.count() {
        let (queue, sender, work, halt) = (queue.clone(), sender.clone(), work.clone(), halt.clone());
        workers.spawn(async move {
            while !halt.load(Ordering::Relaxed)
                && let Some(job) = next(&queue)
            {
                let done = work(job.clone()).await;
                if sender.send((job, done)).await.is_err() {
                    break;
                }
            }
        });
    }
    drop(sender);
    let mut group = Vec::new();
    while ready.recv_many(&mut group, GROUP).await > 0 {
        halt.store(stop.load(Ordering::Relaxed), Ordering::Relaxed);
        commit(lake, std::mem::take(&mut group), ended).await?;
    }
    // A worker that panicked has left its job undone.
    while let Some(worker) = workers.join_next().await {
        if let Err(e) = worker
            && e.is_panic()
        {
            std::panic::resume_unwind(e.into_panic());
        }
    }
    if next(&queue).is_some() { Err(Error::Stopped) } else { Ok(()) }
}

async fn commit<J, R>(
    lake: &Lake,
    group: Vec<(J, Result<Ready<R>>)>,
    ended: &mut (dyn FnMut(Ended<J, R>) -> Result<()> + Send),
) -> Result<()> {
    let staged: Vec<_> =
        group.iter().flat_map(|(_, done)| done.iter().flat_map(|r| r.staged.iter().cloned())).collect();
    let mut outcomes = lake.commit(&staged).await?.into_iter();
    for (job, done) in group {
        let done = done.map(|ready| {
            let last = outcomes.by_ref().take(ready.staged.len()).last();
            (ready.report, last)
        });
        ended((job, done))?;
    }
    Ok(())
}
