//! `catalogue`: one row per surface, with its newest run and the levels of all of its runs.

use std::collections::HashMap;

use echolake_schema::Rig;

use super::{RE_FLAT_BAND, RE_FLAT_TOTAL, column_note, levels};

// Expression over view `levels`, name of its columns here, unit and meaning.
const STATS: [(&str, &str, &str, &str); 8] = [
    ("level_db", "level", RE_FLAT_TOTAL, "Mean of the TNCE values up to their 90th percentile"),
    (
        "coalesce(combined_u_db, u_db)",
        "level_u",
        "dB",
        "Standard uncertainty of level_*_db and of against_flat_*_db, without Foam's bias; with repositioning if known",
    ),
    ("against_flat_db", "against_flat", RE_FLAT_BAND, "level_*_db less that of the surface's Flat"),
    (
        "shown_against_flat_db",
        "shown_against_flat",
        RE_FLAT_BAND,
        "The level that pages show: without Foam's own reflection where it is known",
    ),
    ("shown_u_db", "shown_u", "dB", "Standard uncertainty of shown_against_flat_*_db"),
    ("p5_db", "p5", RE_FLAT_TOTAL, "5th percentile of TNCE"),
    ("p95_db", "p95", RE_FLAT_TOTAL, "95th percentile of TNCE"),
    ("spread_db", "spread", "dB", "Standard deviation of TNCE in dB over the pairs"),
];

fn level_bands(rig: &Rig) -> Vec<String> {
    rig.band_names().into_iter().chain(["total".to_owned()]).collect()
}

pub(super) fn view_sql(rig: &Rig) -> String {
    let names: Vec<_> = STATS
        .iter()
        .flat_map(|(column, name, ..)| {
            level_bands(rig).into_iter().map(move |b| (*column, format!("{name}_{b}_db"), b))
        })
        .collect();
    let pivot = |(column, name, band): &(&str, String, String)| {
        format!("max(CASE WHEN band = '{band}' THEN {column} END) AS {name}")
    };
    let levels: Vec<_> = names.iter().map(|(_, name, _)| format!("t.{name}")).collect();
    let statistics = format!(
        "(SELECT surface_id, {} FROM ({}) GROUP BY surface_id)",
        names.iter().map(pivot).collect::<Vec<_>>().join(", "),
        levels::view_sql()
    );
    format!(
        "SELECT s.surface_id, s.panel, s.side, s.typology, s.macrostructure, s.mesostructure, s.microstructure, \
         s.material, s.reflection_factor, s.parameters, s.relief_min_mm, s.relief_max_mm, s.relief_rms_mm, \
         s.mesh_triangles, s.flat_reference, s.foam_reference, s.macro_reference, s.origin, \
         a.runs, a.all_measurements, a.first_started, a.last_ended, \
         r.run_id, r.state, r.missing, r.started, r.ended, r.measurements, r.rejected, r.attempts, r.damaged, \
         r.temperature_min_c, r.temperature_max_c, r.file, r.file_bytes, r.flat_version, r.foam_version, {levels} \
         FROM surfaces s JOIN runs r ON r.run_id = s.run_id \
         JOIN (SELECT surface_id, count(*) AS runs, CAST(sum(measurements) AS BIGINT) AS all_measurements, \
         min(started) AS first_started, max(ended) AS last_ended FROM runs GROUP BY surface_id) a \
         ON a.surface_id = s.surface_id \
         LEFT JOIN {statistics} t ON t.surface_id = s.surface_id",
        levels = levels.join(", "),
    )
}

pub(super) fn column_notes(rig: &Rig) -> HashMap<String, HashMap<String, String>> {
    let own = [
        column_note("runs", "1", "Runs of the surface"),
        column_note("all_measurements", "1", "Accepted measurements of all of its runs"),
        column_note("first_started", "", "Start of its first run, UTC"),
        column_note("last_ended", "", "End of its last run, UTC"),
        column_note(
            "run_id",
            "",
            "Its newest run; what follows is of that, but for levels, which are means over its runs",
        ),
    ];
    let levels = STATS.iter().flat_map(|(_, name, unit, comment)| {
        level_bands(rig).into_iter().map(move |b| {
            let of = if b == "total" { "all bands".to_owned() } else { format!("the band at {b} Hz") };
            column_note(format!("{name}_{b}_db"), unit, format!("{comment}, {of}, mean over its runs"))
        })
    });
    own.into_iter().chain(levels).collect()
}
