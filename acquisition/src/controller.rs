//! The run controller: moves, powers off, plays, records, reads the air, validates, and tries again.

use std::sync::atomic::{AtomicBool, Ordering};

use echolake_dsp::chain::raw_len;
use echolake_dsp::deconvolution::{DeconvolutionParams, DeconvolutionPlan, DeconvolutionScratch, TransformLength};
use echolake_dsp::geometry::direct_mm;
use echolake_dsp::sweep::LinearSweep;
use echolake_dsp::temperature::speed_of_sound;
use echolake_schema::manifest::RunEnd;
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, SampleFormat, SweepRecording, Verdict};
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
}

impl<'a> RunController<'a> {
    /// Plans for this rig.
    ///
    /// # Errors
    /// [`Error::Plan`] where its settings contradict each other.
    pub fn new(rig: &'a Rig, devices: Devices) -> Result<Self, Error> {
        let failed = |cause| Error::Plan { rig: rig.name.clone(), cause };
        let (sweep, recording_len) = (&rig.sweep, rig.recording_len());
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
    /// [`Error::Device`] or [`Error::Record`]; what was recorded before is kept.
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
            self.measure(recorder, *pair, options, &mut end)?;
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
        let (assessment, mut reasons) = match self.assess(arrival, clipped) {
            Ok(assessment) => {
                let limits = &self.rig.validation;
                (assessment, assessment.objections(limits, reading.outside_level_db))
            }
            Err(cause) => (nothing(clipped), vec![cause.to_string()]),
        };
        if !reading.temperature_c.is_finite() {
            reasons.push("the ambient sensor gives no temperature".to_owned());
        }
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
        Ok(Attempt { at: self.take.started.unwrap_or(reading.at), reading, reached, measurement })
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
        let sample = AmbientSample {
            temperature_c: reading.temperature_c,
            humidity_pct: reading.humidity_pct,
            pressure_hpa: reading.pressure_hpa,
            outside_level_db: reading.outside_level_db,
        };
        recorder.environment(reading.at, &sample)?;
        if options.keep == Keep::Sweeps {
            let recording = SweepRecording {
                pair_id: m.pair_id,
                attempt: m.attempt,
                sample_rate_hz,
                sample_count: self.take.microphone.len() as u32,
                format: SampleFormat::S24le.into(),
                microphone: packed(&self.take.microphone),
                loopback: packed(&self.take.loopback),
                temperature_c: reading.temperature_c,
            };
            recorder.sweep(at, &recording)?;
        }
        let ir = ImpulseResponse {
            pair_id: m.pair_id,
            attempt: m.attempt,
            sample_rate_hz,
            samples: self.ir.clone(),
            temperature_c: reading.temperature_c,
            temperature_corrected: false,
        };
        recorder.ir(at, &ir)?;
        recorder.measurement(at, m)?;
        if m.verdict() != Verdict::Accepted {
            let next = if m.verdict() == Verdict::Repeated { "tried again" } else { "given up" };
            let what = format!("pair {}, attempt {}: {}; {next}", m.pair_id, m.attempt, m.reasons.join("; "));
            recorder.log(at, LogLevel::Warning, NAME, &what)?;
        }
        Ok(())
    }
}

// Samples as fractions of full scale; returns how many are at it.
fn to_fractions(samples: &[i32], out: &mut Vec<f32>) -> u32 {
    out.clear();
    out.extend(samples.iter().map(|x| *x as f32 / FULL_SCALE));
    samples.iter().filter(|x| **x <= -(1 << 23) || **x >= (1 << 23) - 1).count() as u32
}

fn packed(samples: &[i32]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(samples.len() * 3);
    for sample in samples {
        bytes.extend_from_slice(&sample.to_le_bytes()[..3]);
    }
    bytes
}

fn nothing(clipped_samples: u32) -> Assessment {
    let unknown = f64::NAN;
    Assessment { snr_db: unknown, clipped_samples, loopback_dbfs: unknown, arrival_error_us: unknown }
}

#[cfg(test)]
mod tests {
    use echolake_schema::RunId;
    use echolake_schema::manifest::{Origin, RunManifest};

    use super::*;
    use crate::recorder::RunStart;
    use crate::relief::Relief;
    use crate::rig::{AudioInterface, Error as RigError};
    use crate::rigs::simulated::{Simulation, devices};

    /// An interface with something wrong on its first takes.
    struct Faulty {
        inner: Box<dyn AudioInterface>,
        fault: fn(&mut Take),
        takes: u32,
    }

    impl AudioInterface for Faulty {
        fn rate_hz(&self) -> f64 {
            self.inner.rate_hz()
        }

