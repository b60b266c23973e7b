//! `levels`: one row per surface and band, of all runs of the surface, with every part of its uncertainty.

use std::collections::HashMap;

use super::{RE_FLAT_TOTAL, column_note};

// Putting a panel into the rig again is another cause than the run's own noise: only several runs show it, the
// surface's and Flat's.
pub(super) fn view_sql() -> String {
    let runs = "SELECT surface_id, band, max(band_hz) AS band_hz, count(*) AS runs, avg(p90_mean_db) AS level_db, \
                sqrt(avg(p90_mean_u_db * p90_mean_u_db)) AS u_db, stddev_samp(p90_mean_db) / sqrt(count(*)) AS \
                repeats_db FROM surface_stats GROUP BY surface_id, band";
    format!(
        "SELECT l.surface_id, l.band, l.band_hz, s.surface_id = s.flat_reference AS reference, l.runs, \
         l.level_db, l.u_db, \
         CASE WHEN l.surface_id = s.flat_reference THEN f.repeats_db \
         ELSE sqrt(l.repeats_db * l.repeats_db + f.repeats_db * f.repeats_db) END AS repositioning_u_db, \
         CASE WHEN l.surface_id = s.flat_reference THEN sqrt(l.u_db * l.u_db + f.repeats_db * f.repeats_db) \
         ELSE sqrt(l.u_db * l.u_db + l.repeats_db * l.repeats_db + f.repeats_db * f.repeats_db) END AS combined_u_db, \
         s.origin FROM surfaces s JOIN ({runs}) l ON l.surface_id = s.surface_id \
         LEFT JOIN ({runs}) f ON f.surface_id = s.flat_reference AND f.band = l.band"
    )
}

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let noted = [
        column_note("reference", "", "The surface is its own Flat: its levels are 0 by definition, not measured"),
        column_note("band_hz", "Hz", "Centre of the band; null for the total"),
        column_note("runs", "1", "Runs of the surface"),
        column_note("level_db", RE_FLAT_TOTAL, "Mean of p90_mean_db over the runs"),
        column_note("u_db", "dB", "Standard uncertainty of a run's level: subtraction, noise, air"),
        column_note(
            "repositioning_u_db",
            "dB",
            "Standard uncertainty from putting panel and Flat into the rig, by the spread of their runs over the root \
             of their number; null unless both have two runs",
        ),
        column_note("combined_u_db", "dB", "Both together; null if one is not known"),
    ];
    noted.into_iter().collect()
}
