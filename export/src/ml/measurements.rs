//! Rows of one run for a training set: joined by pair, and repeated for each symmetry.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, BooleanArray, FixedSizeListArray, Float32Array, Int32Array, StringArray,
    UInt32Array,
};
use arrow::compute::{cast, take};
use arrow::datatypes::{DataType, FieldRef, Int32Type};
use arrow::record_batch::RecordBatch;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::symmetry::MovedPair;
use echolake_schema::tables::Table;
use echolake_schema::{Grid, PointId, Symmetry};

use super::SplitPart;
use super::columns::TrainingColumns;
use super::surfaces::{TrainingRun, TrainingSurface};
use crate::error::{Error, Result};
use crate::rows;

/// The symmetries of a training set, and the image of each of the rig's pairs under them.
pub(super) struct SymmetryMoves(Vec<(Symmetry, Vec<MovedPair>)>);

impl SymmetryMoves {
    /// Returns all symmetries of the grid, or the identity alone.
    pub fn from_grid(grid: &Grid, symmetries: super::RowSymmetries) -> Self {
        let wanted: &[Symmetry] = match symmetries {
            super::RowSymmetries::None => &[Symmetry::Identity],
            super::RowSymmetries::All => &Symmetry::ALL,
        };
        Self(wanted.iter().filter_map(|s| grid.moved_pairs(*s).map(|pairs| (*s, pairs))).collect())
    }

    /// Returns the names of the symmetries.
    pub fn symmetry_names(&self) -> Vec<&'static str> {
        self.0.iter().map(|(symmetry, _)| symmetry.name()).collect()
    }
}

/// Builds the rows of runs from a snapshot of the lake.
pub(super) struct RowBuilder<'a> {
    pub lake: &'a Lake,
    pub snapshot: &'a LakeSnapshot,
    pub columns: &'a TrainingColumns,
    pub moves: &'a SymmetryMoves,
    /// Measurements that are left out.
    pub rejected: &'a RejectedMeasurements,
}

/// Rows of a run before any symmetry, in the order of their pairs.
pub(super) struct RunRows {
    pairs: Vec<u32>,
    values: Vec<ArrayRef>,
    /// Measurements that are left out because they are rejected.
    pub rejected: u64,
}

