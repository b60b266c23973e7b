//! Rounding of stored samples, so that they compress.

/// Binary digits that curves and reflected responses keep below their greatest sample: a sample of 1 % of the greatest
/// is off by 0.0033 dB at most.
pub const CURVE_BITS: u32 = 16;

/// Binary digits that responses keep below their greatest sample: the rounding is noise 131 dB below it.
pub const RESPONSE_BITS: u32 = 20;

/// Digits of a float's fraction, and the mask of its exponent.
const FRACTION_BITS: i32 = 23;
const EXPONENT_MASK: u32 = 0x7f80_0000;

/// Rounds samples to multiples of a power of two: 2^-`kept_bits` of the greatest power that is not over the greatest
/// magnitude. The last bits of all samples are 0 then. Samples that are not finite leave all as they are.
///
/// Source: Kloewer et al. 2021, Nature Computational Science 1, 713-724, for rounding before lossless compression.
///
/// ```
/// use echolake_dsp::rounding::{CURVE_BITS, round_samples};
///
/// let mut samples = [1.0, 0.3, -0.01, 0.0];
/// round_samples(&mut samples, CURVE_BITS);
/// assert_eq!(samples, [1.0, 19_661.0 / 65_536.0, -655.0 / 65_536.0, 0.0]);
/// ```
pub fn round_samples(samples: &mut [f32], kept_bits: u32) {
    // Magnitudes are in the order of their bits, and those of samples that are not finite have the greatest exponent.
    let greatest = samples.iter().fold(0, |greatest: i32, x| greatest.max(x.abs().to_bits().cast_signed()));
    let power = f32::from_bits(greatest.cast_unsigned() & EXPONENT_MASK);
    // Added to a sample, it leaves no digits below the step.
    let shift = 1.5 * power * 2f32.powi(FRACTION_BITS - kept_bits as i32);
    if shift.is_normal() {
        samples.iter_mut().for_each(|x| *x = (*x + shift) - shift);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_off_by_half_a_step_at_most_and_keep_their_order() {
        let before: Vec<f32> = (0..1_000).map(|i| (i as f32 * 0.37).sin().abs().powi(3) * 0.9e-4).collect();
        let mut after = before.clone();
        round_samples(&mut after, CURVE_BITS);
        let step = 2f32.powi(-14 - 16);
        assert!(before.iter().any(|x| *x > 2f32.powi(-14)) && before.iter().all(|x| *x < 2f32.powi(-13)));
        for (a, b) in before.iter().zip(&after) {
            assert!((a - b).abs() <= step / 2.0 && (b / step).fract() == 0.0, "{a} {b}");
        }
        for (a, b) in before.windows(2).zip(after.windows(2)) {
            assert!((a[0] <= a[1]) == (b[0] <= b[1]) || b[0] == b[1]);
        }
    }

    #[test]
    fn silence_and_what_is_no_number_stay() {
        for samples in [[0.0; 3], [f32::MIN_POSITIVE / 4.0; 3], [f32::MAX, 1.0, 0.3], [1.0, f32::INFINITY, 0.3]] {
            let mut rounded = samples;
            round_samples(&mut rounded, CURVE_BITS);
            assert_eq!(rounded, samples);
        }
        for not_a_number in [f32::NAN, -f32::NAN] {
            let mut rounded = [0.3, not_a_number];
            round_samples(&mut rounded, CURVE_BITS);
            assert!(rounded[0] == 0.3 && rounded[1].is_nan());
        }
    }
}
