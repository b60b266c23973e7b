//! The excitation: a linear or exponential sine sweep with half-cosine fades.

use std::f64::consts::PI;

pub use echolake_schema::SweepShape;

/// A sine sweep.
///
/// ```
/// use echolake_dsp::sweep::{SineSweep, SweepShape};
///
/// let sweep = SineSweep {
///     shape: SweepShape::Linear,
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
pub struct SineSweep {
    /// Course of its frequency.
    pub shape: SweepShape,
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

impl SineSweep {
    /// Makes the sweep that a rig plays, at peak 1.
    pub fn from_rig(sweep: &echolake_schema::rig::Sweep) -> Self {
        Self {
            shape: sweep.shape,
            rate_hz: sweep.rate_hz.get(),
            duration_secs: sweep.duration_secs,
            low_hz: sweep.low_hz,
            high_hz: sweep.high_hz,
            fade_secs: sweep.fade_secs,
        }
    }

    /// Samples in it.
    #[allow(clippy::len_without_is_empty, reason = "an empty sweep is none")]
    pub fn len(&self) -> usize {
        (self.duration_secs * self.rate_hz).round() as usize
    }

    /// The samples, peak 1.
    pub fn samples(&self) -> Vec<f64> {
        let n = self.len();
        let mut samples: Vec<f64> =
            (0..n).map(|i| (2.0 * PI * self.cycles_at_time(i as f64 / self.rate_hz)).sin()).collect();
        let fade = ((self.fade_secs * self.rate_hz).round() as usize).min(n);
        for i in 0..fade {
            let ramp = 0.5 - 0.5 * (PI * (i as f64 + 0.5) / fade as f64).cos();
            samples[i] *= ramp;
            samples[n - 1 - i] *= ramp;
        }
        samples
    }

    /// Periods from the start until a time, s (for exponential ones: Farina 2000, AES 108, paper 5093).
    pub fn cycles_at_time(&self, t: f64) -> f64 {
        match self.shape {
            SweepShape::Linear => self.low_hz * t + (self.high_hz - self.low_hz) / (2.0 * self.duration_secs) * t * t,
            SweepShape::Exponential => self.low_hz * self.efold_secs() * (t / self.efold_secs()).exp_m1(),
        }
    }

    /// Time in which an exponential sweep's frequency grows by e, s.
    pub fn efold_secs(&self) -> f64 {
        self.duration_secs / (self.high_hz / self.low_hz).ln()
    }

    /// Time at which it passes a frequency, s after its start.
    pub fn time_at(&self, hz: f64) -> f64 {
        match self.shape {
            SweepShape::Linear => (hz - self.low_hz) / (self.high_hz - self.low_hz) * self.duration_secs,
            SweepShape::Exponential => self.efold_secs() * (hz / self.low_hz).ln(),
        }
    }

    /// Integral of [`Self::time_at`] over frequency, periods: its spectrum's phase, up to a constant and with the sign
    /// turned.
    pub fn phase_cycles(&self, hz: f64) -> f64 {
        match self.shape {
            SweepShape::Linear => (hz - self.low_hz) * self.time_at(hz) / 2.0,
            SweepShape::Exponential => hz * (self.time_at(hz) - self.efold_secs()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(shape: SweepShape, duration_secs: f64, fade_secs: f64) -> SineSweep {
        SineSweep { shape, rate_hz: 96e3, duration_secs, low_hz: 2e3, high_hz: 40e3, fade_secs }
    }

    #[test]
    fn it_starts_and_ends_silent_and_reaches_full_scale() {
        for shape in [SweepShape::Linear, SweepShape::Exponential] {
            let samples = sweep(shape, 0.05, 0.001).samples();
            assert_eq!(samples.len(), 4800);
            assert!(samples[0].abs() < 1e-3 && samples[4799].abs() < 1e-3);
            let peak = samples.iter().fold(0.0f64, |a, x| a.max(x.abs()));
            assert!((0.999..=1.0).contains(&peak), "{peak}");
        }
    }

    // Zero crossings in 10 ms around the middle: twice the frequency there times 10 ms. The middle of a linear sweep is
    // the arithmetic mean of its limits, 21 kHz, that of an exponential one the geometric mean, 8.944 kHz.
    #[test]
    fn its_frequency_rises_evenly_or_by_equal_factors() {
        for (shape, middle_hz) in [(SweepShape::Linear, 21e3), (SweepShape::Exponential, 8_944.27)] {
            let sweep = sweep(shape, 0.5, 0.0);
            let samples = sweep.samples();
            let middle = &samples[24_000 - 480..24_000 + 480];
            let crossings = middle.windows(2).filter(|w| w[0] * w[1] < 0.0).count() as f64;
            assert!((crossings - 0.02 * middle_hz).abs() < 2.0, "{shape:?}: {crossings}");
            assert!((sweep.time_at(middle_hz) - 0.25).abs() < 1e-6, "{shape:?}");
            let slope = (sweep.phase_cycles(middle_hz + 1.0) - sweep.phase_cycles(middle_hz - 1.0)) / 2.0;
            assert!((slope - 0.25).abs() < 1e-6, "{shape:?}: {slope}");
        }
    }
}
