//! Contents of an answer in a few numbers that do not depend on the order of its rows.

use anyhow::Result;
use arrow::array::{Array, ArrayRef, AsArray as _};
use arrow::compute::{cast, sum};
use arrow::datatypes::{DataType, Float64Type, Int32Type, Int64Type};
use arrow::record_batch::RecordBatch;

/// Relative tolerance for sums of floats in different orders.
const TOLERANCE: f64 = 1e-9;

/// Rows, and of each column the sum of its numbers or of its texts' lengths.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RowsDigest {
    pub rows: u64,
    pub sums: Vec<f64>,
}

impl RowsDigest {
    pub fn of(batches: &[RecordBatch]) -> Result<Self> {
        let rows = batches.iter().map(|b| b.num_rows() as u64).sum();
        let columns = batches.first().map_or(0, RecordBatch::num_columns);
        let mut sums = vec![0.0; columns];
        for batch in batches {
            for (total, column) in sums.iter_mut().zip(batch.columns()) {
                *total += column_sum(column)?;
            }
        }
        Ok(Self { rows, sums })
    }

    /// Returns whether two answers are the same but for rounding.
    pub fn agrees(&self, other: &Self) -> bool {
        let near = |a: &f64, b: &f64| (a - b).abs() <= TOLERANCE * a.abs().max(b.abs()).max(1.0);
        self.rows == other.rows
            && self.sums.len() == other.sums.len()
            && self.sums.iter().zip(&other.sums).all(|(a, b)| near(a, b))
    }
}

fn column_sum(column: &ArrayRef) -> Result<f64> {
    Ok(match column.data_type() {
        DataType::List(_) => {
            let lists = column.as_list::<i32>();
            let from = lists.value_offsets()[0];
            let to = lists.value_offsets()[lists.len()];
            column_sum(&lists.values().slice(from as usize, (to - from) as usize))?
        }
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => {
            let lengths = arrow::compute::kernels::length::length(&cast(column, &DataType::Utf8)?)?;
            sum(lengths.as_primitive::<Int32Type>()).map_or(0.0, f64::from)
        }
        kind if kind.is_integer() => {
            sum(cast(column, &DataType::Int64)?.as_primitive::<Int64Type>()).unwrap_or(0) as f64
        }
        _ => sum(cast(column, &DataType::Float64)?.as_primitive::<Float64Type>()).unwrap_or(0.0),
    })
}
