//! The row of table `surfaces`.

use arrow::record_batch::RecordBatch;
use echolake_lake::ReferenceSurfaces;
use echolake_schema::tables::Table;
use echolake_schema::{Rig, SurfaceRecord};

use super::RunKeys;
use crate::error::Result;

/// Builds the row of a run's surface; references that it does not name default to the lake's.
pub(crate) fn row(
    rig: &Rig,
    keys: &RunKeys,
    surface: &SurfaceRecord,
    references: &ReferenceSurfaces,
    origin: &str,
    heights_mm: &[f32],
) -> Result<RecordBatch> {
    let mesh = surface.mesh.as_ref();
    let relief = relief(heights_mm).or(mesh.map(|m| [m.relief_mm[0] as f32, m.relief_mm[1] as f32, f32::NAN]));
    let known = |i: usize| [relief.map(|r| r[i]).filter(|x| x.is_finite())];
    let flat = surface.flat_reference.as_ref().unwrap_or(&references.flat);
    let foam = surface.foam_reference.as_ref().unwrap_or(&references.foam);
    let row = keys
        .begin_rows(Table::Surfaces, rig, 1)
        .text("panel", keys.surface.panel())
        .ints("side", [keys.surface.side().map(i32::from)])
        .text("typology", surface.typology.as_str())
        .text("macrostructure", surface.macrostructure.as_deref())
        .text("mesostructure", surface.mesostructure.as_deref())
        .text("microstructure", surface.microstructure.as_deref())
        .text("material", surface.material.as_deref())
        .doubles("reflection_factor", [surface.reflection_factor])
        .text("flat_reference", flat.as_str())
        .text("foam_reference", foam.as_str())
        .texts("parameters", [surface.parameters.to_string()])
        .text("mesh_file", mesh.map(|m| m.file.as_str()))
        .longs("mesh_triangles", [mesh.map(|m| m.triangles as i64)])
        .flags("mesh_watertight", [mesh.map(|m| m.watertight)])
        .floats("relief_min_mm", known(0))
        .floats("relief_max_mm", known(1))
        .floats("relief_rms_mm", known(2))
        .text("origin", origin)
        .finish()?;
    Ok(row)
}

// Minimum, maximum and root mean square height about the mean.
fn relief(heights_mm: &[f32]) -> Option<[f32; 3]> {
    if heights_mm.is_empty() {
        return None;
    }
    let count = heights_mm.len() as f64;
    let mean = heights_mm.iter().map(|h| f64::from(*h)).sum::<f64>() / count;
    let square = heights_mm.iter().map(|h| (f64::from(*h) - mean).powi(2)).sum::<f64>() / count;
    let least = heights_mm.iter().copied().fold(f32::INFINITY, f32::min);
    let greatest = heights_mm.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    Some([least, greatest, square.sqrt() as f32])
}
