//! One attempt at one pair: made, judged, and recorded.

use echolake_dsp::air::AirState;
use echolake_dsp::geometry::direct_mm;
use echolake_dsp::take_analysis::TakeAnalysis;
use echolake_dsp::temperature::{ReferenceAir, response_limits_hz};
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, SampleFormat, SweepRecording, Verdict};
use echolake_schema::samples::split_24;
use echolake_schema::{Celsius, Pair, Timestamp};

use super::{Error, NAME, RunController, RunProgress};
use crate::rig::{AmbientReading, ArmPositions, AudioTake, DrivePower, Error as RigError};
use crate::run::assessment::{RepeatDifference, TakeAssessment};
use crate::run::objection::{ARRIVAL, SIGNAL_TO_NOISE, TakeObjection, find_implausible};
use crate::run::recorder::LogLevel;
use crate::run::recording_mode::RecordingMode;

/// Full scale of a take's samples.
const FULL_SCALE: f32 = 8_388_608.0;
/// Number of tries of a device that fails before the run ends: an overrun, or a line of a sensor that was cut short, is
/// over at once.
const TRIES: usize = 3;
/// One attempt with its measurement.
pub(super) struct AttemptResult {
    pub at: Timestamp,
    pub measurement: Measurement,
    pub objections: Vec<TakeObjection>,
    reading: AmbientReading,
    /// Positions of the arms; None if they refused.
    reached: Option<ArmPositions>,
    response: ResponseState,
}

/// State of the response buffer after an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ResponseState {
    /// It is in the controller's buffer.
    Deconvolved,
    /// The recording cannot be deconvolved, and the buffer still has the response of an attempt before.
    Missing,
}

/// Assessment of a pair's first take, with the objections to all.
struct Judged {
    assessment: TakeAssessment,
    response: ResponseState,
    objections: Vec<TakeObjection>,
    /// Difference of the second take, if there is one.
    repeat: Option<RepeatDifference>,
}

