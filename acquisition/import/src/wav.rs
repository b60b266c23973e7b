//! Import of WAV files, one run per surface. One row at a time is in memory.

#[cfg(test)]
mod tests;

use std::ops::Range;
use std::path::Path;

use echolake_acquisition::run::assessment::{RepeatDifference, TakeAssessor};
use echolake_acquisition::run::objection::TakeObjection;
use echolake_acquisition::run::recorder::{LogLevel, Recorder, RunStart};
use echolake_dsp::air::AirState;
use echolake_dsp::chain::raw_len;
use echolake_dsp::deconvolution::{DeconvolutionParams, TransformLength};
use echolake_dsp::geometry::direct_mm;
use echolake_dsp::response_deconvolution::ResponseDeconvolution;
use echolake_dsp::take_analysis::TakeFault;
use echolake_dsp::temperature::{ReferenceAir, response_limits_hz, stretch_recording};
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, SweepRecording, Verdict};
use echolake_schema::{Grid, Rig, SampleRate, SurfaceId, Timestamp};

use crate::batch::ImportBatch;
use crate::response::{describe_unknown_air, known_celsius};
use crate::take_repeats::TakeRepeats;
use crate::take_summary::TakeSummary;
use crate::wav_manifest::{self, ManifestRow, SurfaceFacts};
use crate::{Error, ImportOptions, ImportedRun, wav_search};

/// Source name of the import's log entries.
const NAME: &str = "import wav";
/// Greatest difference of the direct sound's arrival from geometry that roughly known positions explain, us: 0.7 m.
const ARRIVAL_US: f64 = 2_000.0;
/// Amplitude, re the strongest sample that a response keeps, of one behind it that is no noise.
const LATE_SHARE: f32 = 2.0;

/// Returns the sampling rate of a manifest's first recording.
///
/// # Errors
/// [`Error`], naming the manifest and the place.
pub fn sampling_rate_of(manifest: &Path) -> Result<SampleRate, Error> {
    Ok(SampleRate::new(f64::from(wav_manifest::first_recording(manifest)?.layout.rate_hz))?)
}

/// Imports all rows of a manifest; `progress` gets the number of rows done and of all.
///
/// # Errors
/// [`Error`], naming the place; every row is checked before the first is imported, and a refused import leaves nothing
/// behind.
pub fn import_wav(
    manifest: &Path,
    rig: &Rig,
    options: ImportOptions<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<ImportedRun>, Error> {
    let grid = rig.build_grid()?;
    let surfaces = wav_manifest::read_manifest(manifest, rig, &grid)?;
    let total = surfaces.values().map(|(_, rows)| rows.len()).sum();
    let (mut runs, mut batch, mut done) = (Vec::new(), ImportBatch::default(), 0);
    for (surface, (facts, rows)) in surfaces {
        let import = WavImport { manifest, rig, grid: &grid, options };
        let run = import.surface(surface, &facts, &rows, &mut batch, &mut || {
            done += 1;
            progress(done, total);
        })?;
        runs.push(run);
    }
    batch.publish_all()?;
    Ok(runs)
}

struct WavImport<'a> {
    manifest: &'a Path,
    rig: &'a Rig,
    grid: &'a Grid,
    options: ImportOptions<'a>,
}

