//! The envelope of a response.

use std::sync::Arc;

use realfft::num_complex::Complex;
use rustfft::{Fft, FftDirection};

use crate::error::{check_finite, check_len};
use crate::{Error, RealSample};

/// Magnitudes of the analytic signals of responses of one length.
///
/// response  `[len]`
/// envelope  `[len]`, |x + i H(x)|, H the Hilbert transform: of a burst, the curve over its carrier, in its unit
///
/// ```
/// let plan = echolake_dsp::envelope::EnvelopePlan::new(64)?;
/// let burst = |n: i32| (f64::from(n) * 0.8).cos() * (-f64::from(n - 32).powi(2) / 64.0).exp();
/// let burst: Vec<f64> = (0..64).map(burst).collect();
/// let mut envelope = [0.0; 64];
/// plan.compute_envelope(&burst, &mut envelope, &mut plan.make_scratch())?;
/// assert!((envelope[32] - 1.0).abs() < 1e-3 && (envelope[40] - (-1f64).exp()).abs() < 1e-3);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct EnvelopePlan {
    len: usize,
    /// Zeros keep the end of a response from wrapping around to its beginning.
    padded_len: usize,
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
}

/// Buffers of an [`EnvelopePlan`].
pub struct EnvelopeScratch {
    signal: Vec<Complex<f64>>,
    work: Vec<Complex<f64>>,
}

impl EnvelopePlan {
    /// Plans for responses of `len` samples.
    ///
    /// # Errors
    /// [`Error::Setting`] for none.
    pub fn new(len: usize) -> Result<Self, Error> {
        if len == 0 {
            return Err(Error::Setting { what: "the response's length", actual: "0".into(), expected: "1 or more" });
        }
        let padded_len = (2 * len).next_power_of_two();
        let [forward, inverse] =
            [FftDirection::Forward, FftDirection::Inverse].map(|direction| f64::plan_fft(padded_len, direction));
        Ok(Self { len, padded_len, forward, inverse })
    }

    /// Buffers for [`Self::compute_envelope`]; one per thread.
    pub fn make_scratch(&self) -> EnvelopeScratch {
        let work = self.forward.get_inplace_scratch_len().max(self.inverse.get_inplace_scratch_len());
        EnvelopeScratch { signal: vec![Complex::default(); self.padded_len], work: vec![Complex::default(); work] }
    }

    /// Computes the envelope.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_envelope(
        &self,
        response: &[f64],
        envelope: &mut [f64],
        scratch: &mut EnvelopeScratch,
    ) -> Result<(), Error> {
        check_len("the response", response.len(), self.len)?;
        check_len("the envelope", envelope.len(), self.len)?;
        check_finite("the response", response)?;
        let EnvelopeScratch { signal, work } = scratch;
        signal.fill(Complex::default());
        signal.iter_mut().zip(response).for_each(|(to, x)| to.re = *x);
        self.forward.process_with_scratch(signal, work);
        // The analytic signal has no negative frequencies, and twice the positive ones.
        let half = self.padded_len / 2;
        for (k, bin) in signal.iter_mut().enumerate() {
            let weight = match k {
                0 => 1.0,
                _ if k == half => 1.0,
                _ if k < half => 2.0,
                _ => 0.0,
            };
            *bin *= weight / self.padded_len as f64;
        }
        self.inverse.process_with_scratch(signal, work);
        envelope.iter_mut().zip(&*signal).for_each(|(out, x)| *out = x.norm());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_has_its_gaussian_whatever_the_carriers_phase() {
        let gauss = |i: usize| (-((i as f64 - 150.0) / 20.0).powi(2)).exp();
        for len in [384, 401] {
            let plan = EnvelopePlan::new(len).expect("a plan");
            let mut scratch = plan.make_scratch();
            for phase in [0.0, 1.0, 2.0] {
                let carrier = |i: usize| (std::f64::consts::TAU * 12e3 * i as f64 / 96e3 + phase).cos();
                let burst: Vec<f64> = (0..len).map(|i| gauss(i) * carrier(i)).collect();
                let mut envelope = vec![f64::NAN; len];
                plan.compute_envelope(&burst, &mut envelope, &mut scratch).expect("an envelope");
                assert!(envelope.iter().enumerate().all(|(i, x)| (x - gauss(i)).abs() < 1e-5), "{len} {phase}");
            }
        }
    }

    #[test]
    fn bad_signals_are_refused() {
        assert!(EnvelopePlan::new(0).is_err());
        let plan = EnvelopePlan::new(2).expect("a plan");
        let mut scratch = plan.make_scratch();
        assert!(matches!(plan.compute_envelope(&[0.0], &mut [0.0; 2], &mut scratch), Err(Error::Length { .. })));
        let nan = plan.compute_envelope(&[0.0, f64::NAN], &mut [0.0; 2], &mut scratch);
        assert_eq!(nan, Err(Error::NotFinite { what: "the response" }));
    }
}
