//! `repeatability`: one row per surface, band and kind of level, by how much its runs differ.

use std::collections::HashMap;

use super::{RE_FLAT_TOTAL, column_note};

/// Difference of two results over their standard deviation that 95 % do not exceed.
///
/// Source: ISO 5725-6:1994, clause 4.1.
const LIMIT_FACTOR: f64 = 2.8;

// Runs of one rig on one day are repeated under the same conditions. Analysis of variance of one factor, whose groups
// need not have as many runs (ISO 5725-2:2019, clause 7.4).
pub(super) fn view_sql() -> String {
    let levels = "SELECT t.surface_id, t.band, t.band_hz, r.rig, date_trunc('day', r.started) AS day, k.kind, \
                  CASE k.kind WHEN 'measured' THEN t.p90_mean_db ELSE t.unbiased_p90_mean_db END AS level_db \
                  FROM surface_stats t JOIN runs r ON r.run_id = t.run_id \
                  CROSS JOIN (SELECT unnest(['measured', 'unbiased']) AS kind) AS k";
    let conditions = format!(
        "SELECT surface_id, band, kind, max(band_hz) AS band_hz, CAST(count(*) AS DOUBLE) AS n, avg(level_db) AS mean, \
         var_pop(level_db) * count(*) AS inner_squares FROM ({levels}) WHERE level_db IS NOT NULL \
         GROUP BY surface_id, band, kind, rig, day"
    );
    let sums = format!(
        "SELECT surface_id, band, kind, max(band_hz) AS band_hz, sum(n) AS runs, \
         CAST(count(*) AS DOUBLE) AS conditions, sum(n * mean) / sum(n) AS level_db, \
         sum(inner_squares) AS inner_squares, sum(n) - sum(n * n) / sum(n) AS weight, \
         greatest(sum(n * mean * mean) - power(sum(n * mean), 2) / sum(n), 0) AS outer_squares \
         FROM ({conditions}) GROUP BY surface_id, band, kind"
    );
    let variances = format!(
        "SELECT *, CASE WHEN runs > conditions THEN inner_squares / (runs - conditions) END AS repeated, \
         CASE WHEN conditions > 1 THEN outer_squares / (conditions - 1) END AS of_means FROM ({sums})"
    );
    let reproduced = "CASE WHEN conditions = 1 THEN NULL WHEN runs > conditions THEN \
                      repeated + greatest(of_means - repeated, 0) * (conditions - 1) / weight ELSE of_means END";
    format!(
        "SELECT surface_id, band, band_hz, kind, CAST(runs AS BIGINT) AS runs, \
         CAST(conditions AS BIGINT) AS conditions, level_db, sqrt(repeated) AS repeatability_sd_db, \
         {LIMIT_FACTOR} * sqrt(repeated) AS repeatability_limit_db, \
         sqrt({reproduced}) AS reproducibility_sd_db, {LIMIT_FACTOR} * sqrt({reproduced}) AS reproducibility_limit_db, \
         CASE WHEN runs = 1 THEN 'one run' WHEN runs = conditions THEN 'no two runs of one rig and day' \
         WHEN conditions = 1 THEN 'all runs are of one rig and day' END AS reason FROM ({variances})"
    )
}

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let noted = [
        column_note("band_hz", "Hz", "Centre of the band; null for the total"),
        column_note("kind", "", "measured: p90_mean_db; unbiased: unbiased_p90_mean_db, without Foam's own reflection"),
        column_note("runs", "1", "Runs of the surface that have the level"),
        column_note("conditions", "1", "Rigs and days, UTC, of these runs"),
        column_note("level_db", RE_FLAT_TOTAL, "Mean of the level over the runs"),
        column_note("repeatability_sd_db", "dB", "Standard deviation of runs of one rig and day, ISO 5725-2"),
        column_note(
            "repeatability_limit_db",
            "dB",
            "r: two runs of one rig and day differ by no more in 95 % of cases, 2.8 standard deviations",
        ),
        column_note("reproducibility_sd_db", "dB", "Standard deviation of runs of any rig and day, ISO 5725-2"),
        column_note(
            "reproducibility_limit_db",
            "dB",
            "R: two runs of other rigs or days differ by no more in 95 % of cases, 2.8 standard deviations",
        ),
        column_note("reason", "", "Why values are missing"),
    ];
    noted.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow::array::{ArrayRef, AsArray as _, Float64Array, StringArray, TimestampNanosecondArray};
    use arrow::datatypes::Float64Type;
    use arrow::record_batch::RecordBatch;
    use datafusion::prelude::SessionContext;

    use super::*;

    const DAY_NS: i64 = 86_400_000_000_000;

    // Runs of surfaces: rig, day and level.
    async fn limits(runs: &[(&str, &str, i64, f64)]) -> RecordBatch {
        let context = SessionContext::new();
        let texts = |texts: Vec<&str>| -> ArrayRef { Arc::new(StringArray::from(texts)) };
        let names: Vec<String> = (0..runs.len()).map(|run| format!("r{run}")).collect();
        let names = || texts(names.iter().map(String::as_str).collect());
        let levels: ArrayRef = Arc::new(Float64Array::from_iter_values(runs.iter().map(|run| run.3)));
        let unknown: ArrayRef = Arc::new(Float64Array::from(vec![None; runs.len()]));
        // In the middle of the day, and later.
        let started = runs.iter().enumerate().map(|(run, of)| of.2 * DAY_NS + DAY_NS / 2 + run as i64);
        let started: ArrayRef = Arc::new(TimestampNanosecondArray::from_iter_values(started));
        let stats = [
            ("run_id", names()),
            ("surface_id", texts(runs.iter().map(|run| run.0).collect())),
            ("band", texts(vec!["2500"; runs.len()])),
            ("band_hz", Arc::new(Float64Array::from(vec![2_500.0; runs.len()]))),
            ("p90_mean_db", levels),
            ("unbiased_p90_mean_db", unknown),
        ];
        let of_runs =
            [("run_id", names()), ("rig", texts(runs.iter().map(|run| run.1).collect())), ("started", started)];
        let tables = [("surface_stats", stats.to_vec()), ("runs", of_runs.to_vec())];
        for (name, columns) in tables {
            let batch = RecordBatch::try_from_iter(columns).expect("columns of one length");
            context.register_batch(name, batch).expect("registered");
        }
        let query = format!("select * from ({}) order by surface_id", view_sql());
        let batches = context.sql(&query).await.expect("planned").collect().await.expect("an answer");
        arrow::compute::concat_batches(&batches[0].schema(), &batches).expect("rows of one table")
    }

    fn column(rows: &RecordBatch, name: &str) -> Vec<Option<f64>> {
        rows[name].as_primitive::<Float64Type>().iter().map(|x| x.map(|x| (x * 1e6).round() / 1e6)).collect()
    }

    // Of two days with two runs each: the mean square within days is 0.02, that of the days' means 0.16.
    #[tokio::test]
    async fn limits_are_those_of_an_analysis_of_variance() {
        let rows = limits(&[
            ("a", "one", 0, -9.0),
            ("a", "one", 0, -8.8),
            ("a", "one", 3, -8.4),
            ("a", "one", 3, -8.6),
            ("b", "one", 1, 1.0),
            ("c", "one", 1, 1.0),
            ("c", "two", 1, 2.0),
            ("d", "one", 1, 1.0),
            ("d", "one", 1, 2.0),
            // Of the mean of three and one: 0.02 within, 0.75 times the square of 1 between.
            ("e", "one", 1, 0.9),
            ("e", "one", 1, 1.0),
            ("e", "one", 1, 1.1),
            ("e", "two", 1, 2.0),
        ])
        .await;
        let half = 0.5f64.sqrt();
        // (0.75 - 0.01) / 1.5 and the 0.01 within.
        let e = 0.01f64 + 0.74 / 1.5;
        let rounded = |values: [Option<f64>; 5]| values.map(|x| x.map(|x| (x * 1e6).round() / 1e6)).to_vec();
        let repeated = [Some(0.02f64.sqrt()), None, None, Some(half), Some(0.1)];
        let reproduced = [Some(0.3), None, Some(half), None, Some(e.sqrt())];
        assert_eq!(column(&rows, "repeatability_sd_db"), rounded(repeated));
        assert_eq!(column(&rows, "reproducibility_sd_db"), rounded(reproduced));
        assert_eq!(column(&rows, "repeatability_limit_db"), rounded(repeated.map(|sd| sd.map(|sd| 2.8 * sd))));
        assert_eq!(column(&rows, "reproducibility_limit_db"), rounded(reproduced.map(|sd| sd.map(|sd| 2.8 * sd))));
        let reasons: Vec<_> = rows["reason"].as_string::<i32>().iter().map(Option::unwrap_or_default).collect();
        let expected = ["", "one run", "no two runs of one rig and day", "all runs are of one rig and day", ""];
        assert_eq!(reasons, expected);
    }
}