impl WavImport<'_> {
    fn surface(
        &self,
        surface: SurfaceId,
        facts: &SurfaceFacts,
        rows: &[ManifestRow],
        batch: &mut ImportBatch,
        done: &mut dyn FnMut(),
    ) -> Result<ImportedRun, Error> {
        // A run's file is in the order of time, however the manifest's rows are.
        let mut timed: Vec<_> = (0u32..).zip(rows).map(|(i, row)| (self.time(row, i), row)).collect();
        timed.sort_by_key(|(time, _)| *time);
        let started = timed.first().map_or(self.options.started, |(time, _)| *time);
        let manifest = crate::make_manifest(Origin::ImportedWav, &surface, self.rig, started)?;
        let record = facts.fill_record(self.options.surface_record("imported"));
        let path = self.options.folder.join(format!("{}.mcap", manifest.run_id));
        let start = RunStart { manifest: &manifest, rig: self.rig, surface: &record, relief: None, plan: None };
        let mut recorder = batch.create_run(&path, &start)?;
        recorder.log(started, LogLevel::Info, NAME, &format!("{} recordings", rows.len()))?;
        let mut warnings = Vec::new();
        let mut summary = TakeSummary::new(self.rig.sweep.shape);
        let mut repeats = TakeRepeats::new(rows.iter().map(|row| row.pair.id));
        for (at, row) in &timed {
            warnings.extend(self.row(&mut recorder, row, *at, &mut summary, &mut repeats)?);
            done();
        }
        let count = rows.len() as u64;
        let rejected = summary.rejected();
        let unknown_air = rows.iter().filter(|row| row.celsius.is_none()).count();
        let notes: Vec<_> =
            summary.describe_takes().into_iter().chain(describe_unknown_air(unknown_air, self.rig)).collect();
        let logged_at = timed.last().map_or(started, |(time, _)| *time);
        for note in &notes {
            recorder.log(logged_at, LogLevel::Info, NAME, note)?;
        }
        let ended = timed.last().map_or(started, |(time, _)| *time);
        batch.seal_run(recorder, &RunEnd { ended, accepted: count - rejected, rejected, attempts: count })?;
        Ok(ImportedRun {
            path,
            run_id: manifest.run_id,
            surface,
            measurements: rows.len() - rejected as usize,
            rejected: rejected as usize,
            warnings,
            notes,
        })
    }

    fn time(&self, row: &ManifestRow, index: u32) -> Timestamp {
        row.recorded_at.unwrap_or_else(|| self.options.started.plus_secs(f64::from(index)))
    }

    // The samples of a take that a sweep's own file tells of, so that its direct sound arrives after `arrival` s.
    fn find_take(&self, row: &ManifestRow, arrival: f64) -> Result<Range<u64>, Error> {
        let unread = |column, what| Error::Row { path: self.manifest.to_owned(), line: row.line, column, what };
        let sweep = row.loopback.read_all(row.loopback.sample_format()).map_err(|e| unread("loopback", e))?.fractions;
        let ir = &self.rig.impulse_response;
        let reach = raw_len(ir.length, &ReferenceAir::from_response(ir));
        let found = wav_search::find_sweep(&row.recording, &sweep, reach, self.rig);
        let found = found.map_err(|e| unread("recording", e))?;
        let start = found.checked_sub((arrival * self.rig.sweep.rate_hz.get()).round() as u64).ok_or_else(|| {
            let what = format!("{} begins after the sweep, which arrives at its sample {found}", row.recording.label());
            unread("recording", what)
        })?;
        let len = (sweep.len() + reach).max(self.rig.recording_len()) as u64;
        Ok(start..(start + len).min(row.recording.layout.samples))
    }

    // Import keeps all it is given: objections of the rig become warnings. A take whose response is spoiled is kept,
    // too, and rejected: `ingest` makes no rows of it.
    fn row(
        &self,
        recorder: &mut Recorder,
        row: &ManifestRow,
        at: Timestamp,
        summary: &mut TakeSummary,
        repeats: &mut TakeRepeats,
    ) -> Result<Option<String>, Error> {
        let unread = |column, what| Error::Row { path: self.manifest.to_owned(), line: row.line, column, what };
        let rig = self.rig;
        let celsius = known_celsius(row.celsius, rig);
        let planned = |cause| Error::Plan { rig: rig.name.clone(), cause };
        let reference = ReferenceAir::from_response(&rig.impulse_response);
        let air = AirState::with_known(celsius, Some(row.humidity_pct), Some(row.pressure_hpa));
        let [m, s] = [row.pair.microphone, row.pair.speaker].map(|id| self.grid.points()[id.index()].position_mm);
        let arrival = direct_mm(m, s) / 1e3 / reference.speed_in(&air);
        let take = if row.is_sweep { self.find_take(row, arrival)? } else { 0..row.recording.layout.samples };
        let taken_secs = take.start as f64 / rig.sweep.rate_hz.get();
        let len = (take.end - take.start) as usize;
        let loopback = row.loopback.read_samples(row.format, 0..len as u64).map_err(|e| unread("loopback", e))?;
        let microphone = row.recording.read_samples(row.format, take).map_err(|e| unread("recording", e))?;
        let plan = ResponseDeconvolution::<f32>::new(DeconvolutionParams {
            recording_len: len,
            output_len: raw_len(rig.impulse_response.length, &reference).min(len),
            rate_hz: rig.sweep.rate_hz.get(),
            low_hz: rig.sweep.low_hz,
            high_hz: rig.sweep.high_hz,
            division: rig.impulse_response.division,
            taper_hz: rig.taper_hz(),
            length: TransformLength::Fast,
        })
        .map_err(planned)?;
        let mut samples = vec![0.0; plan.output_len()];
        let limits_hz = response_limits_hz([rig.sweep.low_hz, rig.sweep.high_hz], reference.time_ratio(&air));
        let mut scratch = plan.make_scratch();
        plan.run_within(limits_hz, &microphone.fractions, &loopback.fractions, &mut samples, &mut scratch)
            .map_err(|e| unread("loopback", e.to_string()))?;
        let clipped = microphone.clipped + loopback.clipped;
        let mut assessor = TakeAssessor::new(rig, len).map_err(planned)?;
        let channels: [&[f32]; 2] = [&microphone.fractions, &loopback.fractions];
        let joint = plan.joint_spectrum(&mut scratch);
        let mut assessment = assessor.assess_take(channels, joint, arrival, clipped).map_err(planned)?;
        let playing_clock_ppm = assessment.analysis.recording_clock_ppm;
        let mut stretched = Vec::new();
        if let Some(ppm) = playing_clock_ppm {
            stretched.clone_from(&microphone.fractions);
            stretch_recording(&mut stretched, ppm);
            plan.run_within(limits_hz, &stretched, &loopback.fractions, &mut samples, &mut scratch)
                .map_err(|e| unread("loopback", e.to_string()))?;
            let channels: [&[f32]; 2] = [&stretched, &loopback.fractions];
            let joint = plan.joint_spectrum(&mut scratch);
            let again = assessor.assess_take(channels, joint, arrival, clipped).map_err(planned)?;
            assessment.arrival_error_us = again.arrival_error_us;
            assessment
                .analysis
                .faults
                .extend(again.analysis.recording_clock_ppm.map(|left| TakeFault::UnevenClock { ppm, left_ppm: left }));
        }
        check_response(assessor.response(), samples.len(), arrival, rig).map_err(|e| unread("recording", e))?;
        // The geometry of a foreign rig is known less well than its files say, and the level outside was not recorded:
        // the arrival is recorded, not judged, and so is a signal-to-noise ratio that a long response leaves no room
        // for.
        let mut judged = assessment.clone();
        judged.arrival_error_us = 0.0;
        if judged.snr_db.is_nan() {
            judged.snr_db = f64::INFINITY;
        }
        let mut reasons = Vec::new();
        if row.is_sweep {
            assessment.arrival_error_us = f64::NAN;
            reasons.push(format!(
                "no loopback: the sweep was found {taken_secs:.4} s into the recording, {}, and its direct sound is \
                 taken to arrive when geometry and temperature say",
                row.recording.label()
            ));
        } else if assessment.arrival_error_us.abs() > ARRIVAL_US {
            reasons.push(describe_arrival(assessment.arrival_error_us, rig));
        }
        let columns = [("recording", &row.recording), ("loopback", &row.loopback)];
        for (column, wav) in columns {
            reasons.extend(wav.layout.warnings.iter().map(|warning| format!("{column}, {}: {warning}", wav.label())));
        }
        for objection in judged.find_objections(&rig.validation, f64::NEG_INFINITY) {
            match objection {
                // Where to lower the gain depends on which of both it is.
                TakeObjection::Clipped { .. } => {
                    let of = [
                        ("recording", &row.recording, microphone.clipped),
                        ("loopback", &row.loopback, loopback.clipped),
                    ];
                    let clipped = of.iter().filter(|(.., samples)| *samples > 0);
                    reasons.extend(clipped.map(|(column, wav, samples)| {
                        format!("{samples} samples clipped in the {column}, {}", wav.label())
                    }));
                }
                TakeObjection::Take(fault) => reasons.push(format!("{fault}; hint: {}", fault.hint())),
                other => reasons.push(other.to_string()),
            }
        }
        let repeat = repeats.compare_take(row.pair.id, &assessor);
        let change = repeat.and_then(RepeatDifference::find_objection);
        reasons.extend(change.map(|objection| format!("{objection}; hint: {}", objection.hint())));
        let faults = &assessment.analysis.faults;
        let distortion = faults.iter().filter(|fault| matches!(fault, TakeFault::Distortion { .. }));
        reasons.extend(distortion.map(|fault| format!("{fault}; hint: {}", fault.hint())));
        let verdict = if faults.iter().any(TakeFault::spoils_response) { Verdict::Rejected } else { Verdict::Accepted };
        summary.add_take(&assessment.analysis, verdict);
        let sample_rate_hz = rig.sweep.rate_hz.get();
        recorder.poses(at, m, s)?;
        recorder.environment(
            at,
            &AmbientSample {
                temperature_c: celsius,
                humidity_pct: row.humidity_pct,
                pressure_hpa: row.pressure_hpa,
                outside_level_db: f64::NAN,
            },
        )?;
        recorder.sweep(
            at,
            &SweepRecording {
                pair_id: row.pair.id.0,
                attempt: row.attempt,
                sample_rate_hz,
                sample_count: len as u32,
                format: row.format.into(),
                microphone: microphone.bytes.into(),
                loopback: loopback.bytes.into(),
                temperature_c: celsius,
                humidity_pct: Some(air.humidity_pct),
                pressure_hpa: Some(air.pressure_hpa),
                playing_clock_ppm,
            },
        )?;
        recorder.ir(
            at,
            &ImpulseResponse {
                pair_id: row.pair.id.0,
                attempt: row.attempt,
                sample_rate_hz,
                samples,
                temperature_c: celsius,
                temperature_corrected: false,
                humidity_pct: Some(air.humidity_pct),
                pressure_hpa: Some(air.pressure_hpa),
            },
        )?;
        let rejected = if verdict == Verdict::Rejected { "rejected: " } else { "" };
        let warning = (!reasons.is_empty()).then(|| format!("line {}: {rejected}{}", row.line, reasons.join("; ")));
        recorder.measurement(
            at,
            &Measurement {
                pair_id: row.pair.id.0,
                attempt: row.attempt,
                microphone: row.pair.microphone.0,
                speaker: row.pair.speaker.0,
                verdict: verdict.into(),
                snr_db: assessment.snr_db,
                clipped_samples: clipped,
                loopback_level_dbfs: assessment.loopback_dbfs,
                arrival_error_us: assessment.arrival_error_us,
                clock_ratio_ppm: Some(assessment.analysis.clock_ratio_ppm).filter(|ppm| ppm.is_finite()),
                repeat_difference_db: repeat.map(|found| found.difference_db).filter(|db| db.is_finite()),
                outside_level_db: f64::NAN,
                temperature_c: celsius,
                humidity_pct: row.humidity_pct,
                pressure_hpa: row.pressure_hpa,
                reasons,
                microphone_residual_mm: f64::NAN,
                speaker_residual_mm: f64::NAN,
            },
        )?;
        if let Some(warning) = &warning {
            recorder.log(at, LogLevel::Warning, NAME, warning)?;
        }
        recorder.checkpoint()?;
        Ok(warning)
    }
}

