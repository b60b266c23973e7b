//! Figures of the workers that answered when they were asked last.

use echolake_query::{WorkerFigures, WorkerStatus};
use prometheus::{Gauge, IntGaugeVec, Opts, Registry, Result};

/// A figure of each worker: its name, its meaning, and where it is.
type WorkerFigure = (&'static str, &'static str, fn(&WorkerFigures) -> u64);

const FIGURES: [WorkerFigure; 5] = [
    ("echolake_worker_running_tasks", "Tasks of queries that ran on a worker.", |figures| figures.running),
    ("echolake_worker_tasks", "Tasks that were over since the start of a worker.", |figures| figures.tasks),
    ("echolake_worker_reading_tasks", "Those of them that read files.", |figures| figures.reading_tasks),
    ("echolake_worker_read_bytes", "Bytes of files that they read.", |figures| figures.read_bytes),
    ("echolake_worker_store_requests", "Requests of a worker to the object store since its start.", |figures| {
        figures.store_requests
    }),
];

/// Gauges of all workers.
pub(super) struct WorkerGauges {
    usable: IntGaugeVec,
    figures: Vec<IntGaugeVec>,
    imbalance: Gauge,
}

impl WorkerGauges {
    /// Registers gauges without workers.
    ///
    /// # Errors
    /// A defect: two metrics of one name.
    pub(super) fn register(registry: &Registry) -> Result<Self> {
        let of_worker = |name: &str, help: &str| -> Result<IntGaugeVec> {
            let gauge = IntGaugeVec::new(Opts::new(name, help), &["worker"])?;
            registry.register(Box::new(gauge.clone()))?;
            Ok(gauge)
        };
        let usable = of_worker("echolake_worker_usable", "If a worker could be used when it was asked last.")?;
        let figures = FIGURES.iter().map(|(name, help, _)| of_worker(name, help)).collect::<Result<_>>()?;
        let imbalance = Gauge::new(
            "echolake_worker_imbalance",
            "Largest over mean of the bytes that usable workers read since their start; 0 if there are none.",
        )?;
        registry.register(Box::new(imbalance.clone()))?;
        Ok(Self { usable, figures, imbalance })
    }

    /// Takes what an engine was told.
    pub(super) fn set(&self, workers: &[WorkerStatus]) {
        // Those of a worker that cannot be reached are old.
        self.usable.reset();
        self.figures.iter().for_each(IntGaugeVec::reset);
        for worker in workers {
            self.usable.with_label_values(&[&worker.url]).set(i64::from(worker.problem.is_none()));
            for (gauge, (_, _, value)) in self.figures.iter().zip(FIGURES) {
                if let Some(figures) = worker.figures.as_ref().filter(|_| worker.problem.is_none()) {
                    gauge.with_label_values(&[&worker.url]).set(i64::try_from(value(figures)).unwrap_or(i64::MAX));
                }
            }
        }
        self.imbalance.set(imbalance(workers));
    }
}

fn imbalance(workers: &[WorkerStatus]) -> f64 {
    let usable = workers.iter().filter(|worker| worker.problem.is_none());
    let bytes: Vec<_> = usable.filter_map(|worker| Some(worker.figures?.read_bytes)).collect();
    match (bytes.iter().max(), bytes.iter().sum::<u64>()) {
        (Some(largest), sum) if sum > 0 => *largest as f64 * bytes.len() as f64 / sum as f64,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn worker(url: &str, read_bytes: u64, problem: Option<&str>) -> WorkerStatus {
        WorkerStatus {
            url: url.to_owned(),
            problem: problem.map(str::to_owned),
            build: None,
            last_seen: None,
            figures: Some(WorkerFigures { read_bytes, ..WorkerFigures::default() }),
        }
    }

    #[test]
    fn a_worker_that_left_has_no_figures() {
        let registry = Registry::new();
        let gauges = WorkerGauges::register(&registry).expect("distinct names");
        let text = || prometheus::TextEncoder::new().encode_to_string(&registry.gather()).expect("a text");
        gauges.set(&[worker("http://a/", 300, None), worker("http://b/", 100, None)]);
        assert!(text().contains("echolake_worker_read_bytes{worker=\"http://b/\"} 100"), "{}", text());
        gauges.set(&[worker("http://a/", 300, None)]);
        assert!(!text().contains("http://b/"), "{}", text());
        gauges.set(&[worker("http://a/", 300, Some("gone"))]);
        assert!(text().contains("echolake_worker_usable{worker=\"http://a/\"} 0"), "{}", text());
        assert!(!text().contains("read_bytes{worker=\"http://a/\"}"), "{}", text());
    }

    #[test]
    fn imbalance_is_of_the_workers_in_use() {
        assert_eq!(imbalance(&[]), 0.0);
        let two = [worker("a", 300, None), worker("b", 100, None), worker("c", 1_000_000, Some("gone"))];
        assert_eq!(imbalance(&two), 1.5);
        assert_eq!(imbalance(&[worker("a", 0, None)]), 0.0);
    }
}
