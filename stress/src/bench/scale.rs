//! Costs against the size of a lake: short runs of the simulated rig are ingested step by step.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use echolake_acquisition::run::controller::RecordingMode;
use echolake_figures::{FigureNotes, GrowthFigure};
use echolake_ingest::{FileReport, LakeIngest, pending_runs};
use echolake_lake::{Lake, ReferenceSurfaces, TARGET_BYTES};
use echolake_query::Session;
use echolake_schema::Rig;

use super::ingest::simulated::{SimulationOrder, put_into_inbox};
use super::meter::{forget_peak, peak_mib};
use super::queries::{bench_queries, median, middle_surface};
use super::report::{BenchReport, FigureGoal};
use crate::differences::collect_batches;

/// Timed repeats of queries.
const REPEATS: usize = 5;
/// Power of the number of surfaces with which a cost may grow: in proportion, and what timing adds.
const HIGHEST_POWER: f64 = 1.1;
/// Those of the twelve queries that pages send.
const PAGE_QUERIES: [&str; 3] = ["catalogue_page", "facets", "one_ir"];

/// A server that has answered before, and that sees a lake again after a commit.
const NEW_SNAPSHOT: &str = "new snapshot after a commit";
/// Its goals: number of surfaces, milliseconds.
const SNAPSHOT_GOALS: [(usize, f64); 2] = [(350, 20.0), (3500, 50.0)];

