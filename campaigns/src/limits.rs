//! Shows that hostile queries end when they are told to, and that many heavy ones leave room for the light.
//!
//! On a lake of some hundred surfaces (`echolake demo --surfaces 350 --ir-only --no-serve`) it prints, for each of the
//! hostile queries, the time from cancelling it until the process is idle, and then the longest light query and the memory
//! while twenty heavy queries are asked at once.

#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Result;
use echolake_lake::Lake;
use echolake_query::{Client, Engine, Error, Limits, Quota};

/// Plans that never return by themselves for a long time, one for each operator that could hold a processor.
const HOSTILE: [(&str, &str); 10] = [
    ("cross join", "select max(a.tnce_total + b.tnce_total + c.direct_mm) from tnce a, tnce b, pairs c"),
    ("join without a match", "select count(*) from tnce a join tnce b on a.tnce_total > b.tnce_total + 1e9"),
    (
        "one key for all",
        "select count(*) from tnce a join tnce b on a.pair_id % 1 = b.pair_id % 1 and a.tnce_total > b.tnce_total + 1e9",
    ),
    ("recursion", "with recursive r as (select 1 n union all select n + 1 from r) select count(*) from r"),
    ("series", "select count(*) from generate_series(1, 10000000000000) t(v) where v % 7 = 3"),
    (
        "window",
        "select max(m) from (select median(tnce_total) over (order by tnce_total rows between 100000 preceding and current row) m from tnce)",
    ),
    (
        "sort",
        "select max(r) from (select *, row_number() over (order by tnce_total, surface_id desc) r from tnce_d4) where tnce_total < 0",
    ),
    ("groups", "select count(*) from (select distinct surface_id, pair_id, symmetry, tnce_2500 from tnce_d4)"),
    ("texts", "select sum(levenshtein(repeat(surface_id, 20), repeat(run_id, 6))) from tnce"),
    ("lists", "select count(*) from (select unnest(ir) x from measurements) where x > 1e9"),
];
/// Queries that must stay quick.
const LIGHT: &str =
    "select count(*), avg(tnce_total) from tnce where surface_id = (select min(surface_id) from surfaces)";
/// The processor is idle when it works less than this part of the time.
const IDLE: f64 = 0.1;
/// Time over which the processor is looked at.
const LOOK: Duration = Duration::from_millis(10);
/// Memory of all queries while the heavy ones run.
const MEMORY: usize = 1 << 30;
const HEAVY: usize = 20;

#[derive(Debug, clap::Args)]
pub(crate) struct LimitsArgs {
    /// A lake of some hundred surfaces.
    lake: String,
    /// Times that each query is cancelled.
    #[arg(default_value_t = 10)]
    rounds: usize,
    /// Seed of the moments.
    #[arg(default_value_t = 1)]
    seed: u64,
}

pub(crate) async fn run(args: &LimitsArgs) -> Result<()> {
    let lake = Lake::open(&args.lake).await?;
    cancel(&lake, args.rounds, args.seed).await?;
    crowd(&lake).await
}

async fn cancel(lake: &Lake, rounds: usize, seed: u64) -> Result<()> {
    let engine = Engine::new(lake, Limits { memory: Some(4 << 30), ..Limits::default() })?;
    let session = engine.session(&Arc::new(Client::new("bench", Quota::default())));
    let mut all = Vec::new();
    let mut random = seed;
    for (name, sql) in HOSTILE {
        let mut times = Vec::new();
        let mut ended = 0;
        for _ in 0..rounds {
            // Knuth's linear congruential generator: any seeded scatter will do here.
            random = random.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let wait = Duration::from_millis(50 + (random >> 33) % 1500);
            let mut answer = session.query(sql).await?;
            let handle = answer.cancel_handle();
            let reading = tokio::spawn(async move {
                loop {
                    match answer.next().await {
                        Ok(Some(_)) => {}
                        other => break other.map(drop),
                    }
                }
            });
            tokio::time::sleep(wait).await;
            ended += usize::from(reading.is_finished());
            let cancelled = Instant::now();
            handle.cancel();
            let outcome = reading.await?;
            if !matches!(outcome, Err(Error::Cancelled)) && ended == 0 {
                println!("  {name}: {outcome:?}");
            }
            times.push(idle_after(cancelled));
        }
        times.sort();
        println!(
            "{name:22} median {:?}  longest {:?}  ended before {ended}",
            times[times.len() / 2],
            times[times.len() - 1]
        );
        all.extend(times);
    }
    all.sort();
    println!("p99 of {}: {:?}", all.len(), all[(all.len() * 99).div_ceil(100) - 1]);
    Ok(())
}

// Time from `since` until the beginning of the first idle look.
fn idle_after(since: Instant) -> Duration {
    loop {
        let (start, before) = (Instant::now(), processor_ns());
        std::thread::sleep(LOOK);
        let worked = processor_ns().saturating_sub(before) as f64 / start.elapsed().as_nanos() as f64;
        if worked < IDLE {
            return start.duration_since(since);
        }
    }
}

// Nanoseconds that the process's threads have run.
fn processor_ns() -> u64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return 0 };
    let ran = |task: std::path::PathBuf| {
        let text = std::fs::read_to_string(task.join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    };
    tasks.flatten().filter_map(|t| ran(t.path())).sum()
}

async fn crowd(lake: &Lake) -> Result<()> {
    let engine = Engine::new(lake, Limits { memory: Some(MEMORY), ..Limits::default() })?;
    let quota = Quota { time: Some(Duration::from_secs(30)), ..Quota::default() };
    let heavy = Arc::new(Client::new("heavy", quota));
    let before = resident_mib("VmRSS:");
    let mut running = Vec::new();
    for at in 0..HEAVY {
        let session = engine.session(&heavy);
        let (name, sql) = HOSTILE[at % HOSTILE.len()];
        running.push(tokio::spawn(async move {
            let outcome = async {
                let mut answer = session.query(sql).await?;
                while answer.next().await?.is_some() {}
                Ok::<_, Error>(())
            };
            (name, outcome.await)
        }));
    }
    let light = engine.session(&Arc::new(Client::new("light", Quota::default())));
    let mut times = Vec::new();
    let mut most = 0;
    while running.iter().any(|r| !r.is_finished()) {
        let start = Instant::now();
        let mut answer = light.query(LIGHT).await?;
        while answer.next().await?.is_some() {}
        times.push(start.elapsed());
        most = most.max(resident_mib("VmRSS:"));
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    for query in running {
        let (name, outcome) = query.await?;
        println!("  {name}: {}", outcome.map_or_else(|e| e.to_string(), |()| "answered".to_owned()));
    }
    times.sort();
    println!(
        "{HEAVY} heavy queries: {} light ones, median {:?}, longest {:?}; memory {before} MiB before, most {most} MiB, limit {} MiB",
        times.len(),
        times[times.len() / 2],
        times[times.len() - 1],
        MEMORY >> 20
    );
    Ok(())
}

fn resident_mib(field: &str) -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix(field)).unwrap_or_default();
    line.trim().trim_end_matches("kB").trim().parse::<usize>().unwrap_or(0) >> 10
}
