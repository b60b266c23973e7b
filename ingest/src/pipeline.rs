//! Runs jobs on a few workers at once, and commits their files in groups.
//!
//! A commit costs the same for one run as for many, and a table's log and its files grow with every commit; so jobs
//! that become ready within a short time are committed together. Their encoded rows wait in memory, up to a number of
//! bytes.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use echolake_lake::{CommitOutcome, Lake, StagedRows};
use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout_at};
use tracing::Span;

use crate::error::{Error, Result};
use crate::inbox::ReadingMark;

/// Maximum number of jobs per commit: a crash loses that much work, and nothing else. A file of a table has rows of so
/// many runs.
pub(crate) const GROUP: usize = 16;

/// Memory for rows that wait for their commit, KiB; a commit takes three quarters of it, or what one job has.
const WAITING_KIB: u32 = 320 << 10;

/// Time that a job waits for others to share its commit: every commit adds a file to each table's log, which all
/// readers read. Tests count files however busy the machine is, and groups end with the last job.
const GATHER: Duration = Duration::from_secs(if cfg!(test) { 600 } else { 20 });

/// A pool of one thread per core, shared by all computations; each thread reuses its memory. Tokio's blocking pool
/// would spread the work, and the memory it frees, over hundreds of threads.
#[derive(Debug, Clone)]
pub(crate) struct Cores {
    pool: Arc<ThreadPool>,
    /// Number of busy cores, in the pool and elsewhere.
    busy: Arc<AtomicUsize>,
}

/// A guard that counts a core as busy until it is dropped.
pub(crate) struct BusyCore(Arc<AtomicUsize>);

/// A computation on a core that has not ended.
pub(crate) struct PendingComputation<T>(oneshot::Receiver<std::thread::Result<T>>);

impl Drop for BusyCore {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// A finished job, ready for the commit.
pub(crate) struct ReadyJob<R> {
    /// Rows of tables; the last ones decide the job's outcome.
    pub staged: Vec<StagedRows>,
    pub report: R,
    /// It stays until the commit, which may end the process, too.
    pub mark: Option<ReadingMark>,
}

/// A job with its result: its report, and the outcome of its last rows (None if it had none).
pub(crate) type JobOutcome<J, R> = (J, Result<(R, Option<CommitOutcome>)>);

/// A finished job that waits for its commit.
struct WaitingJob<J, R> {
    job: J,
    done: Result<ReadyJob<R>>,
    /// Its share of the memory for waiting rows.
    memory: OwnedSemaphorePermit,
}

impl Cores {
    pub fn all() -> Result<Self> {
        let pool = ThreadPoolBuilder::new().thread_name(|i| format!("compute-{i}")).build();
        let pool = pool.map_err(|source| Error::Threads { source })?;
        Ok(Self { pool: Arc::new(pool), busy: Arc::default() })
    }

