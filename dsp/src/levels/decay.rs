//! Decay of a response's energy.

use crate::RealSample;

/// Schroeder's backward integration: the energy from each sample to the end over all of it, dB. The first is 0 dB;
/// once nothing is left, minus infinity. If the response has no finite energy, returns false and all of `curve` is
/// minus infinity.
///
/// ir, curve  `[n]`, summed up in f64
///
/// Source: Schroeder 1965, J. Acoust. Soc. Am. 37(3):409-412.
///
/// ```
/// let mut curve = [0.0; 2];
/// assert!(echolake_dsp::decay::energy_decay_db(&[3.0, 1.0], &mut curve));
/// assert_eq!(curve, [0.0, -10.0]);
/// ```
pub fn energy_decay_db<T: RealSample>(ir: &[T], curve: &mut [T]) -> bool {
    let total = crate::energy::energy(ir);
    if !(total > 0.0 && total.is_finite()) {
        curve.fill(T::of(f64::NEG_INFINITY));
        return false;
    }
    let mut left = 0.0;
    for (x, out) in ir.iter().zip(curve.iter_mut()).rev() {
        left += x.f64() * x.f64();
        *out = T::of(10.0 * (left / total).log10());
    }
    // Summed up from the other end, the last digits may differ.
    if let Some(first) = curve.first_mut() {
        *first = T::default();
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    // x = e^(-a n): the energy left falls by the same number of dB per sample, except for what the end cuts off.
    #[test]
    fn an_exponential_decays_on_a_line() {
        let (decay, len) = (0.05f64, 2_000);
        let ir: Vec<f64> = (0..len).map(|n| (-decay * f64::from(n)).exp()).collect();
        let mut curve = vec![f64::NAN; ir.len()];
        assert!(energy_decay_db(&ir, &mut curve));
        let slope = -20.0 * decay * std::f64::consts::LOG10_E;
        for (n, level) in curve.iter().enumerate().take(1_000) {
            assert!((level - slope * n as f64).abs() < 1e-9, "{n}: {level}");
        }
        assert!(curve.windows(2).all(|w| w[1] <= w[0]));
    }

    #[test]
    fn nothing_left_is_minus_infinity_and_silence_has_no_decay() {
        let mut curve = [f32::NAN; 3];
        assert!(energy_decay_db(&[1.0, 1.0, 0.0], &mut curve));
        assert_eq!(curve[0], 0.0);
        assert!((curve[1] + 3.0103).abs() < 1e-4);
        assert_eq!(curve[2], f32::NEG_INFINITY);
        assert!(!energy_decay_db(&[0.0, 0.0, 0.0], &mut curve));
        assert!(!energy_decay_db(&[1.0, f32::NAN, 0.0], &mut curve));
        assert!(!energy_decay_db::<f64>(&[], &mut []));
    }
}
