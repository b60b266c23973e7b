//! What is read off a pair's responses: levels, phase, group delay and spectrogram, by the kernels of the lake's own
//! numbers.

use axum::Extension;
use echolake_dsp::arrival::first_arrival;
use echolake_dsp::decay::energy_decay_db;
use echolake_dsp::envelope::EnvelopePlan;
use echolake_dsp::frequency_response::{FrequencyResponse, FrequencyResponsePlan};
use echolake_dsp::level::plotted_power_to_db;
use echolake_dsp::spectrogram::SpectrogramPlan;
use echolake_dsp::temperature::ReferenceAir;
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::pair::{PairPath, ResponseSignal, find_geometry, read_samples};
use super::request::CatalogueRequest;

/// Samples that are analysed; what follows them is left out.
const MOST_SAMPLES: usize = 65_536;
/// Frequencies of an answer; of more, only each second, third, ... is answered.
const MOST_FREQUENCIES: usize = 4096;
/// Windows of a spectrogram.
const MOST_WINDOWS: usize = 512;
/// Distance of a spectrogram's windows, unless that makes too many.
const LEAST_STEP: usize = 2;
/// Shortest windows of a spectrogram, which suit responses of the paper's rig.
const WINDOW_SECS: f64 = 0.5e-3;
/// Length of a spectrogram's windows as a share of a long response.
const WINDOW_SHARE: f64 = 0.01;
/// Reach around the direct sound's time in which its highest value is looked for.
const DIRECT_REACH_SECS: f64 = 0.1e-3;
/// Level re the greatest sample at which a late response begins (ISO 3382-1).
const ARRIVAL_DB: f64 = -20.0;
/// Lowest level of a decay; JSON has no infinity.
const LEAST_DECAY_DB: f64 = -200.0;

/// A delay that phase and group delay are less.
#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "direct")]
enum RemovedDelay {
    #[default]
    Direct,
    Reflected,
    None,
}

/// The smoothing, and the delay that is taken off.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct AnalysisQuery {
    /// Level and group delay are means over the n-th part of an octave, by power; 0: they are not smoothed.
    #[param(inline)]
    octave: WholeNumber<0, 48, 0>,
    #[param(inline)]
    delay: RemovedDelay,
}

/// A pair's responses over time and frequency. Levels are re 1, and -200 dB at least.
#[derive(Serialize, ToSchema)]
struct PairAnalysis {
    surface_id: String,
    pair_id: usize,
    /// Travel time of the direct sound at the reference temperature.
    direct_s: f64,
    /// Travel time of the sound that the panel reflects.
    reflected_s: f64,
    /// Time of the direct sound in the response: `direct_s`, unless the measurement's `arrival_error_us` is over 100
    /// us, as it is if the loopback lacks the delay of the audio interface. Then the first sample within 20 dB of the
    /// greatest.
    arrival_s: f64,
    /// The delay that phase and group delay are less.
    removed_s: f64,
    /// Highest level of the measured response's envelope around the direct sound.
    direct_db: f64,
    /// Within the range of the sweep.
    frequency_hz: Vec<f64>,
    measured: ResponseAnalysis,
    /// Null if Foam is missing.
    reflected: Option<ResponseAnalysis>,
    flat_reflected: Option<ResponseAnalysis>,
}

/// A response by sample and by frequency.
#[derive(Serialize, ToSchema)]
struct ResponseAnalysis {
    /// By sample.
    sample_db: Vec<f32>,
    /// Of the envelope, by sample: the energy-time curve.
    envelope_db: Vec<f32>,
    /// Energy from each sample to the end over all of it (Schroeder), by sample.
    decay_db: Vec<f32>,
    level_db: Vec<f32>,
    /// Unwrapped upwards from the lowest frequency; not smoothed.
    phase_deg: Vec<f32>,
    group_delay_ms: Vec<f32>,
}

