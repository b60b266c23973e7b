//! The row of table `surfaces`.

use arrow::record_batch::RecordBatch;
use echolake_lake::ReferenceSurfaces;
use echolake_schema::tables::Table;
use echolake_schema::{Rig, SurfaceRecord};

use super::{RowColumns, RunKeys};
use crate::CODE_VERSION;
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
    let known = |i: usize| relief.map(|r| r[i]).filter(|x| x.is_finite());
    let flat = surface.flat_reference.as_ref().unwrap_or(&references.flat);
    let foam = surface.foam_reference.as_ref().unwrap_or(&references.foam);
    let mut columns = RowColumns::of_run(Table::Surfaces, 1, keys);
    columns
        .text(Some(keys.surface.panel()))
        .ints([keys.surface.side().map(i32::from)])
        .text(Some(&surface.typology))
        .text(surface.macrostructure.as_deref())
        .text(surface.mesostructure.as_deref())
        .text(surface.microstructure.as_deref())
        .text(surface.material.as_deref())
        .doubles([surface.reflection_factor])
        .text(Some(flat.as_str()))
        .text(Some(foam.as_str()))
        .text(Some(&surface.parameters.to_string()))
        .text(mesh.map(|m| m.file.as_str()))
        .longs([mesh.map(|m| m.triangles as i64)])
        .flags([mesh.map(|m| m.watertight)])
        .floats([known(0)])
        .floats([known(1)])
        .floats([known(2)])
        .text(Some(origin))
        .text(Some(CODE_VERSION));
    columns.finish(rig)
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
