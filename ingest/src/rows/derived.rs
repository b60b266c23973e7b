//! Rows of tables `nce`, `tnce` and `tnce_d4`.

use std::ops::Range;
use std::sync::Arc;

use arrow::array::{Float32Array, Float64Array};
use arrow::record_batch::RecordBatch;
use echolake_schema::symmetry::MovedPair;
use echolake_schema::tables::Table;
use echolake_schema::{Grid, Pair, PairId, Rig, Symmetry};

use super::RunKeys;
use crate::derived_values::{DerivedColumns, DerivedLists};
use crate::error::Result;

/// Versions of the references that the rows used.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ReferenceVersions<'a> {
    pub flat: &'a str,
    pub foam: &'a str,
}

/// The image of each pair under each symmetry that the grid has.
pub(crate) struct SymmetryPairs(Vec<(Symmetry, Vec<MovedPair>)>);

impl SymmetryPairs {
    pub fn from_grid(grid: &Grid) -> Self {
        let moved = |symmetry| grid.moved_pairs(symmetry).map(|pairs| (symmetry, pairs));
        Self(Symmetry::ALL.into_iter().filter_map(moved).collect())
    }
}

/// Builds rows of `nce`.
pub(crate) fn nce_rows(
    rig: &Rig,
    grid: &Grid,
    keys: &RunKeys,
    derived: DerivedLists,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let mut columns = keys.begin_rows(Table::Nce, rig, derived.pairs.len());
    columns.push_pairs("", grid_pairs(grid, derived.pairs.iter())).push_lists("reflected_ir", derived.reflected);
    for (band, curves) in rig.band_names().iter().zip(derived.curves) {
        columns.push_lists(&format!("nce_{band}"), curves);
    }
    Ok(columns.fill_text("flat_version", of.flat).fill_text("foam_version", of.foam).finish()?)
}

/// Builds some rows of `tnce`.
pub(crate) fn tnce_rows(
    rig: &Rig,
    grid: &Grid,
    keys: &RunKeys,
    derived: &DerivedColumns,
    range: Range<usize>,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let pairs = &derived.pairs[range.clone()];
    let mut columns = keys.begin_rows(Table::Tnce, rig, pairs.len());
    columns.push_pairs("", grid_pairs(grid, pairs.iter()));
    let bands = rig.band_names();
    for (name, values) in derived.energy_columns(&bands) {
        columns.push_column(&name, Arc::new(Float64Array::from(values[range.clone()].to_vec())));
    }
    let shapes = derived.shape_columns(&bands, rig.sweep.rate_hz.get(), range.clone());
    for (name, values) in shapes.into_iter().chain(derived.uncertainty_columns(&bands, range)) {
        columns.push_column(&name, Arc::new(Float32Array::from(values)));
    }
    Ok(columns.fill_text("flat_version", of.flat).fill_text("foam_version", of.foam).finish()?)
}

/// Builds rows of `tnce_d4` of some measurements, grouped by pair, one per symmetry. Symmetries that the grid lacks are
/// left out.
pub(crate) fn tnce_d4(
    rig: &Rig,
    grid: &Grid,
    SymmetryPairs(moved): &SymmetryPairs,
    keys: &RunKeys,
    derived: &DerivedColumns,
    range: Range<usize>,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let each = moved.len();
    let pairs = &derived.pairs[range.clone()];
    let rows: Vec<_> = pairs
        .iter()
        .flat_map(|pair| moved.iter().map(move |(symmetry, pairs)| (*symmetry, pairs[*pair as usize])))
        .collect();
    let measured = pairs.iter().flat_map(|pair| std::iter::repeat_n(pair, each));
    let moved = rows.iter().map(|(_, moved)| Some(&moved.pair));
    let mut columns = keys.begin_rows(Table::TnceD4, rig, rows.len());
    columns
        .push_pairs("", grid_pairs(grid, measured))
        .push_texts("symmetry", rows.iter().map(|(symmetry, _)| symmetry.name()))
        .push_flags("swapped", rows.iter().map(|(_, moved)| moved.swapped))
        .push_pairs("d4_", moved.clone())
        .push_positions(grid, moved);
    for (name, values) in derived.energy_columns(&rig.band_names()) {
        let mut repeated = Vec::with_capacity(rows.len());
        values[range.clone()].iter().for_each(|x| repeated.extend(std::iter::repeat_n(*x, each)));
        columns.push_column(&name, Arc::new(Float64Array::from(repeated)));
    }
    Ok(columns.fill_text("flat_version", of.flat).fill_text("foam_version", of.foam).finish()?)
}

fn grid_pairs<'a>(
    grid: &'a Grid,
    ids: impl Iterator<Item = &'a u32> + Clone,
) -> impl Iterator<Item = Option<&'a Pair>> + Clone {
    ids.map(|id| grid.pair(PairId(*id)))
}