/// The responses of a pair over time and over frequency.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}/analysis",
    tag = "catalogue",
    params(PairPath, AnalysisQuery),
    responses((status = 200, description = "OK", body = PairAnalysis)),
    extensions(("x-sql" = json!(["as of pair; Fourier transforms"])))
)]
pub(super) async fn analysis(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
    QueryParams(query): QueryParams<AnalysisQuery>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let pair = request.parse_pair(&path.pair_id)?;
    let found = tokio::try_join!(read_samples(&request, entry, pair), find_geometry(&request, pair));
    let ((measurement, [own, flat]), geometry) = found?;
    let rig = request.catalogue.lake().rig();
    let speed_mm_s = 1000.0 * ReferenceAir::from_response(&rig.impulse_response).speed_of_sound();
    let direct_s = geometry.direct_mm / speed_mm_s;
    let reflected_s = geometry.image_mm / speed_mm_s;
    let rate_hz = rig.sweep.rate_hz.get();
    let arrival_s = if measurement.is_off_by(DIRECT_REACH_SECS) {
        first_arrival(&measurement.ir, ARRIVAL_DB).map_or(direct_s, |samples| samples / rate_hz)
    } else {
        direct_s
    };
    let removed_s = match query.delay {
        RemovedDelay::Direct => arrival_s,
        RemovedDelay::Reflected => arrival_s + reflected_s - direct_s,
        RemovedDelay::None => 0.0,
    };
    let octaves = match query.octave.get() {
        0 => 0.0,
        part => 1.0 / part as f64,
    };
    let analyser = ResponseAnalyser { rate_hz, range_hz: [rig.sweep.low_hz, rig.sweep.high_hz], octaves, removed_s };
    let surface_id = entry.surface.surface_id.clone();
    let analyse = move || {
        let measured = analyser.analyse_samples(&measurement.ir)?;
        Ok(PairAnalysis {
            surface_id,
            pair_id: pair,
            direct_s,
            reflected_s,
            arrival_s,
            removed_s,
            direct_db: analyser.highest_around(&measured.envelope_db, arrival_s),
            frequency_hz: analyser.frequencies_hz(&measurement.ir)?,
            measured,
            reflected: own.as_deref().map(|samples| analyser.analyse_samples(samples)).transpose()?,
            flat_reflected: flat.as_deref().map(|samples| analyser.analyse_samples(samples)).transpose()?,
        })
    };
    let found: Result<PairAnalysis, echolake_dsp::Error> =
        request.catalogue.service().compute_blocking(analyse).await?;
    Ok(AnswerContent::encode_json(&found.map_err(no_analysis(pair))?)?)
}

/// Kernels with their settings.
struct ResponseAnalyser {
    rate_hz: f64,
    range_hz: [f64; 2],
    octaves: f64,
    removed_s: f64,
}

impl ResponseAnalyser {
    fn plan_response(&self, len: usize) -> Result<FrequencyResponsePlan, echolake_dsp::Error> {
        FrequencyResponsePlan::new(len, self.rate_hz, self.range_hz)
    }

    fn analyse_samples(&self, samples: &[f32]) -> Result<ResponseAnalysis, echolake_dsp::Error> {
        let samples = first_samples(samples);
        let mut envelope = vec![0.0; samples.len()];
        let plan = EnvelopePlan::new(samples.len())?;
        plan.compute_envelope(&samples, &mut envelope, &mut plan.make_scratch())?;
        let mut decay = vec![0.0; samples.len()];
        energy_decay_db(&samples, &mut decay);
        let plan = self.plan_response(samples.len())?;
        let mut response = FrequencyResponse::default();
        plan.compute_response(&samples, self.octaves, self.removed_s, &mut response, &mut plan.make_scratch())?;
        let delays_ms = response.group_delay_secs.iter().map(|seconds| 1000.0 * seconds);
        Ok(ResponseAnalysis {
            sample_db: samples.iter().map(|x| plotted_power_to_db(x * x) as f32).collect(),
            envelope_db: envelope.iter().map(|x| plotted_power_to_db(x * x) as f32).collect(),
            decay_db: decay.iter().map(|level| level.max(LEAST_DECAY_DB) as f32).collect(),
            level_db: thin_values(response.level_db.iter().copied()),
            phase_deg: thin_values(response.phase_deg.iter().copied()),
            group_delay_ms: thin_values(delays_ms),
        })
    }

    fn frequencies_hz(&self, samples: &[f32]) -> Result<Vec<f64>, echolake_dsp::Error> {
        let all: Vec<f64> = self.plan_response(samples.len().min(MOST_SAMPLES))?.frequencies_hz().collect();
        let step = all.len().div_ceil(MOST_FREQUENCIES);
        Ok(all.into_iter().step_by(step).collect())
    }

    /// Returns the highest level from a short time before a time to as long after it.
    fn highest_around(&self, levels_db: &[f32], time_s: f64) -> f64 {
        let sample = |time_s: f64| (time_s * self.rate_hz).round().max(0.0) as usize;
        let last = sample(time_s + DIRECT_REACH_SECS).min(levels_db.len().saturating_sub(1));
        let around = levels_db.get(sample(time_s - DIRECT_REACH_SECS)..=last).unwrap_or_default();
        around.iter().copied().fold(plotted_power_to_db(0.0), |highest, level| highest.max(level.into()))
    }
}

/// The signal of a spectrogram.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct SpectrogramQuery {
    #[param(inline)]
    signal: ResponseSignal,
}

/// A response's levels over time and frequency, by Hann windows: a hundredth of the response, half a millisecond at
/// least.
#[derive(Serialize, ToSchema)]
struct Spectrogram {
    /// Windows; the first one's centre is the first sample.
    times: usize,
    step_s: f64,
    /// Frequencies, from 0 Hz to half the rate.
    bins: usize,
    bin_hz: f64,
    window_s: f64,
    /// Below the highest, to a tenth; by time, then by frequency.
    level_db: Vec<f32>,
}

