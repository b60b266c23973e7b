//! Queries over workers, as processes on this machine, beside the same queries in this process: the answers, how many
//! are spread, what each worker reads, and answers while workers are killed. With `--shares`, how much sooner machines
//! with a part of a core are done if there are more of them.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "figures are what it is for; progress goes to stderr")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use arrow::array::RecordBatch;
use echolake_lake::Lake;
use echolake_query::{
    ClusterSettings, EngineClient, Error, QueryEngine, QueryQuota, Session, WorkerCluster, WorkerToken,
};
use echolake_testing::{ChildProcess, SMALL_RIG, run_long_command};
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::differences::{AnswerRows, QueryGenerator, RowOrder};

/// Queries that read lists, by which answers are compared while workers are killed.
const HEAVY: [&str; 5] = [
    "select surface_id, pair_id, ir from measurements where pair_id % 29 = 1",
    "select surface_id, count(*) as n, max(ir[7]) as most, sum(list_energy(ir)) as e from measurements group by 1",
    "select m.surface_id, m.pair_id, n.nce_5000[100] as x from measurements m join nce n using (surface_id, pair_id)",
    "select count(distinct pair_id) as n from measurements where ir[20] <> 0",
    "select pair_id, surface_id, row_number() over (partition by pair_id order by surface_id) as n from measurements \
     where ir[3] <> 0",
];
/// A scan of curves, whose bytes workers share evenly.
const SCAN: &str = "select count(*) as n, max(nce_5000[100]) as most from nce where nce_5000[7] > -1";
/// Much to compute about each response.
const COMPUTING: &str = "select count(*) as n, max(band_energy(ir)['energy_2500']) as most from measurements";
/// Relative tolerance of floats: workers add in different orders.
const TOLERANCE: f64 = 1e-12;
/// A kill comes within this time of its query's start.
const KILL_WITHIN: Duration = Duration::from_millis(400);
/// Time after which a worker that was started again is used: that for which an answer of workers is good.
const CHECK_TIME: Duration = Duration::from_secs(6);
/// Surfaces of the lake that is made if none is given.
const SURFACES: [&str; 4] = ["flat", "foam", "wood", "brick"];
/// The token that workers share.
const TOKEN: &str = "0123456789abcdef0123456789abcdef";
/// Goals: largest over mean of the workers' bytes, and how much sooner four machines are done than one.
const IMBALANCE: f64 = 1.2;
const SPEEDUP: f64 = 3.2;
/// The part of a core that a machine has, and the period of which it is a part, microseconds.
const SHARE_MICROS: u32 = 25_000;
const PERIOD_MICROS: u32 = 100_000;

#[derive(Debug, clap::Args)]
pub(crate) struct WorkersArgs {
    /// Rounds with a killed worker.
    #[arg(default_value_t = 50)]
    rounds: usize,
    /// Workers.
    #[arg(long, default_value_t = 3)]
    workers: usize,
    /// A lake in a folder, as `echolake demo --surfaces 100 --ir-only --no-serve` makes one; by default a small one.
    #[arg(long, value_name = "FOLDER")]
    lake: Option<PathBuf>,
    /// Generated queries that are compared.
    #[arg(long, default_value_t = 60)]
    queries: usize,
    /// Seed of the queries, the moments and who is killed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Measure one and four machines of a quarter of a core, too; needs root.
    #[arg(long)]
    shares: bool,
}

pub(crate) fn run_workers(args: &WorkersArgs) -> Result<()> {
    let runtime = tokio::runtime::Runtime::new()?;
    let binary = super::echolake_path()?;
    let starting = WorkerMachines::start(&binary, args.lake.as_deref(), args.workers, None);
    let mut machines = runtime.block_on(starting)?;
    let report = runtime.block_on(machines.compare_answers(args.queries, args.seed))?;
    println!("{} queries over {} workers: {} spread, the others because", report.compared, args.workers, report.spread);
    for (reason, count) in &report.local {
        println!("  {reason}: {count}");
    }
    let imbalance = runtime.block_on(machines.measure_imbalance())?;
    println!("a scan of nce: largest over mean of the workers' bytes {imbalance:.2}");
    ensure!(imbalance <= IMBALANCE, "the goal is missed: {IMBALANCE}");
    let kills = runtime.block_on(machines.kill_workers(args.rounds, args.seed))?;
    println!(
        "{} rounds with a killed worker: {} whole (slowest {:.1} s), {} lost with an error",
        args.rounds, kills.whole, kills.slowest_secs, kills.lost
    );
    drop(machines);
    if args.shares {
        let lake = args.lake.as_deref().context("--shares needs --lake, a large one")?;
        runtime.block_on(measure_shares(&binary, lake))?;
    }
    Ok(())
}