    pub fn count(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Counts the caller as a busy core.
    pub fn mark_busy(&self) -> BusyCore {
        self.busy.fetch_add(1, Ordering::Relaxed);
        BusyCore(self.busy.clone())
    }

    /// Returns whether a core is idle.
    pub fn is_one_idle(&self) -> bool {
        self.busy.load(Ordering::Relaxed) < self.count()
    }

    /// Starts a computation on a core of its own once one is free, in the order of the calls.
    pub fn begin_on_core<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> PendingComputation<T> {
        let (sender, done) = oneshot::channel();
        let busy = self.mark_busy();
        let span = Span::current();
        self.pool.spawn_fifo(move || {
            let done = catch_unwind(AssertUnwindSafe(|| span.in_scope(work)));
            drop(busy);
            // The receiver is gone if the whole ingest was cancelled.
            let _ = sender.send(done);
        });
        PendingComputation(done)
    }

    /// Computes on a core of its own, as [`Self::begin_on_core`] does, and waits for the result.
    pub async fn compute_on_core<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> T {
        self.begin_on_core(work).wait_for_result().await
    }
}

impl<T> PendingComputation<T> {
    /// Waits for the result; a panic of the computation is resumed here.
    pub async fn wait_for_result(self) -> T {
        match self.0.await {
            Ok(Ok(done)) => done,
            Ok(Err(panic)) => resume_unwind(panic),
            // Unreachable: the pool always sends, and outlives the handle.
            Err(_) => std::future::pending().await,
        }
    }
}

/// Runs all jobs, one per core at a time and one more that reads meanwhile. `ended` is called for each job when its
/// files are committed or it failed; an error that it returns ends everything. Jobs in progress when `stop` is set are
/// completed.
///
/// # Errors
/// [`Error::Stopped`] if jobs are left, an error that `ended` returned, or the lake's error in a commit.
pub(crate) async fn run_jobs<J, R, W, F>(
    lake: &Lake,
    cores: &Cores,
    jobs: Vec<J>,
    stop: &AtomicBool,
    work: W,
    ended: &mut (dyn FnMut(JobOutcome<J, R>) -> Result<()> + Send),
) -> Result<()>
where
    J: Send + Clone + 'static,
    R: Send + 'static,
    W: Fn(J) -> F + Clone + Send + 'static,
    F: Future<Output = Result<ReadyJob<R>>> + Send,
{
    let queue = Arc::new(Mutex::new(VecDeque::from(jobs)));
    let next = |queue: &Mutex<VecDeque<J>>| queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
    let (sender, mut ready) = mpsc::channel(GROUP);
    let memory = Arc::new(Semaphore::new(WAITING_KIB as usize));
    let mut workers = JoinSet::new();
    let halt = Arc::new(AtomicBool::new(false));
    for _ in 0..=cores.count() {
        let queue = queue.clone();
        let sender = sender.clone();
        let work = work.clone();
        let halt = halt.clone();
        let memory = memory.clone();
        workers.spawn(async move {
            while !halt.load(Ordering::Relaxed)
                && let Some(job) = next(&queue)
            {
                let done = work(job.clone()).await;
                // A commit frees memory: it waits for a full group only for a time.
                let Ok(memory) = memory.clone().acquire_many_owned(waiting_kib(&done)).await else { break };
                if sender.send(WaitingJob { job, done, memory }).await.is_err() {
                    break;
                }
            }
        });
    }
    drop(sender);
    while let Some(group) = gather_group(&mut ready).await {
        commit_group(lake, group, ended).await?;
        halt.store(stop.load(Ordering::Relaxed), Ordering::Relaxed);
    }
    // A worker that panicked has not finished its job.
    while let Some(worker) = workers.join_next().await {
        if let Err(e) = worker
            && e.is_panic()
        {
            resume_unwind(e.into_panic());
        }
    }
    if next(&queue).is_some() { Err(Error::Stopped) } else { Ok(()) }
}

fn waiting_kib<R>(done: &Result<ReadyJob<R>>) -> u32 {
    let bytes: usize = done.iter().flat_map(|ready| &ready.staged).map(StagedRows::memory_bytes).sum();
    u32::try_from(bytes >> 10).map_or(WAITING_KIB, |kib| kib.min(WAITING_KIB))
}

// Collects ready jobs until there are enough for a commit or the timeout is over; None once no more will come.
async fn gather_group<J, R>(ready: &mut mpsc::Receiver<WaitingJob<J, R>>) -> Option<Vec<WaitingJob<J, R>>> {
    let mut group = vec![ready.recv().await?];
    let deadline = Instant::now() + GATHER;
    let kib = |group: &[WaitingJob<J, R>]| group.iter().map(|job| job.memory.num_permits()).sum::<usize>();
    while group.len() < GROUP
        && kib(&group) < WAITING_KIB as usize * 3 / 4
        && let Ok(Some(next)) = timeout_at(deadline, ready.recv()).await
    {
        group.push(next);
    }
    Some(group)
}

async fn commit_group<J, R>(
    lake: &Lake,
    group: Vec<WaitingJob<J, R>>,
    ended: &mut (dyn FnMut(JobOutcome<J, R>) -> Result<()> + Send),
) -> Result<()> {
    let mut staged = Vec::new();
    let mut finished = Vec::with_capacity(group.len());
    // Memory and marks are theirs until the end of the commit.
    let mut held = Vec::with_capacity(group.len());
    for waiting in group {
        let done = waiting.done.map(|ready| {
            let count = ready.staged.len();
            staged.extend(ready.staged);
            held.push((waiting.memory, ready.mark));
            (ready.report, count)
        });
        finished.push((waiting.job, done));
    }
    let mut outcomes = lake.commit_rows(staged).await?.into_iter();
    drop(held);
    for (job, done) in finished {
        ended((job, done.map(|(report, count)| (report, outcomes.by_ref().take(count).last()))))?;
    }
    Ok(())
}
