//! Collects the columns of a batch in order, and checks them against the table's schema at the end.

use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, Float32Array, Float64Array, Int32Array, Int64Array, ListArray, StringArray,
    TimestampMicrosecondArray,
};
use arrow::buffer::OffsetBuffer;
use arrow::datatypes::{DataType, Field};
use arrow::record_batch::RecordBatch;
use echolake_lake::Error as LakeError;
use echolake_schema::tables::{LIST_CHILD, Table};
use echolake_schema::{Rig, RunId, SurfaceId, Timestamp};

use crate::error::Result;

/// Key columns of every row of a run.
#[derive(Debug, Clone)]
pub(crate) struct RunKeys {
    pub(crate) surface: SurfaceId,
    pub(crate) run: RunId,
}

/// The columns of one batch.
pub(crate) struct RowColumns {
    table: Table,
    rows: usize,
    arrays: Vec<ArrayRef>,
}

impl RowColumns {
    pub(crate) fn new(table: Table, rows: usize) -> Self {
        Self { table, rows, arrays: Vec::new() }
    }

    /// Returns columns that begin with the run's keys.
    pub(crate) fn of_run(table: Table, rows: usize, keys: &RunKeys) -> Self {
        let mut columns = Self::new(table, rows);
        columns.same(keys.surface.as_str()).same(keys.run.as_str());
        columns
    }

    pub(crate) fn push(&mut self, array: ArrayRef) -> &mut Self {
        self.arrays.push(array);
        self
    }

    /// Appends a column with the same text in every row.
    pub(crate) fn same(&mut self, text: &str) -> &mut Self {
        let rows = self.rows;
        self.push(Arc::new(StringArray::from_iter_values(std::iter::repeat_n(text, rows))))
    }

    pub(crate) fn texts<T: AsRef<str>>(&mut self, values: impl IntoIterator<Item = Option<T>>) -> &mut Self {
        self.push(Arc::new(values.into_iter().collect::<StringArray>()))
    }

    pub(crate) fn text(&mut self, value: Option<&str>) -> &mut Self {
        self.texts([value])
    }

    pub(crate) fn flags(&mut self, values: impl IntoIterator<Item = Option<bool>>) -> &mut Self {
        self.push(Arc::new(values.into_iter().collect::<BooleanArray>()))
    }

    pub(crate) fn ints(&mut self, values: impl IntoIterator<Item = Option<i32>>) -> &mut Self {
        self.push(Arc::new(values.into_iter().collect::<Int32Array>()))
    }

    pub(crate) fn longs(&mut self, values: impl IntoIterator<Item = Option<i64>>) -> &mut Self {
        self.push(Arc::new(values.into_iter().collect::<Int64Array>()))
    }

    pub(crate) fn floats(&mut self, values: impl IntoIterator<Item = Option<f32>>) -> &mut Self {
        self.push(Arc::new(values.into_iter().collect::<Float32Array>()))
    }

    pub(crate) fn doubles(&mut self, values: impl IntoIterator<Item = Option<f64>>) -> &mut Self {
        self.push(Arc::new(values.into_iter().collect::<Float64Array>()))
    }

    /// Appends two columns: nanoseconds, and the time truncated to microseconds.
    pub(crate) fn times(&mut self, nanos: impl IntoIterator<Item = i64>) -> &mut Self {
        let nanos: Vec<i64> = nanos.into_iter().collect();
        let micros = nanos.iter().map(|ns| Timestamp(*ns).micros());
        let micros = TimestampMicrosecondArray::from_iter_values(micros).with_timezone("UTC");
        self.push(Arc::new(Int64Array::from(nanos))).push(Arc::new(micros))
    }

    /// Appends a column of lists of equal length, from their concatenated values.
    pub(crate) fn lists(&mut self, values: Vec<f32>) -> &mut Self {
        let each = values.len().checked_div(self.rows).unwrap_or(0);
        let child = Arc::new(Field::new(LIST_CHILD, DataType::Float32, false));
        let offsets = OffsetBuffer::from_repeated_length(each, self.rows);
        self.push(Arc::new(ListArray::new(child, offsets, Arc::new(Float32Array::from(values)), None)))
    }

    /// Returns the batch.
    pub(crate) fn finish(&mut self, rig: &Rig) -> Result<RecordBatch> {
        let arrays = std::mem::take(&mut self.arrays);
        let made = RecordBatch::try_new(self.table.schema(rig), arrays);
        Ok(made.map_err(|e| LakeError::Encode { table: self.table.name(), reason: e.to_string() })?)
    }
}

/// Returns None for NaN and infinities.
pub(super) fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}
