//! Comparison of two answers value by value, whatever the order of their rows.

use anyhow::Result;
use arrow::array::{Array, ArrayRef, AsArray as _, RecordBatch};
use arrow::compute::{SortColumn, cast, concat, lexsort_to_indices, take};
use arrow::datatypes::{DataType, Float64Type};
use arrow::util::display::array_value_to_string;

/// Relative tolerance of floats: engines add in different orders, and DataFusion 55 rounds the weight between the two
/// neighbours of a percentile to 1e-6, which moved percentiles of the lake by up to 3e-9.
const TOLERANCE: f64 = 1e-8;
/// Sums of large numbers that cancel each other are zero within this.
const NOTHING: f64 = 1e-9;

/// Returns the first difference between two answers, if there is one.
///
/// # Errors
/// Values cannot be compared.
pub(crate) fn find_difference(own: &[RecordBatch], peer: &[RecordBatch]) -> Result<Option<String>> {
    let count = |batches: &[RecordBatch]| batches.iter().map(RecordBatch::num_rows).sum::<usize>();
    if count(own) != count(peer) {
        return Ok(Some(format!("{} rows and {}", count(own), count(peer))));
    }
    let mut own = plain_columns(own)?;
    let mut peer = plain_columns(peer)?;
    if own.len() != peer.len() {
        return Ok(Some(format!("{} columns and {}", own.len(), peer.len())));
    }
    for (a, b) in own.iter_mut().zip(&mut peer) {
        // A sum of integers is a decimal in one engine, an integer in the other.
        if a.data_type() != b.data_type() && *a.data_type() != DataType::Utf8 && *b.data_type() != DataType::Utf8 {
            *a = cast(a, &DataType::Float64)?;
            *b = cast(b, &DataType::Float64)?;
        }
    }
    let own = sort_rows(&own)?;
    let peer = sort_rows(&peer)?;
    for (number, (a, b)) in own.iter().zip(&peer).enumerate() {
        if let Some(row) = (0..a.len()).find(|row| !is_same(a, b, *row)) {
            let own = array_value_to_string(a, row)?;
            let peer = array_value_to_string(b, row)?;
            return Ok(Some(format!("column {number}, row {row} in order: {own} and {peer}")));
        }
    }
    Ok(None)
}

// Whole columns, of few types.
fn plain_columns(batches: &[RecordBatch]) -> Result<Vec<ArrayRef>> {
    let columns = batches.first().map_or(0, RecordBatch::num_columns);
    let column = |number: usize| {
        let parts: Vec<&dyn Array> = batches.iter().map(|batch| batch.column(number).as_ref()).collect();
        let whole = concat(&parts)?;
        Ok(cast(&whole, &plain_type(whole.data_type()))?)
    };
    (0..columns).map(column).collect()
}

fn plain_type(kind: &DataType) -> DataType {
    match kind {
        DataType::Boolean | DataType::Timestamp(..) => DataType::Int64,
        kind if kind.is_integer() => DataType::Int64,
        kind if kind.is_numeric() => DataType::Float64,
        DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(..) => {
            DataType::new_list(DataType::Float64, true)
        }
        _ => DataType::Utf8,
    }
}

// Sorted by what is exact, then by floats, so that rounding does not change the order of rows that differ otherwise.
fn sort_rows(columns: &[ArrayRef]) -> Result<Vec<ArrayRef>> {
    let rank = |column: &&ArrayRef| u8::from(column.data_type().is_floating());
    let mut keys: Vec<_> = columns.iter().filter(|column| !column.data_type().is_list()).collect();
    keys.sort_by_key(rank);
    if keys.is_empty() {
        return Ok(columns.to_vec());
    }
    let keys: Vec<_> = keys.into_iter().map(|key| SortColumn { values: key.clone(), options: None }).collect();
    let order = lexsort_to_indices(&keys, None)?;
    columns.iter().map(|column| Ok(take(column, &order, None)?)).collect()
}

fn is_same(a: &ArrayRef, b: &ArrayRef, row: usize) -> bool {
    if a.data_type() != b.data_type() || a.is_null(row) != b.is_null(row) {
        return false;
    }
    match a.data_type() {
        _ if a.is_null(row) => true,
        DataType::List(_) => {
            let a = a.as_list::<i32>().value(row);
            let b = b.as_list::<i32>().value(row);
            a.len() == b.len() && (0..a.len()).all(|place| is_same(&a, &b, place))
        }
        DataType::Float64 => {
            let a = a.as_primitive::<Float64Type>().value(row);
            let b = b.as_primitive::<Float64Type>().value(row);
            a == b || a.is_nan() && b.is_nan() || (a - b).abs() <= NOTHING.max(TOLERANCE * a.abs().max(b.abs()))
        }
        _ => a.slice(row, 1) == b.slice(row, 1),
    }
}
