//! Watches an engine from within: ends the process if a statement goes on computing after its end, which the library
//! cannot interrupt, or if memory stays over its limit. Its door repeats what the others asked on the next engine.

use std::time::{Duration, Instant};

use echolake_lake::{CACHE_MEMORY_BYTES, CacheCounts};
use echolake_query::{SpreadCounts, StatementBlame, WorkerCluster, WorkerState};
use echolake_service::{EngineCulprit, EngineEnd, EngineReport, EngineRole, EngineServices};

use crate::process_memory::private_bytes;

/// Time between two looks; what was reported meanwhile is sent as often.
const INTERVAL: Duration = Duration::from_millis(50);
/// Time between two looks at memory while statements run.
const MEMORY_LOOK: Duration = Duration::from_millis(10);
/// Time of the processors that a statement may use after it was cancelled, ran out of time, or lost its client.
const GRACE: Duration = Duration::from_millis(250);
/// Memory of an engine that is not of its queries: footers of files, what the allocator keeps.
const CACHE_BYTES: usize = 192 << 20;
/// Part of its memory by which an engine may be over it after its largest statement was cancelled.
const TOLERANCE: f64 = 1.2;
/// Time that a cancelled statement has to give its memory back.
const RELEASE: Duration = Duration::from_millis(500);

/// Starts a thread that looks on until the process ends.
///
/// # Errors
/// The system gives no thread, or does not tell the process's memory.
pub(super) fn start_watchdog(
    services: &EngineServices,
    role: EngineRole,
    memory: usize,
    column_bytes: usize,
) -> std::io::Result<()> {
    let services = services.clone();
    let blocks = if services.lake().is_remote() { CACHE_MEMORY_BYTES as usize } else { 0 };
    let base = private_bytes("self").ok_or_else(|| std::io::Error::other("/proc/self/statm cannot be read"))?;
    let limit = (memory as f64 * TOLERANCE) as usize + base + CACHE_BYTES + blocks + column_bytes;
    let memory = MemoryWatch { limit, cancelled: None };
    std::thread::Builder::new().name("watchdog".to_owned()).spawn(move || watch_engine(&services, role, memory))?;
    Ok(())
}

fn watch_engine(services: &EngineServices, role: EngineRole, mut memory: MemoryWatch) {
    let mut cached = CacheCounts::default();
    let mut spread = ReportedCluster::default();
    let mut looked = Instant::now();
    loop {
        let is_busy = services.engine().count_running() > 0 || memory.cancelled.is_some();
        std::thread::sleep(if is_busy { MEMORY_LOOK } else { INTERVAL });
        // Its own statements are not ended: pages answer on while those from outside go wrong.
        if role == EngineRole::Statements {
            memory.check_memory(services);
        }
        if looked.elapsed() < INTERVAL {
            continue;
        }
        looked = Instant::now();
        EngineReport::send_queued();
        if role == EngineRole::Statements
            && let Some(blame) = services.engine().find_runaway(GRACE)
        {
            end_process("a query that was ended did not stop", Some(blame));
        }
        if let Some(counts) = services.lake().cache_counts()
            && counts != cached
        {
            EngineReport::Cache(counts.since(&cached)).send_line();
            cached = counts;
        }
        if let Some(cluster) = services.engine().cluster() {
            spread.report_changes(cluster);
        }
    }
}

/// The door's knowledge of workers.
#[derive(Default)]
struct ReportedCluster {
    counts: SpreadCounts,
    workers: Vec<WorkerState>,
}

impl ReportedCluster {
    fn report_changes(&mut self, cluster: &WorkerCluster) {
        let counts = cluster.spread_counts();
        // A spare, which has asked none, leaves the door what the engine in use reported.
        let workers: Vec<_> = cluster.worker_states().into_iter().filter(WorkerState::was_asked).collect();
        if counts != self.counts || workers != self.workers {
            EngineReport::Workers { counts: counts.since(&self.counts), workers: workers.clone() }.send_line();
            *self = Self { counts, workers };
        }
    }
}

fn end_process(reason: &str, blame: Option<StatementBlame>) -> ! {
    let culprit = blame.map(|blame| EngineCulprit { client: blame.client, request: blame.request });
    EngineReport::Ending(EngineEnd { reason: reason.to_owned(), culprit }).send_line();
    std::process::abort()
}

/// Memory over the limit: the largest statement is cancelled first.
struct MemoryWatch {
    /// Bytes that the process may occupy.
    limit: usize,
    /// The statement that was cancelled for it, and when.
    cancelled: Option<(Instant, Option<StatementBlame>)>,
}

impl MemoryWatch {
    fn check_memory(&mut self, services: &EngineServices) {
        if private_bytes("self").unwrap_or(0) <= self.limit {
            self.cancelled = None;
            return;
        }
        match &self.cancelled {
            None => self.cancelled = Some((Instant::now(), services.engine().cancel_largest())),
            Some((at, blame)) if at.elapsed() > RELEASE => {
                end_process("queries took more memory than --memory", blame.clone());
            }
            Some(_) => {}
        }
    }
}
