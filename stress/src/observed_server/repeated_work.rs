//! Work that a thread repeats until it is stopped.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A thread that repeats its work. Dropped, it is stopped, and the work that runs is waited for.
pub(super) struct RepeatedWork {
    is_stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl RepeatedWork {
    /// Starts the work, again and again so long after its beginning before.
    pub fn start(every: Duration, mut work: impl FnMut() + Send + 'static) -> Self {
        let is_stopped = Arc::<AtomicBool>::default();
        let stop = is_stopped.clone();
        let thread = std::thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                let begun = Instant::now();
                work();
                std::thread::sleep(every.saturating_sub(begun.elapsed()));
            }
        });
        Self { is_stopped, thread: Some(thread) }
    }

    /// Does not begin the work again.
    pub fn stop(&self) {
        self.is_stopped.store(true, Ordering::Relaxed);
    }
}

impl Drop for RepeatedWork {
    fn drop(&mut self) {
        self.stop();
        // What it found before it panicked is kept.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}
