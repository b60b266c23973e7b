//! Twenty clients of one server, of which some attack it, and five that read pages: pages are answered about as soon as on
//! a quiet server; statements have the right answers, or an error that may be retried, at most one for each engine that
//! ended.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::attacks::{AttackCase, all_cases};
use super::observed_server::{
    AnswerTally, ClientGroup, MemoryWatch, ObservedServer, QueryClient, QueryOutcome, QueryProtocol, RightAnswers,
    take_right_answers,
};
use super::percentile::{millis, percentile};

/// Clients that attack, one after the other what chance gives them.
const ATTACKERS: ClientGroup = ClientGroup {
    name: "hostile",
    count: 5,
    limits: "seconds = 10\nmemory_mb = 400\nrows = 10_000_000\nconcurrent = 4\n",
};
/// Clients that work.
const WORKERS: ClientGroup =
    ClientGroup { name: "light", count: 15, limits: "seconds = 60\nmemory_mb = 400\nconcurrent = 4\n" };
/// Queries of the workers: light ones, and some of tenths of a second. Their rows have an order.
const QUERIES: [&str; 8] = [
    "select count(*) as n from runs",
    "select surface_id, count(*) as n from measurements group by surface_id order by 1",
    "select pair_id, direct_mm from pairs order by pair_id",
    "select surface_id, avg(tnce_total) as a from tnce group by surface_id order by 1",
    "select pair_id, list_energy(ir) as e from measurements where surface_id = 'flat' order by pair_id",
    "select sum(v % 7) as s from generate_series(1, 1000000) t(v)",
    "select v % 1000 as k, count(*) as n from generate_series(1, 300000) t(v) group by 1 order by 1",
    "select v from generate_series(1, 200000) t(v) order by v % 1000, v limit 10",
];
/// Data of pages that readers ask for.
const PAGES: [&str; 2] = ["/api/v1/surfaces?limit=", "/api/v1/runs?limit="];
/// Clients that read pages.
const PAGE_READERS: usize = 5;
/// Between two queries of a worker, at most.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// Duration of an attack.
const ATTACK_LIMIT: Duration = Duration::from_secs(15);
/// A query that takes longer is lost.
const QUERY_LIMIT: Duration = Duration::from_secs(60);
/// Largest ratio of a page's time under attack to its time without: p95.
const SLOWDOWN_GOAL: f64 = 1.5;

#[derive(Debug, clap::Args)]
pub(crate) struct HostileClientsArgs {
    /// Duration of the attacks, in seconds.
    #[arg(long, value_name = "SECS", default_value_t = 3600)]
    seconds: u64,
    /// Duration for which the server is quiet before, in seconds.
    #[arg(long, value_name = "SECS", default_value_t = 60)]
    quiet_seconds: u64,
    /// Seed of the clients' queries and their times.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// The server quiet and under attack.
#[derive(Debug)]
pub(crate) struct HostileReport {
    pub quiet: AnswerTally,
    pub attacked: AnswerTally,
    pub quiet_pages: AnswerTally,
    pub attacked_pages: AnswerTally,
    /// Engines that ended by themselves under attack.
    engine_ends: usize,
    attacks: BTreeMap<String, usize>,
    restarts: usize,
}

pub(crate) fn run_hostile_clients(args: &HostileClientsArgs) -> Result<()> {
    let quiet = Duration::from_secs(args.quiet_seconds);
    let report = run_clients(&super::echolake_path()?, quiet, Duration::from_secs(args.seconds), args.seed)?;
    print_report(&report);
    ensure!(report.is_goal_reached(), "goals are missed: 0 wrong, p95 of pages within {SLOWDOWN_GOAL} x quiet");
    Ok(())
}

/// Lets the workers work alone, and then beside attackers.
///
/// # Errors
/// The lake cannot be made, or the quiet server fails.
pub(crate) fn run_clients(binary: &Path, quiet: Duration, attacked: Duration, seed: u64) -> Result<HostileReport> {
    let mut server = ObservedServer::start(binary, &[ATTACKERS, WORKERS])?;
    let right = take_right_answers(&server.client(WORKERS.name, 0), &QUERIES)?;
    let quiet = run_phase(&mut server, &right, quiet, seed, &[]);
    let ends_before = server.count_engine_ends();
    let attacked = run_phase(&mut server, &right, attacked, seed, &all_cases());
    Ok(HostileReport {
        quiet: quiet.answers,
        quiet_pages: quiet.pages,
        attacked: attacked.answers,
        attacked_pages: attacked.pages,
        engine_ends: server.count_engine_ends().saturating_sub(ends_before),
        attacks: attacked.attacks,
        restarts: server.restarts,
    })
}

impl HostileReport {
    fn is_goal_reached(&self) -> bool {
        self.is_right() && self.slowdown() <= SLOWDOWN_GOAL
    }

