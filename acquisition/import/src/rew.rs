//! Import of responses that Room EQ Wizard (REW) measured, listed in a CSV manifest, one run per surface.
//!
//! Sample 0 of a run's response is the instant of emission. REW's text export has the time of its first sample, less
//! the timing offset that REW was set to, which no export has; a WAV file has neither of them.

mod rew_text;
#[cfg(test)]
mod tests;

use std::path::Path;

use echolake_acquisition::run::recorder::{LogLevel, RunStart};
use echolake_dsp::air::AirState;
use echolake_dsp::geometry::direct_mm;
use echolake_dsp::temperature::ReferenceAir;
use echolake_schema::interchange::REW_MANIFEST;
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::{Celsius, Grid, Pair, Rig, Timestamp};
use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

use self::rew_text::RewText;
use crate::batch::ImportBatch;
use crate::response::{ImportedResponse, known_celsius, least_length, record_unknown_air};
use crate::wav_file::{WavChannel, split_reference};
use crate::wav_manifest::{ManifestCells, SurfaceFacts, SurfaceRows, next_record, no_rows, open_manifest};
use crate::{Error, ImportOptions, ImportedRun};

/// Source name of the import's log entries.
const NAME: &str = "import rew";
/// Greatest difference of the peak from the direct sound's time by geometry that needs no warning, s: 0.7 m.
const PEAK_SECS: f64 = 0.002;

