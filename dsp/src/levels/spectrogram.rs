//! Levels of a response over time and frequency.

use std::sync::Arc;

use realfft::RealToComplex;
use realfft::num_complex::Complex;

use crate::error::{check_finite, check_len};
use crate::level::plotted_power_to_db;
use crate::spectrum::bin_count;
use crate::{Error, RealSample};

/// Shorter windows are padded up to this length, so that bins are close enough for a picture.
const LEAST_LEN: usize = 256;

/// Short-time spectra of responses of one length.
///
/// Hann windows, their centres `step` samples apart from the first sample on; beyond the response there are zeros.
///
/// response  `[len]`
/// levels    `[times][bins]`, 20 log10 |X_k| of the windowed samples, dB; -200 dB at least. Bin k is at
///           [`SpectrogramPlan::bin_hz`] times k.
pub struct SpectrogramPlan {
    len: usize,
    step: usize,
    window: Vec<f64>,
    padded_len: usize,
    forward: Arc<dyn RealToComplex<f64>>,
}

/// Buffers of a [`SpectrogramPlan`].
pub struct SpectrogramScratch {
    signal: Vec<f64>,
    spectrum: Vec<Complex<f64>>,
    work: Vec<Complex<f64>>,
}

impl SpectrogramPlan {
    /// Plans for responses of `len` samples, and windows of `window_len`.
    ///
    /// # Errors
    /// [`Error::Setting`] if one of them is 0.
    pub fn new(len: usize, window_len: usize, step: usize) -> Result<Self, Error> {
        if len == 0 || window_len == 0 || step == 0 {
            let actual = format!("{window_len} of {len} samples, {step} apart");
            return Err(Error::Setting { what: "the window", actual, expected: "1 or more of each" });
        }
        let angle = |i: usize| std::f64::consts::TAU * (i as f64 + 0.5) / window_len as f64;
        let window = (0..window_len).map(|i| 0.5 - 0.5 * angle(i).cos()).collect();
        let padded_len = window_len.next_power_of_two().max(LEAST_LEN);
        Ok(Self { len, step, window, padded_len, forward: f64::plan_real_forward(padded_len) })
    }

    /// Windows of a response.
    pub fn time_count(&self) -> usize {
        self.len.div_ceil(self.step)
    }

    /// Bins of a window.
    pub fn bin_count(&self) -> usize {
        bin_count(self.padded_len)
    }

    /// Distance of the bins, Hz.
    pub fn bin_hz(&self, rate_hz: f64) -> f64 {
        rate_hz / self.padded_len as f64
    }

    /// Buffers for [`Self::compute_levels`]; one per thread.
    pub fn make_scratch(&self) -> SpectrogramScratch {
        SpectrogramScratch {
            signal: self.forward.make_input_vec(),
            spectrum: self.forward.make_output_vec(),
            work: self.forward.make_scratch_vec(),
        }
    }

    /// Computes the levels.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_levels(
        &self,
        response: &[f64],
        levels_db: &mut [f64],
        scratch: &mut SpectrogramScratch,
    ) -> Result<(), Error> {
        check_len("the response", response.len(), self.len)?;
        check_len("the levels", levels_db.len(), self.time_count() * self.bin_count())?;
        check_finite("the response", response)?;
        let SpectrogramScratch { signal, spectrum, work } = scratch;
        for (time, levels) in levels_db.chunks_exact_mut(self.bin_count()).enumerate() {
            signal.fill(0.0);
            let half = self.window.len() / 2;
            for (i, (to, weight)) in signal.iter_mut().zip(&self.window).enumerate() {
                let sample = (time * self.step + i).checked_sub(half).and_then(|position| response.get(position));
                *to = weight * sample.copied().unwrap_or(0.0);
            }
            // It fails for other lengths alone, and these are the plan's.
            let _ = self.forward.process_with_scratch(signal, spectrum, work);
            levels.iter_mut().zip(&*spectrum).for_each(|(out, x)| *out = plotted_power_to_db(x.norm_sqr()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 96e3;

    fn levels(plan: &SpectrogramPlan, response: &[f64]) -> Vec<f64> {
        let mut levels = vec![f64::NAN; plan.time_count() * plan.bin_count()];
        plan.compute_levels(response, &mut levels, &mut plan.make_scratch()).expect("levels");
        levels
    }

    #[test]
    fn a_tone_is_highest_at_its_time_and_frequency() {
        let tone = |i: usize| (std::f64::consts::TAU * 15e3 * i as f64 / RATE_HZ).sin();
        let response: Vec<f64> = (0..384).map(|i: usize| if i.abs_diff(200) < 60 { tone(i) } else { 0.0 }).collect();
        let plan = SpectrogramPlan::new(384, 48, 2).expect("a plan");
        let levels = levels(&plan, &response);
        let highest = (0..levels.len()).max_by(|a, b| levels[*a].total_cmp(&levels[*b])).expect("levels");
        // Half of the Hann window's sum, 48 / 2, because a sine is two lines.
        assert!((levels[highest] - 20.0 * 12f64.log10()).abs() < 0.1, "{}", levels[highest]);
        assert!(((highest % plan.bin_count()) as f64 * plan.bin_hz(RATE_HZ) - 15e3).abs() <= plan.bin_hz(RATE_HZ));
        assert!((2 * (highest / plan.bin_count())).abs_diff(200) < 60);
        assert_eq!(levels[0], -200.0, "silence before it");
    }

    #[test]
    fn an_impulse_is_the_window() {
        for (len, window_len, step) in [(15, 8, 1), (16, 9, 3)] {
            let mut response = vec![0.0; len];
            response[6] = 1.0;
            let plan = SpectrogramPlan::new(len, window_len, step).expect("a plan");
            let levels = levels(&plan, &response);
            for time in 0..plan.time_count() {
                let at = (6 + window_len / 2).checked_sub(time * step);
                let weight = at.and_then(|at| plan.window.get(at)).copied().unwrap_or(0.0);
                let expected = plotted_power_to_db(weight * weight);
                let row = &levels[time * plan.bin_count()..(time + 1) * plan.bin_count()];
                assert!(row.iter().all(|level| (level - expected).abs() < 1e-9), "{len} {time}: {row:?}");
            }
        }
    }

    #[test]
    fn bad_settings_and_signals_are_refused() {
        for (len, window_len, step) in [(0, 1, 1), (1, 0, 1), (1, 1, 0)] {
            assert!(SpectrogramPlan::new(len, window_len, step).is_err(), "{len} {window_len} {step}");
        }
        let plan = SpectrogramPlan::new(2, 4, 1).expect("a plan");
        let mut levels = vec![0.0; 2 * plan.bin_count()];
        let mut scratch = plan.make_scratch();
        assert!(matches!(plan.compute_levels(&[0.0], &mut levels, &mut scratch), Err(Error::Length { .. })));
        let nan = plan.compute_levels(&[0.0, f64::NAN], &mut levels, &mut scratch);
        assert_eq!(nan, Err(Error::NotFinite { what: "the response" }));
    }
}
