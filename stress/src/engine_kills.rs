//! Kills engines of a server, the processes below it that run queries, while clients read answers of known digests:
//! every answer must be whole, or an error with its code, or be seen to be broken off.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::observed_server::{
    AnswerTally, ClientGroup, ObservedServer, RightAnswers, kill_process, take_right_answers,
};

/// Clients at once.
const READERS: usize = 8;
/// Names that a reader takes turns with, because a client whose engines end again and again has to wait.
const NAMES: usize = 4;
const CLIENTS: ClientGroup =
    ClientGroup { name: "reader", count: READERS * NAMES, limits: "seconds = 60\nmemory_mb = 400\nconcurrent = 4\n" };
/// Answers of some megabytes, in an order, which take a while to come.
const QUERIES: [&str; 3] = [
    "select v, repeat('x', 50) as x from generate_series(1, 100000) t(v)",
    "select v, v * 7 as w, 'text ' || v as x from generate_series(1, 200000) t(v) order by v",
    "select m.pair_id, v, m.snr_db from measurements m, generate_series(1, 500) t(v) order by 1, 2, 3",
];
/// Between two kills, at most.
const LONGEST_PAUSE: Duration = Duration::from_millis(500);
/// Longest wait for an engine that can be killed.
const ENGINE_LIMIT: Duration = Duration::from_secs(30);

#[derive(Debug, clap::Args)]
pub(crate) struct EngineKillsArgs {
    /// Number of engines that are killed.
    #[arg(default_value_t = 500)]
    kills: usize,
    /// Seed of the moments and of who is killed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

pub(crate) fn run_engine_kills(args: &EngineKillsArgs) -> Result<()> {
    let tally = run_kills(&super::echolake_path()?, args.kills, args.seed)?;
    let whole = tally.times.len();
    let wrong = tally.wrong;
    println!("{} kills: {whole} answers whole, {wrong} wrong, {} broken off", args.kills, tally.broken_off);
    for (error, count) in tally.refused.iter().chain(&tally.lost) {
        println!("  {error}: {count}");
    }
    ensure!(tally.is_honest(), "goals are missed: no wrong answer, and a code for each that is not whole");
    Ok(())
}

/// Kills so many engines.
///
/// # Errors
/// The lake cannot be made, the undisturbed server fails, or it has no engines.
pub(crate) fn run_kills(binary: &Path, kills: usize, seed: u64) -> Result<AnswerTally> {
    let mut server = ObservedServer::start(binary, &[CLIENTS])?;
    let right = take_right_answers(&server.client(CLIENTS.name, 0), &QUERIES)?;
    let tally = Mutex::<AnswerTally>::default();
    let is_stopped = AtomicBool::new(false);
    let killed = std::thread::scope(|scope| {
        for reader in 0..READERS {
            let server = &server;
            let right = &right;
            let tally = &tally;
            let is_stopped = &is_stopped;
            scope.spawn(move || read_answers(server, reader, right, seed, tally, is_stopped));
        }
        let killed = kill_engines(&server, kills, seed);
        is_stopped.store(true, Ordering::Relaxed);
        killed
    });
    killed?;
    ensure!(server.is_alive(), "the server died: {}", server.last_words());
    Ok(tally.into_inner().unwrap_or_else(PoisonError::into_inner))
}

fn read_answers(
    server: &ObservedServer,
    reader: usize,
    right: &RightAnswers,
    seed: u64,
    tally: &Mutex<AnswerTally>,
    is_stopped: &AtomicBool,
) {
    let mut random = ChaCha8Rng::seed_from_u64(seed + 1 + reader as u64);
    let clients: Vec<_> = (0..NAMES).map(|name| server.client(CLIENTS.name, reader * NAMES + name)).collect();
    let questions: Vec<_> = right.iter().collect();
    while !is_stopped.load(Ordering::Relaxed) {
        let Some(client) = clients.choose(&mut random) else { return };
        let Some(((protocol, sql), expected)) = questions.choose(&mut random) else { return };
        let begun = Instant::now();
        let outcome = client.query(*protocol, sql);
        tally.lock().unwrap_or_else(PoisonError::into_inner).add(*protocol, outcome, expected, begun.elapsed());
    }
}

fn kill_engines(server: &ObservedServer, kills: usize, seed: u64) -> Result<()> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..kills {
        std::thread::sleep(LONGEST_PAUSE.mul_f64(random.random()));
        kill_process(find_engine(server, &mut random)?);
    }
    Ok(())
}

fn find_engine(server: &ObservedServer, random: &mut ChaCha8Rng) -> Result<u32> {
    let begun = Instant::now();
    while begun.elapsed() < ENGINE_LIMIT {
        if let Some(engine) = server.process_tree().children().choose(random) {
            return Ok(*engine);
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    anyhow::bail!("the server has had no engines, which are processes below it, for {ENGINE_LIMIT:?}")
}
