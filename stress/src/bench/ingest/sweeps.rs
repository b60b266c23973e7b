//! Recordings with sweeps: ingest against the transforms that it cannot avoid and against the reference pipeline.

use std::hint::black_box;
use std::io::Write as _;
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use echolake_acquisition::run::controller::RecordingMode;
use echolake_dsp::RealSample as _;
use echolake_dsp::deconvolution::fast_length;
use echolake_schema::messages::SweepRecording;
use echolake_schema::{samples, topics};
use mcap::MessageStream;
use prost::Message as _;

use super::super::meter::{CostMeter, MeasuredCost};
use super::super::report::{BenchReport, FigureGoal};
use super::IngestBenchArgs;
use super::simulated::{SimulatedRuns, SimulationOrder};

/// Runs: Flat, Foam and two others.
const RUNS: usize = 4;
/// Recordings that the bare transforms and Python get.
const SAMPLED: usize = 60;
/// Samples of a sweep of 0.5 s alone; recordings have a tail.
const SWEEP_LEN: usize = 48_000;
/// The clock's ticks are coarse, so the bare transforms are repeated for this long.
const BARE_SECS: f64 = 1.0;
const PROCESS: &str = include_str!("process.py");

struct SampledRecording {
    celsius: f64,
    microphone: Vec<f32>,
    loopback: Vec<f32>,
}

pub(crate) async fn measure_sweeps(args: &IngestBenchArgs, folder: &Path, report: &mut BenchReport) -> Result<()> {
    let runs = folder.join("sweeps");
    let order = SimulationOrder {
        count: RUNS,
        keep: RecordingMode::Sweeps,
        pairs: args.pairs(),
        seed: args.seed,
        folder: &runs,
    };
    let runs = order.make()?;
    let recordings = sample_recordings(&runs)?;
    let length = recordings.first().context("no recordings")?.microphone.len();
    let padded = fast_length(length);
    let mut whole = MeasuredCost::NONE;
    let mut panels = MeasuredCost::NONE;
    let mut bare = f64::INFINITY;
    let mut unpadded = f64::INFINITY;
    let mut peak: f64 = 0.0;
    for _ in 0..args.repeats() {
        let ingested = runs.ingest(&folder.join("lake")).await?;
        whole = whole.least(ingested.whole);
        panels = panels.least(ingested.panels);
        peak = peak.max(ingested.peak_mib);
        bare = bare.min(time_transforms(&recordings, padded)?);
        unpadded = unpadded.min(time_transforms(&recordings, SWEEP_LEN)?);
    }
    let count = runs.panels.attempts as f64;
    let all = runs.all.attempts as f64;
    let each = panels.cpu / count;
    report.group("Ingest of runs with sweeps");
    report.note(format!(
        "{RUNS} runs, two of them references: {all} recordings of {length} samples, two channels, 24 bit; {:.0} MB. \
         Bare transforms: two of {padded} samples, padded as ingest does.",
        runs.all.bytes as f64 / 1e6
    ));
    let transforms = "two bare transforms";
    report.figure("CPU a recording, references there", each * 1e6, "us").beside(transforms, bare * 1e6);
    report
        .figure("CPU a recording, the references among them", whole.cpu / all * 1e6, "us")
        .beside(transforms, bare * 1e6);
    report.figure("wall time a recording, references there, all cores", panels.wall / count * 1e6, "us");
    report.figure("ingest with sweeps / two bare transforms, CPU", each / bare, "x").goal(FigureGoal::AtMost(4.2));
    report
        .figure(format!("the same beside transforms of {SWEEP_LEN} samples (the sweep alone)"), each * 1e6, "us")
        .beside("two bare transforms", unpadded * 1e6);
    match time_reference(args, folder, &recordings) {
        Ok(process) => {
            report
                .figure("SciPy pipeline on one core / ingest, CPU a recording", process / each, "x")
                .goal(FigureGoal::AtLeast(18.0));
        }
        Err(why) => report.note(format!("The SciPy pipeline was skipped: {why:#}.")),
    }
    report.figure("peak memory, sweeps", peak, "MiB").goal(FigureGoal::AtMost(600.0));
    Ok(())
}

