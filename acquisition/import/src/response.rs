//! One imported response as a run records it: its pair, time and temperature; everything else is unknown.

use echolake_acquisition::run::recorder::{Error, LogLevel, Recorder};
use echolake_dsp::air::AirState;
use echolake_dsp::temperature::{ReferenceAir, TemperatureCorrection};
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, Verdict};
use echolake_schema::{Celsius, Grid, Pair, Rig, Timestamp};

/// A response, recorded as the file has it.
pub(crate) struct ImportedResponse {
    pub pair: Pair,
    pub at: Timestamp,
    /// None if it is unknown.
    pub celsius: Option<Celsius>,
    pub samples: Vec<f32>,
    /// True if it is on the time axis of the rig's reference temperature.
    pub is_corrected: bool,
}

impl ImportedResponse {
    /// Records it as the pair's first attempt, accepted.
    pub fn record_response(self, recorder: &mut Recorder, rig: &Rig, grid: &Grid) -> Result<(), Error> {
        let Self { pair, at, celsius, samples, is_corrected } = self;
        let unknown = f64::NAN;
        let celsius = known_celsius(celsius, rig);
        let [m, s] = [pair.microphone, pair.speaker].map(|id| grid.points()[id.index()].position_mm);
        recorder.poses(at, m, s)?;
        recorder.environment(
            at,
            &AmbientSample {
                temperature_c: celsius,
                humidity_pct: unknown,
                pressure_hpa: unknown,
                outside_level_db: unknown,
            },
        )?;
        recorder.ir(
            at,
            &ImpulseResponse {
                pair_id: pair.id.0,
                attempt: 1,
                sample_rate_hz: rig.sweep.rate_hz.get(),
                samples,
                temperature_c: celsius,
                temperature_corrected: is_corrected,
                ..ImpulseResponse::default()
            },
        )?;
        recorder.measurement(
            at,
            &Measurement {
                pair_id: pair.id.0,
                attempt: 1,
                microphone: pair.microphone.0,
                speaker: pair.speaker.0,
                verdict: Verdict::Accepted.into(),
                snr_db: unknown,
                loopback_level_dbfs: unknown,
                arrival_error_us: unknown,
                clock_ratio_ppm: None,
                repeat_difference_db: None,
                outside_level_db: unknown,
                temperature_c: celsius,
                humidity_pct: unknown,
                pressure_hpa: unknown,
                microphone_residual_mm: unknown,
                speaker_residual_mm: unknown,
                ..Measurement::default()
            },
        )
    }
}

/// Returns the temperature, C, or the reference's, to which nothing is corrected then.
pub(crate) fn known_celsius(celsius: Option<Celsius>, rig: &Rig) -> f64 {
    celsius.unwrap_or(rig.impulse_response.reference_temperature_c).get()
}

/// Records how many responses of a run have an unknown temperature, and returns the same as the run's notes.
pub(crate) fn record_unknown_air(
    recorder: &mut Recorder,
    at: Timestamp,
    source: &str,
    responses: usize,
    rig: &Rig,
) -> Result<Vec<String>, Error> {
    let notes: Vec<_> = describe_unknown_air(responses, rig).into_iter().collect();
    notes.iter().try_for_each(|note| recorder.log(at, LogLevel::Warning, source, note))?;
    Ok(notes)
}

/// Describes responses of unknown temperature.
pub(crate) fn describe_unknown_air(responses: usize, rig: &Rig) -> Option<String> {
    let celsius = known_celsius(None, rig);
    let note = || {
        format!(
            "no temperature is known of {responses} responses: {celsius} C, the reference's, stands in temperature_c, \
             and nothing is corrected"
        )
    };
    (responses > 0).then(note)
}

/// Returns the samples that it takes to bring a response to the reference temperature.
pub(crate) fn least_length(rig: &Rig, celsius: Option<Celsius>, is_corrected: bool) -> usize {
    let air = AirState::with_known(known_celsius(celsius, rig), None, None);
    let ratio = ReferenceAir::from_response(&rig.impulse_response).time_ratio(&air);
    match rig.impulse_response.length {
        length if is_corrected || ratio == 1.0 => length,
        length => TemperatureCorrection::<f64>::input_len_for(length, ratio),
    }
}
