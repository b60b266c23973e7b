//! Rows of table `surface_stats`.

use arrow::record_batch::RecordBatch;
use echolake_dsp::foam_reflection::estimate_error;
use echolake_dsp::level::{p90_mean, percentile, power_to_db, standard_deviation};
use echolake_dsp::mean::SignalMean;
use echolake_dsp::scattering::BandScattering;
use echolake_dsp::uncertainty::{LevelError, LevelUncertainty};
use echolake_schema::Rig;
use echolake_schema::tables::{BandStatistics, Table};

use super::derived::ReferenceVersions;
use super::{RunKeys, finite_value};
use crate::error::Result;

/// Values of a surface's pairs, in each band and of the total.
pub(crate) struct SurfaceLevels {
    /// TNCE.
    pub tnce: Vec<Vec<f64>>,
    /// The same without Foam's reflection, by the best estimate and its variants; none if it is not known.
    pub unbiased: Vec<Vec<Vec<f64>>>,
    /// Relative errors of TNCE; none if they are not known.
    pub errors: Vec<Vec<LevelError>>,
    /// Combines them; None if they are not known.
    pub uncertainty: Option<LevelUncertainty>,
    /// Mean NCE curves of the bands.
    pub curves: Vec<SignalMean>,
    /// Coefficients of the octaves around the bands, where the sweep has all of one; none without an estimate of Foam's
    /// reflection.
    pub scattering: Vec<Option<BandScattering>>,
}

/// Builds one row per band and one for the total.
pub(crate) fn stats_rows(
    rig: &Rig,
    keys: &RunKeys,
    levels: &SurfaceLevels,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let names = rig.band_names().into_iter().chain(["total".to_owned()]);
    let mut stats: Vec<_> = names.zip(&levels.tnce).map(|(band, values)| stats_of(band, values)).collect();
    if let Some(uncertainty) = &levels.uncertainty {
        for ((stats, values), errors) in stats.iter_mut().zip(&levels.tnce).zip(&levels.errors) {
            stats.p90_mean_u_db = p90_mean_uncertainty(values, errors, uncertainty);
        }
    }
    for (band, stats) in stats.iter_mut().enumerate() {
        let mean_db = |values: &Vec<Vec<f64>>| stats_of(String::new(), &values[band]).p90_mean_db;
        let estimates: Option<Vec<_>> = levels.unbiased.iter().map(mean_db).collect();
        let Some((best, variants)) = estimates.as_deref().and_then(<[f64]>::split_first) else { continue };
        stats.unbiased_p90_mean_db = Some(*best);
        let level_u_db = stats.p90_mean_u_db;
        stats.unbiased_p90_mean_u_db = level_u_db.and_then(|u| finite_value(u.hypot(estimate_error(*best, variants))));
    }
    // The total has none.
    let numbers = |of: fn(&BandScattering) -> Option<f64>| -> Vec<Option<f64>> {
        let of_band = |band| levels.scattering.get(band).and_then(Option::as_ref);
        (0..stats.len()).map(|band| of_band(band).and_then(of).and_then(finite_value)).collect()
    };
    let batch = keys
        .begin_rows(Table::SurfaceStats, rig, stats.len())
        .push_texts("band", stats.iter().map(|s| &s.band))
        .push_doubles("band_hz", rig.bands.centres_hz.iter().map(|hz| Some(*hz)).chain([None]))
        .push_ints("measurements", stats.iter().map(|s| s.measurements))
        .push_doubles("p90_mean_db", stats.iter().map(|s| s.p90_mean_db))
        .push_doubles("p5_db", stats.iter().map(|s| s.p5_db))
        .push_doubles("p50_db", stats.iter().map(|s| s.p50_db))
        .push_doubles("p95_db", stats.iter().map(|s| s.p95_db))
        .push_doubles("min_db", stats.iter().map(|s| s.min_db))
        .push_doubles("max_db", stats.iter().map(|s| s.max_db))
        .push_doubles("spread_db", stats.iter().map(|s| s.spread_db))
        .push_doubles("p90_mean_u_db", stats.iter().map(|s| s.p90_mean_u_db))
        .push_doubles("unbiased_p90_mean_db", stats.iter().map(|s| s.unbiased_p90_mean_db))
        .push_doubles("unbiased_p90_mean_u_db", stats.iter().map(|s| s.unbiased_p90_mean_u_db))
        .push_doubles("energy_over_flat", numbers(|band| Some(band.energy.value)))
        .push_doubles("energy_over_flat_u", numbers(|band| band.energy.uncertainty))
        .push_doubles("scattering", numbers(|band| Some(band.scattering.value)))
        .push_doubles("scattering_u", numbers(|band| band.scattering.uncertainty))
        .push_doubles("specular_loss", numbers(|band| Some(band.specular_loss.value)))
        .push_doubles("specular_loss_u", numbers(|band| band.specular_loss.uncertainty))
        .push_lists("mean_nce", mean_curves(&levels.curves))
        .fill_text("flat_version", of.flat)
        .fill_text("foam_version", of.foam)
        .finish()?;
    Ok(batch)
}