#[derive(Debug, clap::Args)]
pub(crate) struct ScaleBenchArgs {
    /// Numbers of surfaces, ascending.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [10, 35, 100, 350])]
    pub surfaces: Vec<usize>,
    /// Pairs of each run.
    #[arg(long, value_name = "N", default_value_t = 300)]
    pub pairs: usize,
    /// Parent of the temporary folder.
    #[arg(long, value_name = "DIR")]
    pub folder: Option<PathBuf>,
    /// Seed of the simulated rig.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

pub(crate) async fn measure_scale(args: &ScaleBenchArgs, report: &mut BenchReport) -> Result<()> {
    let folder = super::temporary_folder(args.folder.as_deref())?;
    let count = *args.surfaces.iter().max().context("no numbers of surfaces")?;
    ensure!(args.surfaces.is_sorted() && args.surfaces[0] > 2, "--surfaces: not ascending, or not more than 2");
    report.group("Cost against size");
    report.note(format!(
        "Runs of {} pairs of the simulated rig, without sweeps. Files are not merged; `optimize` merges those of a \
         copy. A cost that grows in proportion to the surfaces has power 1.",
        args.pairs
    ));
    let runs = folder.path().join("runs");
    let order = SimulationOrder {
        count,
        keep: RecordingMode::ResponsesOnly,
        pairs: args.pairs,
        seed: args.seed,
        folder: &runs,
    };
    let files = order.make()?.files;
    let lake = folder.path().join("lake");
    Lake::open_or_create(&lake.display().to_string(), &Rig::paper(), &ReferenceSurfaces::default()).await?;
    let mut costs: Vec<(&str, Vec<f64>)> = Vec::new();
    let mut ingested = 0;
    for size in &args.surfaces {
        ingest_files(&lake, &files[ingested..size - 1]).await?;
        ingested = *size;
        forget_peak();
        let measured = measure_size(&lake, &files[size - 1..*size]).await?;
        let peak = peak_mib()?;
        for (place, (name, seconds)) in measured.into_iter().enumerate() {
            let figure = report.figure(format!("{name}, {size} surfaces"), seconds * 1e3, "ms");
            if let Some((_, most_ms)) = SNAPSHOT_GOALS.iter().find(|(at, _)| name == NEW_SNAPSHOT && at == size) {
                figure.goal(FigureGoal::AtMost(*most_ms));
            }
            if costs.len() == place {
                costs.push((name, Vec::new()));
            }
            costs[place].1.push(seconds);
        }
        report.figure(format!("peak memory of these, {size} surfaces"), peak, "MiB");
    }
    let sizes: Vec<_> = args.surfaces.iter().map(|size| *size as f64).collect();
    if let [.., before, last] = sizes[..] {
        for (name, seconds) in &costs {
            let power = (seconds[seconds.len() - 1] / seconds[seconds.len() - 2]).ln() / (last / before).ln();
            let name = format!("{name}: power of growth from {before} to {last} surfaces");
            report.figure(name, power, "").goal(FigureGoal::AtMost(HIGHEST_POWER));
        }
    }
    let figure = GrowthFigure {
        size_title: "Surfaces".into(),
        cost_title: "Time, s".into(),
        sizes,
        costs: costs.into_iter().map(|(name, seconds)| (name.to_owned(), seconds)).collect(),
        width_px: 720.0,
    };
    let origin = FigureNotes::of_lake(String::new(), std::iter::once("simulated".to_owned()));
    let notes = FigureNotes { title: "Cost against size (simulated runs)".into(), ..origin };
    report.picture("scale", figure.draw(&notes).to_svg());
    Ok(())
}

async fn ingest_files(lake: &Path, files: &[PathBuf]) -> Result<()> {
    put_into_inbox(files, lake)?;
    let lake = Lake::open(&lake.display().to_string()).await?;
    let ingest = LakeIngest::new(&lake, Arc::default());
    let mut refused = Vec::new();
    let mut note_refusal = |report| {
        if !matches!(report, FileReport::Ingested(_)) {
            refused.push(format!("{report:?}"));
        }
    };
    ingest.ingest_runs(pending_runs(&lake).await?, &mut note_refusal).await?;
    ingest.complete_runs(&mut |_, _| {}).await?;
    ensure!(refused.is_empty(), "refused: {}", refused.join("; "));
    Ok(())
}

// Names and seconds.
async fn measure_size(folder: &Path, one_more: &[PathBuf]) -> Result<Vec<(&'static str, f64)>> {
    let url = folder.display().to_string();
    let open_session = async || Session::new(&Lake::open(&url).await?).map_err(anyhow::Error::from);
    let before = open_session().await?;
    let see_runs = "SELECT 1 FROM runs";
    collect_batches(&before, see_runs).await?;
    let begun = Instant::now();
    ingest_files(folder, one_more).await?;
    let mut measured = vec![("ingest of one more run", begun.elapsed().as_secs_f64())];
    before.expire_snapshot();
    let begun = Instant::now();
    collect_batches(&before, see_runs).await?;
    measured.push((NEW_SNAPSHOT, begun.elapsed().as_secs_f64()));
    drop(before);
    let mut times = Vec::new();
    for _ in 0..REPEATS {
        let begun = Instant::now();
        collect_batches(&open_session().await?, see_runs).await?;
        times.push(begun.elapsed().as_secs_f64());
    }
    measured.push(("snapshot", median(times)));
    let lake = Lake::open(&url).await?;
    let session = Session::new(&lake)?;
    let queries = bench_queries(&middle_surface(&lake).await?, 123);
    for name in PAGE_QUERIES {
        let query = queries.iter().find(|query| query.name == name).context("no such query")?;
        let mut times = Vec::new();
        for _ in 0..=REPEATS {
            let begun = Instant::now();
            collect_batches(&session, &query.sql).await?;
            times.push(begun.elapsed().as_secs_f64());
        }
        measured.push((name, median(times.split_off(1))));
    }
    let copy = folder.with_extension("copy");
    // Files of a lake are never changed in their place, so that links are a copy.
    let copied = Command::new("cp").arg("-al").args([folder, &copy]).status()?;
    ensure!(copied.success(), "`cp -al` failed");
    let begun = Instant::now();
    let copied = Lake::open(&copy.display().to_string()).await?;
    copied.optimize(TARGET_BYTES, &AtomicBool::new(false), &mut |_| {}).await?;
    measured.push(("optimize", begun.elapsed().as_secs_f64()));
    std::fs::remove_dir_all(&copy)?;
    Ok(measured)
}