        fn play_and_record(&mut self, output: &[f32], take: &mut Take) -> Result<(), RigError> {
            self.inner.play_and_record(output, take)?;
            if self.takes > 0 {
                self.takes -= 1;
                (self.fault)(take);
            }
            Ok(())
        }
    }

    fn quick() -> Rig {
        Rig::from_toml("sweep.duration_secs = 0.03").expect("a rig")
    }

    fn start() -> Timestamp {
        Timestamp(1_767_600_000_000_000_000)
    }

    fn faulty(rig: &Rig, fault: fn(&mut Take), takes: u32) -> Devices {
        let relief = Relief::Flat.height_field(60);
        let simulation = Simulation { rig, relief: &relief, reflection_factor: 0.83, start: start(), seed: 3 };
        let mut devices = devices(&simulation).expect("devices");
        devices.audio = Box::new(Faulty { inner: devices.audio, fault, takes });
        devices
    }

    fn run_of(rig: &Rig, devices: Devices, pairs: usize) -> (RunEnd, Vec<Measurement>) {
        let folder = tempfile::tempdir().expect("a folder");
        let surface = "flat".parse().expect("an id");
        let manifest = RunManifest {
            run_id: RunId::compose(start(), &surface, 1).expect("an id"),
            surface_id: surface,
            started: start(),
            software: "test".into(),
            rig: rig.name.clone(),
            origin: Origin::Simulated,
        };
        let record = echolake_schema::SurfaceRecord::default();
        let run = RunStart { manifest: &manifest, rig, surface: &record, relief: None };
        let path = folder.path().join("run.mcap");
        let mut recorder = Recorder::create(&path, &run).expect("a recorder");
        let mut controller = RunController::new(rig, devices).expect("a controller");
        let pairs: Vec<_> = controller.grid.pairs().iter().step_by(2951 / pairs).copied().take(pairs).collect();
        let options = RunOptions { keep: Keep::ResponsesOnly, checkpoint_every: 1 };
        let end = controller.run(&mut recorder, &pairs, options, &AtomicBool::new(false), &mut |_| {}).expect("a run");
        let path = recorder.finish(&end).expect("finished");
        let file = std::fs::read(path).expect("the file");
        let messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("a message"));
        let verdicts = messages
            .filter(|m| m.channel.topic == echolake_schema::topics::MEASUREMENT)
            .map(|m| <Measurement as prost::Message>::decode(&m.data[..]).expect("a measurement"));
        (end, verdicts.collect())
    }

    #[test]
    fn good_takes_are_accepted_at_once() {
        let rig = quick();
        let (end, verdicts) = run_of(&rig, faulty(&rig, |_| {}, 0), 40);
        assert_eq!((end.accepted, end.rejected), (40, 0), "{verdicts:?}");
        for v in verdicts.iter().filter(|v| v.verdict() == Verdict::Accepted) {
            assert!(v.snr_db > 30.0 && v.arrival_error_us.abs() < 5.0, "{v:?}");
        }
    }

    fn check(fault: fn(&mut Take), takes: u32, expected: &str) {
        let rig = quick();
        let (end, verdicts) = run_of(&rig, faulty(&rig, fault, takes), 1);
        let reasons = verdicts[0].reasons.join("; ");
        assert!(reasons.contains(expected), "{reasons}");
        if takes < 3 {
            assert_eq!((end.accepted, end.rejected, end.attempts), (1, 0, u64::from(takes) + 1), "{verdicts:?}");
            assert_eq!(verdicts[0].verdict(), Verdict::Repeated);
        } else {
            assert_eq!((end.accepted, end.rejected, end.attempts), (0, 1, 3));
            assert_eq!(verdicts[2].verdict(), Verdict::Rejected);
        }
    }

    #[test]
    fn a_silent_loopback_is_noticed_and_given_up() {
        check(|take| take.loopback.fill(0), 9, "loopback");
    }

    #[test]
    fn clipping_is_repeated() {
        check(|take| take.microphone[100] = (1 << 23) - 1, 1, "1 samples clipped");
    }

    #[test]
    fn noise_is_repeated() {
        let noisy: fn(&mut Take) = |take| {
            let mut state = 1u32;
            for x in &mut take.microphone {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                *x = (*x + (state >> 12) as i32 - (1 << 19)).clamp(-(1 << 23) + 1, (1 << 23) - 2);
            }
        };
        check(noisy, 2, "signal-to-noise ratio");
    }

    #[test]
    fn a_displaced_microphone_is_noticed() {
        check(|take| take.microphone.rotate_right(4), 9, "direct sound");
    }
}
