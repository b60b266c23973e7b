//! Levels of a response over frequency.

use std::sync::Arc;

use realfft::RealToComplex;
use realfft::num_complex::Complex;

use crate::error::check_len;
use crate::{Error, RealSample};

/// Levels of the bins of responses of one length.
///
/// ir      `[len]`
/// levels  `[len/2 + 1]`, 20 log10 |X_k|, X_k = sum_n x_n e^(-2 pi i k n / len), not scaled: of a response, that is
///         its gain, and a single sample of 1 is 0 dB throughout. Bin k is at k rate / len; nothing is minus infinity.
///
/// ```
/// let plan = echolake_dsp::spectrum::SpectrumPlan::new(4)?;
/// let mut levels = [f64::NAN; 3];
/// plan.levels_db(&[0.0, 10.0, 0.0, 0.0], &mut levels, &mut plan.make_scratch())?;
/// assert_eq!(levels, [20.0; 3]);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct SpectrumPlan<T: RealSample> {
    len: usize,
    forward: Arc<dyn RealToComplex<T>>,
}

/// Buffers of a [`SpectrumPlan`].
pub struct SpectrumScratch<T> {
    signal: Vec<T>,
    spectrum: Vec<Complex<T>>,
    work: Vec<Complex<T>>,
}

/// Bins of a signal of `len` samples; none of no samples.
pub fn bin_count(len: usize) -> usize {
    if len == 0 { 0 } else { len / 2 + 1 }
}

/// Frequency of a bin, Hz.
pub fn bin_hz(bin: usize, len: usize, rate_hz: f64) -> f64 {
    bin as f64 * rate_hz / len as f64
}

impl<T: RealSample> SpectrumPlan<T> {
    /// Plans for signals of `len` samples.
    ///
    /// # Errors
    /// [`Error::Setting`] for none.
    pub fn new(len: usize) -> Result<Self, Error> {
        if len == 0 {
            return Err(Error::Setting { what: "the signal's length", actual: "0".into(), expected: "1 or more" });
        }
        Ok(Self { len, forward: T::plan_real_forward(len) })
    }

    /// Buffers for [`Self::levels_db`]; one per thread.
    pub fn make_scratch(&self) -> SpectrumScratch<T> {
        SpectrumScratch {
            signal: self.forward.make_input_vec(),
            spectrum: self.forward.make_output_vec(),
            work: self.forward.make_scratch_vec(),
        }
    }

    /// The levels.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn levels_db(&self, ir: &[T], levels: &mut [T], scratch: &mut SpectrumScratch<T>) -> Result<(), Error> {
        check_len("the response", ir.len(), self.len)?;
        check_len("the levels", levels.len(), bin_count(self.len))?;
        let SpectrumScratch { signal, spectrum, work } = scratch;
        signal.copy_from_slice(ir);
        let not_finite = Error::NotFinite { what: "the response" };
        if self.forward.process_with_scratch(signal, spectrum, work).is_err() {
            return Err(not_finite);
        }
        // The first bin is the sum of all samples, and one that is not finite spoils it.
        if !spectrum.first().is_some_and(|dc| dc.re.f64().is_finite()) {
            return Err(not_finite);
        }
        let level = |x: &Complex<T>| 10.0 * (x.re.f64() * x.re.f64() + x.im.f64() * x.im.f64()).log10();
        levels.iter_mut().zip(&*spectrum).for_each(|(out, x)| *out = T::of(level(x)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_sample_is_flat_and_a_tone_stands_in_its_bin() {
        for len in [1, 2, 15, 384] {
            let plan = SpectrumPlan::<f64>::new(len).expect("a plan");
            let (mut ir, mut levels) = (vec![0.0; len], vec![f64::NAN; bin_count(len)]);
            ir[len / 2] = 10.0;
            plan.levels_db(&ir, &mut levels, &mut plan.make_scratch()).expect("levels");
            assert!(levels.iter().all(|x| (x - 20.0).abs() < 1e-9), "{len}: {levels:?}");
        }
        let plan = SpectrumPlan::<f64>::new(96).expect("a plan");
        let tone: Vec<f64> = (0..96).map(|n| (std::f64::consts::TAU * 7.0 * f64::from(n) / 96.0).cos()).collect();
        let mut levels = vec![f64::NAN; 49];
        plan.levels_db(&tone, &mut levels, &mut plan.make_scratch()).expect("levels");
        assert_eq!(bin_hz(7, 96, 96e3), 7_000.0);
        assert!((levels[7] - 20.0 * 48f64.log10()).abs() < 1e-9);
        assert!(levels.iter().enumerate().all(|(k, x)| k == 7 || *x < -200.0));
    }

    #[test]
    fn bad_signals_are_refused() {
        assert!(SpectrumPlan::<f32>::new(0).is_err());
        let plan = SpectrumPlan::<f32>::new(4).expect("a plan");
        let (mut levels, mut scratch) = ([0.0; 3], plan.make_scratch());
        assert!(matches!(plan.levels_db(&[0.0; 3], &mut levels, &mut scratch), Err(Error::Length { .. })));
        let nan = plan.levels_db(&[0.0, f32::NAN, 0.0, 0.0], &mut levels, &mut scratch);
        assert_eq!(nan, Err(Error::NotFinite { what: "the response" }));
        plan.levels_db(&[0.0; 4], &mut levels, &mut scratch).expect("silence");
        assert_eq!(levels, [f32::NEG_INFINITY; 3]);
    }
}
