//! Literals beside a column that is compared with them: a number beside a REAL is read as REAL, as in DuckDB, so that
//! the number that a page prints finds its row; a time may be without seconds, as in PostgreSQL and DuckDB. The column
//! itself is not cast, so that the bounds of files and pages still count.

use arrow::datatypes::DataType;
use datafusion::common::DFSchema;
use datafusion::common::tree_node::Transformed;
use datafusion::logical_expr::expr::{Between, Cast, InList, TryCast};
use datafusion::logical_expr::{BinaryExpr, Case, Expr, ExprSchemable as _};
use datafusion::scalar::ScalarValue;

/// Characters of `2026-05-07 12:00`.
const TO_MINUTES: usize = 16;

/// Reads the literals that an expression compares or casts as the type of what they are beside.
pub(super) fn read_literals(mut expr: Expr, schema: &DFSchema) -> Transformed<Expr> {
    let is_changed = match &mut expr {
        Expr::BinaryExpr(BinaryExpr { left, op, right }) if op.supports_propagation() => {
            read_beside(left, &mut [right.as_mut()], schema) || read_beside(right, &mut [left.as_mut()], schema)
        }
        Expr::Between(Between { expr, low, high, .. }) => read_beside(expr, &mut [low.as_mut(), high.as_mut()], schema),
        Expr::InList(InList { expr, list, .. }) => read_beside(expr, &mut list.iter_mut().collect::<Vec<_>>(), schema),
        Expr::Case(Case { expr: Some(expr), when_then_expr, .. }) => {
            let mut values: Vec<_> = when_then_expr.iter_mut().map(|(when, _)| when.as_mut()).collect();
            read_beside(expr, &mut values, schema)
        }
        Expr::Cast(Cast { expr, field }) | Expr::TryCast(TryCast { expr, field }) => {
            matches!(field.data_type(), DataType::Timestamp(..)) && read_as(expr, field.data_type())
        }
        _ => false,
    };
    if is_changed { Transformed::yes(expr) } else { Transformed::no(expr) }
}

fn read_beside(expr: &Expr, values: &mut [&mut Expr], schema: &DFSchema) -> bool {
    let is_literal = |value: &&mut Expr| matches!(value, Expr::Literal(..));
    if matches!(expr, Expr::Literal(..)) || !values.iter().any(is_literal) {
        return false;
    }
    let Ok(kind @ (DataType::Float32 | DataType::Timestamp(..))) = expr.get_type(schema) else { return false };
    let mut is_changed = false;
    for value in values {
        is_changed |= read_as(value, &kind);
    }
    is_changed
}

fn read_as(value: &mut Expr, kind: &DataType) -> bool {
    let Expr::Literal(literal, _) = value else { return false };
    let read = match (kind, &*literal) {
        (DataType::Float32, ScalarValue::Float64(Some(number))) => real_from_number(*number),
        (DataType::Float32, ScalarValue::Int64(Some(number))) => real_from_number(*number as f64),
        (DataType::Float32, ScalarValue::UInt64(Some(number))) => real_from_number(*number as f64),
        (DataType::Float32, ScalarValue::Decimal128(Some(digits), _, scale)) => {
            real_from_number(*digits as f64 / 10f64.powi(i32::from(*scale)))
        }
        (DataType::Timestamp(..), ScalarValue::Utf8(Some(text))) => {
            with_seconds(text).map(|text| ScalarValue::Utf8(Some(text)))
        }
        _ => None,
    };
    let is_read = read.is_some();
    if let Some(read) = read {
        *literal = read;
    }
    is_read
}

// A number that no REAL comes near stays as it is.
fn real_from_number(number: f64) -> Option<ScalarValue> {
    let real = number as f32;
    let is_near = real.is_finite() == number.is_finite() && (real == 0.0) == (number == 0.0);
    is_near.then_some(ScalarValue::Float32(Some(real)))
}

// `2026-05-07 12:00`, perhaps with a zone behind it; None if it has seconds, or is no such time.
fn with_seconds(text: &str) -> Option<String> {
    let (minutes, zone) = text.split_at_checked(TO_MINUTES)?;
    let is_time = minutes.bytes().enumerate().all(|(at, byte)| match at {
        4 | 7 => byte == b'-',
        10 => byte == b' ' || byte == b'T',
        13 => byte == b':',
        _ => byte.is_ascii_digit(),
    });
    (is_time && !zone.starts_with(':')).then(|| format!("{minutes}:00{zone}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// R5: Seconds are added to a time that ends with its minutes, and to nothing else.
    #[test]
    fn seconds_are_added() {
        for (text, expected) in [
            ("2026-05-07 12:00", Some("2026-05-07 12:00:00")),
            ("2026-05-07T12:00Z", Some("2026-05-07T12:00:00Z")),
            ("2026-05-07 12:00+02", Some("2026-05-07 12:00:00+02")),
            ("2026-05-07 12:00:30", None),
            ("2026-05-07", None),
            ("12:00", None),
            ("2026-05-07 12.00", None),
        ] {
            assert_eq!(with_seconds(text).as_deref(), expected, "{text}");
        }
    }
}
