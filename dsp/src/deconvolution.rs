//! Division of the recording by the loopback in the Fourier domain, with a floor outside of the sweep's range.

use std::ops::RangeInclusive;
use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

use crate::error::check_len;
use crate::{Error, Real};

/// Settings of a deconvolution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeconvolutionParams {
    /// Samples of recording and loopback.
    pub recording_len: usize,
    /// Samples of the response that are wanted, from its start.
    pub output_len: usize,
    /// Sampling rate, Hz.
    pub rate_hz: f64,
    /// Lowest frequency of the sweep, Hz.
    pub low_hz: f64,
    /// Highest frequency of the sweep, Hz.
    pub high_hz: f64,
    /// Outside of the sweep's range the divisor's power stays above this, dB re its mean in the range.
    pub floor_db: f64,
    /// Length of the transforms.
    pub length: TransformLength,
}

/// Length of the transforms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransformLength {
    /// That of the recording, as in the reference; slow where it has large prime factors.
    Exact,
    /// Padded with zeros to the next even length without prime factors above 5.
    Fast,
}

/// x / s in the Fourier domain (Rust et al. 2021, appendix, step 1).
///
/// recording `[recording_len]`, loopback `[recording_len]`  any unit, the same
/// ir        `[output_len]`                                 their ratio; sample 0 is the instant of emission
///
/// Inside of the sweep's range the division is exact. Outside, the sweep has next to no energy and plain
/// division would fill the lowest and the highest band with noise, so the divisor has a floor.
pub struct DeconvolutionPlan<T: Real> {
    recording_len: usize,
    output_len: usize,
    forward: Arc<dyn RealToComplex<T>>,
    inverse: Arc<dyn ComplexToReal<T>>,
    in_range: RangeInclusive<usize>,
    floor: f64,
}

/// Buffers of a [`DeconvolutionPlan`].
pub struct DeconvolutionScratch<T> {
    signal: Vec<T>,
    recording: Vec<Complex<T>>,
    loopback: Vec<Complex<T>>,
    work: Vec<Complex<T>>,
}

impl<T: Real> DeconvolutionPlan<T> {
    /// Plans the transforms.
    ///
    /// # Errors
    /// [`Error::Setting`] where there is nothing to transform or the range is empty.
    pub fn new(params: DeconvolutionParams) -> Result<Self, Error> {
        let setting = |what, actual: String, expected| Err(Error::Setting { what, actual, expected });
        if params.recording_len < 2 {
            return setting("the recording's length", params.recording_len.to_string(), "2 samples or more");
        }
        if !params.floor_db.is_finite() {
            return setting("the divisor's floor (dB)", params.floor_db.to_string(), "a finite level");
        }
        let n = match params.length {
            TransformLength::Exact => params.recording_len,
            TransformLength::Fast => fast_length(params.recording_len),
        };
        let step = params.rate_hz / n as f64;
        let first = (params.low_hz / step).ceil().max(0.0) as usize;
        let last = ((params.high_hz / step).floor() as usize).min(n / 2);
        if !(step > 0.0 && step.is_finite() && params.low_hz >= 0.0) || first > last {
            let range = format!("{} to {} Hz at {} Hz", params.low_hz, params.high_hz, params.rate_hz);
            return setting("the sweep's range", range, "one that holds a frequency of the transform");
        }
        let mut planner = RealFftPlanner::new();
        Ok(Self {
            recording_len: params.recording_len,
            output_len: params.output_len,
            forward: planner.plan_fft_forward(n),
            inverse: planner.plan_fft_inverse(n),
            in_range: first..=last,
            floor: 10f64.powf(params.floor_db / 10.0),
        })
    }

    /// Buffers for [`Self::run`]; one a thread.
    pub fn scratch(&self) -> DeconvolutionScratch<T> {
        let work = self.forward.get_scratch_len().max(self.inverse.get_scratch_len());
        DeconvolutionScratch {
            signal: self.forward.make_input_vec(),
            recording: self.forward.make_output_vec(),
            loopback: self.forward.make_output_vec(),
            work: vec![Complex::default(); work],
        }
    }