// Silence is not taken for a response: what is strongest in a recording is in the samples that are kept of it.
fn check_response(response: &[f32], kept: usize, arrival: f64, rig: &Rig) -> Result<(), String> {
    let strongest = |from, samples: &[f32]| {
        let all = (from..).zip(samples.iter().map(|x| x.abs()));
        all.max_by(|a: &(usize, f32), b| a.1.total_cmp(&b.1)).unwrap_or_default()
    };
    let (_, inside) = strongest(0, &response[..kept]);
    let (peak, outside) = strongest(kept, &response[kept..]);
    if outside <= LATE_SHARE * inside {
        return Ok(());
    }
    let rate_hz = rig.sweep.rate_hz.get();
    let late_us = (peak as f64 / rate_hz - arrival) * 1e6;
    Err(format!(
        "{}; the response of {} samples would be silence; hint: record a loopback, or name the file of the sweep \
         alone, shorter than the recording, as the loopback, and import finds it in the recording",
        describe_arrival(late_us, rig),
        rig.impulse_response.length
    ))
}

fn describe_arrival(off_us: f64, rig: &Rig) -> String {
    let samples = (off_us.abs() / 1e6 * rig.sweep.rate_hz.get()).round();
    let side = if off_us > 0.0 { "late" } else { "early" };
    format!(
        "the direct sound arrives {samples} samples ({:.1} ms) {side}: no loopback, or one without the latency of the \
         interface",
        off_us.abs() / 1e3
    )
}

/// Checks all rows of a manifest and the files that they name, without importing them.
///
/// # Errors
/// As [`import_wav`].
pub fn check_wav(manifest: &Path, rig: &Rig) -> Result<(), Error> {
    wav_manifest::read_manifest(manifest, rig, &rig.build_grid()?).map(drop)
}