impl RowBuilder<'_> {
    /// Reads the chosen columns of the pairs that the run has in all of the chosen tables.
    pub async fn read_rows(&self, run: &TrainingRun) -> Result<RunRows> {
        let mut tables = HashMap::new();
        let mut pairs: Option<Vec<u32>> = None;
        for table in [Table::Measurements, Table::Nce, Table::Tnce] {
            let mut names = self.columns.of_table(table);
            // Rows need TNCE values even if no column of `tnce` is chosen: every row must be normalised by references.
            if names.is_empty() && table != Table::Tnce {
                continue;
            }
            names.push("pair_id");
            let batch = rows::of_run(self.lake, self.snapshot, table, &run.visible.run, &names).await?;
            let places = pair_rows(&batch, self.lake.grid().pairs().len())?;
            let mut known: Vec<u32> = places.keys().copied().collect();
            if let Some(others) = &pairs {
                known.retain(|pair| others.binary_search(pair).is_ok());
            }
            known.sort_unstable();
            pairs = Some(known);
            tables.insert(table, (batch, places));
        }
        let mut pairs = pairs.unwrap_or_default();
        let measured = pairs.len();
        pairs.retain(|pair| !self.rejected.is_rejected(run.visible.run.as_str(), *pair));
        let rejected = (measured - pairs.len()) as u64;
        let mut values = Vec::new();
        for (table, field) in self.columns.chosen() {
            let (batch, places) = &tables[table];
            let order: UInt32Array = pairs.iter().map(|pair| places[pair]).collect();
            values.push(
                ordered_column(batch, field, &order)
                    .map_err(|e| Error::damaged(format!("{}, {}", table.name(), run.visible.run), e))?,
            );
        }
        Ok(RunRows { pairs, values, rejected })
    }

    /// Returns the rows under each symmetry, one batch per symmetry.
    pub fn row_batches(
        &self,
        surface: &TrainingSurface,
        run: &TrainingRun,
        part: SplitPart,
        rows: &RunRows,
    ) -> Result<Vec<RecordBatch>> {
        self.moves
            .0
            .iter()
            .map(|(symmetry, moved)| self.row_batch(surface, run, part, rows, (*symmetry, moved)))
            .collect()
    }

    fn row_batch(
        &self,
        surface: &TrainingSurface,
        run: &TrainingRun,
        part: SplitPart,
        rows: &RunRows,
        (symmetry, moved): (Symmetry, &[MovedPair]),
    ) -> Result<RecordBatch> {
        let count = rows.pairs.len();
        let same =
            |text: &str| -> ArrayRef { Arc::new(StringArray::from_iter_values(std::iter::repeat_n(text, count))) };
        let moved: Vec<_> = rows.pairs.iter().map(|pair| moved[*pair as usize]).collect();
        let points = |of: fn(&MovedPair) -> PointId| -> ArrayRef {
            Arc::new(Int32Array::from_iter_values(moved.iter().map(|m| of(m).0 as i32)))
        };
        let macrostructure = surface.macrostructure.as_deref();
        let mut columns: Vec<ArrayRef> = vec![
            same(surface.id.as_str()),
            same(run.visible.run.as_str()),
            same(symmetry.name()),
            same(part.name()),
            same(surface.id.panel()),
            same(&surface.typology),
            Arc::new(StringArray::from_iter(std::iter::repeat_n(macrostructure, count))),
            Arc::new(Int32Array::from_iter_values(rows.pairs.iter().map(|p| *p as i32))),
            points(|m| m.pair.microphone),
            points(|m| m.pair.speaker),
            Arc::new(BooleanArray::from_iter(moved.iter().map(|m| Some(m.swapped)))),
            self.position_column("microphone_mm", &moved, |m| m.pair.microphone)?,
            self.position_column("speaker_mm", &moved, |m| m.pair.speaker)?,
        ];
        columns.extend(rows.values.iter().cloned());
        RecordBatch::try_new(self.columns.schema().clone(), columns).map_err(|e| Error::damaged(&run.visible.run, e))
    }

    fn position_column(&self, column: &str, moved: &[MovedPair], of: fn(&MovedPair) -> PointId) -> Result<ArrayRef> {
        let points = self.lake.grid().points();
        let values = moved.iter().flat_map(|m| points[of(m).index()].position_mm.map(|mm| mm as f32));
        let values: ArrayRef = Arc::new(Float32Array::from_iter_values(values));
        let kind = self.columns.schema().field_with_name(column).map(|f| f.data_type().clone());
        kind.and_then(|kind| fixed_lists(values, &kind)).map_err(|e| Error::damaged(column, e))
    }
}

// The row of each pair. A pair occurs once in a run; of duplicates the last one wins.
fn pair_rows(batch: &RecordBatch, pairs: usize) -> Result<HashMap<u32, u32>> {
    let ids = rows::number_column::<Int32Type>(batch, "pair_id")?;
    let place =
        |(row, id): (usize, &i32)| Some((u32::try_from(*id).ok().filter(|id| (*id as usize) < pairs)?, row as u32));
    let all: Option<HashMap<_, _>> = ids.iter().enumerate().map(place).collect();
    all.ok_or_else(|| Error::damaged("pair_id", "a pair that the rig does not have"))
}

fn ordered_column(batch: &RecordBatch, field: &FieldRef, order: &UInt32Array) -> std::result::Result<ArrayRef, String> {
    let array = batch.column_by_name(field.name()).ok_or_else(|| format!("no column `{}`", field.name()))?;
    let taken = take(array, order, None).map_err(|e| e.to_string())?;
    match field.data_type() {
        list @ DataType::FixedSizeList(_, length) => {
            let lists = taken.as_list::<i32>();
            let wrong = (0..lists.len()).find(|row| lists.value_length(*row) != *length || lists.is_null(*row));
            if let Some(row) = wrong {
                return Err(format!("`{}` has {} values, expected {length}", field.name(), lists.value_length(row)));
            }
            let from = lists.value_offsets()[0];
            let to = lists.value_offsets()[lists.len()];
            fixed_lists(lists.values().slice(from as usize, (to - from) as usize), list).map_err(|e| e.to_string())
        }
        plain => cast(&taken, plain).map_err(|e| e.to_string()),
    }
}

/// Returns the values as lists of one length.
pub(super) fn fixed_lists(
    values: ArrayRef,
    kind: &DataType,
) -> std::result::Result<ArrayRef, arrow::error::ArrowError> {
    let DataType::FixedSizeList(child, length) = kind else { return Ok(values) };
    Ok(Arc::new(FixedSizeListArray::try_new(child.clone(), *length, values, None)?))
}