/// A response's levels over time and frequency.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}/spectrogram",
    tag = "catalogue",
    params(PairPath, SpectrogramQuery),
    responses((status = 200, description = "OK", body = Spectrogram)),
    extensions(("x-sql" = json!(["as of pair; Fourier transforms"])))
)]
pub(super) async fn spectrogram(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
    QueryParams(query): QueryParams<SpectrogramQuery>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let pair = request.parse_pair(&path.pair_id)?;
    let samples = query.signal.read_samples(&request, entry, pair).await?;
    let rate_hz = request.catalogue.lake().rig().sweep.rate_hz.get();
    let found = request.catalogue.service().compute_blocking(move || find_spectrogram(&samples, rate_hz)).await?;
    Ok(AnswerContent::encode_json(&found.map_err(no_analysis(pair))?)?)
}

fn find_spectrogram(samples: &[f32], rate_hz: f64) -> Result<Spectrogram, echolake_dsp::Error> {
    let samples = first_samples(samples);
    let shortest = (WINDOW_SECS * rate_hz).max(WINDOW_SHARE * samples.len() as f64);
    let window = shortest.round().clamp(2.0, MOST_FREQUENCIES as f64) as usize;
    let step = samples.len().div_ceil(MOST_WINDOWS).max(LEAST_STEP);
    let plan = SpectrogramPlan::new(samples.len(), window, step)?;
    let mut levels = vec![0.0; plan.time_count() * plan.bin_count()];
    plan.compute_levels(&samples, &mut levels, &mut plan.make_scratch())?;
    let highest = levels.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    Ok(Spectrogram {
        times: plan.time_count(),
        step_s: step as f64 / rate_hz,
        bins: plan.bin_count(),
        bin_hz: plan.bin_hz(rate_hz),
        window_s: window as f64 / rate_hz,
        level_db: levels.iter().map(|level| ((10.0 * (level - highest)).round() / 10.0) as f32).collect(),
    })
}

fn first_samples(samples: &[f32]) -> Vec<f64> {
    samples.iter().take(MOST_SAMPLES).copied().map(f64::from).collect()
}

fn thin_values(values: impl ExactSizeIterator<Item = f64>) -> Vec<f32> {
    let step = values.len().div_ceil(MOST_FREQUENCIES).max(1);
    values.step_by(step).map(|value| value as f32).collect()
}

fn no_analysis(pair: usize) -> impl FnOnce(echolake_dsp::Error) -> RequestFault {
    move |error| RequestFault::NoData {
        what: format!("pair {pair}: {error}; it"),
        data: "analysis",
        hint: "table `measurements` has its samples",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ANALYSER: ResponseAnalyser =
        ResponseAnalyser { rate_hz: 96e3, range_hz: [2e3, 40e3], octaves: 0.0, removed_s: 0.0 };

    #[test]
    fn an_impulse_is_found_where_it_is() {
        let mut samples = vec![0.0; 384];
        samples[100] = 0.5;
        let found = ANALYSER.analyse_samples(&samples).expect("an analysis");
        let frequencies = ANALYSER.frequencies_hz(&samples).expect("frequencies");
        assert_eq!([found.level_db.len(), found.phase_deg.len(), found.group_delay_ms.len()], [frequencies.len(); 3]);
        let level = 20.0 * 0.5f32.log10();
        assert!(found.level_db.iter().all(|x| (x - level).abs() < 1e-4));
        assert_eq!([found.decay_db[100], found.decay_db[101]], [0.0, -200.0]);
        assert!((found.sample_db[100] - level).abs() < 1e-4 && found.sample_db[99] == -200.0);
        for (time_s, expected) in [(100.0 / 96e3, f64::from(level)), (0.0, -200.0), (1.0, -200.0), (-1.0, -200.0)] {
            assert!((ANALYSER.highest_around(&found.sample_db, time_s) - expected).abs() < 1e-4, "{time_s}");
        }
    }

    #[test]
    fn long_responses_have_bounded_answers() {
        let mut samples = vec![0.0; 100_000];
        samples[70] = 1.0;
        let found = ANALYSER.analyse_samples(&samples).expect("an analysis");
        assert_eq!([found.sample_db.len(), found.envelope_db.len()], [MOST_SAMPLES; 2]);
        let frequencies = ANALYSER.frequencies_hz(&samples).expect("frequencies");
        assert!(frequencies.len() <= MOST_FREQUENCIES && frequencies.len() == found.level_db.len());
        let picture = find_spectrogram(&samples, 96e3).expect("a spectrogram");
        assert!(picture.times <= MOST_WINDOWS && picture.level_db.len() == picture.times * picture.bins);
        assert!(picture.level_db.iter().all(|level| *level <= 0.0) && picture.level_db.contains(&0.0));
    }

    #[test]
    fn damaged_responses_are_named() {
        let fault = ANALYSER.analyse_samples(&[f32::NAN; 4]).map_err(no_analysis(7)).err().expect("a fault");
        assert!(fault.to_string().contains("pair 7: the response has samples that are not finite"), "{fault}");
    }
}
