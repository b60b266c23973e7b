//! `augmented`: one row per measurement and symmetry of D4, with the transformed points, the unchanged responses, and
//! the height map under the same symmetry.

use echolake_schema::{Grid, Symmetry};

pub(super) fn view_sql(grid: &Grid) -> String {
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
    // The symmetries come first: the first side is held in memory, the other side streams.
    format!(
        "SELECT m.surface_id, m.run_id, m.pair_id, m.microphone, m.speaker, d.symmetry, {}, m.ir, n.reflected_ir, \
         h.heights_mm \
         FROM (VALUES {}) AS d(symmetry_id, symmetry) CROSS JOIN measurements m \
         LEFT JOIN nce n ON n.surface_id = m.surface_id AND n.run_id = m.run_id AND n.pair_id = m.pair_id \
         LEFT JOIN heightmaps h ON h.surface_id = m.surface_id AND h.symmetry = d.symmetry",
        columns.join(", "),
        symmetries.join(", ")
    )
}
