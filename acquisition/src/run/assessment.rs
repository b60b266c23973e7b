//! Quality of a recording: signal-to-noise ratio, clipping, loopback, clocks, lost samples, and arrival of the direct
//! sound.

use echolake_dsp::deconvolution::JointSpectrum;
use echolake_dsp::level::power_to_db;
use echolake_dsp::sweep::SineSweep;
use echolake_dsp::take_analysis::{TakeAnalysis, TakeAnalyzer, TakeFault, TakeScratch};
use echolake_dsp::temperature::ReferenceAir;
use echolake_dsp::{Error, chain};
use echolake_schema::Rig;
use echolake_schema::rig::Validation;

use crate::run::objection::TakeObjection;

/// Width of the tapers at the limits of the sweep's range, in periods per time until the part that holds noise alone.
/// Hard limits ring until there, 46 dB below the response. These take 60 dB off, and as little of the range as that
/// needs, because the direct sound beside the tweeter's beam is strongest at its lower end.
const TAPER_PERIODS: f64 = 16.0;
/// Half width of the search window around the direct sound's expected time, samples: the first echo follows it by nine
/// samples at least.
const ARRIVAL_WINDOW: f64 = 5.0;
/// Least share of the strongest sample at which an arrival counts: a peak at the expected time is the direct sound only
/// if it reaches this share itself and nothing before it does. The ringing of a band-limited arrival stays under 0.22,
/// a reflection under the direct sound or, focused, not far over it.
const ARRIVAL_SHARE: f32 = 0.3;

/// Greatest energy of the difference between two takes' responses over that of the first, dB, beyond their noise: what
/// is subtracted of Foam is known as well as that.
const MAX_TIME_VARIANCE_DB: f64 = -40.0;
/// Standard deviations of an estimated noise within which a difference is explained by it.
const NOISE_DEVIATIONS: f64 = 3.0;

/// Assessment of one recording.
#[derive(Debug, Clone, PartialEq)]
pub struct TakeAssessment {
    /// Mean power of the response's first part, as long as the rig's responses, over that of the noise far behind it,
    /// dB. Both are in the sweep's range, which is tapered at its limits. NaN if the recording is too short to tell.
    pub snr_db: f64,
    /// Samples at full scale, both channels.
    pub clipped_samples: u32,
    /// Level of the loopback, dB re full scale.
    pub loopback_dbfs: f64,
    /// Direct sound's arrival minus the expected one, us; NaN if the expected one is outside of the response. If there
    /// is no direct sound at the expected time, the arrival is the first strong one, at any time.
    pub arrival_error_us: f64,
    /// Loopback, clocks, distortion, and lost samples.
    pub analysis: TakeAnalysis,
}

/// Difference between the responses of two takes of one pair, which nothing should change (ISO 18233:2006).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RepeatDifference {
    /// Energy of the difference over that of the first response, dB.
    pub difference_db: f64,
    /// The noise in it, likewise.
    pub noise_db: f64,
    /// The part that noise does not explain, likewise; negative infinity if it explains all.
    pub unexplained_db: f64,
}

/// Assesses recordings of one length.
pub struct TakeAssessor {
    analyzer: TakeAnalyzer,
    /// Gains of the response's bins.
    gains: Vec<f32>,
    response: Vec<f32>,
    scratch: TakeScratch,
    signal_len: usize,
    rate_hz: f64,
    /// Sweep's range over half the sampling rate: independent values of a sample.
    bandwidth_share: f64,
}

impl TakeAssessor {
    /// Plans for recordings of `recording_len` samples of this rig.
    ///
    /// # Errors
    /// As [`TakeAnalyzer::new`].
    pub fn new(rig: &Rig, recording_len: usize) -> Result<Self, Error> {
        let rate_hz = rig.sweep.rate_hz.get();
        let signal_len = response_len(rig).min(recording_len);
        let quiet = quiet_range(recording_len, signal_len);
        let analyzer = TakeAnalyzer::new(SineSweep::from_rig(&rig.sweep), recording_len)?;
        Ok(Self {
            gains: analyzer.taper_gains(TAPER_PERIODS * rate_hz / quiet.start.max(1) as f64),
            analyzer,
            response: vec![0.0; recording_len],
            scratch: TakeScratch::default(),
            signal_len,
            rate_hz,
            bandwidth_share: (rig.sweep.high_hz - rig.sweep.low_hz) / (rate_hz / 2.0),
        })
    }

    /// Assesses one recording; samples are fractions of full scale. `joint` is the transform of both channels, if they
    /// were deconvolved.
    ///
    /// # Errors
    /// As [`TakeAnalyzer::deconvolve_take`]: a silent loopback leaves nothing to assess.
    pub fn assess_take(
        &mut self,
        [microphone, loopback]: [&[f32]; 2],
        joint: Option<JointSpectrum<'_, f32>>,
        expected_arrival_secs: f64,
        clipped_samples: u32,
    ) -> Result<TakeAssessment, Error> {
        let Self { analyzer, gains, response, scratch, .. } = self;
        let analysis = analyzer.deconvolve_take([microphone, loopback], joint, gains, response, scratch)?;
        Ok(TakeAssessment {
            snr_db: self.snr_db(),
            clipped_samples,
            loopback_dbfs: power_to_db(mean_power(loopback)),
            arrival_error_us: self.arrival_error_us(expected_arrival_secs),
            analysis,
        })
    }

