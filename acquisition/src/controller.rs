//! The run controller: moves, powers off, plays, records, reads the air, validates, and tries again.

use std::sync::atomic::{AtomicBool, Ordering};

use echolake_dsp::chain::raw_len;
use echolake_dsp::deconvolution::{DeconvolutionParams, DeconvolutionPlan, DeconvolutionScratch, TransformLength};
use echolake_dsp::geometry::direct_mm;
use echolake_dsp::sweep::LinearSweep;
use echolake_dsp::temperature::speed_of_sound;
use echolake_schema::manifest::RunEnd;
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, SampleFormat, SweepRecording, Verdict};
use echolake_schema::samples::split_24;
use echolake_schema::{Grid, Pair, Rig, Timestamp};

use crate::assessment::{Assessment, Assessor};
use crate::recorder::{LogLevel, Recorder};
use crate::rig::{Devices, Positions, Power, Reading, Take};

/// Full scale of a take's samples.
const FULL_SCALE: f32 = 8_388_608.0;
/// Who speaks in the log.
const NAME: &str = "controller";

/// What a run records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// Sweeps and impulse responses.
    Sweeps,
    /// Impulse responses alone.
    ResponsesOnly,
}

/// How a run is recorded.
#[derive(Debug, Clone, Copy)]
pub struct RunOptions {
    /// What is recorded.
    pub keep: Keep,
    /// Pairs between two checkpoints: what a power cut may cost. A real rig takes 1, 12 s each.
    pub checkpoint_every: usize,
}

/// Why a run ended early. What was recorded until then is kept.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] crate::rig::Error),
    /// The recording cannot be written.
    #[error(transparent)]
    Record(#[from] crate::recorder::Error),
    /// The rig's settings make no plan.
    #[error("rig `{rig}` cannot measure: {cause}")]
    Plan {
        /// The rig.
        rig: String,
        /// Why.
        cause: echolake_dsp::Error,
    },
    /// The rig's grid is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
    /// The interface runs at another rate than the rig's sweep is made for.
    #[error(
        "rig `{rig}` samples at {expected_hz} Hz, the audio interface at {actual_hz} Hz; hint: set the interface, or `sweep.rate_hz`"
    )]
    Rate {
        /// The rig.
        rig: String,
        /// Its rate, Hz.
        expected_hz: f64,
        /// The interface's, Hz.
        actual_hz: f64,
    },
}

/// Measures runs with one rig.
pub struct RunController<'a> {
    rig: &'a Rig,
    grid: Grid,
    devices: Devices,
    output: Vec<f32>,
    deconvolution: DeconvolutionPlan<f32>,
    scratch: DeconvolutionScratch<f32>,
    assessor: Assessor,
    take: Take,
    microphone: Vec<f32>,
    loopback: Vec<f32>,
    ir: Vec<f32>,
}

/// One attempt, as it was measured.
struct Attempt {
    at: Timestamp,
    reading: Reading,
    reached: Positions,
    measurement: Measurement,
    response: Response,
}

/// Whether an attempt gave a response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Response {
    /// It is in the controller's buffer.
    Deconvolved,
    /// The recording cannot be deconvolved, and the buffer still has the response of an attempt before.
    Missing,
}

impl<'a> RunController<'a> {
    /// Plans for this rig.
    ///
    /// # Errors
    /// [`Error::Plan`] where its settings contradict each other, [`Error::Rate`] where the interface's rate is not
    /// the rig's.
    pub fn new(rig: &'a Rig, devices: Devices) -> Result<Self, Error> {
        let failed = |cause| Error::Plan { rig: rig.name.clone(), cause };
        let (sweep, recording_len) = (&rig.sweep, rig.recording_len());
        let (expected_hz, actual_hz) = (sweep.rate_hz.get(), devices.audio.rate_hz());
        if actual_hz != expected_hz {
            return Err(Error::Rate { rig: rig.name.clone(), expected_hz, actual_hz });
        }
        let reference = rig.impulse_response.reference_temperature_c.get();
        let deconvolution = DeconvolutionPlan::new(DeconvolutionParams {
            recording_len,
            output_len: raw_len(rig.impulse_response.length, reference).min(recording_len),
            rate_hz: sweep.rate_hz.get(),
            low_hz: sweep.low_hz,
            high_hz: sweep.high_hz,
            floor_db: rig.impulse_response.floor_db,
            length: TransformLength::Fast,
        })
        .map_err(failed)?;
        let gain = 10f64.powf(sweep.level_dbfs / 20.0);
        let excitation = LinearSweep {
            rate_hz: sweep.rate_hz.get(),
            duration_secs: sweep.duration_secs,
            low_hz: sweep.low_hz,
            high_hz: sweep.high_hz,
            fade_secs: sweep.fade_secs,
        };
        let mut output: Vec<f32> = excitation.samples().into_iter().map(|x| (gain * x) as f32).collect();
        output.resize(recording_len, 0.0);
        Ok(Self {
            rig,
            grid: rig.grid()?,
            devices,
            output,
            scratch: deconvolution.scratch(),
            ir: vec![0.0; deconvolution.output_len()],
            deconvolution,
            assessor: Assessor::new(rig, recording_len).map_err(failed)?,
            take: Take::default(),
            microphone: Vec::new(),
            loopback: Vec::new(),
        })
    }

