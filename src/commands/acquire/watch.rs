//! Progress and control of a run for its operator: pause, stop.

use std::io::{BufRead as _, IsTerminal as _};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::Context as _;
use echolake_acquisition::disk::free_bytes;
use echolake_acquisition::run::controller::{RunControl, RunEvent};
use echolake_acquisition::run::metrics::RunMetrics;
use echolake_acquisition::run::recorder::Cost;
use echolake_schema::manifest::RunEnd;
use echolake_schema::messages::Verdict;
use tokio::signal::unix::{SignalKind, signal};

use crate::progress::{CommandProgress, TaskProgress};
use crate::signals::StopRequest;

/// The progress of one run.
pub(in crate::commands) struct RunWatcher {
    task: TaskProgress,
    metrics: RunMetrics,
    folder: PathBuf,
    /// Pairs with an accepted measurement, and those of them that are safe on the disk.
    accepted: u64,
    safe: u64,
    repeats: u64,
    given_up: u64,
    snr_db: f64,
    pair: String,
    begun: Instant,
    cost: Cost,
}

impl RunWatcher {
    /// Of a run over `planned` pairs, `accepted` of which are measured already.
    pub fn new(
        progress: &CommandProgress,
        surface: &str,
        planned: u64,
        accepted: u64,
        metrics: RunMetrics,
        folder: PathBuf,
    ) -> Self {
        let mut task = progress.start_task(surface.to_owned(), planned, "pairs");
        task.begin_at(accepted);
        Self {
            task,
            metrics,
            folder,
            accepted,
            safe: accepted,
            repeats: 0,
            given_up: 0,
            snr_db: f64::NAN,
            pair: String::new(),
            begun: Instant::now(),
            cost: Cost::default(),
        }
    }

    /// Records an event. Measured pairs count as done; the line says how many of them are safe on the disk.
    pub fn observe_event(&mut self, event: &RunEvent<'_>) {
        self.metrics.observe(event);
        match event {
            RunEvent::Pair(pair) => {
                self.pair =
                    format!("pair {} (microphone {}, speaker {})", pair.id.0, pair.microphone.0, pair.speaker.0);
            }
            RunEvent::Attempt(m) => {
                self.snr_db = m.snr_db;
                self.accepted += u64::from(m.verdict() == Verdict::Accepted);
                self.repeats += u64::from(m.verdict() == Verdict::Repeated);
                self.given_up += u64::from(m.verdict() == Verdict::Rejected);
                self.task.set_note(self.status_line());
                self.task.set_done(self.accepted);
            }
            RunEvent::Safe { accepted, cost, .. } => {
                self.cost = *cost;
                if let Ok(bytes) = free_bytes(&self.folder) {
                    self.metrics.disk_free(bytes);
                }
                (self.accepted, self.safe) = (*accepted, *accepted);
                self.task.set_note(self.status_line());
                self.task.set_done(*accepted);
            }
            RunEvent::Paused => {
                self.task.print_message("paused: everything measured is safe; `p` and Enter, or SIGUSR1, continues")
            }
            RunEvent::Continued => self.task.print_message("continued"),
        }
    }

    /// Reports the end of the run, or that it was aborted.
    pub fn report_end(self, end: Option<RunEnd>) {
        if self.cost.checkpoints > 0 {
            let busy = self.cost.busy.as_secs_f64();
            let whole = self.begun.elapsed().as_secs_f64();
            self.task.print_message(&format!(
                "writing took {busy:.2} s of the run's {whole:.2} s ({:.2} s waiting for the disk); {:.1} MB in {} \
                    checkpoints",
                self.cost.waited.as_secs_f64(),
                self.cost.bytes as f64 / 1e6,
                self.cost.checkpoints
            ));
        }
        match end {
            Some(RunEnd { accepted, rejected, attempts, .. }) => {
                self.task.finish_with(format!("{accepted} pairs accepted, {rejected} given up, {attempts} attempts"));
            }
            // The error says why; a run that was refused never began.
            None if self.cost.checkpoints == 0 => self.task.dismiss(),
            None => self.task.finish_with("aborted"),
        }
    }

    fn status_line(&self) -> String {
        let Self { pair, snr_db, repeats, given_up, safe, .. } = self;
        format!("{pair}, SNR {snr_db:.1} dB, {repeats} repeated, {given_up} given up, {safe} safe on the disk")
    }
}

/// Lets signals and the terminal control a run from now on: Ctrl-C and SIGTERM stop it after the current pair, a second
/// one at once; SIGUSR1, or `p` and Enter on a terminal, pauses or resumes it. Returns the request to stop.
///
/// # Errors
/// The system refused a handler.
pub(super) fn obey_signals(control: &Arc<RunControl>) -> anyhow::Result<StopRequest> {
    let stop = StopRequest::listen("stopping after the current pair; Ctrl-C again stops at once")?;
    let mut pauses = signal(SignalKind::user_defined1()).context("cannot listen to SIGUSR1")?;
    let stopped = control.clone();
    let made = stop.clone();
    tokio::spawn(async move {
        made.wait_until_made().await;
        stopped.stop.store(true, Ordering::Relaxed);
    });
    let paused = control.clone();
    tokio::spawn(async move {
        while pauses.recv().await.is_some() {
            toggle_pause(&paused);
        }
    });
    if std::io::stdin().is_terminal() {
        let paused = control.clone();
        std::thread::spawn(move || {
            for line in std::io::stdin().lock().lines().map_while(Result::ok) {
                if line.trim().eq_ignore_ascii_case("p") {
                    toggle_pause(&paused);
                }
            }
        });
    }
    Ok(stop)
}

fn toggle_pause(control: &RunControl) {
    control.pause.fetch_xor(true, Ordering::Relaxed);
}

#[cfg(test)]
mod tests {
    use super::*;
    use echolake_schema::messages::Measurement;

    #[test]
    fn measured_pairs_are_done_and_safe_ones_are_counted() {
        let metrics = RunMetrics::new("flat", 45, 3);
        let mut watcher = RunWatcher::new(&CommandProgress::new(), "flat", 45, 3, metrics, PathBuf::from("."));
        let mut attempt = |verdict: Verdict| {
            watcher
                .observe_event(&RunEvent::Attempt(&Measurement { verdict: verdict.into(), ..Measurement::default() }));
            (watcher.accepted, watcher.status_line())
        };
        assert_eq!(attempt(Verdict::Repeated).0, 3);
        let (accepted, line) = attempt(Verdict::Accepted);
        assert!(accepted == 4 && line.ends_with("1 repeated, 0 given up, 3 safe on the disk"), "{accepted} {line}");
        watcher.observe_event(&RunEvent::Safe { verdicts: &[], accepted: 4, cost: Cost::default() });
        assert!(watcher.status_line().ends_with("4 safe on the disk"), "{}", watcher.status_line());
    }
}
