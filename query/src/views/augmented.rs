//! `augmented`: one row per measurement and symmetry of D4, with the transformed points, the unchanged responses, and
//! the height map under the same symmetry.
//!
//! A turned panel under the same rig has other responses than these: the rig's aim and directivity do not turn with it.
//! Flat, which is the same in every position, shows how much that is: `flat_ratio_*` is Flat's energy at the moved pair
//! over its energy at the measured one.

use std::collections::HashMap;

use echolake_schema::{Grid, Rig, Symmetry};

use super::column_note;
use crate::figure_rows::{TOTAL_BAND, band_keys};

pub(super) fn view_sql(grid: &Grid, rig: &Rig) -> String {
    let has = |s: &Symmetry| grid.point_permutation(*s).is_some() && grid.moved_pairs(*s).is_some();
    let row = |(id, s): (usize, Symmetry)| format!("(CAST({id} AS INT), '{}')", s.name());
    let symmetries: Vec<_> = Symmetry::ALL.into_iter().enumerate().filter(|(_, s)| has(s)).map(row).collect();
    let ends =
        ["microphone", "speaker"].into_iter().flat_map(|end| ["x", "y", "z"].map(|axis| format!("{end}_{axis}_mm")));
    let moved = |name: &str, column: &str| format!("d4_{name}(m.pair_id, d.symmetry_id) AS {column}");
    let ids =
        [("swapped", "swapped"), ("pair_id", "d4_pair_id"), ("microphone", "d4_microphone"), ("speaker", "d4_speaker")];
    let ids = ids.into_iter().map(|(name, column)| moved(name, column));
    let columns: Vec<_> = ids.chain(ends.map(|name| moved(&name, &name))).collect();
    // Flat's energy at a pair is the energy over TNCE, of any surface.
    let ratio = |band: &String| {
        let tnce = if band == TOTAL_BAND { "tnce_total".to_owned() } else { format!("tnce_band_{band}") };
        let flat = |row: &str| format!("({row}.energy_{band} / nullif({row}.{tnce}, 0))");
        format!("{} / nullif({}, 0) AS flat_ratio_{band}", flat("t"), flat("f"))
    };
    let ratios: Vec<_> = band_keys(rig).iter().map(ratio).collect();
    // The symmetries come first: the first side is held in memory, the other side streams.
    format!(
        "SELECT m.surface_id, m.run_id, m.pair_id, m.microphone, m.speaker, d.symmetry, {}, m.ir, n.reflected_ir, \
         h.heights_mm, {} \
         FROM (VALUES {}) AS d(symmetry_id, symmetry) CROSS JOIN measurements m \
         LEFT JOIN nce n ON n.surface_id = m.surface_id AND n.run_id = m.run_id AND n.pair_id = m.pair_id \
         LEFT JOIN heightmaps h ON h.surface_id = m.surface_id AND h.symmetry = d.symmetry \
         LEFT JOIN tnce f ON f.surface_id = m.surface_id AND f.run_id = m.run_id AND f.pair_id = m.pair_id \
         LEFT JOIN tnce t ON t.surface_id = m.surface_id AND t.run_id = m.run_id \
         AND t.pair_id = d4_pair_id(m.pair_id, d.symmetry_id)",
        columns.join(", "),
        ratios.join(", "),
        symmetries.join(", ")
    )
}

pub(super) fn column_notes(rig: &Rig) -> impl Iterator<Item = (String, HashMap<String, String>)> {
    band_keys(rig).into_iter().map(|band| {
        let bands = if band == TOTAL_BAND { "all bands".to_owned() } else { format!("band at {band} Hz") };
        let comment = format!(
            "Flat's energy at d4_pair_id over its energy at pair_id, {bands}: an energy of this row times this ratio \
             is about what the turned panel has there"
        );
        column_note(format!("flat_ratio_{band}"), "1", comment)
    })
}