    /// Returns the whole response of the recording that was assessed last, as long as the recording.
    pub fn response(&self) -> &[f32] {
        &self.response
    }

    /// Compares the response that was assessed last, of a pair's second take, with that of the first.
    ///
    /// first `[recording_len]`: [`Self::response`] of the first take
    pub fn compare_repeat(&self, first: &[f32]) -> RepeatDifference {
        let difference: Vec<f32> = self.response.iter().zip(first).map(|(b, a)| b - a).collect();
        let quiet = quiet_range(difference.len(), self.signal_len);
        let values = self.bandwidth_share * quiet.len().min(self.signal_len).max(1) as f64;
        let [signal, found] = [first, &difference].map(|x| mean_power(&x[..self.signal_len]));
        // Without a quiet part the ratio of signal and noise is unknown, which is an objection of its own.
        let noise = difference.get(quiet).map_or(f64::NAN, mean_power);
        let explained = noise * (1.0 + NOISE_DEVIATIONS * (4.0 / values).sqrt());
        let [difference_db, noise_db, unexplained_db] =
            [found, noise, (found - explained).max(0.0)].map(|power| power_to_db(power / signal));
        RepeatDifference { difference_db, noise_db, unexplained_db }
    }

    // The deconvolution spreads noise over the whole length; far behind the response there is nothing else.
    fn snr_db(&self) -> f64 {
        let quiet = quiet_range(self.response.len(), self.signal_len);
        let (Some(noise), signal) = (self.response.get(quiet), &self.response[..self.signal_len]) else {
            return f64::NAN;
        };
        let noise = mean_power(noise);
        power_to_db((mean_power(signal) - noise).max(0.0) / noise)
    }

    fn arrival_error_us(&self, expected_secs: f64) -> f64 {
        let expected = expected_secs * self.rate_hz;
        let from = (expected - ARRIVAL_WINDOW).ceil().max(1.0) as usize;
        let to = ((expected + ARRIVAL_WINDOW).floor().max(0.0) as usize).min(self.response.len().saturating_sub(2));
        let magnitude = |n: usize| f64::from(self.response[n].abs());
        let Some(near) = (from..=to).max_by(|a, b| magnitude(*a).total_cmp(&magnitude(*b))) else { return f64::NAN };
        let first = self.first_arrival(to);
        let peak = if (from..=to).contains(&first) { near } else { first };
        // A parabola through the peak and its neighbours.
        let [before, at, after] = [peak - 1, peak, peak + 1].map(magnitude);
        let bend = before - 2.0 * at + after;
        let shift = if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-1.0, 1.0) } else { 0.0 };
        (peak as f64 + shift - expected) / self.rate_hz * 1e6
    }

    // The local maximum that follows the first sample of a strong arrival, up to the response's end or `to`.
    fn first_arrival(&self, to: usize) -> usize {
        let end = self.signal_len.max(to + 1).min(self.response.len() - 1);
        let searched = &self.response[..end];
        let strongest = searched.iter().fold(0.0f32, |most, x| most.max(x.abs()));
        let strong = searched.iter().position(|x| x.abs() >= ARRIVAL_SHARE * strongest).unwrap_or(0);
        let rises = |n: &usize| self.response[n + 1].abs() > self.response[*n].abs();
        (strong.max(1)..end - 1).find(|n| !rises(n)).unwrap_or(end - 1).max(1)
    }
}

impl RepeatDifference {
    /// Returns the reason against both takes, if they differ by more than their noise.
    pub fn find_objection(self) -> Option<TakeObjection> {
        let Self { difference_db, noise_db, unexplained_db } = self;
        let most_db = MAX_TIME_VARIANCE_DB;
        (unexplained_db > most_db).then_some(TakeObjection::TimeVariance { difference_db, noise_db, most_db })
    }
}

impl TakeAssessment {
    /// Returns the rig's reasons against the recording; empty if it would accept it.
    pub fn find_objections(&self, limits: &Validation, outside_level_db: f64) -> Vec<TakeObjection> {
        let mut reasons = Vec::new();
        if self.clipped_samples > 0 {
            reasons.push(TakeObjection::Clipped { samples: self.clipped_samples });
        }
        // Distortion is the rig's own, and no other take would be without it.
        let faults = self.analysis.faults.iter().filter(|fault| !matches!(fault, TakeFault::Distortion { .. }));
        reasons.extend(faults.cloned().map(TakeObjection::Take));
        if self.snr_db < limits.snr_db {
            reasons.push(TakeObjection::Noise { snr_db: self.snr_db, least_db: limits.snr_db });
        }
        if self.arrival_error_us.abs() > limits.arrival_us {
            reasons.push(TakeObjection::Arrival { off_us: self.arrival_error_us, most_us: limits.arrival_us });
        }
        if outside_level_db > limits.outside_level_db {
            reasons.push(TakeObjection::Outside { level_db: outside_level_db, most_db: limits.outside_level_db });
        }
        reasons
    }
}

