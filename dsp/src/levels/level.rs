//! Decibels and order statistics.

/// Reference of sound pressure levels in air, Pa (ISO 1683:2015).
const REFERENCE_PRESSURE_PA: f64 = 20e-6;
/// -200 dB: levels for plots end there, so that silence has one.
const LEAST_PLOTTED_POWER: f64 = 1e-20;

/// 10 log10 x: the level of a power ratio, dB. No power is minus infinity.
pub fn power_to_db(power: f64) -> f64 {
    10.0 * power.log10()
}

/// The level of a power ratio for a plot: as [`power_to_db`], but -200 dB at least.
pub fn plotted_power_to_db(power: f64) -> f64 {
    power_to_db(power.max(LEAST_PLOTTED_POWER))
}

/// 20 log10 |x|: the level of an amplitude ratio, dB. No amplitude is minus infinity.
pub fn amplitude_to_db(amplitude: f64) -> f64 {
    20.0 * amplitude.abs().log10()
}

/// Sound pressure level of a root mean square pressure in Pa, dB re 20 uPa.
pub fn sound_pressure_level_db(rms_pa: f64) -> f64 {
    amplitude_to_db(rms_pa / REFERENCE_PRESSURE_PA)
}

/// The `percent`-th percentile of ascending values, linearly interpolated as in NumPy; NaN of none.
pub fn percentile(sorted: &[f64], percent: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let position = percent / 100.0 * last as f64;
    let below = (position.floor() as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (sorted[above] - sorted[below]) * (position - below as f64)
}

/// Standard deviation about the mean, by the number of values; NaN of none.
pub fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Mean of the values up to their 90th percentile, as in the paper's tables; None of none, NaN if one is.
///
/// ```
/// let mean = echolake_dsp::level::p90_mean(&[1.0, 2.0, 3.0, 100.0], &mut Vec::new());
/// assert_eq!(mean, Some(2.0));
/// ```
pub fn p90_mean(values: &[f64], scratch: &mut Vec<f64>) -> Option<f64> {
    scratch.clear();
    scratch.extend_from_slice(values);
    if scratch.iter().any(|x| x.is_nan()) {
        return Some(f64::NAN);
    }
    // Unstable, because the stable sort allocates.
    scratch.sort_unstable_by(f64::total_cmp);
    let limit = percentile(scratch, 90.0);
    let kept = scratch.iter().take_while(|x| **x <= limit);
    let (count, sum) = kept.fold((0u32, 0.0), |(n, sum), x| (n + 1, sum + x));
    (count > 0).then(|| sum / f64::from(count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_interpolate() {
        let values = [1.0, 2.0, 4.0, 8.0];
        for (percent, expected) in [(0.0, 1.0), (50.0, 3.0), (100.0, 8.0), (90.0, 6.8)] {
            assert!((percentile(&values, percent) - expected).abs() < 1e-12, "{percent}");
        }
        assert!(percentile(&[], 50.0).is_nan());
        assert_eq!(percentile(&[5.0], 90.0), 5.0);
    }

    #[test]
    fn outliers_above_the_90th_percentile_do_not_count() {
        let values: Vec<f64> = (1..=10).map(f64::from).chain([1e9]).collect();
        assert_eq!(p90_mean(&values, &mut Vec::new()), Some(5.5));
        assert_eq!(p90_mean(&[], &mut Vec::new()), None);
        assert_eq!(p90_mean(&[3.0, 3.0], &mut vec![1.0]), Some(3.0));
        for nan in [f64::NAN, -f64::NAN] {
            assert!(p90_mean(&[1.0, nan, 2.0], &mut Vec::new()).is_some_and(f64::is_nan));
        }
    }

    #[test]
    fn levels_and_powers() {
        assert_eq!(power_to_db(100.0), 20.0);
        assert!((10f64.powf(power_to_db(0.37) / 10.0) - 0.37).abs() < 1e-15);
        assert_eq!(power_to_db(0.0), f64::NEG_INFINITY);
        assert_eq!((plotted_power_to_db(0.0), plotted_power_to_db(100.0)), (-200.0, 20.0));
        assert_eq!((amplitude_to_db(-10.0), amplitude_to_db(0.0)), (20.0, f64::NEG_INFINITY));
        assert!((sound_pressure_level_db(1.0) - 93.979).abs() < 1e-3, "the calibrator's 94 dB");
    }
}