    /// Samples of the response that a run gives.
    pub fn output_len(&self) -> usize {
        self.output_len
    }

    /// Deconvolves one recording.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NoLoopback`], or [`Error::NotFinite`].
    pub fn run(
        &self,
        recording: &[T],
        loopback: &[T],
        ir: &mut [T],
        scratch: &mut DeconvolutionScratch<T>,
    ) -> Result<(), Error> {
        check_len("the recording", recording.len(), self.recording_len)?;
        check_len("the loopback", loopback.len(), self.recording_len)?;
        check_len("the response", ir.len(), self.output_len)?;
        let DeconvolutionScratch { signal, recording: x, loopback: s, work } = scratch;
        self.transform("the recording", recording, signal, x, work)?;
        self.transform("the loopback", loopback, signal, s, work)?;
        self.divide(x, s)?;
        self.inverse.process_with_scratch(x, signal, work).map_err(|_| Error::NotFinite { what: "the response" })?;
        let kept = ir.len().min(signal.len());
        // Finite samples can still be too large for a spectrum; that spoils every sample of the response.
        if !signal[..kept].iter().all(|x| x.f64().is_finite()) {
            return Err(Error::NotFinite { what: "the response" });
        }
        let scale = T::of(1.0 / signal.len() as f64);
        ir[kept..].fill(T::default());
        ir.iter_mut().zip(&*signal).for_each(|(out, x)| *out = *x * scale);
        Ok(())
    }

    fn transform(
        &self,
        what: &'static str,
        from: &[T],
        signal: &mut [T],
        to: &mut [Complex<T>],
        work: &mut [Complex<T>],
    ) -> Result<(), Error> {
        signal[..from.len()].copy_from_slice(from);
        signal[from.len()..].fill(T::default());
        self.forward.process_with_scratch(signal, to, work).map_err(|_| Error::NotFinite { what })?;
        // A sum over the spectrum's first bin would cancel; one value of the signal spoils them all.
        if to.first().is_some_and(|c| c.re.f64().is_finite()) { Ok(()) } else { Err(Error::NotFinite { what }) }
    }

    // x becomes x conj(s) / |s|^2.
    fn divide(&self, x: &mut [Complex<T>], s: &[Complex<T>]) -> Result<(), Error> {
        let power = |c: &Complex<T>| c.norm_sqr();
        let inside = &s[self.in_range.clone()];
        let mean = inside.iter().map(|c| power(c).f64()).sum::<f64>() / inside.len() as f64;
        if !mean.is_finite() {
            return Err(Error::NotFinite { what: "the loopback's power" });
        }
        let floor = T::of(mean * self.floor);
        if !(mean > 0.0 && floor > T::default()) || inside.iter().any(|c| power(c) <= T::default()) {
            return Err(Error::NoLoopback);
        }
        let (first, last) = (*self.in_range.start(), *self.in_range.end());
        for (k, (x, s)) in x.iter_mut().zip(s).enumerate() {
            let power = power(s);
            let raised = if (first..=last).contains(&k) || power > floor { power } else { floor };
            *x = (*x * s.conj()).unscale(raised);
        }
        // The inverse transform asks for real ends, and rounding leaves a trace.
        if let Some(dc) = x.first_mut() {
            dc.im = T::default();
        }
        if self.forward.len().is_multiple_of(2)
            && let Some(nyquist) = x.last_mut()
        {
            nyquist.im = T::default();
        }
        Ok(())
    }
}

