//! Runs without sweeps: ingest against writing the same rows with the parquet crate alone.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context as _, Result};
use echolake_acquisition::run::controller::RecordingMode;

use super::IngestBenchArgs;
use super::meter::{CostMeter, MeasuredCost};
use super::parquet_files::{FileRows, read_table_files};
use super::report::{FigureGoal, FigureReport};
use super::simulated::{IngestedLake, SimulationOrder};
use super::{lake_size, layout};

pub(crate) async fn measure_responses(args: &IngestBenchArgs, folder: &Path, report: &mut FigureReport) -> Result<()> {
    let runs = folder.join("responses");
    let order = SimulationOrder {
        count: args.runs(),
        keep: RecordingMode::ResponsesOnly,
        pairs: usize::MAX,
        seed: args.seed,
        folder: &runs,
    };
    let runs = order.make()?;
    let mut whole = MeasuredCost::NONE;
    let mut panels = MeasuredCost::NONE;
    let mut alone = MeasuredCost::NONE;
    let (mut peak, mut last): (f64, Option<IngestedLake>) = (0.0, None);
    for _ in 0..args.repeats() {
        let ingested = runs.ingest(&folder.join("lake")).await?;
        whole = whole.least(ingested.whole);
        panels = panels.least(ingested.panels);
        peak = peak.max(ingested.peak_mib);
        last = Some(ingested);
    }
    let last = last.context("no repeats")?;
    let found = read_table_files(&last.lake).await?;
    let rows = found.iter().map(FileRows::read).collect::<Result<Vec<_>>>()?;
    let of_panels: Vec<_> = rows.iter().filter(|r| !r.of_reference).collect();
    let mut written = 0;
    for _ in 0..args.repeats() {
        let target = folder.join("written");
        fs::create_dir_all(&target)?;
        let meter = CostMeter::start()?;
        written = write_all(&of_panels, &target)?;
        alone = alone.least(meter.stop()?);
        fs::remove_dir_all(&target)?;
    }
    let stored: u64 = of_panels.iter().map(|r| r.bytes).sum();
    let count = runs.panels.accepted as f64;
    let all = runs.all.accepted as f64;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    report.title(&format!(
        "{} runs without sweeps, two of them references: {all} impulse responses, {:.0} MB",
        args.runs(),
        runs.all.bytes as f64 / 1e6
    ))?;
    report.line(&format!(
        "of those that are none: {} Parquet files, {:.0} MB",
        of_panels.len(),
        stored as f64 / 1e6
    ))?;
    report.figure(&format!("ingest, references there, {cores} cores"), count / panels.wall, "IRs a second")?;
    report.figure(&format!("ingest with the references', {cores} cores"), all / whole.wall, "IRs a second")?;
    report.figure(&format!("parquet crate alone, {cores} threads"), count / alone.wall, "IRs a second")?;
    report.figure("ingest, references there, CPU a response", panels.cpu / count * 1e6, "us")?;
    report.figure("ingest with the references', CPU a response", whole.cpu / all * 1e6, "us")?;
    report.figure("parquet crate alone, CPU a response", alone.cpu / count * 1e6, "us")?;
    report.figure("size of what it wrote / of the lake's files", written as f64 / stored as f64, "x")?;
    report.goal("speed of ingest / of the parquet crate, by CPU time", 100.0 * alone.cpu / panels.cpu, "%", HALF)?;
    report.figure("the same by wall time", 100.0 * alone.wall / panels.wall, "%")?;
    report.goal("peak memory of the ingest", peak, "MiB", FigureGoal::AtMost(600.0))?;
    lake_size::measure_lake_size(&last, &found, report)?;
    layout::measure_layouts(args, &found, &rows, report)
}

const HALF: FigureGoal = FigureGoal::AtLeast(50.0);

// Each file is encoded in memory, written, synced and renamed, and its folder synced, as the lake does it. Returns how
// many bytes they are.
fn write_all(rows: &[&FileRows], folder: &Path) -> Result<usize> {
    let next = AtomicUsize::new(0);
    let work = || -> Result<usize> {
        let mut bytes = 0;
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let Some(rows) = rows.get(number) else { return Ok(bytes) };
            let encoded = rows.write(&rows.properties)?;
            let temporary = folder.join(format!("{number}#"));
            let path = folder.join(format!("{number}.parquet"));
            let mut file = File::create_new(&temporary)?;
            file.write_all(&encoded)?;
            file.sync_all()?;
            fs::rename(&temporary, &path)?;
            File::open(folder)?.sync_all()?;
            bytes += encoded.len();
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
        threads.into_iter().map(|t| t.join().ok().context("a thread panicked").flatten()).sum()
    })
}
