//! Rows of tables `nce`, `tnce` and `tnce_d4`.

use arrow::record_batch::RecordBatch;
use echolake_schema::symmetry::MovedPair;
use echolake_schema::tables::Table;
use echolake_schema::{Grid, PairId, Rig, Symmetry};

use super::{RowColumns, RunKeys};
use crate::CODE_VERSION;
use crate::derived_values::{DerivedLists, DerivedRows};
use crate::error::Result;

/// Versions of the references that the rows used.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ReferenceVersions<'a> {
    pub(crate) flat: &'a str,
    pub(crate) foam: &'a str,
}

/// The image of each pair under each symmetry that the grid has.
pub(crate) struct SymmetryPairs(Vec<(Symmetry, Vec<MovedPair>)>);

impl SymmetryPairs {
    pub(crate) fn of(grid: &Grid) -> Self {
        let moved = |symmetry| grid.moved_pairs(symmetry).map(|pairs| (symmetry, pairs));
        Self(Symmetry::ALL.into_iter().filter_map(moved).collect())
    }
}

/// Builds rows of `nce`.
pub(crate) fn nce(
    rig: &Rig,
    grid: &Grid,
    keys: &RunKeys,
    derived: DerivedLists,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let mut columns = RowColumns::of_run(Table::Nce, derived.pairs.len(), keys);
    pair_columns(&mut columns, grid, &derived.pairs);
    columns.lists(derived.reflected);
    for curves in derived.curves {
        columns.lists(curves);
    }
    columns.same(of.flat).same(of.foam).same(CODE_VERSION);
    columns.finish(rig)
}

/// Builds rows of `tnce`.
pub(crate) fn tnce(
    rig: &Rig,
    grid: &Grid,
    keys: &RunKeys,
    derived: &DerivedRows,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let mut columns = RowColumns::of_run(Table::Tnce, derived.pairs.len(), keys);
    pair_columns(&mut columns, grid, &derived.pairs);
    energy_columns(&mut columns, derived, 1);
    columns.same(of.flat).same(of.foam).same(CODE_VERSION);
    columns.finish(rig)
}

/// Builds rows of `tnce_d4`, grouped by pair, one per symmetry. Symmetries that the grid lacks are left out.
pub(crate) fn tnce_d4(
    rig: &Rig,
    grid: &Grid,
    SymmetryPairs(moved): &SymmetryPairs,
    keys: &RunKeys,
    derived: &DerivedRows,
    of: ReferenceVersions<'_>,
) -> Result<RecordBatch> {
    let each = moved.len();
    let rows: Vec<_> = derived
        .pairs
        .iter()
        .flat_map(|pair| moved.iter().map(move |(symmetry, pairs)| (*symmetry, pairs[*pair as usize])))
        .collect();
    let pairs: Vec<u32> = derived.pairs.iter().flat_map(|p| std::iter::repeat_n(*p, each)).collect();
    let mut columns = RowColumns::of_run(Table::TnceD4, rows.len(), keys);
    pair_columns(&mut columns, grid, &pairs);
    columns
        .texts(rows.iter().map(|(s, _)| Some(s.name())))
        .flags(rows.iter().map(|(_, m)| Some(m.swapped)))
        .ints(rows.iter().map(|(_, m)| Some(m.pair.id.0 as i32)))
        .ints(rows.iter().map(|(_, m)| Some(m.pair.microphone.0 as i32)))
        .ints(rows.iter().map(|(_, m)| Some(m.pair.speaker.0 as i32)));
    for axis in 0..3 {
        columns.doubles(rows.iter().map(|(_, m)| grid.point(m.pair.microphone).map(|p| p.position_mm[axis])));
    }
    for axis in 0..3 {
        columns.doubles(rows.iter().map(|(_, m)| grid.point(m.pair.speaker).map(|p| p.position_mm[axis])));
    }
    energy_columns(&mut columns, derived, each);
    columns.same(of.flat).same(of.foam).same(CODE_VERSION);
    columns.finish(rig)
}

fn pair_columns(columns: &mut RowColumns, grid: &Grid, pairs: &[u32]) {
    let pair = |id: &u32| grid.pair(PairId(*id));
    columns
        .ints(pairs.iter().map(|p| Some(*p as i32)))
        .ints(pairs.iter().map(|p| pair(p).map(|p| p.microphone.0 as i32)))
        .ints(pairs.iter().map(|p| pair(p).map(|p| p.speaker.0 as i32)));
}

// Repeats each measurement's numbers in `each` rows.
fn energy_columns(columns: &mut RowColumns, derived: &DerivedRows, each: usize) {
    for values in derived.energy_columns() {
        columns.doubles(values.into_iter().flat_map(|x| std::iter::repeat_n(Some(x), each)));
    }
}
