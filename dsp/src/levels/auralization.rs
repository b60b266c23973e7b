//! Auralization: a dry recording as it sounds by a response that was measured at another sampling rate.

use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

/// Length of a block over that of the response, when both are convolved.
const BLOCK_RESPONSES: usize = 4;

/// Returns a response at another sampling rate, for convolution: its spectrum keeps its values, and is 0 above.
///
/// response `[n]` at `from_hz`; returns `[m]` at `to_hz`, m = n `to_hz` / `from_hz`, for n with zeros behind it up to
/// the next for which m is whole.
pub fn resample_response(response: &[f32], from_hz: u32, to_hz: u32) -> Vec<f64> {
    let step = from_hz / greatest_common_divisor(from_hz, to_hz);
    let padded = response.len().next_multiple_of(step as usize);
    let length = padded / step as usize * (u64::from(to_hz) * u64::from(step) / u64::from(from_hz)) as usize;
    if length == 0 {
        return Vec::new();
    }
    let mut planner = RealFftPlanner::new();
    let from = compute_spectrum(&mut planner, response.iter().map(|x| f64::from(*x)), padded);
    let mut to = vec![Complex::default(); length / 2 + 1];
    let shared = from.len().min(to.len());
    to[..shared].copy_from_slice(&from[..shared]);
    // The value at half of the lower rate stands for both signs of its frequency in the spectrum of that rate alone.
    let lower = padded.min(length);
    if lower.is_multiple_of(2) && padded != length {
        to[lower / 2] = (to[lower / 2] * if length > padded { 0.5 } else { 2.0 }).re.into();
    }
    invert_spectrum(&mut planner, &mut to, length)
}

/// The convolution of a recording, block by block, with a response of the same sampling rate: of n samples and m they
/// are n + m - 1.
pub struct RecordingConvolution {
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
    of_response: Vec<Complex<f64>>,
    spectrum: Vec<Complex<f64>>,
    /// `[size]`: a block and zeros, then what it becomes.
    signal: Vec<f64>,
    /// `[m - 1]`: what the blocks before add to the next one.
    tail: Vec<f64>,
}

impl RecordingConvolution {
    /// Plans the convolution; None if the response, `[m]`, is empty.
    pub fn new(response: &[f64]) -> Option<Self> {
        let tail = vec![0.0; response.len().checked_sub(1)?];
        let size = (response.len() * BLOCK_RESPONSES).next_power_of_two();
        let mut planner = RealFftPlanner::new();
        let of_response = compute_spectrum(&mut planner, response.iter().copied(), size);
        let (forward, inverse) = (planner.plan_fft_forward(size), planner.plan_fft_inverse(size));
        let spectrum = forward.make_output_vec();
        Some(Self { forward, inverse, of_response, spectrum, signal: vec![0.0; size], tail })
    }

    /// Samples of the longest block.
    pub fn block_len(&self) -> usize {
        self.signal.len() - self.tail.len()
    }

    /// Convolves the next block.
    ///
    /// dry `[n]`, n up to [`Self::block_len`], of which the rest is left out
    /// sound: `[n]` are appended
    pub fn convolve_block(&mut self, dry: &[f32], sound: &mut Vec<f32>) {
        let dry = &dry[..dry.len().min(self.block_len())];
        self.signal.iter_mut().zip(dry).for_each(|(to, x)| *to = f64::from(*x));
        self.signal[dry.len()..].fill(0.0);
        // The lengths are the plans' own.
        let _ = self.forward.process(&mut self.signal, &mut self.spectrum);
        self.spectrum.iter_mut().zip(&self.of_response).for_each(|(part, response)| *part *= response);
        let _ = self.inverse.process(&mut self.spectrum, &mut self.signal);
        let scale = self.signal.len() as f64;
        self.signal.iter_mut().for_each(|x| *x /= scale);
        self.signal.iter_mut().zip(&self.tail).for_each(|(sum, x)| *sum += x);
        sound.extend(self.signal[..dry.len()].iter().map(|x| *x as f32));
        self.tail.iter_mut().zip(&self.signal[dry.len()..]).for_each(|(to, x)| *to = *x);
    }

