//! Figures of the server, for Prometheus: what is counted since the start, and the gauges of one moment. Engines report
//! their part to the door, which alone has figures.

mod gauges;
mod workers;

use echolake_lake::CacheCounts;
use echolake_query::{SpreadCounts, WorkerState};
use echolake_service::{FaultCode, QueryEnd, RequestFault, ServerProtocol};
use prometheus::{
    HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge, Opts, Registry, Result, TextEncoder,
};

pub(crate) use gauges::{DiskSpace, EngineGauges, ServerGauges};
use workers::WorkerMetrics;

/// Upper bounds of the buckets of a query's time, in seconds.
const BUCKETS: [f64; 7] = [0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0];
/// The outcome of a query that was answered to its end.
const ANSWERED: &str = "answered";

/// Counters since the start.
pub(crate) struct ServerMetrics {
    registry: Registry,
    queries: IntCounterVec,
    failures: IntCounterVec,
    rows: IntCounter,
    bytes: IntCounter,
    running: IntGauge,
    seconds: HistogramVec,
    requests: HistogramVec,
    cache_blocks: IntCounterVec,
    cache_requests: IntCounter,
    cache_bytes: IntCounter,
    workers: WorkerMetrics,
}

impl ServerMetrics {
    /// Counters at zero.
    ///
    /// # Errors
    /// A defect: two metrics of one name.
    pub fn new() -> Result<Self> {
        let histogram = |name: &str, help: &str| HistogramOpts::new(name, help).buckets(BUCKETS.to_vec());
        let query_time = histogram("echolake_query_seconds", "Time of a query, to its last row sent.");
        let request_time = histogram("echolake_http_request_seconds", "Time of a request, to the head of its answer.");
        let registry = Registry::new();
        let metrics = Self {
            workers: WorkerMetrics::register_new(&registry)?,
            registry,
            queries: IntCounterVec::new(
                Opts::new("echolake_queries_total", "Queries that were begun."),
                &["protocol"],
            )?,
            failures: IntCounterVec::new(Opts::new("echolake_failures_total", "Requests that failed."), &["code"])?,
            rows: IntCounter::new("echolake_rows_total", "Rows of all answers.")?,
            bytes: IntCounter::new(
                "echolake_answer_bytes_total",
                "Bytes of the rows of all answers, before they are encoded.",
            )?,
            running: IntGauge::new("echolake_running_queries", "Queries that run now.")?,
            seconds: HistogramVec::new(query_time, &["protocol", "outcome"])?,
            requests: HistogramVec::new(request_time, &["status"])?,
            cache_blocks: IntCounterVec::new(
                Opts::new("echolake_cache_blocks_total", "Blocks of a lake on an object store that were read."),
                &["from"],
            )?,
            cache_requests: IntCounter::new(
                "echolake_cache_store_requests_total",
                "Requests to the object store for blocks that were not cached.",
            )?,
            cache_bytes: IntCounter::new("echolake_cache_fetched_bytes_total", "Bytes of these blocks.")?,
        };
        metrics.register_all()?;
        Ok(metrics)
    }

    fn register_all(&self) -> Result<()> {
        let Self { registry, queries, failures, rows, bytes, running, seconds, requests, .. } = self;
        registry.register(Box::new(queries.clone()))?;
        registry.register(Box::new(failures.clone()))?;
        registry.register(Box::new(rows.clone()))?;
        registry.register(Box::new(bytes.clone()))?;
        registry.register(Box::new(running.clone()))?;
        registry.register(Box::new(seconds.clone()))?;
        registry.register(Box::new(requests.clone()))?;
        registry.register(Box::new(self.cache_blocks.clone()))?;
        registry.register(Box::new(self.cache_requests.clone()))?;
        registry.register(Box::new(self.cache_bytes.clone()))?;
        // What did not happen yet is zero, and not unknown.
        for protocol in ServerProtocol::ALL {
            queries.with_label_values(&[protocol.name()]);
            seconds.with_label_values(&[protocol.name(), ANSWERED]);
        }
        for code in FaultCode::ALL {
            failures.with_label_values(&[code.name()]);
        }
        self.count_cached(&CacheCounts::default());
        Ok(())
    }

    /// Counts a query that begins.
    pub fn count_begin(&self, protocol: ServerProtocol) {
        self.queries.with_label_values(&[protocol.name()]).inc();
        self.running.inc();
    }

    /// Counts a query that has ended.
    pub fn count_end(&self, protocol: ServerProtocol, end: &QueryEnd) {
        let outcome = end.failure.map_or(ANSWERED, FaultCode::name);
        self.seconds.with_label_values(&[protocol.name(), outcome]).observe(end.seconds);
        self.rows.inc_by(end.rows);
        self.bytes.inc_by(end.bytes);
        self.running.dec();
    }

