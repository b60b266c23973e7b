//! Metrics of a run in progress, for Prometheus to scrape.

mod serve;
#[cfg(test)]
mod tests;

use std::fmt::Write as _;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echolake_schema::messages::{Measurement, Verdict};

use crate::run::controller::RunEvent;
use crate::run::recorder::Cost;
pub use serve::MetricsServer;

/// A run's numbers; clones share them.
#[derive(Clone)]
pub struct RunMetrics {
    surface: String,
    inner: Arc<Mutex<MetricValues>>,
}

#[derive(Default)]
struct MetricValues {
    planned: u64,
    accepted: u64,
    attempts: u64,
    repeated: u64,
    rejected: u64,
    pair: u32,
    paused: bool,
    broken_off: bool,
    last: Option<Measurement>,
    cost: Cost,
    disk_free_bytes: Option<u64>,
}

/// Kind of a metric: a counter only grows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MetricKind {
    Counter,
    Gauge,
}

impl MetricKind {
    fn name(self) -> &'static str {
        match self {
            Self::Counter => "counter",
            Self::Gauge => "gauge",
        }
    }
}

/// A metric: its name without `echolake_`, its kind, its help text, its value.
type Metric = (&'static str, MetricKind, &'static str, f64);

impl RunMetrics {
    /// Metrics of a run over `planned` pairs, `accepted` of which are measured already.
    pub fn new(surface: &str, planned: u64, accepted: u64) -> Self {
        let numbers = MetricValues { planned, accepted, ..MetricValues::default() };
        Self { surface: surface.to_owned(), inner: Arc::new(Mutex::new(numbers)) }
    }

    /// Counts an event of the run.
    pub fn observe(&self, event: &RunEvent<'_>) {
        let mut numbers = self.numbers();
        match event {
            RunEvent::Pair(pair) => numbers.pair = pair.id.0,
            RunEvent::Attempt(m) => {
                numbers.attempts += 1;
                match m.verdict() {
                    Verdict::Repeated => numbers.repeated += 1,
                    Verdict::Rejected => numbers.rejected += 1,
                    _ => {}
                }
                numbers.last = Some((*m).clone());
            }
            // These pairs are on the disk.
            RunEvent::Safe { accepted, cost, .. } => (numbers.accepted, numbers.cost) = (*accepted, *cost),
            RunEvent::Paused => numbers.paused = true,
            RunEvent::Continued => numbers.paused = false,
        }
    }

    /// Sets the bytes left on the recording's disk.
    pub fn disk_free(&self, bytes: u64) {
        self.numbers().disk_free_bytes = Some(bytes);
    }

    /// Records that the run broke off.
    pub fn broke_off(&self) {
        self.numbers().broken_off = true;
    }

    /// Returns the metrics in Prometheus' text format 0.0.4.
    pub fn prometheus(&self) -> String {
        let mut out = String::new();
        // Backslash, quote and line break are no part of a surface's name.
        let label = format!("{{surface=\"{}\"}}", self.surface);
        for (name, kind, help, value) in self.numbers().metrics() {
            let _ = writeln!(out, "# HELP echolake_{name} {help}\n# TYPE echolake_{name} {}", kind.name());
            let _ = writeln!(out, "echolake_{name}{label} {value}");
        }
        out
    }

    fn numbers(&self) -> MutexGuard<'_, MetricValues> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl MetricValues {
    fn metrics(&self) -> Vec<Metric> {
        use MetricKind::{Counter, Gauge};
        let flag = |on: bool| f64::from(u8::from(on));
        let mut metrics: Vec<Metric> = vec![
            ("pairs_planned", Gauge, "Pairs of the run.", self.planned as f64),
            ("pairs_accepted", Gauge, "Pairs whose measurement is safe on the disk.", self.accepted as f64),
            ("pair", Gauge, "The pair that is measured now.", f64::from(self.pair)),
            ("attempts_total", Counter, "Attempts of this session.", self.attempts as f64),
            ("repeats_total", Counter, "Attempts of this session that were retried.", self.repeated as f64),
            ("given_up_total", Counter, "Pairs of this session that were given up.", self.rejected as f64),
            ("paused", Gauge, "1 while the run waits.", flag(self.paused)),
            ("broken_off", Gauge, "1 where the run broke off.", flag(self.broken_off)),
            ("recorded_bytes_total", Counter, "Bytes recorded, before compression.", self.cost.bytes as f64),
            ("recorded_messages_total", Counter, "Messages recorded.", self.cost.messages as f64),
            ("checkpoints_total", Counter, "Checkpoints.", self.cost.checkpoints as f64),
            ("recorder_busy_seconds_total", Counter, "Time spent recording.", self.cost.busy.as_secs_f64()),
            (
                "recorder_sync_seconds_total",
                Counter,
                "Time of it spent waiting for the disk.",
                self.cost.waited.as_secs_f64(),
            ),
        ];
        if let Some(m) = &self.last {
            metrics.extend([
                ("snr_db", Gauge, "Signal-to-noise ratio of the last take, dB.", m.snr_db),
                ("loopback_dbfs", Gauge, "Level of its loopback, dB re full scale.", m.loopback_level_dbfs),
                (
                    "arrival_error_us",
                    Gauge,
                    "Its direct sound's arrival minus the expected one, us.",
                    m.arrival_error_us,
                ),
                ("clipped_samples", Gauge, "Its samples at full scale.", f64::from(m.clipped_samples)),
                ("outside_level_db", Gauge, "Sound pressure level outside, dB re 20 uPa.", m.outside_level_db),
                ("temperature_c", Gauge, "Temperature of the air, C.", m.temperature_c),
                ("humidity_pct", Gauge, "Relative humidity, %.", m.humidity_pct),
                ("pressure_hpa", Gauge, "Air pressure, hPa.", m.pressure_hpa),
            ]);
        }
        if let Some(bytes) = self.disk_free_bytes {
            metrics.push(("disk_free_bytes", Gauge, "Bytes left on the recording's disk.", bytes as f64));
        }
        metrics
    }
}