impl RunController<'_> {
    pub(super) fn attempt_pair(
        &mut self,
        run: &mut RunProgress<'_>,
        pair: Pair,
        number: u32,
        is_last: bool,
    ) -> Result<AttemptResult, Error> {
        let [microphone, speaker] = self.pair_positions(pair);
        self.devices.robots.switch_drives(DrivePower::On)?;
        let reached = match self.devices.robots.move_to(microphone, speaker) {
            Ok(reached) => reached,
            // A retry would not change it; the other pairs may be reached.
            Err(refusal @ RigError::Unreachable { .. }) => {
                self.devices.robots.switch_drives(DrivePower::Off)?;
                return self.refused_attempt(pair, number, refusal);
            }
            Err(error) => return Err(error.into()),
        };
        // The drives hum; the arms hold by their brakes while the sweep is recorded.
        self.devices.robots.switch_drives(DrivePower::Off)?;
        self.make_takes(run)?;
        let reading = self.read_ambient()?;
        let Judged { assessment, response, objections, repeat } = self.judge_takes(microphone, speaker, &reading);
        let verdict = match (objections.is_empty(), is_last) {
            (true, _) => Verdict::Accepted,
            (false, false) => Verdict::Repeated,
            (false, true) => Verdict::Rejected,
        };
        let measurement = Measurement {
            snr_db: assessment.snr_db,
            clipped_samples: assessment.clipped_samples,
            loopback_level_dbfs: assessment.loopback_dbfs,
            arrival_error_us: assessment.arrival_error_us,
            clock_ratio_ppm: Some(assessment.analysis.clock_ratio_ppm).filter(|ppm| ppm.is_finite()),
            repeat_difference_db: repeat.map(|found| found.difference_db).filter(|db| db.is_finite()),
            microphone_residual_mm: direct_mm(microphone, reached.microphone_mm),
            speaker_residual_mm: direct_mm(speaker, reached.speaker_mm),
            ..verdict_on(pair, number, verdict, &objections, &reading)
        };
        let at = self.take.started.unwrap_or(reading.at);
        Ok(AttemptResult { at, measurement, objections, reading, reached: Some(reached), response })
    }

    /// Makes a take at a pair and judges it without recording it: a check of the rig before a run.
    pub(crate) fn try_pair(&mut self, pair: Pair) -> Result<(TakeAssessment, Vec<TakeObjection>), RigError> {
        let [microphone, speaker] = self.pair_positions(pair);
        self.devices.robots.switch_drives(DrivePower::On)?;
        self.devices.robots.move_to(microphone, speaker)?;
        self.devices.robots.switch_drives(DrivePower::Off)?;
        for take in [&mut self.take, &mut self.repeat].into_iter().take(self.rig.sweep.repeat.into()) {
            self.devices.audio.play_and_record(&self.output, take)?;
        }
        let reading = self.read_ambient()?;
        let judged = self.judge_takes(microphone, speaker, &reading);
        Ok((judged.assessment, judged.objections))
    }

    /// Reads the air, with retries if the sensor fails.
    pub(crate) fn read_ambient(&mut self) -> Result<AmbientReading, RigError> {
        retry_device(|| self.devices.sensor.read_ambient())
    }

    // An interface that lost samples is retried: nothing of that take is kept.
    fn make_takes(&mut self, run: &mut RunProgress<'_>) -> Result<(), Error> {
        let mut lost = Vec::new();
        let mut takes = [&mut self.take, &mut self.repeat].into_iter().take(self.rig.sweep.repeat.into());
        let taken = takes.try_for_each(|take| {
            retry_device(|| {
                let taken = self.devices.audio.play_and_record(&self.output, take);
                lost.extend(taken.as_ref().err().map(ToString::to_string));
                taken
            })
        });
        for what in lost {
            run.say(LogLevel::Warning, &format!("a take was lost, and made again: {what}"))?;
        }
        Ok(taken?)
    }

    fn pair_positions(&self, pair: Pair) -> [[f64; 3]; 2] {
        [pair.microphone, pair.speaker].map(|id| self.grid.points()[id.index()].position_mm)
    }

    fn refused_attempt(&mut self, pair: Pair, number: u32, refusal: RigError) -> Result<AttemptResult, Error> {
        let reading = self.read_ambient()?;
        let objections = vec![TakeObjection::Refused { refusal }];
        let unknown = f64::NAN;
        let measurement = Measurement {
            snr_db: unknown,
            loopback_level_dbfs: unknown,
            arrival_error_us: unknown,
            microphone_residual_mm: unknown,
            speaker_residual_mm: unknown,
            ..verdict_on(pair, number, Verdict::Rejected, &objections, &reading)
        };
        Ok(AttemptResult {
            at: reading.at,
            measurement,
            objections,
            reading,
            reached: None,
            response: ResponseState::Missing,
        })
    }

    fn judge_takes(&mut self, microphone: [f64; 3], speaker: [f64; 3], reading: &AmbientReading) -> Judged {
        let mut clipped = to_fractions(&self.take.microphone, &mut self.microphone);
        clipped += to_fractions(&self.take.loopback, &mut self.loopback);
        let reference = ReferenceAir::from_response(&self.rig.impulse_response);
        let air = measured_air(reading);
        let arrival = direct_mm(microphone, speaker) / 1e3 / reference.speed_in(&air);
        match self.deconvolve_and_assess(arrival, clipped, reference.time_ratio(&air)) {
            Ok(assessment) => {
                let mut objections = assessment.find_objections(&self.rig.validation, reading.outside_level_db);
                objections.extend(find_unknowns(&assessment, reading));
                objections.extend(find_implausible(reading));
                let repeat = self.judge_repeat(arrival, reading, &mut objections);
                Judged { assessment, response: ResponseState::Deconvolved, objections, repeat }
            }
            Err(cause) => {
                let objections = vec![TakeObjection::Broken { reason: cause.to_string() }];
                let assessment = unknown_assessment(clipped);
                Judged { assessment, response: ResponseState::Missing, objections, repeat: None }
            }
        }
    }

    // The second take must be as good as the first, and the same. What is wrong with both is said once.
    fn judge_repeat(
        &mut self,
        arrival_secs: f64,
        reading: &AmbientReading,
        objections: &mut Vec<TakeObjection>,
    ) -> Option<RepeatDifference> {
        if self.rig.sweep.repeat < 2 {
            return None;
        }
        self.first_response.clear();
        self.first_response.extend_from_slice(self.assessor.response());
        let mut clipped = to_fractions(&self.repeat.microphone, &mut self.microphone);
        clipped += to_fractions(&self.repeat.loopback, &mut self.loopback);
        let found = match self.assessor.assess_take([&self.microphone, &self.loopback], None, arrival_secs, clipped) {
            Ok(found) => found,
            Err(cause) => {
                objections.push(TakeObjection::Broken { reason: format!("second take: {cause}") });
                return None;
            }
        };
        let difference = self.assessor.compare_repeat(&self.first_response);
        let of_second = found.find_objections(&self.rig.validation, reading.outside_level_db);
        for objection in of_second.into_iter().chain(difference.find_objection()) {
            let is_known = |known: &TakeObjection| std::mem::discriminant(known) == std::mem::discriminant(&objection);
            if !objections.iter().any(is_known) {
                objections.push(objection);
            }
        }
        Some(difference)
    }

    fn deconvolve_and_assess(
        &mut self,
        arrival_secs: f64,
        clipped: u32,
        time_ratio: f64,
    ) -> Result<TakeAssessment, echolake_dsp::Error> {
        let sweep = &self.rig.sweep;
        let limits_hz = response_limits_hz([sweep.low_hz, sweep.high_hz], time_ratio);
        self.deconvolution.run_within(limits_hz, &self.microphone, &self.loopback, &mut self.ir, &mut self.scratch)?;
        let joint = self.deconvolution.joint_spectrum(&mut self.scratch);
        self.assessor.assess_take([&self.microphone, &self.loopback], joint, arrival_secs, clipped)
    }

    // The order within an attempt is kept for live views. In the file a verdict follows its messages because
    // the recorder writes its chunk last.
    pub(super) fn record_attempt(&mut self, run: &mut RunProgress<'_>, made: &AttemptResult) -> Result<(), Error> {
        let at = made.at;
        let m = &made.measurement;
        let reading = &made.reading;
        let sample_rate_hz = self.rig.sweep.rate_hz.get();
        if let Some(reached) = made.reached {
            run.recorder.poses(at, reached.microphone_mm, reached.speaker_mm)?;
            if let Some(joints) = &reached.joints {
                run.recorder.record_joints(at, joints)?;
            }
        }
        let sample = AmbientSample {
            temperature_c: reading.temperature_c,
            humidity_pct: reading.humidity_pct,
            pressure_hpa: reading.pressure_hpa,
            outside_level_db: reading.outside_level_db,
        };
        run.recorder.environment(reading.at, &sample)?;
        for (device, notice) in self.devices.take_notices() {
            run.recorder.log(at, LogLevel::Warning, device, &notice)?;
        }
        // Without a temperature they are useless; the verdict has the sensor's values.
        let is_usable = made.reached.is_some() && Celsius::new(reading.temperature_c).is_ok();
        let air = measured_air(reading);
        if run.options.keep == RecordingMode::Sweeps && is_usable {
            let recording_of = |take: &AudioTake| SweepRecording {
                pair_id: m.pair_id,
                attempt: m.attempt,
                sample_rate_hz,
                sample_count: take.microphone.len() as u32,
                format: SampleFormat::S24Split.into(),
                microphone: split_24(&take.microphone).into(),
                loopback: split_24(&take.loopback).into(),
                temperature_c: reading.temperature_c,
                humidity_pct: Some(air.humidity_pct),
                pressure_hpa: Some(air.pressure_hpa),
                playing_clock_ppm: None,
            };
            run.recorder.sweep(at, &recording_of(&self.take))?;
            if self.rig.sweep.repeat > 1 {
                run.recorder.record_repeat(at, &recording_of(&self.repeat))?;
            }
        }
        if made.response == ResponseState::Deconvolved && is_usable {
            let ir = ImpulseResponse {
                pair_id: m.pair_id,
                attempt: m.attempt,
                sample_rate_hz,
                samples: self.ir.clone(),
                temperature_c: reading.temperature_c,
                temperature_corrected: false,
                humidity_pct: Some(air.humidity_pct),
                pressure_hpa: Some(air.pressure_hpa),
            };
            run.recorder.ir(at, &ir)?;
        }
        run.recorder.measurement(at, m)?;
        if m.verdict() != Verdict::Accepted {
            let next = if m.verdict() == Verdict::Repeated { "retried" } else { "given up" };
            let what = format!("pair {}, attempt {}: {}; {next}", m.pair_id, m.attempt, m.reasons.join("; "));
            run.recorder.log(at, LogLevel::Warning, NAME, &what)?;
        }
        Ok(())
    }
}

