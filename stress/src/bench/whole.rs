//! All benchmarks on one lake, which is made for them.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context as _, Result, anyhow, ensure};
use echolake_acquisition::run::controller::RecordingMode;
use echolake_lake::Lake;

use super::FULL_LAKE_RESPONSES;
use super::ingest::simulated::{SimulationOrder, put_into_inbox};
use super::ingest::{IngestBenchArgs, lake_size, responses, sweeps};
use super::limits::measure_limits;
use super::mcap::{McapBenchArgs, measure_mcap};
use super::queries::{QueryBenchArgs, measure_queries};
use super::readers::{QuestionKind, ReadersArgs, measure_readers};
use super::report::{BenchReport, FigureGoal};
use super::scale::{ScaleBenchArgs, measure_scale};
use super::served_costs::{measure_full_stores, measure_pair_pages};
use crate::serve::server::ServedLake;
use crate::{block_on, echolake_path};

#[derive(Debug, clap::Args)]
pub(crate) struct WholeBenchArgs {
    /// Smaller runs and fewer repeats: a few minutes.
    #[arg(long)]
    quick: bool,
    /// Surfaces of the lake that is made; 350 by default, 6 with `--quick`.
    #[arg(long, value_name = "N")]
    surfaces: Option<u32>,
    /// A lake whose run files are ingested again, instead of simulated ones. It is only read. If there is no such folder,
    /// the simulated run files are kept there for the next time.
    #[arg(long, value_name = "FOLDER")]
    lake: Option<PathBuf>,
    /// A Python that has duckdb, pyarrow, mcap, mcap-protobuf-support, NumPy and SciPy; without one, no peers.
    #[arg(long, value_name = "PATH")]
    python: Option<PathBuf>,
    /// Folder of `pipeline.py`.
    #[arg(long, value_name = "DIR", default_value = "../shared/reference")]
    reference: PathBuf,
    /// Generated queries.
    #[arg(long, value_name = "N", default_value_t = 60)]
    generated: usize,
    /// Parent of the temporary folder; it should be on the disk that the lake would be on.
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Seed of the simulated rig and of the generated queries.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

pub(crate) fn measure_whole(args: &WholeBenchArgs, report: &mut BenchReport) -> Result<()> {
    let folder = super::temporary_folder(args.folder.as_deref())?;
    // A part that fails must not take the others' figures with it.
    let parts: [(&str, PartMeasurement); 5] = [
        ("ingest of a lake", measure_lake_ingest),
        ("queries", measure_lake_queries),
        ("readers", measure_lake_readers),
        ("ingest", measure_ingest_cost),
        ("cost against size", measure_growth),
    ];
    for (name, measure_part) in parts {
        if let Err(why) = measure_part(args, folder.path(), report) {
            report.fail(format!("{name}: {why:#}"));
        }
    }
    Ok(())
}

type PartMeasurement = fn(&WholeBenchArgs, &Path, &mut BenchReport) -> Result<()>;

// From run files to a lake that has answered a query.
fn measure_lake_ingest(args: &WholeBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let fresh = folder.join("lake");
    match &args.lake {
        Some(lake) => {
            if !lake.exists() {
                make_runs(args, lake)?;
            }
            link_runs(lake, &fresh)?;
        }
        None => make_runs(args, &fresh)?,
    }
    let begun = Instant::now();
    run_echolake(&fresh, &["ingest"])?;
    let counted = run_echolake(&fresh, &["sql", "--format", "csv", "select count(*) from measurements"])?;
    let seconds = begun.elapsed().as_secs_f64();
    let responses: f64 = counted.lines().nth(1).context("no count")?.trim().parse()?;
    report.group("From run files to a lake");
    report.note(format!(
        "`echolake ingest` of {responses} responses and a first query took {seconds:.1} s; scaled to \
         {FULL_LAKE_RESPONSES}."
    ));
    let name = "a million responses from run files to a queryable lake";
    report.figure(name, seconds * FULL_LAKE_RESPONSES as f64 / responses, "s").goal(FigureGoal::AtMost(57.0));
    block_on(async {
        let lake = Lake::open(&folder.join("lake").display().to_string()).await?;
        let run =
            lake.snapshot().await?.runs().next().map(|r| Lake::run_path(&r.surface, &r.run)).context("no runs")?;
        measure_limits(folder.join("lake").join(run.as_ref()), report)?;
        lake_size::measure_lake_size(&lake, report).await
    })
}

fn measure_lake_queries(args: &WholeBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let queries = QueryBenchArgs {
        lake: folder.join("lake").display().to_string(),
        python: args.python.clone(),
        generated: args.generated,
        seed: args.seed,
        runs: if args.quick { 3 } else { 5 },
        threads: std::thread::available_parallelism().map_or(1, usize::from),
        only: String::new(),
        explain: false,
        folder: Some(folder.to_owned()),
    };
    block_on(measure_queries(&queries, report))
}

fn measure_lake_readers(args: &WholeBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let served = ServedLake::start(&echolake_path()?, folder, &[]);
    let load = |readers, is_ingesting| ReadersArgs {
        address: served.http.clone(),
        readers,
        seconds: if args.quick { 5 } else { 60 },
        kind: QuestionKind::All,
        certificate: None,
        token: None,
        pid: Some(served.id()),
        is_ingesting,
    };
    block_on(async {
        let lake = Lake::open(&folder.join("lake").display().to_string()).await?;
        measure_pair_pages(&served, &lake, args.seed, report).await?;
        for readers in [10, 200] {
            measure_readers(&load(readers, false), report)?;
        }
        measure_full_stores(&served, &lake, report)
    })?;
    let again = SimulationOrder {
        count: if args.quick { 3 } else { 20 },
        keep: RecordingMode::ResponsesOnly,
        pairs: usize::MAX,
        seed: args.seed,
        folder: &folder.join("again"),
    };
    let files = again.make()?.files;
    let lake = folder.join("lake");
    let has_ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // One after the other, and each by a command of its own, as a rig's runs come.
        let ingest = scope.spawn(|| {
            for file in files.iter().take_while(|_| !has_ended.load(Ordering::Relaxed)) {
                put_into_inbox(std::slice::from_ref(file), &lake)?;
                run_echolake(&lake, &["ingest"])?;
            }
            Ok(())
        });
        let measured = measure_readers(&load(200, true), report);
        has_ended.store(true, Ordering::Relaxed);
        let ingested = ingest.join().map_err(|_| anyhow!("the ingest panicked"))?;
        measured.and(ingested)
    })
}

