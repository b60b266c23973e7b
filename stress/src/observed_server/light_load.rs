//! Requests of other clients of an attacked server: light queries, pages and `/health`, each at a fixed pace.

use std::io;
use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::query_client::AnswerDigest;
use super::repeated_work::RepeatedWork;
use super::{ObservedServer, QueryClient, QueryOutcome, QueryProtocol, http_query};
use crate::serve::http::HttpRequest;

/// Between the beginnings of two probes.
const PROBE_EVERY: Duration = Duration::from_millis(200);
/// A probe that takes longer is given up, and counts as a failure; on a busy machine one takes seconds.
const PROBE_LIMIT: Duration = Duration::from_secs(30);
/// Other clients than the attackers come from another address.
const LIGHT_SOURCE: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);
const LIGHT_QUERY: &str = "select count(*) from runs";
/// Data of pages: a wall of surfaces, and runs. They are asked for with another number each time,
/// so that they are computed and not remembered.
const PAGE_PATHS: [&str; 2] = ["/api/v1/surfaces?limit=", "/api/v1/runs?limit="];

/// A request that must be answered soon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LightProbe {
    HttpQuery,
    PostgresQuery,
    Page,
    Health,
}

/// Times and failures of the probes.
#[derive(Debug, Clone, Default)]
pub(crate) struct LightReport {
    /// Times of light queries, those that failed included.
    pub queries: Vec<Duration>,
    /// Times of pages.
    pub pages: Vec<Duration>,
    /// Times of `/health`.
    pub health: Vec<Duration>,
    /// Queries that failed because their engine ended; they may be sent again.
    pub retriable: usize,
    /// Answers that were not the right ones.
    pub failures: Vec<String>,
}

/// Threads that probe until they are stopped.
pub(crate) struct LightLoad {
    report: Arc<Mutex<LightReport>>,
    probes: [RepeatedWork; 4],
}

impl LightLoad {
    pub fn start(server: &ObservedServer) -> Self {
        let report = Arc::<Mutex<LightReport>>::default();
        let kinds = [
            (LightProbe::HttpQuery, 0),
            (LightProbe::PostgresQuery, 1),
            (LightProbe::Page, 2),
            (LightProbe::Health, 3),
        ];
        let probes = kinds.map(|(probe, number)| {
            let client = server.client("light", number);
            let runs = server.run_count();
            let found = report.clone();
            RepeatedWork::start(PROBE_EVERY, move || run_probe(probe, &client, runs, &found))
        });
        Self { report, probes }
    }

    /// Begins no more probes.
    pub fn pause(&self) {
        self.probes.iter().for_each(RepeatedWork::stop);
    }

    /// Waits for the probes that run, and returns what all of them found.
    pub fn stop(self) -> LightReport {
        drop(self.probes);
        self.report.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

fn run_probe(probe: LightProbe, client: &QueryClient, runs: usize, report: &Mutex<LightReport>) {
    let begun = Instant::now();
    let outcome = send_probe(probe, client);
    let took = begun.elapsed();
    let mut report = report.lock().unwrap_or_else(PoisonError::into_inner);
    if is_retriable(probe, &outcome) {
        report.retriable += 1;
    } else if !is_right(probe, &outcome, runs) {
        report.failures.push(format!("{probe:?}: {outcome}"));
    }
    match probe {
        LightProbe::HttpQuery | LightProbe::PostgresQuery => report.queries.push(took),
        LightProbe::Page => report.pages.push(took),
        LightProbe::Health => report.health.push(took),
    }
}

fn send_probe(probe: LightProbe, client: &QueryClient) -> QueryOutcome {
    let client = client.clone().with_source(LIGHT_SOURCE);
    client.connections.close_after(PROBE_LIMIT, || match probe {
        LightProbe::HttpQuery => client.query(QueryProtocol::Http, LIGHT_QUERY),
        LightProbe::PostgresQuery => client.query(QueryProtocol::PostgresSimple, LIGHT_QUERY),
        LightProbe::Page => {
            static ASKED: AtomicUsize = AtomicUsize::new(0);
            let number = ASKED.fetch_add(1, Ordering::Relaxed);
            let path = format!("{}{}", PAGE_PATHS[number % PAGE_PATHS.len()], 1 + number % 100);
            http_query::send_request(&client, HttpRequest::get(&path))
        }
        LightProbe::Health => http_query::send_request(&client, HttpRequest::get("/health")),
    })
}

// The error of a statement whose engine ended. A page never has one.
fn is_retriable(probe: LightProbe, outcome: &QueryOutcome) -> bool {
    matches!(probe, LightProbe::HttpQuery | LightProbe::PostgresQuery) && outcome.is_engine_end()
}

fn is_right(probe: LightProbe, outcome: &QueryOutcome, runs: usize) -> bool {
    let QueryOutcome::Answer(digest) = outcome else { return false };
    match probe {
        LightProbe::HttpQuery => *digest == digest_of(format!("count(*)\n{runs}\n").as_bytes()),
        // One value with its length.
        LightProbe::PostgresQuery => {
            let value = runs.to_string();
            *digest == digest_of(&[&[0, 1, 0, 0, 0, value.len() as u8], value.as_bytes()].concat())
        }
        LightProbe::Page | LightProbe::Health => true,
    }
}

fn digest_of(mut bytes: &[u8]) -> AnswerDigest {
    let mut digest = AnswerDigest::default();
    // Nothing is written anywhere.
    let _ = io::copy(&mut bytes, &mut digest);
    digest
}
