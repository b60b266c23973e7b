//! Sizes of a call's arguments, row by row.

use std::cell::OnceCell;
use std::collections::HashSet;

use arrow::array::{Array, ArrayRef, AsArray as _, GenericListArray, OffsetSizeTrait};
use arrow::compute::{CastOptions, cast, cast_with_options};
use arrow::datatypes::{DataType, Float64Type, IntervalMonthDayNanoType, TimeUnit};
use datafusion::common::ScalarValue;
use datafusion::logical_expr::ColumnarValue;

/// Microseconds of a day, and of the shortest month.
const DAY_MICROS: f64 = 86_400e6;
const MONTH_MICROS: f64 = 28.0 * DAY_MICROS;

/// The arguments of a call. A missing argument, and a null, has the size 0.
pub(super) struct CallSize<'a> {
    args: &'a [ColumnarValue],
    rows: usize,
    /// Numbers of each argument, once one is asked for.
    numbers: Vec<OnceCell<Vec<f64>>>,
    bytes: Vec<OnceCell<Vec<f64>>>,
    lengths: Vec<OnceCell<Vec<f64>>>,
}

impl<'a> CallSize<'a> {
    /// Of constants alone a call makes one value.
    pub fn new(args: &'a [ColumnarValue], rows: usize) -> Self {
        let is_constant = args.iter().all(|value| matches!(value, ColumnarValue::Scalar(_)));
        let cells = || vec![OnceCell::new(); args.len()];
        Self { args, rows: if is_constant { 1 } else { rows }, numbers: cells(), bytes: cells(), lengths: cells() }
    }

    /// Returns the sum of a size of all rows.
    pub fn sum(&self, size: impl Fn(usize) -> f64) -> f64 {
        (0..self.rows).map(size).sum()
    }

    /// Returns an argument's number in a row, if it is positive.
    pub fn number(&self, argument: usize, row: usize) -> f64 {
        self.any_number(argument, row).max(0.0)
    }

    fn any_number(&self, argument: usize, row: usize) -> f64 {
        let Some(cell) = self.numbers.get(argument) else { return 0.0 };
        value_in_row(cell.get_or_init(|| numbers_of(&self.args[argument])), row)
    }

    /// Returns the bytes of an argument's value in a row.
    pub fn bytes(&self, argument: usize, row: usize) -> f64 {
        let Some(cell) = self.bytes.get(argument) else { return 0.0 };
        value_in_row(cell.get_or_init(|| bytes_of(&self.args[argument])), row)
    }

    /// Returns the elements of an argument's list in a row.
    pub fn length(&self, argument: usize, row: usize) -> f64 {
        let Some(cell) = self.lengths.get(argument) else { return 0.0 };
        value_in_row(cell.get_or_init(|| lengths_of(&self.args[argument])), row)
    }

    /// Returns the bytes of all arguments in all rows.
    pub fn total_bytes(&self) -> f64 {
        let of_argument = |argument: &ColumnarValue| match argument {
            // A part of a list array has the values of all of it.
            ColumnarValue::Array(values) if values.data_type().is_nested() => bytes_by_row(values).iter().sum(),
            ColumnarValue::Array(values) => value_bytes(values),
            ColumnarValue::Scalar(_) => value_in_row(&bytes_of(argument), 0) * self.rows as f64,
        };
        self.args.iter().map(of_argument).sum()
    }

    /// Returns the elements of the series from the first argument to the second by the third, or to the first alone.
    pub fn series_length(&self, row: usize) -> f64 {
        let (start, stop) = match self.args.len() {
            1 => (0.0, self.any_number(0, row)),
            _ => (self.any_number(0, row), self.any_number(1, row)),
        };
        let step = if self.args.len() > 2 { self.any_number(2, row) } else { 1.0 };
        match (stop - start) / step {
            count if count.is_finite() && count > 0.0 => count,
            // A step of 0 is refused by the function.
            _ => 0.0,
        }
    }