// Recordings spread over the last run, because the reference pipeline's cost depends on the temperature.
fn sample_recordings(runs: &SimulatedRuns) -> Result<Vec<SampledRecording>> {
    let bytes = std::fs::read(runs.files.last().context("no runs")?)?;
    let mut found = Vec::new();
    let every = (runs.all.attempts as usize / RUNS / SAMPLED).max(1);
    let mut number = 0;
    for message in MessageStream::new(&bytes)? {
        let message = message?;
        if message.channel.topic != topics::SWEEP {
            continue;
        }
        if number % every == 0 && found.len() < SAMPLED {
            found.push(SampledRecording::read(&message.data)?);
        }
        number += 1;
    }
    Ok(found)
}

impl SampledRecording {
    fn read(data: &[u8]) -> Result<Self> {
        let sweep = SweepRecording::decode(data)?;
        let (mut microphone, mut loopback) =
            (vec![0.0; sweep.sample_count as usize], vec![0.0; sweep.sample_count as usize]);
        samples::decode_samples(sweep.format(), &sweep.microphone, &mut microphone)?;
        samples::decode_samples(sweep.format(), &sweep.loopback, &mut loopback)?;
        Ok(Self { celsius: sweep.temperature_c, microphone, loopback })
    }
}

// CPU seconds that the two transforms of a recording take, of `length` samples each.
fn time_transforms(recordings: &[SampledRecording], length: usize) -> Result<f64> {
    let forward = f32::plan_real_forward(length);
    let mut input = forward.make_input_vec();
    let mut spectrum = forward.make_output_vec();
    let mut work = forward.make_scratch_vec();
    let meter = CostMeter::start()?;
    let begun = std::time::Instant::now();
    let mut done = 0;
    while begun.elapsed().as_secs_f64() < BARE_SECS {
        for SampledRecording { microphone, loopback, .. } in recordings {
            for signal in [microphone, loopback] {
                let count = signal.len().min(length);
                input[..count].copy_from_slice(&signal[..count]);
                input[count..].fill(0.0);
                forward.process_with_scratch(&mut input, &mut spectrum, &mut work)?;
                black_box(&spectrum);
            }
        }
        done += recordings.len();
    }
    Ok(meter.stop()?.cpu / done as f64)
}

// CPU seconds that the reference pipeline takes per recording, on one core.
fn time_reference(args: &IngestBenchArgs, folder: &Path, recordings: &[SampledRecording]) -> Result<f64> {
    let pipeline = args.reference.join("pipeline.py");
    ensure!(pipeline.is_file(), "no `{}`; hint: --reference DIR", pipeline.display());
    let file = folder.join("recordings.f32");
    let mut out = std::io::BufWriter::new(std::fs::File::create(&file)?);
    for SampledRecording { celsius, microphone, loopback } in recordings {
        out.write_all(&(*celsius as f32).to_le_bytes())?;
        for x in microphone.iter().chain(loopback) {
            out.write_all(&x.to_le_bytes())?;
        }
    }
    out.flush()?;
    let length = recordings.first().map_or(0, |r| r.microphone.len());
    let done = Command::new(&args.python)
        .args(["-c", PROCESS])
        .args([&args.reference, &file])
        .args([length.to_string(), args.repeats().min(2).to_string()])
        .envs(["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"].map(|name| (name, "1")))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .with_context(|| format!("`{}` does not start; hint: --python PATH", args.python.display()))?;
    let said = String::from_utf8_lossy(&done.stderr);
    ensure!(done.status.success(), "{}; hint: --python PATH", said.lines().last().unwrap_or("it failed"));
    Ok(String::from_utf8_lossy(&done.stdout).trim().parse()?)
}
