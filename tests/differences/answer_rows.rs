//! Comparison of two engines' answers value by value.

use std::cmp::Ordering;
use std::fmt::{self, Display, Formatter};
use std::sync::Arc;

use anyhow::{Result, bail};
use arrow::array::{Array, ArrayRef, AsArray as _, RecordBatch};
use arrow::compute::{CastOptions, cast_with_options};
use arrow::datatypes::{
    DataType, Decimal128Type, DurationMicrosecondType, Float64Type, Int64Type, IntervalDayTimeType,
    IntervalMonthDayNanoType, IntervalUnit, IntervalYearMonthType, TimeUnit,
};

/// Relative tolerance of floats: engines add in different orders, DataFusion 55 rounds the weight between the two
/// neighbours of a percentile to 1e-6, which moved percentiles of the lake by up to 3e-9, and functions of REAL, which
/// has 24 bits, are REAL in one engine and double in the other.
const TOLERANCE: f64 = 1e-7;
/// Relative tolerance if a side answers by a float of 32 bits, which has 24 bits of digits.
const SINGLE_TOLERANCE: f64 = 1e-6;
/// Sums of large numbers that cancel each other are zero within this.
const NOTHING: f64 = 1e-9;
/// Nanoseconds of a day.
const DAY_NANOS: i128 = 86_400_000_000_000;

/// Whether the order of an answer's rows is part of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RowOrder {
    /// Rows are a multiset.
    Free,
    /// `ORDER BY` determines the place of each row.
    Total,
}

/// A value, whatever type the engine has for it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum CellValue {
    /// NULL.
    Null,
    /// A truth value.
    Flag(bool),
    /// A whole number or a decimal: its digits, and how many of them are behind the point.
    Exact(i128, i8),
    /// A float.
    Float(f64),
    /// A date, a time of day or an instant, ns.
    Time(i128),
    /// An interval: months and ns.
    Span(i64, i128),
    /// Text; bytes as hexadecimal digits.
    Text(String),
    /// A list, or the fields of a struct.
    List(Vec<Self>),
}

/// The rows of an answer, and a word for the type of each column.
pub(crate) struct AnswerRows {
    types: Vec<&'static str>,
    /// Whether a column is of floats of 32 bits.
    is_single: Vec<bool>,
    rows: Vec<Vec<CellValue>>,
    /// Relative tolerance of floats of 64 bits.
    tolerance: f64,
}

/// Returns the first difference between two answers, whatever the order of their rows, if there is one.
///
/// # Errors
/// Values cannot be compared.
pub(crate) fn find_difference(own: &[RecordBatch], peer: &[RecordBatch]) -> Result<Option<String>> {
    Ok(AnswerRows::read(own)?.find_difference(AnswerRows::read(peer)?, RowOrder::Free))
}

impl AnswerRows {
    /// Reads the values of all batches.
    ///
    /// # Errors
    /// A column has a type that is not known here.
    pub fn read(batches: &[RecordBatch]) -> Result<Self> {
        let Some(first) = batches.first() else {
            return Ok(Self { types: Vec::new(), is_single: Vec::new(), rows: Vec::new(), tolerance: TOLERANCE });
        };
        let schema = first.schema();
        let kinds = || schema.fields().iter().map(|field| field.data_type());
        let mut rows = Vec::new();
        for batch in batches {
            let columns: Vec<_> = batch.columns().iter().map(read_cells).collect::<Result<_>>()?;
            rows.extend((0..batch.num_rows()).map(|row| columns.iter().map(|column| column[row].clone()).collect()));
        }
        Ok(Self {
            types: kinds().map(name_type).collect(),
            is_single: kinds().map(|kind| matches!(kind, DataType::Float32)).collect(),
            rows,
            tolerance: TOLERANCE,
        })
    }

