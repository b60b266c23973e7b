//! Runs without sweeps: ingest against writing the same rows with the parquet crate alone.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Context as _, Result};
use echolake_acquisition::run::controller::RecordingMode;

use super::super::meter::{CostMeter, MeasuredCost};
use super::super::report::{BenchReport, FigureGoal};
use super::IngestBenchArgs;
use super::parquet_files::{FileRows, read_table_files};
use super::simulated::{IngestedLake, SimulationOrder};

pub(crate) async fn measure_responses(args: &IngestBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let runs = folder.join("responses");
    let order = SimulationOrder {
        count: args.runs(),
        keep: RecordingMode::ResponsesOnly,
        pairs: usize::MAX,
        seed: args.seed,
        folder: &runs,
    };
    let begun = Instant::now();
    let runs = order.make()?;
    let simulated = begun.elapsed().as_secs_f64() / args.runs() as f64;
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
    let of_panels = found.iter().filter(|file| !file.of_reference).map(FileRows::read).collect::<Result<Vec<_>>>()?;
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
    report.group("Simulated rig");
    let name = format!("a surface of {} pairs, responses only, {cores} cores", runs.all.accepted / args.runs() as u64);
    report.figure(name, simulated, "s").goal(FigureGoal::AtMost(2.8));
    report.group("Ingest of runs without sweeps");
    report.note(format!(
        "{} runs, two of them references: {all} impulse responses, {:.0} MB. Those that are none: {} Parquet files, \
         {:.0} MB. The parquet crate writes the same rows; its files have {:.2} of the size.",
        args.runs(),
        runs.all.bytes as f64 / 1e6,
        of_panels.len(),
        stored as f64 / 1e6,
        written as f64 / stored as f64
    ));
    let alone_by_wall = count / alone.wall;
    let parquet = "parquet crate alone";
    report
        .figure(format!("references there, {cores} cores"), count / panels.wall, "IRs/s")
        .beside(parquet, alone_by_wall);
    report.figure(format!("the references among them, {cores} cores"), all / whole.wall, "IRs/s");
    report
        .figure("CPU a response, references there", panels.cpu / count * 1e6, "us")
        .beside(parquet, alone.cpu / count * 1e6)
        .goal(FigureGoal::AtMost(108.0));
    report.figure("CPU a response, the references among them", whole.cpu / all * 1e6, "us");
    for (name, share) in [("CPU time", alone.cpu / panels.cpu), ("wall time", alone.wall / panels.wall)] {
        let name = format!("speed of response-only ingest / of the parquet crate, by {name}");
        report.figure(name, share, "x").goal(FigureGoal::AtLeast(0.36));
    }
    report.figure("peak memory, responses", peak, "MiB").goal(FigureGoal::AtMost(600.0));
    Ok(())
}

// Each file is encoded in memory, written, synced and renamed, and its folder synced, as the lake does it. Returns how
// many bytes they are.
fn write_all(rows: &[FileRows], folder: &Path) -> Result<usize> {
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
    Ok(super::super::run_on_cores(work)?.into_iter().sum())
}