    /// Measures the pairs in their order; `progress` hears of each that is done. When `stop` becomes true the run
    /// ends after the current pair. Finishing the recording is the caller's.
    ///
    /// # Errors
    /// [`Error::Device`] or [`Error::Record`]; what was recorded before is kept, the log says at which pair it broke
    /// off, and the drives are off if they can be.
    pub fn run(
        &mut self,
        recorder: &mut Recorder,
        pairs: &[Pair],
        options: RunOptions,
        stop: &AtomicBool,
        progress: &mut dyn FnMut(usize),
    ) -> Result<RunEnd, Error> {
        let mut end = RunEnd { ended: Timestamp(0), accepted: 0, rejected: 0, attempts: 0 };
        let begun = self.devices.sensor.read()?;
        let what = format!("{} pairs with rig {}, {}", pairs.len(), self.rig.name, self.devices.origin.label());
        recorder.log(begun.at, LogLevel::Info, NAME, &what)?;
        end.ended = begun.at;
        for (done, pair) in pairs.iter().enumerate() {
            if stop.load(Ordering::Relaxed) {
                let what = format!("stopped by hand after {done} of {} pairs", pairs.len());
                recorder.log(end.ended, LogLevel::Warning, NAME, &what)?;
                break;
            }
            if let Err(error) = self.measure(recorder, *pair, options, &mut end) {
                return Err(self.broken_off(recorder, end.ended, *pair, error));
            }
            if (done + 1).is_multiple_of(options.checkpoint_every.max(1)) {
                recorder.checkpoint()?;
            }
            progress(done + 1);
        }
        let RunEnd { accepted, rejected, attempts, .. } = end;
        let what = format!("{accepted} pairs accepted, {rejected} given up, {attempts} attempts");
        recorder.log(end.ended, LogLevel::Info, NAME, &what)?;
        Ok(end)
    }

    fn broken_off(&mut self, recorder: &mut Recorder, at: Timestamp, pair: Pair, error: Error) -> Error {
        let what = format!("broken off at pair {}: {error}", pair.id.0);
        // The caller must hear of the first failure; that these fail behind it too would only hide it.
        let _ = self.devices.robots.power(Power::Off);
        let _ = recorder.log(at, LogLevel::Error, NAME, &what).and_then(|()| recorder.checkpoint());
        error
    }

    fn measure(
        &mut self,
        recorder: &mut Recorder,
        pair: Pair,
        options: RunOptions,
        end: &mut RunEnd,
    ) -> Result<(), Error> {
        for attempt in 1..=self.rig.validation.attempts {
            let made = self.attempt(pair, attempt)?;
            self.record(recorder, &made, options)?;
            end.attempts += 1;
            end.ended = made.at.plus_secs(self.output.len() as f64 / self.rig.sweep.rate_hz.get());
            match made.measurement.verdict() {
                Verdict::Accepted => {
                    end.accepted += 1;
                    return Ok(());
                }
                Verdict::Rejected => end.rejected += 1,
                _ => {}
            }
        }
        Ok(())
    }

    fn attempt(&mut self, pair: Pair, attempt: u32) -> Result<Attempt, Error> {
        let [microphone, speaker] =
            [pair.microphone, pair.speaker].map(|id| self.grid.points()[id.index()].position_mm);
        self.devices.robots.power(Power::On)?;
        let reached = self.devices.robots.move_to(microphone, speaker)?;
        // The drives hum; the arms hold by their brakes while the sweep is recorded.
        self.devices.robots.power(Power::Off)?;
        self.devices.audio.play_and_record(&self.output, &mut self.take)?;
        let reading = self.devices.sensor.read()?;
        let mut clipped = to_fractions(&self.take.microphone, &mut self.microphone);
        clipped += to_fractions(&self.take.loopback, &mut self.loopback);
        let arrival = direct_mm(microphone, speaker) / 1e3 / speed_of_sound(reading.temperature_c);
        let limits = &self.rig.validation;
        let (assessment, response, reasons) = match self.assess(arrival, clipped) {
            Ok(found) => {
                let mut reasons = found.objections(limits, reading.outside_level_db);
                reasons.extend(unknowns(&found, &reading));
                (found, Response::Deconvolved, reasons)
            }
            Err(cause) => (nothing(clipped), Response::Missing, vec![cause.to_string()]),
        };
        let verdict = match (reasons.is_empty(), attempt < self.rig.validation.attempts) {
            (true, _) => Verdict::Accepted,
            (false, true) => Verdict::Repeated,
            (false, false) => Verdict::Rejected,
        };
        let off = |wanted: [f64; 3], reached: [f64; 3]| direct_mm(wanted, reached);
        let measurement = Measurement {
            pair_id: pair.id.0,
            attempt,
            microphone: pair.microphone.0,
            speaker: pair.speaker.0,
            verdict: verdict.into(),
            snr_db: assessment.snr_db,
            clipped_samples: clipped,
            loopback_level_dbfs: assessment.loopback_dbfs,
            arrival_error_us: assessment.arrival_error_us,
            outside_level_db: reading.outside_level_db,
            temperature_c: reading.temperature_c,
            humidity_pct: reading.humidity_pct,
            pressure_hpa: reading.pressure_hpa,
            reasons,
            microphone_residual_mm: off(microphone, reached.microphone_mm),
            speaker_residual_mm: off(speaker, reached.speaker_mm),
        };
        Ok(Attempt { at: self.take.started.unwrap_or(reading.at), reading, reached, measurement, response })
    }