    /// Sets the relative tolerance of floats of 64 bits.
    pub fn with_tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// Returns the first difference to another answer.
    pub fn find_difference(mut self, mut peer: Self, order: RowOrder) -> Option<String> {
        if self.rows.len() != peer.rows.len() {
            return Some(format!("{} rows and {}", self.rows.len(), peer.rows.len()));
        }
        if self.rows.is_empty() {
            return None;
        }
        if self.types.len() != peer.types.len() {
            return Some(format!("{} columns and {}", self.types.len(), peer.types.len()));
        }
        let single = self.is_single.iter().zip(&peer.is_single).map(|(a, b)| *a || *b);
        let tolerances: Vec<_> = single.map(|s| if s { SINGLE_TOLERANCE } else { self.tolerance }).collect();
        let is_same = |a: &[CellValue], b: &[CellValue]| {
            a.iter().zip(b).zip(&tolerances).all(|((a, b), tolerance)| a.is_same(b, *tolerance))
        };
        if order == RowOrder::Total {
            let place = self.rows.iter().zip(&peer.rows).position(|(a, b)| !is_same(a, b));
            return place.map(|row| {
                format!("row {row} in order: {} and {}", show_row(&self.rows[row]), show_row(&peer.rows[row]))
            });
        }
        self.rows.sort_by(|a, b| compare_rows(a, b));
        peer.rows.sort_by(|a, b| compare_rows(a, b));
        // Rounding may have sorted rows differently that are alike otherwise.
        let mut left: Vec<_> = peer.rows.iter().collect();
        left.reverse();
        for row in &self.rows {
            let Some(place) = left.iter().rposition(|other| is_same(row, other)) else {
                let nearest = left.last().map_or_else(String::new, |row| show_row(row));
                return Some(format!("a row {} and {nearest}", show_row(row)));
            };
            left.remove(place);
        }
        None
    }

    /// Returns the first column that the two sides give other types: a whole number here, a float there.
    pub fn find_type_difference(&self, peer: &Self) -> Option<String> {
        let mut pairs = self.types.iter().zip(&peer.types);
        let (own, peer) = pairs.find(|(own, peer)| own != peer && **own != "null" && **peer != "null")?;
        Some(format!("{own} and {peer}"))
    }

    /// Returns its rows as text, a line each, with commas between the values.
    #[cfg(all(test, feature = "lake"))]
    pub fn show_rows(&self, order: RowOrder) -> Vec<String> {
        let mut lines: Vec<_> = self.rows.iter().map(|row| show_row(row)).collect();
        if order == RowOrder::Free {
            lines.sort();
        }
        lines
    }
}

impl CellValue {
    fn is_same(&self, other: &Self, tolerance: f64) -> bool {
        match (self, other) {
            (Self::Exact(a, a_scale), Self::Exact(b, b_scale)) => {
                let scale = *a_scale.max(b_scale);
                match (scale_digits(*a, scale - a_scale), scale_digits(*b, scale - b_scale)) {
                    (Some(a), Some(b)) => a == b,
                    _ => false,
                }
            }
            (Self::Float(_) | Self::Exact(..), Self::Float(_) | Self::Exact(..)) => {
                let a = self.float_value();
                let b = other.float_value();
                let near = NOTHING.max(tolerance * a.abs().max(b.abs()));
                a == b || a.is_nan() && b.is_nan() || a.is_finite() && b.is_finite() && (a - b).abs() <= near
            }
            (Self::List(a), Self::List(b)) => {
                a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.is_same(b, tolerance))
            }
            (a, b) => a == b,
        }
    }

    fn float_value(&self) -> f64 {
        match self {
            Self::Float(value) => *value,
            Self::Exact(digits, scale) => *digits as f64 / 10_f64.powi(i32::from(*scale)),
            _ => f64::NAN,
        }
    }

    // Numbers have one rank, whatever their type, and come after all else, so that rounding decides last.
    fn rank(&self) -> u8 {
        match self {
            Self::Null => 0,
            Self::Flag(_) => 1,
            Self::Time(_) => 2,
            Self::Span(..) => 3,
            Self::Text(_) => 4,
            Self::List(_) => 5,
            Self::Exact(..) | Self::Float(_) => 6,
        }
    }
}