    /// Returns whether every page was answered, every other answer was right or an error that may be retried, at most one
    /// for each worker and engine that ended, and the server lives.
    pub fn is_right(&self) -> bool {
        let AnswerTally { wrong, lost, broken_off, .. } = &self.attacked;
        let failed = self.attacked.count_engine_ends() + broken_off;
        self.attacked_pages.is_right()
            && (*wrong, lost.is_empty(), self.restarts) == (0, true, 0)
            && !self.attacked.has_other_errors()
            && failed <= self.engine_ends * WORKERS.count
    }

    fn slowdown(&self) -> f64 {
        let quiet = percentile(&self.quiet_pages.times, 0.95).as_secs_f64();
        percentile(&self.attacked_pages.times, 0.95).as_secs_f64() / quiet.max(f64::MIN_POSITIVE)
    }
}

fn print_report(report: &HostileReport) {
    let phases = [
        ("quiet", &report.quiet),
        ("attacked", &report.attacked),
        ("quiet, pages", &report.quiet_pages),
        ("attacked, pages", &report.attacked_pages),
    ];
    for (name, phase) in phases {
        println!(
            "{name:16} {} answers, {} wrong, {} broken off, p50 {:.1} ms, p95 {:.1} ms, errors {:?} {:?}",
            phase.times.len(),
            phase.wrong,
            phase.broken_off,
            millis(percentile(&phase.times, 0.5)),
            millis(percentile(&phase.times, 0.95)),
            phase.refused,
            phase.lost,
        );
    }
    println!(
        "p95 of pages under attack is {:.1} x quiet; the server died {} times",
        report.slowdown(),
        report.restarts
    );
    println!("{} engines ended", report.engine_ends);
    println!("attacks: {:?}", report.attacks);
}

/// What a phase has found.
struct PhaseResult {
    answers: AnswerTally,
    pages: AnswerTally,
    /// How attacks ended.
    attacks: BTreeMap<String, usize>,
}

// Restarts the server if it dies. Without attacks, only workers run.
fn run_phase(
    server: &mut ObservedServer,
    right: &RightAnswers,
    time: Duration,
    seed: u64,
    attacks: &[AttackCase],
) -> PhaseResult {
    let phase = ClientPhase {
        right,
        attacks,
        end: Instant::now() + time,
        server_died: AtomicBool::new(false),
        report: Mutex::default(),
        pages: Mutex::default(),
        outcomes: Mutex::default(),
    };
    while Instant::now() < phase.end {
        phase.run_until_death(server, seed + 100 * server.restarts as u64);
    }
    PhaseResult {
        answers: phase.report.into_inner().unwrap_or_else(PoisonError::into_inner),
        pages: phase.pages.into_inner().unwrap_or_else(PoisonError::into_inner),
        attacks: phase.outcomes.into_inner().unwrap_or_else(PoisonError::into_inner),
    }
}

/// Clients at work, with or without attackers.
struct ClientPhase<'a> {
    right: &'a RightAnswers,
    attacks: &'a [AttackCase],
    end: Instant,
    server_died: AtomicBool,
    report: Mutex<AnswerTally>,
    pages: Mutex<AnswerTally>,
    outcomes: Mutex<BTreeMap<String, usize>>,
}

