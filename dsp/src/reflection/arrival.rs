//! Time of a response's first arrival.

use crate::RealSample;

/// Time of the first arrival in samples from the first, fractions included: the point at which the magnitude first
/// reaches `threshold_db` (below 0) relative to its greatest, linearly interpolated from the sample before. None if
/// there is no sound, or a sample that is not finite.
///
/// ISO 3382-1:2009 looks for the start of a response at least 20 dB below its greatest.
///
/// ```
/// let arrival = echolake_dsp::arrival::first_arrival(&[0.0, 0.0, 1.0, 0.5], -20.0);
/// assert!(arrival.is_some_and(|samples| (samples - 1.1).abs() < 1e-9));
/// ```
pub fn first_arrival<T: RealSample>(ir: &[T], threshold_db: f64) -> Option<f64> {
    let magnitude = |x: &T| x.f64().abs();
    let mut greatest = 0.0f64;
    for x in ir {
        let x = magnitude(x);
        if !x.is_finite() {
            return None;
        }
        greatest = greatest.max(x);
    }
    if greatest == 0.0 {
        return None;
    }
    let limit = greatest * 10f64.powf(threshold_db.min(0.0) / 20.0);
    let at = ir.iter().position(|x| magnitude(x) >= limit)?;
    let Some(before) = at.checked_sub(1).map(|n| magnitude(&ir[n])) else { return Some(0.0) };
    Some(at as f64 - (magnitude(&ir[at]) - limit) / (magnitude(&ir[at]) - before))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_where_the_threshold_is_crossed() {
        assert_eq!(first_arrival(&[0.0, 0.0, -1.0, 0.5], 0.0), Some(2.0));
        // A tenth is reached a tenth of the way from 0 to 1.
        assert!((first_arrival(&[0.0, 0.0, 1.0, 0.5], -20.0).expect("one") - 1.1).abs() < 1e-12);
        assert_eq!(first_arrival(&[0.05f32, 0.0, 1.0], -20.0), Some(1.1));
        assert_eq!(first_arrival(&[1.0, 0.0], -20.0), Some(0.0));
        assert_eq!(first_arrival(&[0.0, 1.0, 1.0], 6.0), Some(1.0));
    }

    #[test]
    fn silence_never_arrives() {
        for none in [&[][..], &[0.0, 0.0], &[f64::NAN, 1.0], &[1.0, f64::INFINITY]] {
            assert_eq!(first_arrival(none, -20.0), None, "{none:?}");
        }
    }
}
