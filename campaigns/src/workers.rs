//! Queries over workers, as processes on this machine: the answers of four protocols with workers and without, the same
//! while workers are killed, and what workers read.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::observed_server::{
    ProcessTree, QueryClient, QueryOutcome, QueryProtocol, RightAnswers, ServerAddresses, take_right_answers,
};
use crate::SMALL_RIG;
use crate::child::{ChildProcess, run_command};
use crate::serve::http::HttpRequest;
use crate::serve::server::ServedLake;

/// Queries whose answers have the same bytes whoever computes them: ordered, and without sums of floats.
const QUERIES: [&str; 6] = [
    "select surface_id, pair_id, ir from measurements where pair_id < 50 order by surface_id, pair_id",
    "select surface_id, pair_id, v, ir[1] as first from (select surface_id, pair_id, ir, unnest(range(1, 200)) as v \
     from measurements where pair_id < 100) order by 1, 2, 3 limit 20000",
    "select surface_id, count(*) as n, max(ir[7]) as most, min(pair_id) as least from measurements group by 1 order by 1",
    "select m.surface_id, m.pair_id, n.nce_5000[100] as x from measurements m join nce n using (surface_id, pair_id) \
     where m.pair_id % 10 = 3 order by 1, 2",
    "select count(distinct pair_id) as n from measurements where ir[20] <> 0",
    "select pair_id, surface_id, row_number() over (partition by pair_id order by surface_id) as n from measurements \
     where ir[3] <> 0 and pair_id < 50 order by 1, 2",
];
/// A kill comes within this time of its query's start.
const KILL_WITHIN: Duration = Duration::from_millis(400);
/// Surfaces of the lake that is made if none is given.
const SURFACES: [&str; 4] = ["flat", "foam", "wood", "brick"];
/// A query that computes on all workers for as long as it is let.
const ENDLESS: &str = "select count(*) from (select unnest(range(1, 3000 + pair_id)) as v from measurements where pair_id < 20) \
     a join (select unnest(range(1, 3000 + pair_id)) as w from measurements where pair_id < 20) b on a.v % 7 = b.w % 7 \
     where a.v + b.w <> 9";
/// Processor time of all workers after which its client goes, and time to wait for that.
const WORK_TIME: Duration = Duration::from_millis(300);
const START_LIMIT: Duration = Duration::from_secs(60);
/// Time for the workers to be idle then: in tests, on a busy machine.
const IDLE_LIMIT: Duration = Duration::from_secs(30);
/// Goal for that time, of 99 in 100.
const IDLE_GOAL: Duration = Duration::from_millis(500);
/// Codes of a query that lost a worker after its first row.
const LOST_CODES: [&str; 2] = ["worker_lost", "58030"];

