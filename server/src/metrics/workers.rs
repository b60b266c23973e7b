//! Figures of workers, as they last reported them to an engine, and of the queries that were spread over them.

use echolake_query::{SpreadCounts, WorkerFigures, WorkerState};
use prometheus::{IntCounterVec, IntGaugeVec, Opts, Registry, Result};

/// A figure of each worker: its name, its meaning, and how it is read.
type WorkerFigure = (&'static str, &'static str, fn(&WorkerFigures) -> u64);

const FIGURES: [WorkerFigure; 4] = [
    ("echolake_worker_running_tasks", "Tasks of queries that ran on a worker.", |figures| figures.running),
    ("echolake_worker_tasks", "Tasks that were over since the start of a worker.", |figures| figures.tasks),
    ("echolake_worker_read_bytes", "Bytes of files that they read.", |figures| figures.read_bytes),
    ("echolake_worker_store_requests", "Requests of a worker to the object store since its start.", |figures| {
        figures.store_requests
    }),
];

/// Counters and gauges of workers.
pub(super) struct WorkerMetrics {
    spread: IntCounterVec,
    usable: IntGaugeVec,
    figures: Vec<IntGaugeVec>,
}

impl WorkerMetrics {
    /// Registers them, without workers.
    ///
    /// # Errors
    /// A defect: two metrics of one name.
    pub fn register_new(registry: &Registry) -> Result<Self> {
        let register_gauge = |name: &str, help: &str| -> Result<IntGaugeVec> {
            let gauge = IntGaugeVec::new(Opts::new(name, help), &["worker"])?;
            registry.register(Box::new(gauge.clone()))?;
            Ok(gauge)
        };
        let help = "Queries that were begun on workers, repeated without a lost one, or returned to the engine.";
        let spread = IntCounterVec::new(Opts::new("echolake_spread_queries_total", help), &["event"])?;
        registry.register(Box::new(spread.clone()))?;
        let usable = register_gauge("echolake_worker_usable", "1 if a worker could be used when it was last asked.")?;
        let figures = FIGURES.iter().map(|(name, help, _)| register_gauge(name, help)).collect::<Result<_>>()?;
        let metrics = Self { spread, usable, figures };
        metrics.count_spread(&SpreadCounts::default());
        Ok(metrics)
    }

    /// Counts queries that were spread.
    pub fn count_spread(&self, counts: &SpreadCounts) {
        let SpreadCounts { spread, repeated, returned } = *counts;
        for (event, queries) in [("begun", spread), ("repeated", repeated), ("returned", returned)] {
            self.spread.with_label_values(&[event]).inc_by(queries);
        }
    }

    /// Replaces the figures of all workers. Those of a worker that cannot be reached are old, and left out.
    pub fn set_workers(&self, workers: &[WorkerState]) {
        self.usable.reset();
        self.figures.iter().for_each(IntGaugeVec::reset);
        for worker in workers {
            self.usable.with_label_values(&[&worker.url]).set(i64::from(worker.problem.is_none()));
            let Some(figures) = worker.figures.as_ref().filter(|_| worker.problem.is_none()) else { continue };
            for (gauge, (_, _, value)) in self.figures.iter().zip(FIGURES) {
                gauge.with_label_values(&[&worker.url]).set(i64::try_from(value(figures)).unwrap_or(i64::MAX));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_worker_that_left_has_no_figures() {
        let registry = Registry::new();
        let metrics = WorkerMetrics::register_new(&registry).expect("distinct names");
        let text = || prometheus::TextEncoder::new().encode_to_string(&registry.gather()).expect("a text");
        let worker = |url: &str, read_bytes: u64, problem: Option<&str>| WorkerState {
            url: url.to_owned(),
            problem: problem.map(str::to_owned),
            build: None,
            last_seen_micros: None,
            figures: Some(WorkerFigures { read_bytes, ..WorkerFigures::default() }),
        };
        assert!(text().contains("echolake_spread_queries_total{event=\"begun\"} 0"), "{}", text());
        metrics.count_spread(&SpreadCounts { spread: 3, repeated: 1, returned: 0 });
        metrics.set_workers(&[worker("http://a/", 300, None), worker("http://b/", 100, None)]);
        assert!(text().contains("echolake_spread_queries_total{event=\"repeated\"} 1"), "{}", text());
        assert!(text().contains("echolake_worker_read_bytes{worker=\"http://b/\"} 100"), "{}", text());
        metrics.set_workers(&[worker("http://a/", 300, Some("gone"))]);
        assert!(!text().contains("http://b/"), "{}", text());
        assert!(text().contains("echolake_worker_usable{worker=\"http://a/\"} 0"), "{}", text());
        assert!(!text().contains("read_bytes{worker=\"http://a/\"}"), "{}", text());
    }
}