impl Display for CellValue {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Null => f.write_str("null"),
            Self::Flag(flag) => write!(f, "{flag}"),
            Self::Exact(digits, scale) if *scale <= 0 => {
                write!(f, "{digits}{}", "0".repeat(usize::from(scale.unsigned_abs())))
            }
            Self::Exact(digits, scale) => {
                let scale = usize::from(scale.unsigned_abs());
                let text = format!("{:0>width$}", digits.unsigned_abs(), width = scale + 1);
                let (whole, fraction) = text.split_at(text.len() - scale);
                let fraction = fraction.trim_end_matches('0');
                let sign = if *digits < 0 { "-" } else { "" };
                let point = if fraction.is_empty() { "" } else { "." };
                write!(f, "{sign}{whole}{point}{fraction}")
            }
            Self::Float(value) => write!(f, "{value}"),
            Self::Time(nanos) => write!(f, "{nanos} ns"),
            Self::Span(months, nanos) => write!(f, "{months} months {nanos} ns"),
            Self::Text(text) => f.write_str(text),
            Self::List(values) => write!(f, "[{}]", show_values(values, ", ")),
        }
    }
}

fn show_row(row: &[CellValue]) -> String {
    show_values(row, ",")
}

fn show_values(values: &[CellValue], between: &str) -> String {
    values.iter().map(ToString::to_string).collect::<Vec<_>>().join(between)
}

fn scale_digits(digits: i128, places: i8) -> Option<i128> {
    digits.checked_mul(10_i128.checked_pow(u32::from(places.unsigned_abs()))?)
}

// By what is exact, then by numbers, so that rounding does not change the order of rows that differ otherwise.
fn compare_rows(a: &[CellValue], b: &[CellValue]) -> Ordering {
    let is_number = |cell: &&CellValue| matches!(cell, CellValue::Exact(..) | CellValue::Float(_));
    let others = |row: &[CellValue]| {
        row.iter().filter(|cell| !is_number(cell)).map(|c| (c.rank(), c.to_string())).collect::<Vec<_>>()
    };
    let numbers = |row: &[CellValue]| row.iter().filter(is_number).map(CellValue::float_value).collect::<Vec<_>>();
    let by_number = || {
        let a = numbers(a);
        let b = numbers(b);
        let first = a.iter().zip(&b).map(|(a, b)| (a + 0.0).total_cmp(&(b + 0.0))).find(|order| order.is_ne());
        first.unwrap_or(a.len().cmp(&b.len()))
    };
    others(a).cmp(&others(b)).then_with(by_number)
}

fn name_type(kind: &DataType) -> &'static str {
    match kind {
        DataType::Null => "null",
        DataType::Boolean => "flag",
        kind if kind.is_integer() => "integer",
        // A sum of integers is a decimal in one engine, a wide integer in the other.
        DataType::Decimal128(_, 0) | DataType::Decimal256(_, 0) => "integer",
        kind if kind.is_decimal() => "decimal",
        kind if kind.is_floating() => "float",
        DataType::Date32 | DataType::Date64 => "date",
        DataType::Timestamp(_, None) => "timestamp",
        DataType::Timestamp(_, Some(_)) => "timestamp with time zone",
        DataType::Time32(_) | DataType::Time64(_) => "time",
        DataType::Duration(_) | DataType::Interval(_) => "interval",
        kind if kind.is_nested() => "list or struct",
        DataType::Binary | DataType::LargeBinary | DataType::BinaryView | DataType::FixedSizeBinary(_) => "bytes",
        DataType::Dictionary(_, value) => name_type(value),
        _ => "text",
    }
}