fn measure_ingest_cost(args: &WholeBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let ingest = IngestBenchArgs {
        quick: args.quick,
        pairs: None,
        runs: None,
        repeats: None,
        python: args.python.clone().unwrap_or_else(|| "python3".into()),
        reference: args.reference.clone(),
        folder: None,
        seed: args.seed,
    };
    let folder = folder.join("ingest");
    std::fs::create_dir(&folder)?;
    block_on(async {
        sweeps::measure_sweeps(&ingest, &folder, report).await?;
        let lake = folder.join("lake").display().to_string();
        measure_mcap(&McapBenchArgs { lake, pattern: "*".to_owned(), python: args.python.clone() }, report).await?;
        responses::measure_responses(&ingest, &folder, report).await
    })
}

fn measure_growth(args: &WholeBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let scale = ScaleBenchArgs {
        surfaces: if args.quick { vec![4, 8, 16] } else { vec![10, 35, 100, 350] },
        pairs: if args.quick { 20 } else { 300 },
        folder: Some(folder.to_owned()),
        seed: args.seed,
    };
    block_on(measure_scale(&scale, report))
}

// Makes a lake with simulated run files in its inbox.
fn make_runs(args: &WholeBenchArgs, lake: &Path) -> Result<()> {
    let surfaces = args.surfaces.unwrap_or(if args.quick { 6 } else { 350 }).to_string();
    let seed = args.seed.to_string();
    let order = ["demo", "--no-serve", "--no-ingest", "--ir-only", "--surfaces", &surfaces, "--seed", &seed];
    run_echolake(lake, &order).map(drop)
}

// Runs `echolake` on a lake, and returns its output.
fn run_echolake(lake: &Path, args: &[&str]) -> Result<String> {
    let mut command = Command::new(echolake_path()?);
    command.arg("--lake").arg(lake).args(args).env_remove("ECHOLAKE_LAKE");
    let output = command.stderr(Stdio::inherit()).output()?;
    ensure!(output.status.success(), "`echolake {}` failed", args.join(" "));
    Ok(String::from_utf8(output.stdout)?)
}

// Makes a new lake whose inbox has the run files of another one.
fn link_runs(from: &Path, lake: &Path) -> Result<()> {
    let inbox = lake.join("inbox");
    std::fs::create_dir_all(&inbox)?;
    std::fs::copy(from.join("lake.toml"), lake.join("lake.toml"))?;
    let mut folders = vec![from.join("inbox")];
    for surface in std::fs::read_dir(from.join("runs")).into_iter().flatten() {
        folders.push(surface?.path());
    }
    let mut linked = 0;
    for run in folders.iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flatten() {
        let run = run?;
        if run.path().extension().is_none_or(|kind| kind != "mcap") {
            continue;
        }
        let target = inbox.join(run.file_name());
        // Another file system has no links into this one.
        if std::fs::hard_link(run.path(), &target).is_err() {
            std::fs::copy(run.path(), &target)?;
        }
        linked += 1;
    }
    ensure!(linked > 0, "no run files in `{}`", from.display());
    Ok(())
}
