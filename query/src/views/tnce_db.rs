//! `tnce_db`: one row per measurement, the TNCE columns as levels, with both points and the path's geometry.

use std::collections::HashMap;

use echolake_schema::Rig;

use super::ir::geometry;
use super::note;

// Linear column, the column of its level, and the level's description.
fn levels(rig: &Rig) -> Vec<(String, String, String)> {
    let bands = rig.band_names();
    let over_total = bands.iter().map(|b| (format!("tnce_{b}"), format!("of the band at {b} Hz over Flat's total")));
    let total = [("tnce_total".to_owned(), "of all bands over Flat's total".to_owned())];
    let over_band =
        bands.iter().map(|b| (format!("tnce_band_{b}"), format!("of the band at {b} Hz over Flat's of the same band")));
    let named = over_total.chain(total).chain(over_band);
    named
        .map(|(column, what)| (column.clone(), format!("{column}_db"), format!("Level of the energy {what}")))
        .collect()
}

// Zero energy has no level: null.
pub(super) fn sql(rig: &Rig) -> String {
    let level = |(column, name, _): &(String, String, String)| format!("10 * log10(nullif(t.{column}, 0)) AS {name}");
    let levels: Vec<_> = levels(rig).iter().map(level).collect();
    format!(
        "SELECT t.surface_id, t.run_id, t.pair_id, t.microphone, t.speaker, {}, {} FROM tnce t",
        geometry("t"),
        levels.join(", ")
    )
}

pub(super) fn notes(rig: &Rig) -> impl Iterator<Item = (String, HashMap<String, String>)> {
    levels(rig).into_iter().map(|(_, name, comment)| note(name, "dB re Flat", comment))
}