#[derive(Debug, clap::Args)]
pub(crate) struct WorkersArgs {
    /// Rounds with a killed worker.
    #[arg(default_value_t = 200)]
    rounds: usize,
    /// Workers.
    #[arg(long, default_value_t = 4)]
    workers: usize,
    /// A lake; by default a small one is made.
    #[arg(long, value_name = "FOLDER")]
    lake: Option<PathBuf>,
    /// Clients that go while their query computes.
    #[arg(long, default_value_t = 20)]
    cancels: usize,
    /// Seed of the moments, the queries and who is killed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// The answers that queries got while workers were killed.
#[derive(Debug, Default)]
pub(crate) struct WorkersReport {
    pub(crate) right: usize,
    /// Answers that look whole and are not the right ones.
    pub(crate) wrong: usize,
    /// Errors that say that a worker was lost.
    lost: usize,
    /// Anything else.
    pub(crate) others: BTreeMap<String, usize>,
    /// Times of the right ones, s.
    slowest: f64,
}

pub(crate) fn run(args: &WorkersArgs) -> Result<()> {
    let binary = super::echolake_path()?;
    let mut cluster = WorkerProcesses::start(&binary, args.lake.as_deref(), args.workers)?;
    let mut idle = (0..args.cancels).map(|_| cluster.cancel_to_idle()).collect::<Result<Vec<_>>>()?;
    idle.sort_unstable();
    let quantile =
        |part: f64| idle.get((idle.len() as f64 * part) as usize).or(idle.last()).copied().unwrap_or_default();
    let [half, most] = [0.5, 0.99].map(|part| quantile(part).as_secs_f64() * 1e3);
    println!("{} clients went: all workers idle after {half:.0} ms (p50), {most:.0} ms (p99)", idle.len());
    let report = cluster.check(args.rounds, args.seed)?;
    println!(
        "{} rounds with a killed worker of {}: {} right (slowest {:.1} s), {} wrong, {} say that a worker was lost",
        args.rounds, args.workers, report.right, report.slowest, report.wrong, report.lost
    );
    for (what, count) in &report.others {
        println!("  {what}: {count}");
    }
    for sql in QUERIES {
        let (local, spread) = (cluster.bytes_read(&cluster.local, sql)?, cluster.bytes_read(&cluster.spread, sql)?);
        println!(
            "read by workers {spread} B, locally {local} B: {:.3}  {sql:.60}",
            spread as f64 / local.max(1) as f64
        );
    }
    ensure!(report.is_goal_reached(), "goals are missed: no wrong answer, and a code for each that is not whole");
    ensure!(
        quantile(0.99) <= IDLE_GOAL,
        "the goal is missed: workers idle {} ms after a cancel",
        IDLE_GOAL.as_millis()
    );
    Ok(())
}

/// Workers, a server that uses them, and one that does not.
pub(crate) struct WorkerProcesses {
    _folder: tempfile::TempDir,
    binary: PathBuf,
    lake: PathBuf,
    workers: Vec<WorkerProcess>,
    token: String,
    spread: ServedLake,
    local: ServedLake,
}

struct WorkerProcess {
    child: ChildProcess,
    address: String,
}

impl WorkerProcess {
    fn start(binary: &Path, lake: &Path, folder: &Path, address: &str) -> Result<Self> {
        let mut command = Command::new(binary);
        command.arg("--lake").arg(lake).args(["serve", "--worker", address, "--worker-token", "worker.token"]);
        let mut child = ChildProcess::start(command.current_dir(folder).env_remove("ECHOLAKE_LAKE"))?;
        let line = child.wait_for_line("  worker http://");
        let address = line.rsplit("//").next().context("an address")?.to_owned();
        Ok(Self { child, address })
    }
}

impl WorkerProcesses {
    /// Starts all of them, on a lake in a folder or on a small one of their own.
    ///
    /// # Errors
    /// A command fails.
    pub(crate) fn start(binary: &Path, lake: Option<&Path>, count: usize) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let path = folder.path();
        let lake = match lake {
            Some(lake) => lake.canonicalize()?,
            None => make_lake(binary, path)?,
        };
        std::fs::write(path.join("worker.token"), "0123456789abcdef0123456789abcdef\n")?;
        let token = make_token(binary, path)?;
        let start = |_| WorkerProcess::start(binary, &lake, path, "127.0.0.1:0");
        let workers = (0..count).map(start).collect::<Result<Vec<_>>>()?;
        let urls: Vec<_> = workers.iter().map(|worker| format!("http://{}", worker.address)).collect();
        let serve = |more: &[&str]| {
            let mut command = Command::new(binary);
            command.arg("--lake").arg(&lake).current_dir(path).env_remove("ECHOLAKE_LAKE");
            let temp = path.display().to_string();
            ServedLake::start_command(&mut command, &[&["--tokens", "tokens.toml", "--temp", &temp], more].concat())
        };
        let local = serve(&[]);
        let spread = serve(&["--workers", &urls.join(","), "--worker-token", "worker.token", "--spread-from", "0"]);
        Ok(Self { binary: binary.to_owned(), lake, workers, token, spread, local, _folder: folder })
    }

    fn client(&self, server: &ServedLake) -> QueryClient {
        let ServedLake { http, flight_sql, postgres, .. } = server;
        let addresses =
            ServerAddresses { http: http.clone(), flight_sql: flight_sql.clone(), postgres: postgres.clone() };
        QueryClient::new(addresses, &self.token, "")
    }

    /// Compares answers over workers with those without, and again in rounds in each of which a worker is killed.
    ///
    /// # Errors
    /// An answer over undisturbed workers differs, or a worker does not start again.
    pub(crate) fn check(&mut self, rounds: usize, seed: u64) -> Result<WorkersReport> {
        let right = take_right_answers(&self.client(&self.local), &QUERIES)?;
        let client = self.client(&self.spread);
        for ((protocol, sql), expected) in &right {
            let given = client.query(*protocol, sql);
            ensure!(given == *expected, "{sql} over {}: {given}, not what it is without workers", protocol.name());
        }
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut report = WorkersReport::default();
        for _ in 0..rounds {
            self.run_round(&client, &right, &mut random, &mut report)?;
        }
        Ok(report)
    }

    /// Lets a client go while its query computes; returns the time until all workers were idle. To be called before workers are
    /// killed: one that is started again is used after some seconds.
    ///
    /// # Errors
    /// A worker did not work, or is not idle for long.
    pub(crate) fn cancel_to_idle(&self) -> Result<Duration> {
        let trees: Vec<_> = self.workers.iter().map(|worker| ProcessTree::new(worker.child.id())).collect();
        let before: Duration = trees.iter().map(ProcessTree::processor_time).sum();
        let connection = HttpRequest::post("/api/v1/sql", ENDLESS)
            .with("content-type", "text/plain")
            .with("authorization", &format!("Bearer {}", self.token))
            .begin(&self.spread);
        let begun = Instant::now();
        let mut worked = Duration::ZERO;
        while worked < WORK_TIME {
            ensure!(begun.elapsed() < START_LIMIT, "the workers computed for {worked:?} only");
            std::thread::sleep(Duration::from_millis(50));
            worked = trees.iter().map(ProcessTree::processor_time).sum::<Duration>() - before;
        }
        drop(connection);
        let gone = Instant::now();
        let times = std::thread::scope(|scope| {
            let watches: Vec<_> =
                trees.iter().map(|tree| scope.spawn(move || tree.time_until_idle(gone, IDLE_LIMIT))).collect();
            watches.into_iter().map(|watch| watch.join().ok().flatten()).collect::<Option<Vec<_>>>()
        });
        times.context("a worker is not idle")?.into_iter().max().context("no workers")
    }

