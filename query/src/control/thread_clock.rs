//! Processor time of the threads of one seat, as the system counts it.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Threads of this process, by their numbers.
const THREADS: &str = "/proc/self/task";
/// Places of user and system time in a thread's `stat`, in ticks, behind its name in parentheses.
const STAT_TIMES: [usize; 2] = [11, 12];

/// Processor time by number of the thread.
pub(crate) type ThreadTimes = HashMap<u64, Duration>;

/// The threads of a seat that live.
#[derive(Debug, Default)]
pub(crate) struct ThreadClock(Mutex<BTreeSet<u64>>);

impl ThreadClock {
    /// Adds the calling thread.
    pub fn add_thread(&self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend(current_thread());
    }

    /// Removes the calling thread, which ends.
    pub fn remove_thread(&self) {
        if let Some(thread) = current_thread() {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&thread);
        }
    }

    /// Returns the time that each thread has computed. It is empty if the system does not tell, as systems other than
    /// Linux.
    pub fn read_times(&self) -> ThreadTimes {
        let threads = self.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        threads.into_iter().filter_map(|thread| Some((thread, read_time(thread)?))).collect()
    }

    /// Returns the longest time that one thread has computed since `before`.
    ///
    /// Work that does not end stays on its thread. The sum over all threads would grow with the number of cores: on 64
    /// of them, operators that end within 4 ms each are a quarter of a second.
    pub fn busiest_since(&self, before: &ThreadTimes) -> Duration {
        let since =
            |(thread, now): (u64, Duration)| now.saturating_sub(before.get(&thread).copied().unwrap_or_default());
        self.read_times().into_iter().map(since).max().unwrap_or_default()
    }
}

fn current_thread() -> Option<u64> {
    // `PID/task/TID`.
    let path = std::fs::read_link("/proc/thread-self").ok()?;
    path.file_name()?.to_str()?.parse().ok()
}

// Nanoseconds, or ticks of 10 ms if the kernel counts no others.
fn read_time(thread: u64) -> Option<Duration> {
    let folder = Path::new(THREADS).join(thread.to_string());
    if let Ok(text) = std::fs::read_to_string(folder.join("schedstat")) {
        return text.split_whitespace().next()?.parse().ok().map(Duration::from_nanos);
    }
    let text = std::fs::read_to_string(folder.join("stat")).ok()?;
    let (_, values) = text.rsplit_once(')')?;
    let values: Vec<_> = values.split_whitespace().collect();
    let ticks = STAT_TIMES.iter().map(|at| values.get(*at)?.parse::<u64>().ok()).sum::<Option<u64>>()?;
    Some(
        Duration::from_secs(1) * u32::try_from(ticks).ok()?
            / u32::try_from(rustix::param::clock_ticks_per_second()).ok()?,
    )
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, mpsc};
    use std::time::Instant;

    use super::*;

    #[test]
    fn the_busiest_thread_counts_and_others_do_not() {
        let clock = Arc::new(ThreadClock::default());
        let (begin, begun) = mpsc::channel();
        let (end, ended) = mpsc::channel::<()>();
        let counted = clock.clone();
        let idle = std::thread::spawn(move || {
            counted.add_thread();
            begin.send(()).expect("somebody waits");
            let _ = ended.recv();
            counted.remove_thread();
        });
        begun.recv().expect("it began");
        let before = clock.read_times();
        assert_eq!(before.len(), 1);
        compute(Duration::from_millis(50));
        assert!(clock.busiest_since(&before) < Duration::from_millis(20), "this thread is not the seat's");
        clock.add_thread();
        assert!(clock.busiest_since(&before) >= Duration::from_millis(20), "it is now");
        let before = clock.read_times();
        assert!(clock.busiest_since(&before) < Duration::from_millis(20));
        drop(end);
        idle.join().expect("no panic");
        assert_eq!(clock.read_times().len(), 1, "a thread that ended is not counted");
    }

    fn compute(time: Duration) {
        let before = current_thread().and_then(read_time).expect("a time");
        let begun = Instant::now();
        while current_thread().and_then(read_time).expect("a time") - before < time {
            assert!(begun.elapsed() < Duration::from_secs(60), "this thread does not get a processor");
        }
    }
}