/// Samples of a rig's responses, before they are corrected to the reference temperature.
pub(crate) fn response_len(rig: &Rig) -> usize {
    chain::raw_len(rig.impulse_response.length, &ReferenceAir::from_response(&rig.impulse_response))
}

/// Samples of a deconvolved recording behind the response that hold noise alone; an empty range if there are none.
pub(crate) fn quiet_range(recorded: usize, response: usize) -> std::ops::Range<usize> {
    (recorded / 2).max(response)..recorded / 4 * 3
}

fn mean_power(x: &[f32]) -> f64 {
    echolake_dsp::energy::energy(x) / x.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use echolake_dsp::deconvolution::fast_length;
    use echolake_dsp::sweep::SweepShape;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution as _, StandardNormal};

    // A sweep and its echo-free recording, `delay` samples late, in a little noise.
    fn assessed(delay: usize, expected: f64) -> TakeAssessment {
        let rig = Rig::from_toml("sweep.duration_secs = 0.03").expect("a rig");
        let sweep = SineSweep::from_rig(&rig.sweep);
        let mut loopback: Vec<f32> = sweep.samples().iter().map(|x| 0.5 * *x as f32).collect();
        loopback.resize(rig.recording_len(), 0.0);
        let mut state = 1u32;
        let mut microphone: Vec<f32> = (0..loopback.len())
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / 16_777_216.0 * 1e-5
            })
            .collect();
        microphone[delay..].iter_mut().zip(&loopback).for_each(|(m, l)| *m += 0.3 * l);
        let mut assessor = TakeAssessor::new(&rig, loopback.len()).expect("a plan");
        assessor.assess_take([&microphone, &loopback], None, expected / 96e3, 0).expect("assessed")
    }

    // A sweep of amplitude A, T seconds and B Hz has a power spectrum of (A rate)^2 T / 4 B within its range
    // (stationary phase; Klauder 1960), and white noise of N samples one of N sigma^2. Fades weigh response and noise
    // alike.
    #[test]
    fn the_ratio_of_signal_and_noise_is_the_true_one() {
        for duration_secs in [0.03, 0.5] {
            let rig = Rig::from_toml(&format!("sweep.duration_secs = {duration_secs}")).expect("a rig");
            let sweep = SineSweep {
                shape: SweepShape::Linear,
                rate_hz: 96e3,
                duration_secs,
                low_hz: 2e3,
                high_hz: 40e3,
                fade_secs: 1e-3,
            };
            let mut loopback: Vec<f32> = sweep.samples().iter().map(|x| 0.5 * *x as f32).collect();
            loopback.resize(rig.recording_len(), 0.0);
            let mut assessor = TakeAssessor::new(&rig, loopback.len()).expect("a plan");
            let transformed = fast_length(loopback.len()) as f64;
            let spectrum = (0.5 * 96e3f64).powi(2) * duration_secs / (4.0 * 38e3);
            let signal = 0.3f64.powi(2) / response_len(&rig) as f64;
            for true_db in [30.0, 50.0, 70.0, 90.0] {
                let noise = signal / 10f64.powf(true_db / 10.0);
                let sigma = (noise * spectrum * transformed / loopback.len() as f64).sqrt();
                let mut rng = ChaCha8Rng::seed_from_u64(7);
                let normal = std::iter::repeat_with(|| -> f64 { StandardNormal.sample(&mut rng) });
                let mut microphone: Vec<f32> = normal.take(loopback.len()).map(|x| (sigma * x) as f32).collect();
                microphone[60..].iter_mut().zip(&loopback).for_each(|(m, l)| *m += 0.3 * l);
                let found = assessor.assess_take([&microphone, &loopback], None, 60.0 / 96e3, 0).expect("assessed");
                assert!((found.snr_db - true_db).abs() < 1.0, "{duration_secs} s: {true_db}, {}", found.snr_db);
            }
        }
    }

    #[test]
    fn an_arrival_is_told_however_far_off_it_is() {
        // One sample is 10.4 us. Half a sample off, the parabola is right to a tenth of one.
        for off in [-80i32, -37, -12, -7, -3, -1, 0, 1, 3, 7, 12, 37, 80, 200] {
            for fraction in [0.0, 0.4] {
                let expected = f64::from(100 - off) + fraction;
                let told = assessed(100, expected.max(2.0)).arrival_error_us;
                let wanted = (100.0 - expected.max(2.0)) / 96e3 * 1e6;
                assert!((told - wanted).abs() < 2.0, "{off}, {fraction}: {told} us, {wanted} us");
            }
        }
    }

    #[test]
    fn an_arrival_outside_of_the_response_is_unknown() {
        assert!(assessed(100, 1e6).arrival_error_us.is_nan());
    }
}