/// Answers over workers beside those of one process.
#[derive(Debug, Default)]
pub(crate) struct ComparisonReport {
    pub compared: usize,
    pub spread: usize,
    /// The reasons of those that were not spread.
    pub local: BTreeMap<String, usize>,
}

/// Answers while workers were killed. None was wrong.
#[derive(Debug, Default)]
pub(crate) struct KillReport {
    pub whole: usize,
    /// Errors that tell that a worker was lost.
    pub lost: usize,
    slowest_secs: f64,
}

/// Workers as processes, and an engine in this one that uses them.
pub(crate) struct WorkerMachines {
    folder: tempfile::TempDir,
    binary: PathBuf,
    lake_folder: PathBuf,
    lake: Lake,
    workers: Vec<WorkerProcess>,
}

struct WorkerProcess {
    child: ChildProcess,
    address: String,
}

impl WorkerMachines {
    /// Starts the workers, on a lake in a folder or on a small one of their own; each in a control group of its own if
    /// `shares` names them.
    ///
    /// # Errors
    /// A command fails.
    pub async fn start(binary: &Path, lake: Option<&Path>, count: usize, shares: Option<&[CoreShare]>) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        std::fs::write(folder.path().join("worker.token"), TOKEN)?;
        let lake_folder = match lake {
            Some(lake) => lake.canonicalize()?,
            None => make_lake(binary, folder.path())?,
        };
        let opened = Lake::open(&lake_folder.display().to_string()).await?;
        let mut machines = Self { folder, binary: binary.to_owned(), lake_folder, lake: opened, workers: Vec::new() };
        for number in 0..count {
            let share = shares.and_then(|shares| shares.get(number));
            machines.workers.push(machines.start_worker("127.0.0.1:0", share)?);
        }
        Ok(machines)
    }

    fn start_worker(&self, address: &str, share: Option<&CoreShare>) -> Result<WorkerProcess> {
        let mut command = match share {
            Some(share) => share.limit_command(&self.binary),
            None => Command::new(&self.binary),
        };
        command.arg("--lake").arg(&self.lake_folder).args(["serve", "--worker", address]);
        command.args(["--worker-token", "worker.token"]).current_dir(self.folder.path()).env_remove("ECHOLAKE_LAKE");
        let mut child = ChildProcess::start(&mut command)?;
        let line = child.wait_for_line("  worker http://");
        let address = line.rsplit("//").next().context("an address")?.to_owned();
        Ok(WorkerProcess { child, address })
    }

    async fn open_cluster(&self) -> Result<Arc<WorkerCluster>> {
        let build = self.worker_build().await?;
        let settings = self.cluster_settings(build)?;
        Ok(Arc::new(WorkerCluster::new(&settings, self.lake.snapshot().await?.tables_id())?))
    }

    fn cluster_settings(&self, build: String) -> Result<ClusterSettings> {
        Ok(ClusterSettings {
            workers: self.workers.iter().map(|worker| format!("http://{}", worker.address)).collect(),
            token: Some(WorkerToken::parse(TOKEN)?),
            authorities: None,
            least_bytes: 0,
            build,
        })
    }

    // This program is another one than the workers', and made of the same sources: it takes their build for its own.
    async fn worker_build(&self) -> Result<String> {
        let cluster = WorkerCluster::new(&self.cluster_settings(String::new())?, "")?;
        let states = cluster.ask_workers().await;
        states.into_iter().find_map(|state| state.build).context("no worker answers")
    }

    fn open_session(&self, cluster: Option<&Arc<WorkerCluster>>) -> Result<Session> {
        let engine = QueryEngine::new(&self.lake, None)?;
        if let Some(cluster) = cluster {
            engine.spread_over(cluster.clone());
        }
        Ok(engine.open_session(&Arc::new(EngineClient::new("campaign", QueryQuota::default()))))
    }

    /// Compares answers of generated queries, of heavy ones and of the functions' examples with those of one process.
    ///
    /// # Errors
    /// An answer differs, or a query fails.
    pub async fn compare_answers(&self, queries: usize, seed: u64) -> Result<ComparisonReport> {
        let cluster = self.open_cluster().await?;
        let local = self.open_session(None)?;
        let spread = self.open_session(Some(&cluster))?;
        let generated = QueryGenerator::new(&local, seed).await?.generate_queries(queries);
        let examples = local.sql_functions().into_iter().filter(|function| function.is_own);
        let texts = HEAVY.iter().map(|sql| (*sql).to_owned()).chain(generated.into_iter().map(|(_, sql)| sql));
        let texts: Vec<_> = texts.chain(examples.filter_map(|function| example_query(&function.example?))).collect();
        let mut report = ComparisonReport::default();
        let count = texts.len();
        for sql in texts {
            eprintln!("query {} of {count}", report.compared + 1);
            let before = cluster.spread_counts();
            let expected = collect_rows(&local, &sql).await.with_context(|| sql.clone())?;
            let given = collect_rows(&spread, &sql).await.with_context(|| format!("over workers: {sql}"))?;
            if let Some(difference) = find_difference(&given, &expected)? {
                anyhow::bail!("{sql} over workers: {difference}");
            }
            let counts = cluster.spread_counts().since(&before);
            report.compared += 1;
            match counts.spread > counts.returned {
                true => report.spread += 1,
                false => *report.local.entry(self.find_reason(&spread, &sql).await?).or_default() += 1,
            }
        }
        Ok(report)
    }

    async fn find_reason(&self, spread: &Session, sql: &str) -> Result<String> {
        let text = format!("{:?}", collect_rows(spread, &format!("explain {sql}")).await?);
        let reason = text.split("not spread over workers: ").nth(1).unwrap_or("it failed on workers, and ran here");
        let reason: String = reason.chars().take_while(|c| *c != '\\' && *c != '\n').collect();
        // How much it reads differs from query to query.
        Ok(reason.chars().map(|c| if c.is_ascii_digit() { 'n' } else { c }).collect())
    }

    /// Returns the largest over the mean of the bytes that workers read in a scan of curves.
    ///
    /// # Errors
    /// The query fails, or a worker does not answer.
    pub async fn measure_imbalance(&self) -> Result<f64> {
        let before = self.read_bytes().await?;
        collect_rows(&self.open_session(Some(&self.open_cluster().await?))?, SCAN).await?;
        // Tasks are over when their engine closes their calls.
        tokio::time::sleep(Duration::from_secs(1)).await;
        let after = self.read_bytes().await?;
        let read: Vec<_> = after.iter().zip(&before).map(|(after, before)| after - before).collect();
        let mean = read.iter().sum::<u64>() as f64 / read.len() as f64;
        ensure!(mean > 0.0, "workers read nothing");
        Ok(read.into_iter().max().unwrap_or(0) as f64 / mean)
    }

    async fn read_bytes(&self) -> Result<Vec<u64>> {
        let states = self.open_cluster().await?.ask_workers().await;
        let bytes = states.into_iter().map(|state| Some((state.url, state.figures?.read_bytes)));
        let bytes: BTreeMap<_, _> = bytes.collect::<Option<_>>().context("a worker gives no figures")?;
        Ok(bytes.into_values().collect())
    }

    /// Kills a worker in each round while a query runs, and starts it again.
    ///
    /// # Errors
    /// An answer is neither whole nor an error that a worker was lost.
    pub async fn kill_workers(&mut self, rounds: usize, seed: u64) -> Result<KillReport> {
        let local = self.open_session(None)?;
        let mut right = Vec::new();
        for sql in HEAVY {
            right.push((sql, collect_rows(&local, sql).await?));
        }
        let cluster = self.open_cluster().await?;
        let spread = self.open_session(Some(&cluster))?;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut report = KillReport::default();
        for round in 0..rounds {
            eprintln!("kill {} of {rounds}", round + 1);
            let (sql, expected) = right.choose(&mut random).context("a query")?;
            let victim = random.random_range(0..self.workers.len());
            let moment = KILL_WITHIN.mul_f64(random.random());
            let begun = Instant::now();
            let worker = &mut self.workers[victim];
            let kill = async {
                tokio::time::sleep(moment).await;
                worker.child.kill();
            };
            let (answer, ()) = tokio::join!(collect_rows(&spread, sql), kill);
            match answer {
                Ok(given) => {
                    let difference = find_difference(&given, expected)?;
                    ensure!(difference.is_none(), "round {round}, {sql}: {difference:?}");
                    report.whole += 1;
                    report.slowest_secs = report.slowest_secs.max(begun.elapsed().as_secs_f64());
                }
                Err(error) => match error.downcast_ref::<Error>() {
                    Some(Error::WorkerLost { .. }) => report.lost += 1,
                    _ => return Err(error.context(format!("round {round}, {sql}"))),
                },
            }
            let address = self.workers[victim].address.clone();
            self.workers[victim] = self.start_worker(&address, None)?;
            let back = Instant::now();
            while cluster.ask_workers().await.iter().any(|state| state.problem.is_some()) {
                ensure!(back.elapsed() < 10 * CHECK_TIME, "a worker that was started again is not used");
            }
        }
        Ok(report)
    }
}