    /// Returns what sounds after the last block, `[m - 1]`.
    pub fn finish(self) -> Vec<f32> {
        self.tail.into_iter().map(|x| x as f32).collect()
    }
}

fn compute_spectrum(
    planner: &mut RealFftPlanner<f64>,
    samples: impl Iterator<Item = f64>,
    length: usize,
) -> Vec<Complex<f64>> {
    let mut signal: Vec<f64> = samples.collect();
    signal.resize(length, 0.0);
    let plan = planner.plan_fft_forward(length);
    let mut spectrum = plan.make_output_vec();
    // It fails for other lengths only.
    let _ = plan.process(&mut signal, &mut spectrum);
    spectrum
}

fn invert_spectrum(planner: &mut RealFftPlanner<f64>, spectrum: &mut [Complex<f64>], length: usize) -> Vec<f64> {
    let plan = planner.plan_fft_inverse(length);
    let mut signal = plan.make_output_vec();
    let _ = plan.process(spectrum, &mut signal);
    signal.iter_mut().for_each(|x| *x /= length as f64);
    signal
}

fn greatest_common_divisor(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { greatest_common_divisor(b, a % b) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn convolve(dry: &[f32], response: &[f64], block: usize) -> Vec<f32> {
        let mut convolution = RecordingConvolution::new(response).expect("a response");
        let mut sound = Vec::new();
        dry.chunks(block.min(convolution.block_len())).for_each(|part| convolution.convolve_block(part, &mut sound));
        sound.extend(convolution.finish());
        sound
    }

    // By definition, in the time domain; over several blocks, of which some are shorter than the response.
    #[test]
    fn convolution_is_the_sum_of_delayed_copies() {
        let dry: Vec<f32> = (0..1000).map(|n| ((n * n) % 17) as f32 - 8.0).collect();
        let response: Vec<f64> = (0..31).map(|n| f64::from((n * 7) % 11) - 5.0).collect();
        for block in [1000, 13, 1] {
            let sound = convolve(&dry, &response, block);
            assert_eq!(sound.len(), 1030);
            for (n, found) in sound.iter().enumerate() {
                let expected: f64 =
                    (0..31).filter_map(|k| Some(response[k] * f64::from(*dry.get(n.checked_sub(k)?)?))).sum();
                assert!((f64::from(*found) - expected).abs() < 1e-3, "{block}, {n}: {found} {expected}");
            }
        }
        assert_eq!(convolve(&dry, &[2.0], 1000), dry.iter().map(|x| 2.0 * x).collect::<Vec<_>>());
        assert!(RecordingConvolution::new(&[]).is_none());
    }

    // scipy.signal.resample([1, -2, 3, 0.5], n) * 4 / n by SciPy 1.17.1.
    #[test]
    fn resampled_responses_are_those_of_scipy() {
        let up = [0.5, -0.482995128834866, -1.0, 0.224111652351682, 1.5, 1.107995128834866, 0.25, 0.400888347648318];
        let down = [-0.5, 0.056624327025936, 2.943375672974064];
        for (to_hz, expected) in [(8, &up[..]), (3, &down[..])] {
            let found = resample_response(&[1.0, -2.0, 3.0, 0.5], 4, to_hz);
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 1e-12, "{found} {expected}");
            }
        }
        assert_eq!(resample_response(&[0.5; 384], 9_600, 44_100).len(), 1_764);
        assert_eq!(resample_response(&[0.5; 5], 9_600, 48_000).len(), 25);
        assert_eq!(resample_response(&[0.5; 5], 9_600, 44_100).len(), 147);
        assert!(resample_response(&[], 9_600, 44_100).is_empty());
    }
}