/// Imports all rows of a manifest; `progress` gets the number of rows done and of all.
///
/// # Errors
/// [`Error`], naming the place; every row is checked before the first is imported, and a refused import leaves nothing
/// behind.
pub fn import_rew(
    manifest: &Path,
    rig: &Rig,
    options: ImportOptions<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<ImportedRun>, Error> {
    let grid = rig.build_grid()?;
    let surfaces = read_rows(manifest, rig, &grid)?;
    let total = surfaces.values().map(|(_, rows)| rows.len()).sum();
    let mut runs = Vec::new();
    let mut batch = ImportBatch::default();
    let mut done = 0;
    for (surface, (facts, mut rows)) in surfaces {
        // A run's file is in the order of time.
        for (index, row) in (0u32..).zip(&mut rows) {
            row.response.at = row.recorded_at.unwrap_or_else(|| options.started.plus_secs(f64::from(index)));
        }
        rows.sort_by_key(|row| row.response.at);
        let [started, ended] = [rows.first(), rows.last()].map(|row| row.map_or(options.started, |r| r.response.at));
        let run_manifest = crate::make_manifest(Origin::ImportedRew, &surface, rig, started)?;
        let path = options.folder.join(format!("{}.mcap", run_manifest.run_id));
        let record = facts.fill_record(options.surface_record("imported"));
        let start = RunStart { manifest: &run_manifest, rig, surface: &record, relief: None, plan: None };
        let mut recorder = batch.create_run(&path, &start)?;
        let measurements = rows.len();
        let mut warnings = Vec::new();
        let unknown_air = rows.iter().filter(|row| row.response.celsius.is_none()).count();
        let notes = record_unknown_air(&mut recorder, started, NAME, unknown_air, rig)?;
        for RewRow { line, response, warnings: faults, .. } in rows {
            let at = response.at;
            response.record_response(&mut recorder, rig, &grid)?;
            for fault in faults {
                let warning = format!("line {line}: {fault}");
                recorder.log(at, LogLevel::Warning, NAME, &warning)?;
                warnings.push(warning);
            }
            done += 1;
            progress(done, total);
        }
        let count = measurements as u64;
        batch.seal_run(recorder, &RunEnd { ended, accepted: count, rejected: 0, attempts: count })?;
        runs.push(ImportedRun {
            path,
            run_id: run_manifest.run_id,
            surface,
            measurements,
            warnings,
            rejected: 0,
            notes,
        });
    }
    batch.publish_all()?;
    Ok(runs)
}

/// Checks all rows of a manifest and the files that they name, without importing them.
///
/// # Errors
/// As [`import_rew`].
pub fn check_rew(manifest: &Path, rig: &Rig) -> Result<(), Error> {
    read_rows(manifest, rig, &rig.build_grid()?).map(drop)
}

/// A row of the manifest, checked.
struct RewRow {
    line: u64,
    recorded_at: Option<Timestamp>,
    response: ImportedResponse,
    warnings: Vec<String>,
}

/// A response as its file has it.
struct RewResponse {
    samples: Vec<f64>,
    rate_hz: f64,
    /// Time of the first sample, s, if the file has it.
    start_secs: Option<f64>,
    warnings: Vec<String>,
}

fn read_rows(path: &Path, rig: &Rig, grid: &Grid) -> Result<SurfaceRows<RewRow>, Error> {
    let (mut reader, places) = open_manifest(path, &REW_MANIFEST)?;
    let mut surfaces = SurfaceRows::new();
    while let Some(record) = next_record(path, &mut reader)? {
        let cells = ManifestCells { path, columns: &REW_MANIFEST, places: &places, record: &record };
        let row = parse_row(&cells, rig, grid)?;
        let (facts, rows): &mut (SurfaceFacts, Vec<RewRow>) = surfaces.entry(cells.parse_cell("surface")?).or_default();
        facts.add_row(&cells)?;
        if let Some(twin) = rows.iter().find(|other| other.response.pair == row.response.pair) {
            return Err(cells.cell_error("speaker", format!("this pair is in line {} already", twin.line)));
        }
        rows.push(row);
    }
    if surfaces.is_empty() { Err(no_rows(path, &REW_MANIFEST)) } else { Ok(surfaces) }
}

fn parse_row(cells: &ManifestCells<'_>, rig: &Rig, grid: &Grid) -> Result<RewRow, Error> {
    let pair = cells.parse_pair(grid)?;
    let celsius = cells.parse_celsius()?;
    let name = cells.needed_text("response")?;
    let file = read_response(cells.folder(), name).map_err(|e| cells.cell_error("response", e))?;
    let rate_hz = rig.sweep.rate_hz.get();
    if (file.rate_hz / rate_hz - 1.0).abs() > 1e-6 {
        let what = format!(
            "`{name}` is sampled at {:.1} Hz, expected the rig's {rate_hz} Hz; hint: sweep.rate_hz in the rig file",
            file.rate_hz
        );
        return Err(cells.cell_error("response", what));
    }
    let offset_ms = cells.parse_number("timing_offset_ms")?.ok_or_else(|| {
        let what =
            "it is empty, and no export of REW has it; expected the timing offset that REW was set to, 0 if none";
        cells.cell_error("timing_offset_ms", what)
    })?;
    let start_secs = file.start_secs.map_or_else(|| cells.parse_number("start_secs"), |secs| Ok(Some(secs)))?;
    let start_secs = start_secs.ok_or_else(|| {
        let what =
            format!("it is empty, and `{name}` does not have the time of its first sample; expected that time, s");
        cells.cell_error("start_secs", what)
    })?;
    // REW takes the offset away from all times.
    let emission = -(start_secs + offset_ms / 1e3) * rate_hz;
    let len = least_length(rig, celsius, false);
    let peak = check_response(&file.samples, emission, len)
        .map_err(|what| cells.cell_error("response", format!("`{name}` {what}")))?;
    let mut warnings = file.warnings;
    let expected = geometry_secs(pair, rig, grid, celsius) * rate_hz;
    if (peak - expected).abs() > PEAK_SECS * rate_hz {
        warnings.push(format!(
            "the peak of `{name}` is {peak:.0} samples after the emission, and geometry gives {expected:.0}: is the \
             timing offset right?"
        ));
    }
    let samples = advance(&file.samples, emission, len);
    if let Some(x) = samples.iter().find(|x| !x.is_finite()) {
        return Err(cells.cell_error("response", format!("`{name}` has a sample that is {x}, expected a finite f32")));
    }
    let response = ImportedResponse { pair, at: Timestamp(0), celsius, samples, is_corrected: false };
    Ok(RewRow { line: cells.line(), recorded_at: cells.parse_time()?, response, warnings })
}

fn geometry_secs(pair: Pair, rig: &Rig, grid: &Grid, celsius: Option<Celsius>) -> f64 {
    let [m, s] = [pair.microphone, pair.speaker].map(|id| grid.points()[id.index()].position_mm);
    let air = AirState::with_known(known_celsius(celsius, rig), None, None);
    direct_mm(m, s) / 1e3 / ReferenceAir::from_response(&rig.impulse_response).speed_in(&air)
}

fn read_response(folder: &Path, name: &str) -> Result<RewResponse, String> {
    let (file, _) = split_reference(folder, name)?;
    if !file.to_lowercase().ends_with(".wav") {
        let path = folder.join(name);
        return RewText::read(&path).map_err(|fault| format!("`{}` {fault}", path.display()));
    }
    let wav = WavChannel::open(folder, name)?;
    let samples = wav.read_all(wav.sample_format())?.fractions.into_iter().map(f64::from).collect();
    let rate_hz = f64::from(wav.layout.rate_hz);
    Ok(RewResponse { samples, rate_hz, start_secs: None, warnings: wav.layout.warnings })
}

// Returns the samples from the emission to the peak, which is among the `len` that a run keeps.
fn check_response(samples: &[f64], emission: f64, len: usize) -> Result<f64, String> {
    let peak = (0..samples.len()).max_by(|a, b| samples[*a].abs().total_cmp(&samples[*b].abs()));
    let Some(peak) = peak.filter(|n| samples[*n] != 0.0) else { return Err("is silent".into()) };
    let peak = peak as f64 - emission;
    if !(0.0..len as f64).contains(&peak) {
        return Err(format!(
            "has its peak {peak:.0} samples after the emission, expected within the {len} samples of the rig's \
             response; hint: are start time and timing offset right, and impulse_response.length in the rig file?"
        ));
    }
    let kept = samples.len() as f64 - emission;
    if kept < len as f64 {
        return Err(format!("has {kept:.0} samples after the emission, expected at least {len}"));
    }
    Ok(peak)
}

// The first `len` samples of what begins `delay` samples later, or earlier if it is negative: all frequencies are
// turned by the delay, so that a part of a sample is exact for what has nothing at half the sampling rate.
fn advance(samples: &[f64], delay: f64, len: usize) -> Vec<f32> {
    let mut signal = samples.to_vec();
    // Room for what moves past the end. What moves past the start is behind the samples that are wanted.
    signal.resize(samples.len() + (-delay).max(0.0).ceil() as usize, 0.0);
    let count = signal.len();
    let mut planner = RealFftPlanner::<f64>::new();
    let forward = planner.plan_fft_forward(count);
    let mut spectrum = forward.make_output_vec();
    // The buffers are the plan's own, so that nothing can fail.
    let _ = forward.process(&mut signal, &mut spectrum);
    for (k, bin) in spectrum.iter_mut().enumerate() {
        let turns = (k as f64 * delay / count as f64).fract();
        *bin *= Complex::from_polar(1.0 / count as f64, std::f64::consts::TAU * turns);
    }
    if let (0, Some(last)) = (count % 2, spectrum.last_mut()) {
        last.im = 0.0;
    }
    let _ = planner.plan_fft_inverse(count).process(&mut spectrum, &mut signal);
    signal.iter().take(len).map(|x| *x as f32).collect()
}