// Runs a query on one machine of a quarter of a core, and on four.
async fn measure_shares(binary: &Path, lake: &Path) -> Result<()> {
    for (name, sql) in [("a scan of curves", SCAN), ("band energies", COMPUTING)] {
        let mut times = Vec::new();
        for count in [1, 4] {
            let shares = (0..count).map(CoreShare::create).collect::<Result<Vec<_>>>()?;
            times.push(match count {
                1 => time_command(&shares[0], binary, lake, sql)?,
                _ => {
                    let machines = WorkerMachines::start(binary, Some(lake), count, Some(&shares)).await?;
                    let session = machines.open_session(Some(&machines.open_cluster().await?))?;
                    let begun = Instant::now();
                    collect_rows(&session, sql).await?;
                    begun.elapsed().as_secs_f64()
                }
            });
        }
        let speedup = times[0] / times[1];
        println!("{name}: 1 machine {:.1} s, 4 machines {:.1} s, {speedup:.2} times", times[0], times[1]);
        ensure!(speedup >= SPEEDUP, "the goal is missed: {SPEEDUP} times");
    }
    Ok(())
}

// What a command takes for a query, without what it takes to start and to read the lake's logs.
fn time_command(share: &CoreShare, binary: &Path, lake: &Path, sql: &str) -> Result<f64> {
    let time = |sql: &str| -> Result<f64> {
        let mut command = share.limit_command(binary);
        command.arg("--lake").arg(lake).args(["sql", sql]).env_remove("ECHOLAKE_LAKE");
        let begun = Instant::now();
        let output = run_long_command(&mut command)?;
        ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Ok(begun.elapsed().as_secs_f64())
    };
    let empty = time("select count(*) from runs")?;
    Ok(time(sql)? - empty)
}