// Retries a device that fails, a few times.
fn retry_device<T>(mut ask: impl FnMut() -> Result<T, RigError>) -> Result<T, RigError> {
    for _ in 1..TRIES {
        if let Ok(answer) = ask() {
            return Ok(answer);
        }
    }
    ask()
}

fn verdict_on(
    pair: Pair,
    attempt: u32,
    verdict: Verdict,
    objections: &[TakeObjection],
    reading: &AmbientReading,
) -> Measurement {
    Measurement {
        pair_id: pair.id.0,
        attempt,
        microphone: pair.microphone.0,
        speaker: pair.speaker.0,
        verdict: verdict.into(),
        outside_level_db: reading.outside_level_db,
        temperature_c: reading.temperature_c,
        humidity_pct: reading.humidity_pct,
        pressure_hpa: reading.pressure_hpa,
        reasons: objections.iter().map(ToString::to_string).collect(),
        ..Measurement::default()
    }
}

// A comparison with NaN raises no objection, and a take with unknown values is no good one.
fn find_unknowns(found: &TakeAssessment, reading: &AmbientReading) -> Vec<TakeObjection> {
    let values = [
        (SIGNAL_TO_NOISE, found.snr_db),
        (ARRIVAL, found.arrival_error_us),
        // Infinite is as bad as unknown here, while a take without any noise has an infinite ratio.
        ("temperature", if reading.temperature_c.is_finite() { reading.temperature_c } else { f64::NAN }),
        ("level outside", reading.outside_level_db),
    ];
    values.into_iter().filter(|(_, x)| x.is_nan()).map(|(what, _)| TakeObjection::Unknown { what }).collect()
}

// Samples as fractions of full scale; returns how many are at it.
fn to_fractions(samples: &[i32], out: &mut Vec<f32>) -> u32 {
    out.clear();
    out.extend(samples.iter().map(|x| *x as f32 / FULL_SCALE));
    samples.iter().filter(|x| **x <= -(1 << 23) || **x >= (1 << 23) - 1).count() as u32
}

// Without humidity and pressure from the sensor they are the reference air's.
fn measured_air(reading: &AmbientReading) -> AirState {
    AirState::with_known(reading.temperature_c, Some(reading.humidity_pct), Some(reading.pressure_hpa))
}

fn unknown_assessment(clipped_samples: u32) -> TakeAssessment {
    let unknown = f64::NAN;
    TakeAssessment {
        snr_db: unknown,
        clipped_samples,
        loopback_dbfs: unknown,
        arrival_error_us: unknown,
        analysis: TakeAnalysis::unknown(),
    }
}
