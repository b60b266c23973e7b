//! `ir`: one row per measurement, with both points, the path's geometry, and the response before and after Foam is
//! subtracted.

/// Columns of table `pairs` in the views of measurements, without its keys.
pub(super) const GEOMETRY: [&str; 11] = [
    "microphone_x_mm",
    "microphone_y_mm",
    "microphone_z_mm",
    "speaker_x_mm",
    "speaker_y_mm",
    "speaker_z_mm",
    "direct_mm",
    "image_mm",
    "incidence_deg",
    "specular_x_mm",
    "specular_y_mm",
];

/// Returns the SQL of the geometry columns for the pair of a row of `table`.
pub(super) fn geometry_columns(table: &str) -> String {
    let column = |name: &&str| format!("pair_{name}({table}.pair_id) AS {name}");
    GEOMETRY.iter().map(column).collect::<Vec<_>>().join(", ")
}

pub(super) fn view_sql() -> String {
    format!(
        "SELECT m.surface_id, m.run_id, m.pair_id, m.microphone, m.speaker, {}, m.log_time_ns, m.log_time, \
         m.temperature_c, m.snr_db, m.ir, n.reflected_ir \
         FROM measurements m LEFT JOIN nce n \
         ON n.surface_id = m.surface_id AND n.run_id = m.run_id AND n.pair_id = m.pair_id",
        geometry_columns("m")
    )
}
