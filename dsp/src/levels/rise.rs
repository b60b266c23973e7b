//! Times and slope of a cumulative energy curve: the paper's measure of how diffuse a reflection is is the curve's
//! slope.

use crate::RealSample;

/// Shares of a curve's last value between which it rises.
const RISE_SHARES: [f64; 2] = [0.1, 0.9];

/// Samples that are compared side by side.
const BLOCK: usize = 16;

/// Shape of one cumulative energy curve, in samples from its first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurveShape {
    /// Samples in which the curve rises from 10 % to 90 % of its last value, linearly interpolated.
    pub rise: f64,
    /// Centre of gravity of the energy.
    pub centre: f64,
    /// Mean slope between 10 % and 90 %, in the curve's unit per sample: 0.8 times the last value over the rise.
    pub slope: f64,
}

/// Computes the shape of a curve that does not fall, from a sample before its first, where it is 0. None without
/// energy, or if a value is not finite.
///
/// ```
/// use echolake_dsp::rise::curve_shape;
///
/// // Ten samples of the same energy.
/// let shape = curve_shape(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]).ok_or("energy")?;
/// assert!((shape.rise - 8.0).abs() < 1e-9 && (shape.centre - 4.5).abs() < 1e-9);
/// assert!((shape.slope - 0.1).abs() < 1e-9);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn curve_shape<T: RealSample>(curve: &[T]) -> Option<CurveShape> {
    let last = curve.last()?.f64();
    // A sum is not finite if one of its terms is not.
    let sum = T::sum_samples(curve);
    if !(last > 0.0 && sum.is_finite()) {
        return None;
    }
    let (blocks, _) = curve.as_chunks::<BLOCK>();
    let crossing = |share: f64| {
        let level = share * last;
        // Whole blocks below the level are passed over without a branch for each sample.
        let reaches = |block: &[T; BLOCK]| block.iter().fold(false, |reaches, x| reaches | (x.f64() >= level));
        let first = BLOCK * blocks.iter().position(reaches).unwrap_or(blocks.len());
        let at = first + curve[first..].iter().position(|x| x.f64() >= level)?;
        let (before, here) = (at.checked_sub(1).map_or(0.0, |n| curve[n].f64()), curve[at].f64());
        Some(at as f64 - (here - level) / (here - before))
    };
    let [begin, end] = RISE_SHARES.map(crossing);
    let rise = end? - begin?;
    let slope = (RISE_SHARES[1] - RISE_SHARES[0]) * last / rise;
    // Summed by parts: sample n adds what the curve rises there.
    Some(CurveShape { rise, centre: (curve.len() as f64) - sum / last, slope })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_arrival_rises_within_a_sample_and_two_are_apart() {
        let one = curve_shape(&[0.0f32, 0.0, 2.0, 2.0]).expect("a shape");
        assert!((one.rise - 0.8).abs() < 1e-6 && (one.centre - 2.0).abs() < 1e-6 && (one.slope - 2.0).abs() < 1e-6);
        let two = curve_shape(&[0.0, 1.0, 1.0, 1.0, 1.0, 2.0]).expect("a shape");
        assert!((two.rise - (4.8 - 0.2)).abs() < 1e-9, "{two:?}");
        assert!((two.centre - 3.0).abs() < 1e-9, "{two:?}");
        // An arrival in the first sample.
        assert_eq!(curve_shape(&[1.0, 1.0]).map(|shape| shape.centre), Some(0.0));
    }

    // Curves that fall, as a list of a query may, cross where they first do.
    #[test]
    fn the_first_crossing_counts_in_curves_of_any_length() {
        for len in 1..70 {
            let curve: Vec<f32> = (0..len).map(|n| (n as f32 * 0.9).sin() + n as f32 * 0.1 + 1.0).collect();
            let last = f64::from(curve[len - 1]);
            let crossing = |share: f64| {
                let at = curve.iter().position(|x| f64::from(*x) >= share * last).expect("the last one");
                let before = if at == 0 { 0.0 } else { f64::from(curve[at - 1]) };
                at as f64 - (f64::from(curve[at]) - share * last) / (f64::from(curve[at]) - before)
            };
            let shape = curve_shape(&curve).expect("a shape");
            assert_eq!(shape.rise, crossing(0.9) - crossing(0.1), "{len}");
            let sum: f64 = curve.iter().map(|x| f64::from(*x)).sum();
            assert!((shape.centre - (len as f64 - sum / last)).abs() < 1e-12, "{len}");
        }
    }

    #[test]
    fn no_energy_has_no_shape() {
        for none in [&[][..], &[0.0, 0.0], &[0.0, f64::NAN], &[f64::NAN, 1.0], &[1.0, f64::INFINITY]] {
            assert_eq!(curve_shape(none), None, "{none:?}");
        }
    }
}