    fn assess(&mut self, arrival_secs: f64, clipped: u32) -> Result<Assessment, echolake_dsp::Error> {
        self.deconvolution.run(&self.microphone, &self.loopback, &mut self.ir, &mut self.scratch)?;
        self.assessor.assess(&self.microphone, &self.loopback, arrival_secs, clipped)
    }

    // The order within an attempt: what a verdict rests on stands before it, so that a cut-off file never has a
    // verdict without its recording.
    fn record(&mut self, recorder: &mut Recorder, made: &Attempt, options: RunOptions) -> Result<(), Error> {
        let (at, m, reading) = (made.at, &made.measurement, &made.reading);
        let sample_rate_hz = self.rig.sweep.rate_hz.get();
        recorder.poses(at, made.reached.microphone_mm, made.reached.speaker_mm)?;
        if let Some(joints) = &made.reached.joints {
            recorder.joints(at, joints)?;
        }
        let sample = AmbientSample {
            temperature_c: reading.temperature_c,
            humidity_pct: reading.humidity_pct,
            pressure_hpa: reading.pressure_hpa,
            outside_level_db: reading.outside_level_db,
        };
        recorder.environment(reading.at, &sample)?;
        for (device, notice) in self.devices.notices() {
            recorder.log(at, LogLevel::Warning, device, &notice)?;
        }
        if options.keep == Keep::Sweeps {
            let recording = SweepRecording {
                pair_id: m.pair_id,
                attempt: m.attempt,
                sample_rate_hz,
                sample_count: self.take.microphone.len() as u32,
                format: SampleFormat::S24Split.into(),
                microphone: split_24(&self.take.microphone).into(),
                loopback: split_24(&self.take.loopback).into(),
                temperature_c: reading.temperature_c,
            };
            recorder.sweep(at, &recording)?;
        }
        if made.response == Response::Deconvolved {
            let ir = ImpulseResponse {
                pair_id: m.pair_id,
                attempt: m.attempt,
                sample_rate_hz,
                samples: self.ir.clone(),
                temperature_c: reading.temperature_c,
                temperature_corrected: false,
            };
            recorder.ir(at, &ir)?;
        }
        recorder.measurement(at, m)?;
        if m.verdict() != Verdict::Accepted {
            let next = if m.verdict() == Verdict::Repeated { "tried again" } else { "given up" };
            let what = format!("pair {}, attempt {}: {}; {next}", m.pair_id, m.attempt, m.reasons.join("; "));
            recorder.log(at, LogLevel::Warning, NAME, &what)?;
        }
        Ok(())
    }
}

// A comparison with NaN objects to nothing, and a take of which nothing is known is no good one.
fn unknowns(found: &Assessment, reading: &Reading) -> Vec<String> {
    let values = [
        ("signal-to-noise ratio", found.snr_db),
        ("arrival of the direct sound", found.arrival_error_us),
        // Infinite is as bad as unknown here, while a take without any noise has an infinite ratio.
        ("temperature", if reading.temperature_c.is_finite() { reading.temperature_c } else { f64::NAN }),
        ("level outside", reading.outside_level_db),
    ];
    values.into_iter().filter(|(_, x)| x.is_nan()).map(|(what, _)| format!("{what} unknown")).collect()
}

// Samples as fractions of full scale; returns how many are at it.
fn to_fractions(samples: &[i32], out: &mut Vec<f32>) -> u32 {
    out.clear();
    out.extend(samples.iter().map(|x| *x as f32 / FULL_SCALE));
    samples.iter().filter(|x| **x <= -(1 << 23) || **x >= (1 << 23) - 1).count() as u32
}

fn nothing(clipped_samples: u32) -> Assessment {
    let unknown = f64::NAN;
    Assessment { snr_db: unknown, clipped_samples, loopback_dbfs: unknown, arrival_error_us: unknown }
}

#[cfg(test)]
mod tests;