    /// Counts queries that ended with their engine.
    pub fn count_lost(&self, queries: usize) {
        self.running.sub(i64::try_from(queries).unwrap_or(i64::MAX));
    }

    /// Counts an answer over HTTP by the first digit of its status.
    pub fn count_answer(&self, status: u16, seconds: f64) {
        let class = ["1xx", "2xx", "3xx", "4xx", "5xx"];
        let class = class.get(usize::from(status / 100).wrapping_sub(1)).copied().unwrap_or("other");
        self.requests.with_label_values(&[class]).observe(seconds);
    }

    /// Counts what an engine read of an object store.
    pub fn count_cached(&self, counts: &CacheCounts) {
        let CacheCounts { memory_hits, disk_hits, misses, requests, fetched_bytes } = *counts;
        for (from, blocks) in [("memory", memory_hits), ("disk", disk_hits), ("store", misses)] {
            self.cache_blocks.with_label_values(&[from]).inc_by(blocks);
        }
        self.cache_requests.inc_by(requests);
        self.cache_bytes.inc_by(fetched_bytes);
    }

    /// Takes what an engine has spread over workers, and what they reported.
    pub fn set_workers(&self, counts: &SpreadCounts, workers: &[WorkerState]) {
        self.workers.count_spread(counts);
        self.workers.set_workers(workers);
    }

    /// Counts a failed request.
    pub fn count_failure(&self, code: FaultCode) {
        self.failures.with_label_values(&[code.name()]).inc();
    }

    /// Counts a failed request and writes it to the log.
    pub fn record_failure(&self, fault: &RequestFault) {
        self.count_failure(fault.code());
        fault.log_failure();
    }

    /// Returns all figures in Prometheus' text format.
    ///
    /// # Errors
    /// A defect: two metrics of one name, or values that are not as their metric.
    pub fn prometheus_text(&self, gauges: &ServerGauges) -> Result<String> {
        let moment = Registry::new();
        gauges.register_all(&moment)?;
        let mut families = self.registry.gather();
        families.extend(moment.gather());
        TextEncoder::new().encode_to_string(&families)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_happened_is_counted() {
        let metrics = ServerMetrics::new().expect("distinct names");
        metrics.count_begin(ServerProtocol::Postgres);
        metrics.count_failure(FaultCode::ReadOnly);
        metrics.count_answer(404, 0.5);
        let text = metrics.prometheus_text(&ServerGauges::default()).expect("a text");
        let has = |text: &str, line: &str| assert!(text.lines().any(|l| l == line), "{line} in {text}");
        for line in [
            "echolake_queries_total{protocol=\"postgres\"} 1",
            "echolake_queries_total{protocol=\"http\"} 0",
            "echolake_failures_total{code=\"read_only\"} 1",
            "echolake_running_queries 1",
            "echolake_http_request_seconds_count{status=\"4xx\"} 1",
            "echolake_query_seconds_count{outcome=\"answered\",protocol=\"postgres\"} 0",
        ] {
            has(&text, line);
        }
        let (failure, plan_seconds, first_row_seconds) = (Some(FaultCode::TimeLimit), None, None);
        let end = QueryEnd {
            number: 0,
            failure,
            plan_seconds,
            first_row_seconds,
            seconds: 2.0,
            rows: 3,
            bytes: 9,
            memory: 0,
        };
        metrics.count_end(ServerProtocol::Postgres, &end);
        let text = metrics.prometheus_text(&ServerGauges::default()).expect("a text");
        for line in [
            "echolake_rows_total 3",
            "echolake_answer_bytes_total 9",
            "echolake_running_queries 0",
            "echolake_query_seconds_bucket{outcome=\"time_limit\",protocol=\"postgres\",le=\"1\"} 0",
            "echolake_query_seconds_bucket{outcome=\"time_limit\",protocol=\"postgres\",le=\"10\"} 1",
            "echolake_query_seconds_sum{outcome=\"time_limit\",protocol=\"postgres\"} 2",
        ] {
            has(&text, line);
        }
        metrics.count_cached(&CacheCounts {
            memory_hits: 3,
            disk_hits: 2,
            misses: 5,
            requests: 1,
            fetched_bytes: 4096,
        });
        let text = metrics.prometheus_text(&ServerGauges::default()).expect("a text");
        has(&text, "echolake_cache_blocks_total{from=\"disk\"} 2");
        has(&text, "echolake_cache_fetched_bytes_total 4096");
        metrics.count_begin(ServerProtocol::Http);
        metrics.count_lost(1);
        has(&metrics.prometheus_text(&ServerGauges::default()).expect("a text"), "echolake_running_queries 0");
    }
}