/// The least even length without prime factors above 5 that holds `len` samples.
pub fn fast_length(len: usize) -> usize {
    let smooth = |mut n: usize| {
        for factor in [2, 3, 5] {
            while n.is_multiple_of(factor) {
                n /= factor;
            }
        }
        n == 1
    };
    (len.max(2)..).find(|n| n.is_multiple_of(2) && smooth(*n)).unwrap_or(len)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fast_lengths() {
        for (len, expected) in [(1, 2), (2, 2), (7, 8), (11, 12), (487, 500), (5_760, 5_760), (48_961, 49_152)] {
            assert_eq!(fast_length(len), expected, "{len}");
        }
    }

    #[test]
    fn silence_and_nan_are_refused() {
        let plan = DeconvolutionPlan::<f32>::new(DeconvolutionParams {
            recording_len: 100,
            output_len: 10,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            floor_db: -60.0,
            length: TransformLength::Fast,
        })
        .expect("a plan");
        let (mut ir, mut scratch) = (vec![0.0; 10], plan.scratch());
        let noise: Vec<f32> = (0..100).map(|i| ((i * 37) % 19) as f32 - 9.0).collect();
        assert_eq!(plan.run(&noise, &[0.0; 100], &mut ir, &mut scratch), Err(Error::NoLoopback));
        let mut broken = noise.clone();
        broken[50] = f32::NAN;
        assert!(matches!(plan.run(&broken, &noise, &mut ir, &mut scratch), Err(Error::NotFinite { .. })));
        assert!(matches!(plan.run(&noise[1..], &noise, &mut ir, &mut scratch), Err(Error::Length { .. })));
        // Finite, but its power is past what an f32 holds.
        let loud: Vec<f32> = noise.iter().map(|x| x * 1e20).collect();
        assert!(matches!(plan.run(&noise, &loud, &mut ir, &mut scratch), Err(Error::NotFinite { .. })));
        assert!(matches!(plan.run(&loud, &loud, &mut ir, &mut scratch), Err(Error::NotFinite { .. })));
        let faint: Vec<f32> = noise.iter().map(|x| x * 1e-30).collect();
        assert_eq!(plan.run(&noise, &faint, &mut ir, &mut scratch), Err(Error::NoLoopback));
        plan.run(&noise, &noise, &mut ir, &mut scratch).expect("good after bad");
        assert!((ir[0] - ir.iter().copied().fold(0.0, f32::max)).abs() < 1e-6, "{ir:?}");
    }

    #[test]
    fn settings_without_a_meaning_are_refused() {
        let good = DeconvolutionParams {
            recording_len: 100,
            output_len: 10,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            floor_db: -60.0,
            length: TransformLength::Exact,
        };
        assert!(DeconvolutionPlan::<f32>::new(good).is_ok());
        for bad in [
            DeconvolutionParams { recording_len: 1, ..good },
            DeconvolutionParams { rate_hz: 0.0, ..good },
            DeconvolutionParams { rate_hz: f64::NAN, ..good },
            DeconvolutionParams { rate_hz: f64::INFINITY, ..good },
            DeconvolutionParams { low_hz: f64::NAN, ..good },
            DeconvolutionParams { low_hz: 41e3, ..good },
            DeconvolutionParams { high_hz: f64::NAN, ..good },
            DeconvolutionParams { floor_db: f64::NAN, ..good },
            DeconvolutionParams { floor_db: f64::NEG_INFINITY, ..good },
        ] {
            assert!(matches!(DeconvolutionPlan::<f32>::new(bad), Err(Error::Setting { .. })), "{bad:?}");
        }
    }

    // Zeros follow where more is asked for than the transform holds.
    #[test]
    fn what_is_longer_than_the_transform_ends_in_zeros() {
        let plan = DeconvolutionPlan::<f64>::new(DeconvolutionParams {
            recording_len: 99,
            output_len: 120,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            floor_db: -60.0,
            length: TransformLength::Exact,
        })
        .expect("a plan");
        let noise: Vec<f64> = (0..99).map(|i| f64::from((i * 37) % 19) - 9.0).collect();
        let mut ir = vec![f64::NAN; 120];
        plan.run(&noise, &noise, &mut ir, &mut plan.scratch()).expect("a response");
        assert!(ir[..99].iter().all(|x| x.is_finite()));
        assert_eq!(&ir[99..], &[0.0; 21]);
    }
}