    /// Returns the number of different texts of an argument.
    pub fn count_texts(&self, argument: usize) -> f64 {
        let Some(ColumnarValue::Array(values)) = self.args.get(argument) else { return 1.0 };
        let Ok(texts) = cast(values, &DataType::LargeUtf8) else { return 1.0 };
        texts.as_string::<i64>().iter().flatten().collect::<HashSet<_>>().len() as f64
    }
}

// A constant has one value for all rows.
fn value_in_row(values: &[f64], row: usize) -> f64 {
    values.get(if values.len() == 1 { 0 } else { row }).copied().unwrap_or(0.0)
}

fn one_or_more(argument: &ColumnarValue) -> Option<ArrayRef> {
    match argument {
        ColumnarValue::Array(values) => Some(values.clone()),
        ColumnarValue::Scalar(value) => value.to_array().ok(),
    }
}

// Numbers, times in microseconds, intervals as well. What is none of them has no limit here: the function refuses it.
fn numbers_of(argument: &ColumnarValue) -> Vec<f64> {
    let Some(values) = one_or_more(argument) else { return Vec::new() };
    if let Some(intervals) = values.as_primitive_opt::<IntervalMonthDayNanoType>() {
        let micros = |interval: arrow::datatypes::IntervalMonthDayNano| {
            f64::from(interval.months) * MONTH_MICROS
                + f64::from(interval.days) * DAY_MICROS
                + interval.nanoseconds as f64 / 1000.0
        };
        return intervals.iter().map(|interval| interval.map_or(0.0, micros)).collect();
    }
    let safe = CastOptions { safe: true, ..CastOptions::default() };
    let to_micros = DataType::Timestamp(TimeUnit::Microsecond, None);
    let numbers = match values.data_type() {
        DataType::Date32 | DataType::Date64 | DataType::Timestamp(..) => cast_with_options(&values, &to_micros, &safe)
            .and_then(|micros| cast_with_options(&micros, &DataType::Int64, &safe)),
        _ => Ok(values),
    };
    let numbers = numbers.and_then(|numbers| cast_with_options(&numbers, &DataType::Float64, &safe));
    let Ok(numbers) = numbers else { return Vec::new() };
    numbers.as_primitive::<Float64Type>().iter().map(Option::unwrap_or_default).collect()
}

fn bytes_of(argument: &ColumnarValue) -> Vec<f64> {
    match argument {
        ColumnarValue::Scalar(ScalarValue::Utf8(text) | ScalarValue::LargeUtf8(text) | ScalarValue::Utf8View(text)) => {
            vec![text.as_ref().map_or(0, String::len) as f64]
        }
        _ => one_or_more(argument).map(|values| bytes_by_row(&values)).unwrap_or_default(),
    }
}

fn bytes_by_row(values: &ArrayRef) -> Vec<f64> {
    let rows = values.len();
    let by_average = || vec![value_bytes(values) / rows.max(1) as f64; rows];
    match values.data_type() {
        DataType::Utf8 => offset_lengths(values.as_string::<i32>().value_offsets()),
        DataType::LargeUtf8 => offset_lengths(values.as_string::<i64>().value_offsets()),
        DataType::Utf8View => values.as_string_view().lengths().map(f64::from).collect(),
        DataType::Binary => offset_lengths(values.as_binary::<i32>().value_offsets()),
        DataType::LargeBinary => offset_lengths(values.as_binary::<i64>().value_offsets()),
        DataType::List(_) => list_bytes(values.as_list::<i32>()),
        DataType::LargeList(_) => list_bytes(values.as_list::<i64>()),
        _ => by_average(),
    }
}

fn list_bytes<O: OffsetSizeTrait>(lists: &GenericListArray<O>) -> Vec<f64> {
    let element = value_bytes(lists.values()) / lists.values().len().max(1) as f64;
    offset_lengths(lists.value_offsets()).into_iter().map(|length| length * element).collect()
}

