//! The two kinds of sample: f32 for the product, f64 for its oracle.

use std::sync::Arc;

use realfft::{ComplexToReal, FftNum, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftDirection, FftPlanner};

/// Products that are summed side by side.
const LANES: usize = 8;

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
    /// Sums samples, side by side.
    fn sum_samples(signal: &[Self]) -> f64;
    /// Sums the products of samples of two signals, as many as both have, side by side.
    fn dot_product(a: &[Self], b: &[Self]) -> f64;
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

            fn sum_samples(signal: &[Self]) -> f64 {
                let mut sums = [0.0; LANES];
                let (blocks, last) = signal.as_chunks::<LANES>();
                for block in blocks {
                    sums.iter_mut().zip(block).for_each(|(sum, x)| *sum += x.f64());
                }
                sums.iter().sum::<f64>() + last.iter().map(|x| x.f64()).sum::<f64>()
            }

            fn dot_product(a: &[Self], b: &[Self]) -> f64 {
                let len = a.len().min(b.len());
                let (a, last_a) = a[..len].as_chunks::<LANES>();
                let (b, last_b) = b[..len].as_chunks::<LANES>();
                let mut sums = [0.0; LANES];
                for (a, b) in a.iter().zip(b) {
                    for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
                        *sum += a.f64() * b.f64();
                    }
                }
                let last = last_a.iter().zip(last_b).map(|(a, b)| a.f64() * b.f64());
                sums.iter().sum::<f64>() + last.sum::<f64>()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_are_summed_as_far_as_both_signals_go() {
        for (a, b) in [(0, 3), (7, 7), (8, 8), (17, 30), (384, 201), (201, 384)] {
            let a: Vec<f32> = (0..a).map(|n| (n as f32 * 0.7).sin()).collect();
            let b: Vec<f32> = (0..b).map(|n| (n as f32 * 1.3).cos()).collect();
            let expected: f64 = a.iter().zip(&b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
            assert!((f32::dot_product(&a, &b) - expected).abs() < 1e-13, "{} {}", a.len(), b.len());
        }
    }
}
