//! The excitation: a linear sine sweep with half-cosine fades.

use std::f64::consts::PI;

/// A linear sine sweep.
///
/// ```
/// let sweep = echolake_dsp::sweep::LinearSweep {
///     rate_hz: 96e3,
///     duration_secs: 0.5,
///     low_hz: 2e3,
///     high_hz: 40e3,
///     fade_secs: 0.001,
/// };
/// let samples = sweep.samples();
/// assert_eq!(samples.len(), 48_000);
/// assert!(samples.iter().all(|x| x.abs() <= 1.0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinearSweep {
    /// Sampling rate, Hz.
    pub rate_hz: f64,
    /// Duration, s.
    pub duration_secs: f64,
    /// Frequency at the start, Hz.
    pub low_hz: f64,
    /// Frequency at the end, Hz.
    pub high_hz: f64,
    /// Half-cosine fade at either end, s.
    pub fade_secs: f64,
}

impl LinearSweep {
    /// Samples in it.
    #[allow(clippy::len_without_is_empty, reason = "an empty sweep is none")]
    pub fn len(&self) -> usize {
        (self.duration_secs * self.rate_hz).round() as usize
    }

    /// The samples, peak 1.
    pub fn samples(&self) -> Vec<f64> {
        let n = self.len();
        let slope = (self.high_hz - self.low_hz) / (2.0 * self.duration_secs);
        let at = |i: usize| {
            let t = i as f64 / self.rate_hz;
            (2.0 * PI * (self.low_hz * t + slope * t * t)).sin()
        };
        let mut samples: Vec<f64> = (0..n).map(at).collect();
        let fade = ((self.fade_secs * self.rate_hz).round() as usize).min(n);
        for i in 0..fade {
            let ramp = 0.5 - 0.5 * (PI * (i as f64 + 0.5) / fade as f64).cos();
            samples[i] *= ramp;
            samples[n - 1 - i] *= ramp;
        }
        samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_starts_and_ends_silent_and_reaches_full_scale() {
        let sweep = LinearSweep { rate_hz: 96e3, duration_secs: 0.05, low_hz: 2e3, high_hz: 40e3, fade_secs: 0.001 };
        let samples = sweep.samples();
        assert_eq!(samples.len(), 4800);
        assert!(samples[0].abs() < 1e-3 && samples[4799].abs() < 1e-3);
        let peak = samples.iter().fold(0.0f64, |a, x| a.max(x.abs()));
        assert!((0.999..=1.0).contains(&peak), "{peak}");
    }

    #[test]
    fn its_frequency_rises_evenly() {
        let sweep = LinearSweep { rate_hz: 96e3, duration_secs: 0.5, low_hz: 2e3, high_hz: 40e3, fade_secs: 0.0 };
        let samples = sweep.samples();
        // Zero crossings in a stretch of 10 ms in the middle: twice 21 kHz times 10 ms.
        let middle = &samples[24_000 - 480..24_000 + 480];
        let crossings = middle.windows(2).filter(|w| w[0] * w[1] < 0.0).count();
        assert!((418..=422).contains(&crossings), "{crossings}");
    }
}
