//! Rows of table `surface_stats`.

use arrow::record_batch::RecordBatch;
use echolake_dsp::level::{p90_mean, percentile, power_to_db};
use echolake_schema::Rig;
use echolake_schema::tables::{BandStatistics, Table};

use super::derived::ReferenceVersions;
use super::{RunKeys, finite};
use crate::error::Result;

/// Builds one row per band and one for the total, from the TNCE values of each over all pairs; `unbiased` are those
/// without Foam's reflection, none if it is not known.
pub(crate) fn rows(
    rig: &Rig,
    keys: &RunKeys,
    tnce: &[Vec<f64>],
    unbiased: &[Vec<f64>],
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let names = rig.band_names().into_iter().chain(["total".to_owned()]);
    let mut stats: Vec<_> = names.zip(tnce).map(|(band, values)| stats_of(band, values)).collect();
    for (stats, values) in stats.iter_mut().zip(unbiased) {
        stats.unbiased_p90_mean_db = stats_of(String::new(), values).p90_mean_db;
    }
    let batch = keys
        .begin_rows(Table::SurfaceStats, rig, stats.len())
        .texts("band", stats.iter().map(|s| &s.band))
        .doubles("band_hz", rig.bands.centres_hz.iter().map(|hz| Some(*hz)).chain([None]))
        .ints("measurements", stats.iter().map(|s| s.measurements))
        .doubles("p90_mean_db", stats.iter().map(|s| s.p90_mean_db))
        .doubles("p5_db", stats.iter().map(|s| s.p5_db))
        .doubles("p50_db", stats.iter().map(|s| s.p50_db))
        .doubles("p95_db", stats.iter().map(|s| s.p95_db))
        .doubles("min_db", stats.iter().map(|s| s.min_db))
        .doubles("max_db", stats.iter().map(|s| s.max_db))
        .doubles("spread_db", stats.iter().map(|s| s.spread_db))
        .doubles("unbiased_p90_mean_db", stats.iter().map(|s| s.unbiased_p90_mean_db))
        .text("flat_version", of.flat)
        .text("foam_version", of.foam)
        .finish()?;
    Ok(batch)
}

// Means are of power, as in the paper's tables; no energy at all has no level.
fn stats_of(band: String, values: &[f64]) -> BandStatistics {
    let measurements = values.len() as i32;
    let mut sorted: Vec<f64> = values.iter().copied().filter(|x| x.is_finite()).collect();
    if sorted.is_empty() {
        return BandStatistics { band, measurements, ..BandStatistics::default() };
    }
    sorted.sort_by(f64::total_cmp);
    let db = |power: f64| finite(power_to_db(power));
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
        spread_db: spread(&levels),
        unbiased_p90_mean_db: None,
    }
}

fn spread(levels: &[f64]) -> Option<f64> {
    let count = levels.len() as f64;
    let mean = levels.iter().sum::<f64>() / count;
    finite((levels.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count).sqrt())
}

#[cfg(test)]
mod tests {
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
    fn no_energy_has_no_level() {
        assert_eq!(stats_of(String::new(), &[]), BandStatistics::default());
        let silent = stats_of(String::new(), &[0.0, 0.0]);
        assert_eq!((silent.p50_db, silent.spread_db), (None, None));
    }
}