    fn run_round(
        &mut self,
        client: &QueryClient,
        right: &RightAnswers,
        random: &mut ChaCha8Rng,
        report: &mut WorkersReport,
    ) -> Result<()> {
        let questions: Vec<_> = right.iter().collect();
        let ((protocol, sql), expected) = questions.choose(random).context("a query")?;
        let (moment, victim) = (KILL_WITHIN.mul_f64(random.random()), random.random_range(0..self.workers.len()));
        let begun = Instant::now();
        let worker = &mut self.workers[victim];
        let outcome = std::thread::scope(|scope| {
            let query = scope.spawn(|| client.query(*protocol, sql));
            std::thread::sleep(moment);
            worker.child.kill();
            query.join()
        });
        let outcome = outcome.map_err(|_| anyhow::anyhow!("a client panicked"))?;
        report.add(*protocol, outcome, expected, begun.elapsed().as_secs_f64());
        let address = self.workers[victim].address.clone();
        self.workers[victim] = WorkerProcess::start(&self.binary, &self.lake, self._folder.path(), &address)?;
        Ok(())
    }

    // The sum of what all scans say, in the text of EXPLAIN ANALYZE.
    fn bytes_read(&self, server: &ServedLake, sql: &str) -> Result<u64> {
        let text = HttpRequest::post("/api/v1/sql?format=csv", &format!("explain analyze {sql}"))
            .with("content-type", "text/plain")
            .with("authorization", &format!("Bearer {}", self.token))
            .send(server)
            .text();
        Ok(text.split("bytes_scanned=").skip(1).filter_map(parse_bytes).sum())
    }
}

// As DataFusion writes numbers: `12.50 M`, `384`; a B is a billion.
fn parse_bytes(text: &str) -> Option<u64> {
    let end = text.find([',', ']', '\n', '}']).unwrap_or(text.len());
    let mut parts = text[..end].split_whitespace();
    let number: f64 = parts.next()?.parse().ok()?;
    let factor = match parts.next() {
        None => 1.0,
        Some("K") => 1e3,
        Some("M") => 1e6,
        Some("B") => 1e9,
        Some(_) => return None,
    };
    Some((number * factor) as u64)
}

impl WorkersReport {
    /// Returns whether no answer was wrong, and each that is not whole says why.
    pub(crate) fn is_goal_reached(&self) -> bool {
        self.wrong == 0 && self.others.is_empty()
    }

    fn add(&mut self, protocol: QueryProtocol, outcome: QueryOutcome, expected: &QueryOutcome, seconds: f64) {
        match outcome {
            right if right == *expected => {
                self.right += 1;
                self.slowest = self.slowest.max(seconds);
            }
            QueryOutcome::Answer(_) => self.wrong += 1,
            QueryOutcome::Refused(code) if LOST_CODES.contains(&code.as_str()) => self.lost += 1,
            // How HTTP shows an error after the first byte.
            QueryOutcome::Truncated if protocol == QueryProtocol::Http => self.lost += 1,
            other => *self.others.entry(format!("{} {other}", protocol.name())).or_default() += 1,
        }
    }
}

fn make_lake(binary: &Path, folder: &Path) -> Result<PathBuf> {
    std::fs::write(folder.join("rig.toml"), SMALL_RIG)?;
    for surface in SURFACES {
        run_echolake(
            binary,
            folder,
            &["--lake", "lake", "acquire", "--surface", surface, "--rig", "rig.toml", "--ir-only"],
        )?;
    }
    run_echolake(binary, folder, &["--lake", "lake", "ingest"])?;
    Ok(folder.join("lake"))
}

fn make_token(binary: &Path, folder: &Path) -> Result<String> {
    let made = run_echolake(binary, folder, &["token", "reader"])?;
    std::fs::write(folder.join("tokens.toml"), &made.0)?;
    Ok(made.1.lines().next().context("no token")?.to_owned())
}

fn run_echolake(binary: &Path, folder: &Path, args: &[&str]) -> Result<(String, String)> {
    let output = run_command(Command::new(binary).args(args).current_dir(folder).env_remove("ECHOLAKE_LAKE"))?;
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    ensure!(output.status.success(), "{args:?}: {stderr}");
    Ok((String::from_utf8_lossy(&output.stdout).into_owned(), stderr))
}
