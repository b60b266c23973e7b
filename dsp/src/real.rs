//! The two kinds of sample: f32 for the product, f64 for its oracle.

use std::sync::Arc;

use realfft::{ComplexToReal, FftNum, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftDirection, FftPlanner};

/// A sample.
///
/// Transforms are planned here and nowhere else: rustfft's planner is generic, and each crate that calls it compiles
/// all of rustfft's kernels once more (20 s of a first build).
pub trait RealSample: FftNum + PartialOrd + Default {
    /// Nearest to an f64.
    fn of(value: f64) -> Self;
    /// As f64, exactly.
    fn f64(self) -> f64;
    /// Distance from 1 to the next sample value.
    fn epsilon() -> f64;
    /// The largest that is finite.
    fn max_value() -> Self;
    /// Adds each sample of a signal to its sum, `[n]`; compiled with the kernels, however its caller is.
    fn add_to(signal: &[Self], sums: &mut [f64]);
    /// Plans the transform of `len` complex samples.
    fn plan_fft(len: usize, direction: FftDirection) -> Arc<dyn Fft<Self>>;
    /// Plans the transform of `len` real samples.
    fn plan_real_forward(len: usize) -> Arc<dyn RealToComplex<Self>>;
    /// Plans the transform back to `len` real samples, not divided by `len`.
    fn plan_real_inverse(len: usize) -> Arc<dyn ComplexToReal<Self>>;
}

macro_rules! real_samples {
    ($($sample:ty),+) => {$(
        impl RealSample for $sample {
            fn of(value: f64) -> Self {
                value as Self
            }

            fn f64(self) -> f64 {
                self.into()
            }

            fn epsilon() -> f64 {
                Self::EPSILON.into()
            }

            fn max_value() -> Self {
                Self::MAX
            }

            fn add_to(signal: &[Self], sums: &mut [f64]) {
                sums.iter_mut().zip(signal).for_each(|(sum, x)| *sum += x.f64());
            }

            fn plan_fft(len: usize, direction: FftDirection) -> Arc<dyn Fft<Self>> {
                FftPlanner::new().plan_fft(len, direction)
            }

            fn plan_real_forward(len: usize) -> Arc<dyn RealToComplex<Self>> {
                RealFftPlanner::new().plan_fft_forward(len)
            }

            fn plan_real_inverse(len: usize) -> Arc<dyn ComplexToReal<Self>> {
                RealFftPlanner::new().plan_fft_inverse(len)
            }
        }
    )+};
}

real_samples!(f32, f64);
