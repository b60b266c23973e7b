//! `levels`: one row per surface and band, the mean over the surface's runs, with every part of its uncertainty.
//!
//! It is the rule by which all pages, views, figures and exports give one number for a surface.

use std::collections::HashMap;

use super::{RE_FLAT_BAND, RE_FLAT_TOTAL, column_note};

// Putting a panel into the rig again is another cause than the run's own noise: only several runs show it, the
// surface's and Flat's. Each surface has its own estimate of Foam's reflection, and Flat's share of noise is in the
// uncertainty of a level already. Of the Foam that is subtracted nothing is left to be shown, whatever it reflects.
pub(super) fn view_sql() -> String {
    let runs = "SELECT surface_id, band, max(band_hz) AS band_hz, count(*) AS runs, \
                array_agg(run_id ORDER BY run_id) AS run_ids, \
                avg(p90_mean_db) AS level_db, sqrt(avg(p90_mean_u_db * p90_mean_u_db)) AS u_db, \
                avg(unbiased_p90_mean_db) AS unbiased_db, \
                sqrt(avg(unbiased_p90_mean_u_db * unbiased_p90_mean_u_db)) AS unbiased_u_db, \
                stddev_samp(p90_mean_db) / sqrt(count(*)) AS repeats_db, \
                CAST(sum(measurements) AS BIGINT) AS measurements, avg(p5_db) AS p5_db, avg(p50_db) AS p50_db, \
                avg(p95_db) AS p95_db, min(min_db) AS min_db, max(max_db) AS max_db, avg(spread_db) AS spread_db \
                FROM surface_stats GROUP BY surface_id, band";
    let parts = format!(
        "SELECT l.surface_id, l.band, l.band_hz, s.surface_id = s.flat_reference AS reference, l.runs, l.run_ids, \
         l.level_db, l.u_db, CASE WHEN l.surface_id = s.flat_reference THEN f.repeats_db \
         ELSE sqrt(l.repeats_db * l.repeats_db + f.repeats_db * f.repeats_db) END AS repositioning_u_db, \
         l.level_db - f.level_db AS against_flat_db, l.unbiased_db, l.unbiased_u_db, \
         l.unbiased_db - f.unbiased_db AS unbiased_against_flat_db, \
         CASE WHEN l.surface_id = s.flat_reference THEN l.unbiased_u_db \
         ELSE sqrt(l.unbiased_u_db * l.unbiased_u_db + f.unbiased_u_db * f.unbiased_u_db) END AS both_unbiased_u_db, \
         l.measurements, l.p5_db, l.p50_db, l.p95_db, l.min_db, l.max_db, l.spread_db, s.origin \
         FROM surfaces s JOIN ({runs}) l ON l.surface_id = s.surface_id \
         LEFT JOIN ({runs}) f ON f.surface_id = s.flat_reference AND f.band = l.band"
    );
    let with_repositioning = |u: &str| format!("sqrt({u} * {u} + repositioning_u_db * repositioning_u_db)");
    let known = |u: &str| format!("coalesce({}, {u})", with_repositioning(u));
    format!(
        "SELECT surface_id, band, band_hz, reference, runs, run_ids, level_db, u_db, repositioning_u_db, \
         {combined} AS combined_u_db, against_flat_db, unbiased_db, {unbiased_u} AS unbiased_u_db, \
         unbiased_against_flat_db, {against_u} AS unbiased_against_flat_u_db, \
         CASE WHEN level_db IS NULL OR unbiased_against_flat_db IS NULL THEN level_db ELSE unbiased_db END \
         AS shown_db, \
         CASE WHEN level_db IS NOT NULL THEN coalesce(unbiased_against_flat_db, against_flat_db) END \
         AS shown_against_flat_db, \
         CASE WHEN level_db IS NULL OR unbiased_against_flat_db IS NULL THEN {measured_u} ELSE {against_u} END \
         AS shown_u_db, level_db IS NOT NULL AND unbiased_against_flat_db IS NULL AS has_foam, \
         measurements, p5_db, p50_db, p95_db, min_db, max_db, spread_db, \
         origin FROM ({parts})",
        combined = with_repositioning("u_db"),
        unbiased_u = known("unbiased_u_db"),
        against_u = known("both_unbiased_u_db"),
        measured_u = known("u_db"),
    )
}

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let noted = [
        column_note("reference", "", "The surface is its own Flat: its levels are 0 by definition, not measured"),
        column_note("band_hz", "Hz", "Centre of the band; null for the total"),
        column_note("runs", "1", "Runs of the surface that have levels: those that are not rejected"),
        column_note("run_ids", "", "Their names"),
        column_note("level_db", RE_FLAT_TOTAL, "Mean of p90_mean_db over the runs, as in Rust et al. 2021"),
        column_note("u_db", "dB", "Standard uncertainty of a run's level: subtraction, noise, air"),
        column_note(
            "repositioning_u_db",
            "dB",
            "Standard uncertainty from putting panel and Flat into the rig, by the spread of their runs over the root \
             of their number; null unless both have two runs",
        ),
        column_note("combined_u_db", "dB", "Both together; null if one is not known"),
        column_note("against_flat_db", RE_FLAT_BAND, "level_db less that of Flat, with Foam's own reflection in both"),
        column_note(
            "unbiased_db",
            RE_FLAT_TOTAL,
            "Mean of unbiased_p90_mean_db over the runs: without Foam's reflection",
        ),
        column_note(
            "unbiased_u_db",
            "dB",
            "Its standard uncertainty: subtraction, noise, air, the estimate of Foam's reflection, and repositioning \
             if it is known",
        ),
        column_note("unbiased_against_flat_db", RE_FLAT_BAND, "unbiased_db less that of Flat"),
        column_note("unbiased_against_flat_u_db", "dB", "Its standard uncertainty, of the surface's parts and Flat's"),
        column_note("shown_db", RE_FLAT_TOTAL, "Level that pages show: unbiased_db, or level_db if has_foam"),
        column_note("shown_against_flat_db", RE_FLAT_BAND, "The same against Flat"),
        column_note(
            "shown_u_db",
            "dB",
            "Its standard uncertainty, with repositioning if it is known; without Foam's bias if has_foam",
        ),
        column_note("has_foam", "", "The level that is shown holds Foam's own reflection, of which nothing is known"),
        column_note("measurements", "1", "Pairs of all runs that the row is of"),
        column_note("p5_db", RE_FLAT_TOTAL, "5th percentile of TNCE, mean over the runs"),
        column_note("p50_db", RE_FLAT_TOTAL, "Median of TNCE, mean over the runs"),
        column_note("p95_db", RE_FLAT_TOTAL, "95th percentile of TNCE, mean over the runs"),
        column_note("min_db", RE_FLAT_TOTAL, "Least TNCE of all runs"),
        column_note("max_db", RE_FLAT_TOTAL, "Greatest TNCE of all runs"),
        column_note("spread_db", "dB", "Standard deviation of TNCE in dB over the pairs, mean over the runs"),
    ];
    noted.into_iter().collect()
}