/// A control group of a quarter of a core.
pub(crate) struct CoreShare(PathBuf);

impl CoreShare {
    fn create(number: usize) -> Result<Self> {
        let root = Path::new("/sys/fs/cgroup");
        let is_first_version = root.join("cpu").is_dir();
        let parent = if is_first_version { root.join("cpu") } else { root.to_owned() };
        let folder = parent.join(format!("echolake-{}-{number}", std::process::id()));
        std::fs::create_dir(&folder).with_context(|| format!("cannot make `{}`", folder.display()))?;
        let share = Self(folder);
        if is_first_version {
            std::fs::write(share.0.join("cpu.cfs_period_us"), PERIOD_MICROS.to_string())?;
            std::fs::write(share.0.join("cpu.cfs_quota_us"), SHARE_MICROS.to_string())?;
        } else {
            std::fs::write(share.0.join("cpu.max"), format!("{SHARE_MICROS} {PERIOD_MICROS}"))?;
        }
        Ok(share)
    }

    fn limit_command(&self, binary: &Path) -> Command {
        let mut command = Command::new("sh");
        let enter = "echo $$ > \"$0\" && exec \"$@\"";
        command.args(["-c", enter]).arg(self.0.join("cgroup.procs")).arg(binary);
        command
    }
}

impl Drop for CoreShare {
    fn drop(&mut self) {
        // Its processes end a moment after they were killed.
        for _ in 0..50 {
            if std::fs::remove_dir(&self.0).is_ok() {
                return;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

// Its answer is the function's, and not compared here.
fn example_query(example: &str) -> Option<String> {
    let text = example.trim_start_matches("```sql\n> ");
    Some(text.split_once(";\n")?.0.to_owned())
}

async fn collect_rows(session: &Session, sql: &str) -> Result<Vec<RecordBatch>> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok(batches)
}

fn find_difference(given: &[RecordBatch], expected: &[RecordBatch]) -> Result<Option<String>> {
    let expected = AnswerRows::read(expected)?.with_tolerance(TOLERANCE);
    Ok(expected.find_difference(AnswerRows::read(given)?, RowOrder::Free))
}

fn make_lake(binary: &Path, folder: &Path) -> Result<PathBuf> {
    std::fs::write(folder.join("rig.toml"), SMALL_RIG)?;
    for surface in SURFACES {
        run_echolake(binary, folder, &["acquire", "--surface", surface, "--rig", "rig.toml", "--ir-only"])?;
    }
    run_echolake(binary, folder, &["ingest"])?;
    Ok(folder.join("lake"))
}

fn run_echolake(binary: &Path, folder: &Path, args: &[&str]) -> Result<()> {
    let mut command = Command::new(binary);
    command.args(["--lake", "lake"]).args(args).current_dir(folder).env_remove("ECHOLAKE_LAKE");
    let output = run_long_command(&mut command)?;
    ensure!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}
