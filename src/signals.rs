//! Ctrl-C and SIGTERM as a request to stop. A command listens before it prints its first line: whoever waits for that
//! line may send the signal next.

use std::fmt::Display;
use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::Notify;

/// Exit codes of a process that a signal ended, as shells report them: 128 and the signal's number.
const INTERRUPTED: i32 = 130;
const TERMINATED: i32 = 143;

/// A request to stop, made by the first Ctrl-C or SIGTERM. The second ends the process at once.
#[derive(Clone)]
pub(crate) struct StopRequest {
    flag: Arc<AtomicBool>,
    made: Arc<Notify>,
}

/// The two signals that ask for an end.
struct StopSignals {
    interrupts: Signal,
    terminations: Signal,
}

impl StopRequest {
    /// Listens from now on, also if the parent process set Ctrl-C to be ignored, as shells do for background jobs.
    /// `reply` is printed when the request is made.
    ///
    /// # Errors
    /// The system refused a handler.
    pub fn listen(reply: impl Display + Send + 'static) -> anyhow::Result<Self> {
        let mut signals = StopSignals::register_handlers()?;
        let request = Self { flag: Arc::new(AtomicBool::new(false)), made: Arc::new(Notify::new()) };
        let listener = request.clone();
        tokio::spawn(async move {
            signals.next().await;
            listener.flag.store(true, Ordering::SeqCst);
            listener.made.notify_waiters();
            // A closed stderr must not keep the second signal from being heard.
            let _ = writeln!(std::io::stderr(), "{reply}");
            std::process::exit(signals.next().await);
        });
        Ok(request)
    }

    /// Returns a flag that becomes true with the request, for threads that poll it.
    #[cfg(feature = "lake")]
    pub fn flag(&self) -> &Arc<AtomicBool> {
        &self.flag
    }

    /// Returns whether the request was made.
    pub fn is_made(&self) -> bool {
        self.flag.load(Ordering::SeqCst)
    }

    /// Waits until the request is made.
    pub async fn wait_until_made(&self) {
        // Hears of a request from here on, so that none falls between the look and the wait.
        let made = self.made.notified();
        if !self.is_made() {
            made.await;
        }
    }
}

impl StopSignals {
    fn register_handlers() -> anyhow::Result<Self> {
        let terminations = signal(SignalKind::terminate()).context("cannot listen to SIGTERM")?;
        Ok(Self { interrupts: interrupt_signal()?, terminations })
    }

    /// Waits for either signal; returns the exit code of a process that it ends.
    async fn next(&mut self) -> i32 {
        tokio::select! {
            _ = self.interrupts.recv() => INTERRUPTED,
            _ = self.terminations.recv() => TERMINATED,
        }
    }
}

/// Listens to Ctrl-C alone, which then no longer ends the process.
///
/// # Errors
/// The system refused the handler.
pub(crate) fn interrupt_signal() -> anyhow::Result<Signal> {
    signal(SignalKind::interrupt()).context("cannot listen to Ctrl-C")
}
