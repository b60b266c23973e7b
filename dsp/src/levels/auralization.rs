//! Auralization: a dry recording as it sounds by a response that was measured at another sampling rate.

use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

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

/// Returns a recording convolved with a response of the same sampling rate.
///
/// dry `[n]`, response `[m]`; returns `[n + m - 1]`, or nothing if one of both is empty
pub fn convolve_recording(dry: &[f32], response: &[f64]) -> Vec<f32> {
    if dry.is_empty() || response.is_empty() {
        return Vec::new();
    }
    let size = (response.len() * BLOCK_RESPONSES).next_power_of_two();
    let block = size + 1 - response.len();
    let mut planner = RealFftPlanner::new();
    let of_response = compute_spectrum(&mut planner, response.iter().copied(), size);
    let mut sound = vec![0.0; dry.len() + response.len() - 1];
    for (number, part) in dry.chunks(block).enumerate() {
        let mut spectrum = compute_spectrum(&mut planner, part.iter().map(|x| f64::from(*x)), size);
        spectrum.iter_mut().zip(&of_response).for_each(|(part, response)| *part *= response);
        let convolved = invert_spectrum(&mut planner, &mut spectrum, size);
        sound[number * block..].iter_mut().zip(convolved).for_each(|(sum, x)| *sum += x);
    }
    sound.into_iter().map(|x| x as f32).collect()
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

    // By definition, in the time domain; over several blocks.
    #[test]
    fn convolution_is_the_sum_of_delayed_copies() {
        let dry: Vec<f32> = (0..1000).map(|n| ((n * n) % 17) as f32 - 8.0).collect();
        let response: Vec<f64> = (0..31).map(|n| f64::from((n * 7) % 11) - 5.0).collect();
        let sound = convolve_recording(&dry, &response);
        assert_eq!(sound.len(), 1030);
        for (n, found) in sound.iter().enumerate() {
            let expected: f64 =
                (0..31).filter_map(|k| Some(response[k] * f64::from(*dry.get(n.checked_sub(k)?)?))).sum();
            assert!((f64::from(*found) - expected).abs() < 1e-3, "{n}: {found} {expected}");
        }
        assert!(convolve_recording(&[], &response).is_empty() && convolve_recording(&dry, &[]).is_empty());
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