// The bands' curves, then their sum; nothing without measurements.
fn mean_curves(bands: &[SignalMean]) -> Vec<f32> {
    let means: Vec<Vec<f64>> = bands.iter().map(|band| band.mean_values().collect()).collect();
    let length = means.first().map_or(0, Vec::len);
    let total = (0..length).map(|i| means.iter().map(|mean| mean[i]).sum());
    means.iter().flatten().copied().chain(total).map(|x: f64| x as f32).collect()
}

// Means are of power, as in the paper's tables; no energy at all has no level.
fn stats_of(band: String, values: &[f64]) -> BandStatistics {
    let measurements = values.len() as i32;
    let mut sorted: Vec<f64> = values.iter().copied().filter(|x| x.is_finite()).collect();
    if sorted.is_empty() {
        return BandStatistics { band, measurements, ..BandStatistics::default() };
    }
    sorted.sort_by(f64::total_cmp);
    let db = |power: f64| finite_value(power_to_db(power));
    let levels: Vec<f64> = sorted.iter().filter_map(|x| db(*x)).collect();
    BandStatistics {
        band,
        measurements,
        p90_mean_db: p90_mean(&sorted, &mut Vec::new()).and_then(db),
        p5_db: db(percentile(&sorted, 5.0)),
        p50_db: db(percentile(&sorted, 50.0)),
        p95_db: db(percentile(&sorted, 95.0)),
        min_db: db(sorted[0]),
        max_db: db(sorted[sorted.len() - 1]),
        spread_db: finite_value(standard_deviation(&levels)),
        p90_mean_u_db: None,
        unbiased_p90_mean_db: None,
        unbiased_p90_mean_u_db: None,
    }
}

// Errors that the pairs have in common add up, the others average out.
fn p90_mean_uncertainty(values: &[f64], errors: &[LevelError], uncertainty: &LevelUncertainty) -> Option<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|x| x.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let limit = percentile(&sorted, 90.0);
    let counted = values.iter().zip(errors).filter(|(value, _)| **value > 0.0 && **value <= limit);
    let sum: f64 = counted.clone().map(|(value, _)| value).sum();
    let mut mean = LevelError::default();
    for (value, error) in counted {
        let share = value / sum;
        mean.common += share * error.common;
        mean.variance += share * share * error.variance;
        mean.own_per_kelvin += share * error.own_per_kelvin;
        mean.flat_per_kelvin += share * error.flat_per_kelvin;
        mean.per_ratio += share * error.per_ratio;
    }
    (sum > 0.0).then(|| uncertainty.combine_db(&mean)).and_then(finite_value)
}

#[cfg(test)]
mod tests {
    use echolake_dsp::uncertainty::DirectSoundResidual;

    use super::*;

    #[test]
    fn levels_of_known_values() {
        let stats = stats_of("2500".into(), &[10.0, 1.0, 0.1]);
        assert_eq!(stats.p50_db, Some(0.0));
        assert!((stats.min_db.expect("there") + 10.0).abs() < 1e-12);
        assert!((stats.max_db.expect("there") - 10.0).abs() < 1e-12);
        assert!((stats.spread_db.expect("there") - (200.0f64 / 3.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn common_errors_stay_in_the_mean_and_others_average_out() {
        let run = DirectSoundResidual::default();
        let mut uncertainty = LevelUncertainty { run, flat: None, temperature_k: 0.1, ln_ratio: 0.0 };
        let of = |error: LevelError, uncertainty: &LevelUncertainty| {
            p90_mean_uncertainty(&[0.5; 100], &[error; 100], uncertainty).expect("an uncertainty")
        };
        let u = |error| of(error, &uncertainty);
        assert!((u(LevelError { common: 0.01, ..LevelError::default() }) - 0.0434).abs() < 1e-4);
        assert!((u(LevelError { variance: 1e-4, ..LevelError::default() }) - 0.00434).abs() < 1e-5);
        let slopes = LevelError { own_per_kelvin: 0.03, flat_per_kelvin: 0.04, ..LevelError::default() };
        assert!((u(slopes) - 0.0217).abs() < 1e-4);
        assert_eq!(p90_mean_uncertainty(&[0.5; 100], &[], &uncertainty), None);
        uncertainty.ln_ratio = 0.005;
        assert!((of(LevelError { per_ratio: 2.0, ..LevelError::default() }, &uncertainty) - 0.0434).abs() < 1e-4);
    }

    #[test]
    fn mean_curves_end_with_their_sum() {
        let mut bands = vec![SignalMean::default(); 2];
        assert!(mean_curves(&bands).is_empty());
        for (band, curves) in bands.iter_mut().zip([[[0.0f32, 2.0], [1.0, 4.0]], [[0.0, 1.0], [0.0, 3.0]]]) {
            curves.iter().for_each(|curve| band.add_signal(curve).expect("equally long"));
        }
        assert_eq!(mean_curves(&bands), [0.5, 3.0, 0.0, 2.0, 0.5, 5.0]);
    }

    #[test]
    fn no_energy_has_no_level() {
        assert_eq!(stats_of(String::new(), &[]), BandStatistics::default());
        let silent = stats_of(String::new(), &[0.0, 0.0]);
        assert_eq!((silent.p50_db, silent.spread_db), (None, None));
    }
}
