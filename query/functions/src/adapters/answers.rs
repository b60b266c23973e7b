//! Builds answers as Arrow arrays row by row; null if an argument is null.

use std::sync::Arc;

use arrow::array::builder::NullBufferBuilder;
use arrow::array::{ArrayRef, Float64Array, ListArray, PrimitiveArray, StructArray};
use arrow::buffer::{NullBuffer, OffsetBuffer, ScalarBuffer};
use arrow::datatypes::{DataType, Field, Fields};
use datafusion::error::{DataFusionError, Result};

use super::arguments::{CallArguments, SampleElement};

/// Builds one number per row; None is null.
pub(crate) fn build_numbers(
    arguments: &CallArguments<'_>,
    mut number: impl FnMut(usize) -> Result<Option<f64>>,
) -> Result<ArrayRef> {
    let mut values = Vec::with_capacity(arguments.row_count());
    let mut valid = NullBufferBuilder::new(arguments.row_count());
    for row in 0..arguments.row_count() {
        let value = if arguments.is_null(row) { None } else { number(row)? };
        values.push(value.unwrap_or_default());
        valid.append(value.is_some());
    }
    Ok(Arc::new(Float64Array::new(values.into(), valid.finish())))
}

/// Builds one list per row, with a capacity of `room` values in all. `list` appends a row's values; if it returns
/// false, the row is null.
pub(crate) fn build_lists<T: SampleElement>(
    arguments: &CallArguments<'_>,
    room: usize,
    mut list: impl FnMut(usize, &mut Vec<T>) -> Result<bool>,
) -> Result<ArrayRef> {
    let mut values = Vec::with_capacity(room.min(i32::MAX as usize));
    let mut offsets = Vec::with_capacity(arguments.row_count() + 1);
    let mut valid = NullBufferBuilder::new(arguments.row_count());
    offsets.push(0);
    for row in 0..arguments.row_count() {
        let start = values.len();
        let there = !arguments.is_null(row) && list(row, &mut values)?;
        if !there {
            values.truncate(start);
        }
        offsets.push(i32::try_from(values.len()).map_err(|_| too_long())?);
        valid.append(there);
    }
    Ok(Arc::new(list_array::<T>(values, offsets, valid.finish())?))
}

/// Builds lists of the type that [`super::arguments::list_of`] returns.
pub(crate) fn list_array<T: SampleElement>(
    values: Vec<T>,
    offsets: Vec<i32>,
    nulls: Option<NullBuffer>,
) -> Result<ListArray> {
    let values = PrimitiveArray::<T::Arrow>::new(values.into(), None);
    let field = Field::new_list_field(<T::Arrow as arrow::datatypes::ArrowPrimitiveType>::DATA_TYPE, true);
    let offsets = OffsetBuffer::new(ScalarBuffer::from(offsets));
    Ok(ListArray::try_new(Arc::new(field), offsets, Arc::new(values), nulls)?)
}

/// Builds one struct of numbers per row. `numbers` fills them; if it returns false, the row is null.
pub(crate) fn build_structs(
    arguments: &CallArguments<'_>,
    fields: &Fields,
    mut numbers: impl FnMut(usize, &mut [f64]) -> Result<bool>,
) -> Result<ArrayRef> {
    let mut columns = vec![Vec::with_capacity(arguments.row_count()); fields.len()];
    let mut valid = NullBufferBuilder::new(arguments.row_count());
    let mut values = vec![0.0; fields.len()];
    for row in 0..arguments.row_count() {
        let there = !arguments.is_null(row) && numbers(row, &mut values)?;
        valid.append(there);
        for (column, value) in columns.iter_mut().zip(&values) {
            column.push(if there { *value } else { 0.0 });
        }
    }
    let nulls = valid.finish();
    // The fields' own arrays need the nulls, too: a field taken out of a null struct must be null.
    let column = |values: Vec<f64>| -> ArrayRef { Arc::new(Float64Array::new(values.into(), nulls.clone())) };
    let columns = columns.into_iter().map(column).collect();
    Ok(Arc::new(StructArray::try_new_with_length(fields.clone(), columns, nulls, arguments.row_count())?))
}

/// Returns the fields of a struct of numbers.
pub(crate) fn number_fields<'a>(names: impl IntoIterator<Item = &'a str>) -> Fields {
    names.into_iter().map(|name| Field::new(name, DataType::Float64, true)).collect()
}

/// Appends `by` default values and returns them.
pub(crate) fn append_defaults<T: SampleElement>(values: &mut Vec<T>, by: usize) -> &mut [T] {
    let start = values.len();
    values.resize(start + by, T::default());
    &mut values[start..]
}

fn too_long() -> DataFusionError {
    let hint = "array_slice() takes a part of a list";
    DataFusionError::Execution(format!("the lists of one batch have more than 2^31 values; hint: {hint}"))
}
