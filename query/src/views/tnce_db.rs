//! `tnce_db`: one row per measurement, the TNCE columns as levels, with both points and the path's geometry.

use std::collections::HashMap;

use echolake_schema::Rig;

use super::ir::geometry_columns;
use super::{RE_FLAT_BAND, RE_FLAT_TOTAL, column_note};

/// A level of the view.
struct LevelColumn {
    /// The column of `tnce` that it is of.
    energy: String,
    name: String,
    unit: &'static str,
    comment: String,
}

impl LevelColumn {
    fn new(energy: String, unit: &'static str, energy_of: &str) -> Self {
        let name = format!("{energy}_db");
        let comment = format!("Level of the energy {energy_of}");
        Self { energy, name, unit, comment }
    }
}

fn level_columns(rig: &Rig) -> Vec<LevelColumn> {
    let bands = rig.band_names();
    let over_total = bands.iter().map(|b| {
        LevelColumn::new(format!("tnce_{b}"), RE_FLAT_TOTAL, &format!("of the band at {b} Hz over Flat's total"))
    });
    let total = [LevelColumn::new("tnce_total".to_owned(), RE_FLAT_TOTAL, "of all bands over Flat's total")];
    let over_band = bands.iter().map(|b| {
        let energy_of = format!("of the band at {b} Hz over Flat's of the same band");
        LevelColumn::new(format!("tnce_band_{b}"), RE_FLAT_BAND, &energy_of)
    });
    over_total.chain(total).chain(over_band).collect()
}

// Zero energy has no level: null.
pub(super) fn view_sql(rig: &Rig) -> String {
    let level = |LevelColumn { energy, name, .. }: &LevelColumn| format!("10 * log10(nullif(t.{energy}, 0)) AS {name}");
    let levels: Vec<_> = level_columns(rig).iter().map(level).collect();
    format!(
        "SELECT t.surface_id, t.run_id, t.pair_id, t.microphone, t.speaker, {}, {} FROM tnce t",
        geometry_columns("t"),
        levels.join(", ")
    )
}

pub(super) fn column_notes(rig: &Rig) -> impl Iterator<Item = (String, HashMap<String, String>)> {
    level_columns(rig).into_iter().map(|level| column_note(level.name, level.unit, level.comment))
}
