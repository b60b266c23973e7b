//! Responses of complex spectra (SOFA's data type TF), by inverse transforms.

use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

/// Greatest error of a frequency, as a part of the highest: that of singles.
const FREQUENCY_ERROR: f64 = 1e-6;
/// Greatest imaginary part of the bins that are real, as a part of the greatest amplitude.
const IMAGINARY_ERROR: f64 = 1e-6;

/// Returns the number of samples that spectra of these frequencies have at a sampling rate, or what is wrong with the
/// frequencies: actual and expected.
pub(super) fn response_length(frequencies: &[f64], rate_hz: f64) -> Result<usize, (String, String)> {
    let &[first, .., highest] = frequencies else {
        return Err((format!("{} frequencies", frequencies.len()), "two at least".into()));
    };
    let steps = frequencies.len() - 1;
    let step = highest / steps as f64;
    // Not a number is no frequency, either.
    let off = |(i, f): &(usize, &f64)| !((**f - step * *i as f64).abs() <= FREQUENCY_ERROR * highest.abs());
    if !(first.abs() <= FREQUENCY_ERROR * highest.abs()) {
        return Err((format!("frequencies from {first} Hz"), "evenly spaced ones from 0 Hz, for a response".into()));
    }
    if let Some((i, f)) = frequencies.iter().enumerate().find(off) {
        let expected = format!("{} Hz, because a response needs evenly spaced frequencies", step * i as f64);
        return Err((format!("frequency {i} is {f} Hz"), expected));
    }
    // The highest bin is at half the rate, or half a step below it where the number of samples is odd.
    let lengths = [2 * steps, 2 * steps + 1];
    let fits = |length: &usize| (rate_hz / *length as f64 - step).abs() * steps as f64 <= FREQUENCY_ERROR * rate_hz;
    lengths.into_iter().find(fits).ok_or_else(|| {
        let expected = format!(
            "frequencies up to half the rig's {rate_hz} Hz; hint: sweep.rate_hz in the rig file is {} for them",
            2.0 * highest
        );
        (format!("frequencies up to {highest} Hz"), expected)
    })
}

/// Transforms spectra, one after the other, into responses of `length` samples; an error is the index of the number
/// that is imaginary and must not be.
pub(super) fn invert_spectra(real: &[f64], imaginary: &[f64], length: usize) -> Result<Vec<f32>, usize> {
    let bins = length / 2 + 1;
    let plan = RealFftPlanner::<f64>::new().plan_fft_inverse(length);
    let mut spectrum = plan.make_input_vec();
    let mut samples = plan.make_output_vec();
    let mut scratch = plan.make_scratch_vec();
    let mut responses = Vec::with_capacity(real.len() / bins * length);
    for (number, (real, imaginary)) in real.chunks_exact(bins).zip(imaginary.chunks_exact(bins)).enumerate() {
        let greatest = real.iter().zip(imaginary).map(|(re, im)| re.hypot(*im)).fold(0.0, f64::max);
        spectrum.iter_mut().zip(real.iter().zip(imaginary)).for_each(|(x, (re, im))| *x = Complex::new(*re, *im));
        let nyquist = length.is_multiple_of(2).then_some(bins - 1);
        for bin in [Some(0), nyquist].into_iter().flatten() {
            if imaginary[bin].abs() > IMAGINARY_ERROR * greatest {
                return Err(number * bins + bin);
            }
            spectrum[bin].im = 0.0;
        }
        // Lengths are the plan's own, and what must be real is: it cannot fail.
        let _ = plan.process_with_scratch(&mut spectrum, &mut samples, &mut scratch);
        responses.extend(samples.iter().map(|x| (x / length as f64) as f32));
    }
    Ok(responses)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spectra_are_those_of_their_responses() {
        for length in [8, 9] {
            let bins = length / 2 + 1;
            let samples: Vec<f64> = (0..2 * length).map(|i| f64::from((i * 7 % 5) as u8) - 1.5).collect();
            // The sum that a transform is.
            let bin = |response: &[f64], k: usize| {
                let turn = |i: usize| -std::f64::consts::TAU * (i * k) as f64 / length as f64;
                let terms = response.iter().enumerate().map(|(i, x)| (x * turn(i).cos(), x * turn(i).sin()));
                terms.fold((0.0, 0.0), |sum, term| (sum.0 + term.0, sum.1 + term.1))
            };
            let spectra: Vec<_> =
                samples.chunks_exact(length).flat_map(|r| (0..bins).map(|k| bin(r, k)).collect::<Vec<_>>()).collect();
            let (real, mut imaginary): (Vec<f64>, Vec<f64>) = spectra.into_iter().unzip();
            let found = invert_spectra(&real, &imaginary, length).expect("responses");
            assert_eq!(found.len(), samples.len());
            assert!(found.iter().zip(&samples).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6), "{found:?}");
            imaginary[bins] = 1.0;
            assert_eq!(invert_spectra(&real, &imaginary, length), Err(bins));
        }
    }

    #[test]
    fn frequencies_are_even_and_reach_half_the_rate() {
        let even = |count: u32, step: f64| (0..count).map(|i| f64::from(i) * step).collect::<Vec<_>>();
        assert_eq!(response_length(&even(5, 6000.0), 48e3), Ok(8));
        assert_eq!(response_length(&even(5, 48e3 / 9.0), 48e3), Ok(9));
        let fault = |frequencies: &[f64]| response_length(frequencies, 48e3).expect_err("a fault");
        assert_eq!(fault(&even(5, 5000.0)).0, "frequencies up to 20000 Hz");
        assert_eq!(fault(&[100.0, 200.0, 300.0]).0, "frequencies from 100 Hz");
        assert_eq!(fault(&[0.0, 125.0, 250.0, 24e3]).0, "frequency 1 is 125 Hz");
        assert_eq!(fault(&[0.0, f64::NAN, 24e3]).0, "frequency 1 is NaN Hz");
        assert_eq!(fault(&[0.0, 1.0, f64::NAN]).0, "frequencies from 0 Hz");
        assert_eq!(
            fault(&[0.0, 0.0]).1,
            "frequencies up to half the rig's 48000 Hz; hint: sweep.rate_hz in the rig file is 0 for them"
        );
        assert_eq!(fault(&[24e3]).0, "1 frequencies");
    }
}
