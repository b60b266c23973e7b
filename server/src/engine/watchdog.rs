//! Ends its own process if work continues after its query has ended: planning, a call of a function, an operator that
//! does not return. The library cannot be interrupted there; the process is one client's, and its door starts another.

use std::time::{Duration, Instant};

use echolake_lake::CacheCounts;
use echolake_service::{EngineReport, QueryService};
use rustix::time::{ClockId, clock_gettime};

/// Time between two looks; what was reported meanwhile is sent as often.
const INTERVAL: Duration = Duration::from_millis(50);
/// Time for which work may continue after its query was cancelled, ran out of time, or lost its client.
const GRACE: Duration = Duration::from_millis(250);
/// Part of one processor from which an engine without requests is not idle.
const BUSY: f64 = 0.5;

/// Starts a thread that looks on until the process ends.
///
/// # Errors
/// The system gives no thread.
pub(super) fn start_watchdog(service: &QueryService) -> std::io::Result<()> {
    let service = service.clone();
    std::thread::Builder::new().name("watchdog".to_owned()).spawn(move || watch_service(&service))?;
    Ok(())
}

fn watch_service(service: &QueryService) {
    let mut idle = IdleWork::default();
    let mut cached = CacheCounts::default();
    loop {
        std::thread::sleep(INTERVAL);
        EngineReport::send_queued();
        if service.engine().find_runaway(GRACE).is_some() {
            end_process("a query that was ended did not stop");
        }
        if idle.measure_busy_time(service.activity().count() == 0) > GRACE {
            end_process("work that nobody waits for did not stop");
        }
        if let Some(counts) = service.lake().cache_counts()
            && counts != cached
        {
            EngineReport::Cache(counts.since(&cached)).send_line();
            cached = counts;
        }
    }
}

fn end_process(why: &str) -> ! {
    EngineReport::Ending(why.to_owned()).send_line();
    std::process::abort()
}

/// Time for which the process has computed without a request.
#[derive(Default)]
struct IdleWork {
    last: Option<(Instant, Duration)>,
    time: Duration,
}

impl IdleWork {
    fn measure_busy_time(&mut self, is_idle: bool) -> Duration {
        let now = Instant::now();
        let cpu = cpu_time();
        if let (Some((then, before)), true) = (self.last, is_idle)
            && cpu.saturating_sub(before).as_secs_f64() > BUSY * (now - then).as_secs_f64()
        {
            self.time += now - then;
        } else {
            self.time = Duration::ZERO;
        }
        self.last = Some((now, cpu));
        self.time
    }
}

// Of all threads of the process.
fn cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec as u32)
}