impl ClientPhase<'_> {
    // Until the end, or until the server dies; then it is restarted.
    fn run_until_death(&self, server: &mut ObservedServer, seed: u64) {
        self.server_died.store(false, Ordering::Relaxed);
        let watch = MemoryWatch::start(server.process_tree());
        std::thread::scope(|scope| {
            for number in 0..WORKERS.count {
                let client = numbered_client(server, WORKERS, number);
                let random = ChaCha8Rng::seed_from_u64(seed + number as u64);
                scope.spawn(move || self.work(&client, random));
            }
            for number in 0..PAGE_READERS {
                let client = numbered_client(server, WORKERS, number);
                let random = ChaCha8Rng::seed_from_u64(seed + 70 + number as u64);
                scope.spawn(move || self.read_pages(&client, random));
            }
            for number in (0..ATTACKERS.count).filter(|_| !self.attacks.is_empty()) {
                let client = numbered_client(server, ATTACKERS, number);
                let random = ChaCha8Rng::seed_from_u64(seed + 50 + number as u64);
                scope.spawn(move || self.attack(&client, random));
            }
            while Instant::now() < self.end && server.is_alive() {
                std::thread::sleep(Duration::from_millis(50));
            }
            self.server_died.store(!server.is_alive(), Ordering::Relaxed);
        });
        drop(watch);
        if !server.is_alive() {
            server.restart();
        }
    }

    fn is_over(&self) -> bool {
        Instant::now() >= self.end || self.server_died.load(Ordering::Relaxed)
    }

    fn work(&self, client: &QueryClient, mut random: ChaCha8Rng) {
        let questions: Vec<_> = self.right.iter().collect();
        while !self.is_over() {
            let Some(((protocol, sql), expected)) = questions.choose(&mut random) else { return };
            let one = client.clone().with_source(client.connections.source());
            let begun = Instant::now();
            let answer = one.connections.close_after(QUERY_LIMIT, || one.query(*protocol, sql));
            let mut tally = self.report.lock().unwrap_or_else(PoisonError::into_inner);
            tally.add(*protocol, answer, expected, begun.elapsed());
            drop(tally);
            std::thread::sleep(LONGEST_PAUSE.mul_f64(random.random()));
        }
    }

    fn read_pages(&self, client: &QueryClient, mut random: ChaCha8Rng) {
        while !self.is_over() {
            let Some(path) = PAGES.choose(&mut random) else { return };
            let one = client.clone().with_source(client.connections.source());
            let begun = Instant::now();
            let answer = one
                .connections
                .close_after(QUERY_LIMIT, || one.get_page(&format!("{path}{}", random.random_range(1..=100))));
            // Any whole answer is right: pages are compared elsewhere.
            let expected = match &answer {
                QueryOutcome::Answer(_) => answer.clone(),
                _ => QueryOutcome::Abandoned,
            };
            let mut tally = self.pages.lock().unwrap_or_else(PoisonError::into_inner);
            tally.add(QueryProtocol::Http, answer, &expected, begun.elapsed());
            drop(tally);
            std::thread::sleep(LONGEST_PAUSE.mul_f64(random.random::<f64>() / 4.0));
        }
    }

    fn attack(&self, client: &QueryClient, mut random: ChaCha8Rng) {
        while !self.is_over() {
            let Some(case) = self.attacks.choose(&mut random) else { return };
            let one = client.clone().with_source(client.connections.source());
            let ends = one.connections.close_after(ATTACK_LIMIT, || case.run(&one));
            let mut outcomes = self.outcomes.lock().unwrap_or_else(PoisonError::into_inner);
            ends.into_iter().for_each(|end| *outcomes.entry(end).or_default() += 1);
        }
    }
}

fn numbered_client(server: &ObservedServer, group: ClientGroup, number: usize) -> QueryClient {
    let network = if group.name == WORKERS.name { 2 } else { 1 };
    server.client(group.name, number).with_source(Ipv4Addr::new(127, 0, network, 1 + number as u8))
}