fn read_cells(array: &ArrayRef) -> Result<Vec<CellValue>> {
    let to = |kind: &DataType| {
        Ok::<_, anyhow::Error>(cast_with_options(array, kind, &CastOptions { safe: false, ..CastOptions::default() })?)
    };
    let nanos_from = |unit: &TimeUnit| match unit {
        TimeUnit::Second => 1_000_000_000,
        TimeUnit::Millisecond => 1_000_000,
        TimeUnit::Microsecond => 1_000,
        TimeUnit::Nanosecond => 1,
    };
    let times = |factor: i128| -> Result<Vec<CellValue>> {
        let array = to(&DataType::Int64)?;
        let value = |row| CellValue::Time(i128::from(array.as_primitive::<Int64Type>().value(row)) * factor);
        Ok(fill_cells(&array, value))
    };
    match array.data_type() {
        DataType::Null => Ok(vec![CellValue::Null; array.len()]),
        DataType::Boolean => Ok(fill_cells(array, |row| CellValue::Flag(array.as_boolean().value(row)))),
        kind if kind.is_integer() || kind.is_decimal() => {
            let scale = match kind {
                DataType::Decimal128(_, scale) | DataType::Decimal256(_, scale) => *scale,
                DataType::Decimal64(_, scale) | DataType::Decimal32(_, scale) => *scale,
                _ => 0,
            };
            let array = to(&DataType::Decimal128(38, scale))?;
            Ok(fill_cells(&array, |row| CellValue::Exact(array.as_primitive::<Decimal128Type>().value(row), scale)))
        }
        kind if kind.is_floating() => {
            let array = to(&DataType::Float64)?;
            Ok(fill_cells(&array, |row| CellValue::Float(array.as_primitive::<Float64Type>().value(row))))
        }
        DataType::Timestamp(unit, _) | DataType::Time64(unit) => times(nanos_from(unit)),
        DataType::Date32 => {
            let days = to(&DataType::Int32)?;
            let array = cast_with_options(&days, &DataType::Int64, &CastOptions::default())?;
            let value = |row| CellValue::Time(i128::from(array.as_primitive::<Int64Type>().value(row)) * DAY_NANOS);
            Ok(fill_cells(&array, value))
        }
        DataType::Date64 => times(1_000_000),
        DataType::Duration(_) => {
            let array = to(&DataType::Duration(TimeUnit::Microsecond))?;
            let micros = |row| i128::from(array.as_primitive::<DurationMicrosecondType>().value(row));
            Ok(fill_cells(&array, |row| CellValue::Span(0, micros(row) * 1_000)))
        }
        DataType::Interval(unit) => Ok(fill_cells(array, |row| read_interval(array, unit, row))),
        DataType::List(_) => fill_lists(array, |row| array.as_list::<i32>().value(row)),
        DataType::LargeList(_) => fill_lists(array, |row| array.as_list::<i64>().value(row)),
        DataType::FixedSizeList(..) => fill_lists(array, |row| array.as_fixed_size_list().value(row)),
        DataType::Map(..) => fill_lists(array, |row| Arc::new(array.as_map().value(row))),
        DataType::Struct(_) => {
            let fields = array.as_struct().columns().iter().map(read_cells).collect::<Result<Vec<_>>>()?;
            let values = |row: usize| fields.iter().map(|field| field[row].clone()).collect();
            Ok(fill_cells(array, |row| CellValue::List(values(row))))
        }
        DataType::Binary | DataType::LargeBinary | DataType::BinaryView => {
            let array = to(&DataType::Binary)?;
            let digits = |row| array.as_binary::<i32>().value(row).iter().map(|byte| format!("{byte:02x}")).collect();
            Ok(fill_cells(&array, |row| CellValue::Text(digits(row))))
        }
        kind if kind.is_string() || matches!(kind, DataType::Dictionary(..)) => {
            let array = to(&DataType::Utf8)?;
            Ok(fill_cells(&array, |row| CellValue::Text(array.as_string::<i32>().value(row).to_owned())))
        }
        kind => bail!("values of type {kind} are not compared"),
    }
}

fn read_interval(array: &ArrayRef, unit: &IntervalUnit, row: usize) -> CellValue {
    match unit {
        IntervalUnit::YearMonth => {
            CellValue::Span(i64::from(array.as_primitive::<IntervalYearMonthType>().value(row)), 0)
        }
        IntervalUnit::DayTime => {
            let value = array.as_primitive::<IntervalDayTimeType>().value(row);
            let nanos = i128::from(value.days) * DAY_NANOS + i128::from(value.milliseconds) * 1_000_000;
            CellValue::Span(0, nanos)
        }
        IntervalUnit::MonthDayNano => {
            let value = array.as_primitive::<IntervalMonthDayNanoType>().value(row);
            let nanos = i128::from(value.days) * DAY_NANOS + i128::from(value.nanoseconds);
            CellValue::Span(i64::from(value.months), nanos)
        }
    }
}

fn fill_cells(array: &ArrayRef, value: impl Fn(usize) -> CellValue) -> Vec<CellValue> {
    (0..array.len()).map(|row| if array.is_null(row) { CellValue::Null } else { value(row) }).collect()
}

fn fill_lists(array: &ArrayRef, value: impl Fn(usize) -> ArrayRef) -> Result<Vec<CellValue>> {
    let list = |row| {
        if array.is_null(row) { Ok(CellValue::Null) } else { Ok(CellValue::List(read_cells(&value(row))?)) }
    };
    (0..array.len()).map(list).collect()
}
