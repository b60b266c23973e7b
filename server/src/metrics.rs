//! Figures of the server, in Prometheus' text format.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::fault::{FaultCode, RequestFault};

/// The protocol of a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ServerProtocol {
    Http,
    FlightSql,
    Postgres,
}

impl ServerProtocol {
    const ALL: [Self; 3] = [Self::Http, Self::FlightSql, Self::Postgres];

    /// As metrics and the log have it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Http => "http",
            Self::FlightSql => "flight_sql",
            Self::Postgres => "postgres",
        }
    }
}

/// Upper bounds of the buckets of a query's time, in milliseconds.
const BUCKETS: [u64; 7] = [3, 10, 30, 100, 300, 1_000, 10_000];

/// Counters since the start.
#[derive(Default)]
pub(crate) struct ServerMetrics {
    queries: [AtomicU64; ServerProtocol::ALL.len()],
    failures: [AtomicU64; FaultCode::ALL.len()],
    rows: AtomicU64,
    running: AtomicI64,
    micros: AtomicU64,
    finished: AtomicU64,
    buckets: [AtomicU64; BUCKETS.len()],
}

/// A query that runs; dropping it counts its time.
pub(crate) struct QueryTimer<'a> {
    metrics: &'a ServerMetrics,
    begun: Instant,
}

impl Drop for QueryTimer<'_> {
    fn drop(&mut self) {
        self.metrics.running.fetch_sub(1, Ordering::Relaxed);
        self.metrics.took(self.begun.elapsed());
    }
}

impl ServerMetrics {
    /// Counts a query that begins; its time is measured until the timer is dropped.
    pub(crate) fn begin(&self, protocol: ServerProtocol) -> QueryTimer<'_> {
        self.queries[protocol as usize].fetch_add(1, Ordering::Relaxed);
        self.running.fetch_add(1, Ordering::Relaxed);
        QueryTimer { metrics: self, begun: Instant::now() }
    }

    /// Counts rows of an answer.
    pub(crate) fn rows(&self, rows: usize) {
        self.rows.fetch_add(rows as u64, Ordering::Relaxed);
    }

    /// Counts a failed request.
    pub(crate) fn failed(&self, code: FaultCode) {
        self.failures[code as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a failed request and writes it to the log.
    pub(crate) fn record_failure(&self, fault: &RequestFault) {
        self.failed(fault.code());
        fault.log();
    }

    fn took(&self, time: Duration) {
        self.finished.fetch_add(1, Ordering::Relaxed);
        self.micros.fetch_add(time.as_micros() as u64, Ordering::Relaxed);
        for (bound, count) in BUCKETS.iter().zip(&self.buckets) {
            if time <= Duration::from_millis(*bound) {
                count.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// All counters, always in the same order; the gauge of running queries is the last.
    pub(crate) fn counters(&self) -> Vec<u64> {
        let all = self.queries.iter().chain(&self.failures).chain(&self.buckets);
        let single = [&self.rows, &self.micros, &self.finished];
        let counters = all.chain(single).map(|counter| counter.load(Ordering::Relaxed));
        counters.chain([self.running.load(Ordering::Relaxed).unsigned_abs()]).collect()
    }

    /// Adds what another process counted between two readings of its counters.
    pub(crate) fn add(&self, before: &[u64], after: &[u64]) {
        let all = self.queries.iter().chain(&self.failures).chain(&self.buckets);
        let counters = all.chain([&self.rows, &self.micros, &self.finished]);
        let difference = |at: usize| {
            let value = |counters: &[u64]| counters.get(at).copied().unwrap_or(0);
            value(after).wrapping_sub(value(before))
        };
        let mut last = 0;
        for (at, counter) in counters.enumerate() {
            counter.fetch_add(difference(at), Ordering::Relaxed);
            last = at + 1;
        }
        self.running.fetch_add(difference(last).cast_signed(), Ordering::Relaxed);
    }

    /// Returns all counters in Prometheus' text format.
    pub(crate) fn text(&self) -> String {
        let mut text = String::new();
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let mut family = |name: &str, kind: &str, help: &str, lines: &[(String, String)]| {
            let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
            for (suffix, value) in lines {
                let _ = writeln!(text, "{name}{suffix} {value}");
            }
        };
        let by_protocol = ServerProtocol::ALL
            .map(|p| (format!("{{protocol=\"{}\"}}", p.name()), get(&self.queries[p as usize]).to_string()));
        family("echolake_queries_total", "counter", "Queries that were begun.", &by_protocol);
        let by_code =
            FaultCode::ALL.map(|c| (format!("{{code=\"{}\"}}", c.name()), get(&self.failures[c as usize]).to_string()));
        family("echolake_failures_total", "counter", "Requests that failed.", &by_code);
        let plain = |value: String| [(String::new(), value)];
        family("echolake_rows_total", "counter", "Rows of all answers.", &plain(get(&self.rows).to_string()));
        let running = self.running.load(Ordering::Relaxed).to_string();
        family("echolake_running_queries", "gauge", "Queries that run now.", &plain(running));
        let mut seconds: Vec<_> = BUCKETS
            .iter()
            .zip(&self.buckets)
            .map(|(bound, count)| (format!("_bucket{{le=\"{}\"}}", *bound as f64 / 1e3), get(count).to_string()))
            .collect();
        let finished = get(&self.finished).to_string();
        seconds.push(("_bucket{le=\"+Inf\"}".to_owned(), finished.clone()));
        seconds.push(("_sum".to_owned(), (get(&self.micros) as f64 / 1e6).to_string()));
        seconds.push(("_count".to_owned(), finished));
        family("echolake_query_seconds", "histogram", "Time of a query, to its last row sent.", &seconds);
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_happened_is_counted() {
        let metrics = ServerMetrics::default();
        let timed = metrics.begin(ServerProtocol::Postgres);
        metrics.rows(3);
        metrics.failed(FaultCode::ReadOnly);
        let text = metrics.text();
        for line in [
            "echolake_queries_total{protocol=\"postgres\"} 1",
            "echolake_queries_total{protocol=\"http\"} 0",
            "echolake_failures_total{code=\"read_only\"} 1",
            "echolake_rows_total 3",
            "echolake_running_queries 1",
            "echolake_query_seconds_count 0",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} in {text}");
        }
        drop(timed);
        let text = metrics.text();
        assert!(text.contains("echolake_running_queries 0\n") && text.contains("_bucket{le=\"+Inf\"} 1\n"), "{text}");
    }

    #[test]
    fn counters_of_another_process_are_added() {
        let (engine, all) = (ServerMetrics::default(), ServerMetrics::default());
        let before = engine.counters();
        let timed = engine.begin(ServerProtocol::FlightSql);
        engine.rows(7);
        engine.failed(FaultCode::TimeLimit);
        let running = engine.counters();
        all.add(&before, &running);
        drop(timed);
        all.add(&running, &engine.counters());
        assert_eq!(all.counters(), engine.counters());
    }

    #[test]
    fn counters_stand_where_their_code_says() {
        for (i, code) in FaultCode::ALL.into_iter().enumerate() {
            assert_eq!(code as usize, i, "{}", code.name());
        }
    }
}
