//! `flat_drift`: one row per run of a Flat and band, as a control chart: what a rig drifts by, all levels drift by.

use std::collections::HashMap;

use super::{RE_FLAT_TOTAL, column_note};

/// Standard errors beyond which a shift or an outlier is an alarm: by chance once in thousands of charts.
const ALARM_ERRORS: f64 = 5.0;
/// Least number of runs before and after a shift, and of all runs.
const LEAST_PART: i64 = 3;
const LEAST_RUNS: i64 = 8;

// The spread is that of the differences of neighbours (moving ranges, as ISO 7870-2), which a shift hardly raises; the
// shift is where the means before and after differ by the most standard errors.
pub(super) fn view_sql() -> String {
    let runs = "SELECT t.surface_id, t.band, t.band_hz, t.run_id, r.started, t.p90_mean_db AS level_db, \
                t.p90_mean_u_db AS u_db \
                FROM surface_stats t JOIN runs r ON r.run_id = t.run_id WHERE t.p90_mean_db IS NOT NULL \
                AND t.surface_id IN (SELECT flat_reference FROM surfaces)";
    let chart = "PARTITION BY surface_id, band";
    let order = format!("{chart} ORDER BY started, run_id");
    let numbered = format!(
        "SELECT *, row_number() OVER ({order}) AS n, count(*) OVER ({chart}) AS runs, \
         sum(level_db) OVER ({chart}) AS total_db, level_db - lag(level_db) OVER ({order}) AS step_db, \
         sum(level_db) OVER ({order} ROWS BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW) - level_db AS before_db \
         FROM ({runs})"
    );
    let spread = format!("SELECT *, avg(abs(step_db)) OVER ({chart}) * sqrt(pi()) / 2 AS sd_db FROM ({numbered})");
    let shifts = format!(
        "SELECT *, CASE WHEN runs >= {LEAST_RUNS} AND n > {LEAST_PART} AND runs - n + 1 >= {LEAST_PART} \
         THEN (total_db - before_db) / (runs - n + 1) - before_db / (n - 1) END AS shift_db FROM ({spread})"
    );
    let errors = format!(
        "SELECT *, abs(shift_db) / nullif(sd_db, 0) / sqrt(1.0 / (n - 1) + 1.0 / (runs - n + 1)) AS shift_errors \
         FROM ({shifts})"
    );
    let greatest = format!(
        "SELECT *, coalesce(shift_errors > {ALARM_ERRORS} AND shift_errors = max(shift_errors) OVER ({chart}), false) \
         AS is_shift FROM ({errors})"
    );
    let parts = format!(
        "SELECT *, sum(CASE WHEN is_shift THEN 1 ELSE 0 END) OVER ({order} ROWS BETWEEN UNBOUNDED PRECEDING AND \
         CURRENT ROW) AS part FROM ({greatest})"
    );
    let means = format!("SELECT *, avg(level_db) OVER (PARTITION BY surface_id, band, part) AS part_db FROM ({parts})");
    format!(
        "SELECT surface_id, band, band_hz, run_id, started, level_db, u_db, runs, total_db / runs AS mean_db, sd_db, \
         shift_db, shift_errors, CASE WHEN is_shift THEN 'shift' \
         WHEN runs >= {LEAST_RUNS} AND abs(level_db - part_db) > {ALARM_ERRORS} * nullif(sd_db, 0) THEN 'outlier' END \
         AS alarm FROM ({means})"
    )
}

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let noted = [
        column_note("band_hz", "Hz", "Centre of the band; null for the total"),
        column_note(
            "level_db",
            RE_FLAT_TOTAL,
            "p90_mean_db of the run: Flat is normalised by the mean of all its runs",
        ),
        column_note("u_db", "dB", "Its standard uncertainty: subtraction, noise, air"),
        column_note("runs", "1", "Runs of this Flat; below 8 there is no alarm"),
        column_note("mean_db", RE_FLAT_TOTAL, "Mean of the level over them"),
        column_note(
            "sd_db",
            "dB",
            "Standard deviation of a run's level, by the differences of neighbours (ISO 7870-2)",
        ),
        column_note("shift_db", "dB", "Mean from this run on less that before it; null near both ends"),
        column_note("shift_errors", "1", "Its size over its standard error"),
        column_note(
            "alarm",
            "",
            "shift: the level is another from this run on, by over 5 standard errors; outlier: this run alone is over \
             5 standard deviations away; null if neither",
        ),
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

    // Values of a normal distribution of standard deviation 0.02: sums of twelve even ones.
    fn normal_levels(seed: u64, count: usize) -> Vec<f64> {
        let mut state = seed;
        let mut even = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        (0..count).map(|_| 0.02 * ((0..12).map(|_| even()).sum::<f64>() - 6.0)).collect()
    }

    // Alarms of charts, one for each band: band, number of the run, alarm and shift.
    async fn alarms(charts: &[Vec<f64>]) -> Vec<(usize, usize, String, f64)> {
        let context = SessionContext::new();
        let runs = charts.iter().map(Vec::len).max().unwrap_or(0);
        let name = |run: usize| format!("r{run:03}");
        let texts = |texts: Vec<String>| -> ArrayRef { Arc::new(StringArray::from(texts)) };
        let rows: Vec<_> =
            charts.iter().enumerate().flat_map(|(b, chart)| (0..chart.len()).map(move |run| (b, run))).collect();
        let levels: ArrayRef = Arc::new(Float64Array::from_iter_values(rows.iter().map(|(b, run)| charts[*b][*run])));
        let stats = vec![
            ("surface_id", texts(vec!["flat".into(); rows.len()])),
            ("run_id", texts(rows.iter().map(|(_, run)| name(*run)).collect())),
            ("band", texts(rows.iter().map(|(b, _)| b.to_string()).collect())),
            ("band_hz", Arc::new(Float64Array::from_iter_values(rows.iter().map(|(b, _)| *b as f64))) as ArrayRef),
            ("p90_mean_db", levels.clone()),
            ("p90_mean_u_db", levels),
        ];
        let started: ArrayRef =
            Arc::new(TimestampNanosecondArray::from_iter_values((0..runs).map(|run| run as i64 * 3_600_000_000_000)));
        let of_runs = vec![("run_id", texts((0..runs).map(name).collect())), ("started", started)];
        let surfaces = vec![("flat_reference", texts(vec!["flat".into()]))];
        for (table, columns) in [("surface_stats", stats), ("runs", of_runs), ("surfaces", surfaces)] {
            let batch = RecordBatch::try_from_iter(columns).expect("columns of one length");
            context.register_batch(table, batch).expect("registered");
        }
        let sql = format!(
            "select cast(band as bigint) as band, run_id, alarm, coalesce(shift_db, 0) as shift_db from ({}) \
             where alarm is not null order by 1, 2",
            view_sql()
        );
        let batches = context.sql(&sql).await.expect("planned").collect().await.expect("an answer");
        let mut found = Vec::new();
        for batch in &batches {
            let text = |column: &str, row: usize| batch[column].as_string::<i32>().value(row).to_owned();
            for row in 0..batch.num_rows() {
                let band = batch["band"].as_primitive::<arrow::datatypes::Int64Type>().value(row) as usize;
                let run = text("run_id", row)[1..].parse().expect("a number");
                let shift = batch["shift_db"].as_primitive::<Float64Type>().value(row);
                found.push((band, run, text("alarm", row), shift));
            }
        }
        found
    }

    #[tokio::test]
    async fn a_hundred_quiet_runs_raise_nothing() {
        let charts: Vec<_> = (0..400).map(|seed| normal_levels(seed, 100)).collect();
        assert_eq!(alarms(&charts).await, []);
    }

    #[tokio::test]
    async fn a_tenth_of_a_decibel_is_found_in_thirty_runs() {
        let first = |chart: usize| 5 + chart % 21;
        let shifted = |chart: usize| -> Vec<f64> {
            let levels = normal_levels(1_000 + chart as u64, 30).into_iter().enumerate();
            levels.map(|(run, level)| if run < first(chart) { level } else { level + 0.1 }).collect()
        };
        let charts: Vec<_> = (0..200).map(shifted).collect();
        let found = alarms(&charts).await;
        let shifts: Vec<_> = found.iter().filter(|(_, _, alarm, _)| alarm == "shift").collect();
        assert_eq!(shifts.len(), charts.len());
        for (chart, run, _, shift_db) in shifts {
            assert!(run.abs_diff(first(*chart)) <= 1 && (shift_db - 0.1).abs() < 0.04, "{chart} {run} {shift_db}");
        }
        assert!(found.len() <= charts.len() + 1, "{found:?}");
    }

    #[tokio::test]
    async fn single_runs_are_named_and_few_runs_are_not() {
        let mut outlier = normal_levels(5, 30);
        outlier[17] += 0.4;
        let mut few = outlier[12..19].to_vec();
        few[6] = 3.0;
        let found = alarms(&[outlier, few, vec![1.0; 30]]).await;
        let found: Vec<_> = found.iter().map(|(band, run, alarm, _)| (*band, *run, alarm.as_str())).collect();
        assert_eq!(found, [(0, 17, "outlier")]);
    }
}