fn lengths_of(argument: &ColumnarValue) -> Vec<f64> {
    let Some(values) = one_or_more(argument) else { return Vec::new() };
    match values.data_type() {
        DataType::List(_) => offset_lengths(values.as_list::<i32>().value_offsets()),
        DataType::LargeList(_) => offset_lengths(values.as_list::<i64>().value_offsets()),
        DataType::FixedSizeList(_, length) => vec![f64::from(*length); values.len()],
        _ => Vec::new(),
    }
}

fn offset_lengths<O: OffsetSizeTrait>(offsets: &[O]) -> Vec<f64> {
    offsets.windows(2).map(|ends| (ends[1].as_usize() - ends[0].as_usize()) as f64).collect()
}

// Bytes of an array's values, also of one that is a part of another.
pub(super) fn value_bytes(values: &ArrayRef) -> f64 {
    let bytes = values.to_data().get_slice_memory_size();
    bytes.unwrap_or_else(|_| values.get_array_memory_size()) as f64
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow::array::{Int64Array, ListArray, StringArray};
    use arrow::datatypes::Int64Type;

    use super::*;

    fn scalar(value: impl Into<ScalarValue>) -> ColumnarValue {
        ColumnarValue::Scalar(value.into())
    }

    #[test]
    fn sizes_of_rows_and_of_constants() {
        let texts = ColumnarValue::Array(Arc::new(StringArray::from(vec![Some("a"), None, Some("abc")])));
        let times = ColumnarValue::Array(Arc::new(Int64Array::from(vec![Some(2), Some(9), None])));
        let args = [texts, times, scalar("xy"), scalar(7_i64)];
        let call = CallSize::new(&args, 3);
        assert_eq!(call.sum(|row| call.bytes(0, row)), 4.0);
        assert_eq!(call.sum(|row| call.number(1, row)), 11.0);
        assert_eq!(call.sum(|row| call.bytes(2, row) * call.number(3, row)), 42.0);
        assert_eq!(call.number(9, 0) + call.bytes(9, 0) + call.length(0, 0), 0.0, "not there, or no list");
        assert_eq!(CallSize::new(&args[2..], 1000).sum(|row| call.bytes(2, row)), 2.0, "constants are one value");
        assert_eq!((call.count_texts(0), call.count_texts(2)), (2.0, 1.0));
    }

    #[test]
    fn sizes_of_lists() {
        let lists = ListArray::from_iter_primitive::<Int64Type, _, _>([Some(vec![Some(1); 3]), None, Some(vec![])]);
        let args = [ColumnarValue::Array(Arc::new(lists))];
        let call = CallSize::new(&args, 3);
        assert_eq!((call.length(0, 0), call.bytes(0, 0), call.bytes(0, 1)), (3.0, 24.0, 0.0));
    }

    #[test]
    fn lengths_of_series() {
        let length = |args: Vec<ColumnarValue>| CallSize::new(&args, 1).series_length(0);
        assert_eq!(length(vec![scalar(5_i64)]), 5.0);
        assert_eq!(length(vec![scalar(10_i64), scalar(0_i64), scalar(-2_i64)]), 5.0);
        assert_eq!(length(vec![scalar(10_i64), scalar(0_i64)]), 0.0);
        assert_eq!(length(vec![scalar(1_i64), scalar(2_i64), scalar(0_i64)]), 0.0);
        let day = |days| ColumnarValue::Scalar(ScalarValue::Date32(Some(days)));
        let second = ColumnarValue::Scalar(ScalarValue::new_interval_mdn(0, 0, 1_000_000_000));
        assert_eq!(length(vec![day(0), day(1), second]), 86_400.0);
        let nanosecond = ColumnarValue::Scalar(ScalarValue::new_interval_mdn(0, 0, 1));
        assert_eq!(length(vec![day(-700_000), day(2_900_000), nanosecond]), 3.6e6 * 86_400e9);
    }
}
