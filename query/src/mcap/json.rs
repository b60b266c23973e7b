//! JSON messages into columns: by their schema's properties, else as one column `json` with the text.
//!
//! A value that does not fit its column's type is null and counted: nothing in a JSON channel binds its writer to the
//! schema.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;
use serde_json::{Map, Number, Value};

use super::column::{Column, DEEPEST, MOST_LEAVES, Record, integer_type, width};
use super::error::{Malformed, Spent};
use super::schema::BYTE_ORDER_MARK;

/// A parsed value takes about this many bytes for each byte of its text, at worst.
const PARSED: usize = 16;
/// Integers are below this, 2^64.
const MOST_INTEGER: f64 = 18_446_744_073_709_551_616.0;
/// Numbers that JSON's grammar lacks and that many writers write all the same. Others, as `1e400`, exceed 64 bits.
const NO_NUMBERS: [&str; 3] = ["-Infinity", "Infinity", "NaN"];

/// Where the columns come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    /// Each is a property.
    Properties,
    /// There is one, the text.
    Text,
}

/// The columns that a JSON schema describes.
pub(super) fn columns(schema: &[u8]) -> Result<(Fields, Shape), String> {
    let whole = || (Fields::from(vec![Field::new("json", DataType::Utf8, true)]), Shape::Text);
    if schema.iter().all(u8::is_ascii_whitespace) {
        return Ok(whole());
    }
    let schema: Value = serde_json::from_slice(schema).map_err(|e| format!("its schema is no JSON: {e}"))?;
    let mut leaves = 0;
    match properties(&schema) {
        Some(properties) => Ok((fields(properties, 1, &mut leaves)?, Shape::Properties)),
        None => Ok(whole()),
    }
}

fn properties(schema: &Value) -> Option<&Map<String, Value>> {
    schema.get("properties")?.as_object().filter(|p| !p.is_empty())
}

fn fields(properties: &Map<String, Value>, depth: usize, leaves: &mut usize) -> Result<Fields, String> {
    let one = |(name, schema): (&String, &Value)| Ok(Field::new(name, kind(schema, depth, leaves)?, true));
    properties.iter().map(one).collect()
}

// What has no type of its own, such as a choice of several, is given as JSON.
fn kind(schema: &Value, depth: usize, leaves: &mut usize) -> Result<DataType, String> {
    *leaves += 1;
    if *leaves > MOST_LEAVES {
        return Err(format!("its schema has more than {MOST_LEAVES} columns"));
    }
    let name = match schema.get("type") {
        Some(Value::String(name)) => Some(name.as_str()),
        // A type or null is that type: all columns may be null.
        Some(Value::Array(names)) => {
            let mut names = names.iter().filter_map(Value::as_str).filter(|name| *name != "null");
            names.next().filter(|_| names.next().is_none())
        }
        _ => None,
    };
    Ok(match name {
        Some("number") => DataType::Float64,
        Some("integer") => integer(schema),
        Some("boolean") => DataType::Boolean,
        Some("array") if depth < DEEPEST => match schema.get("items") {
            Some(items) => {
                let child = kind(items, depth + 1, leaves)?;
                DataType::List(Arc::new(Field::new(LIST_CHILD, child, true)))
            }
            None => DataType::Utf8,
        },
        Some("object") if depth < DEEPEST => match properties(schema) {
            Some(properties) => DataType::Struct(fields(properties, depth + 1, leaves)?),
            None => DataType::Utf8,
        },
        _ => DataType::Utf8,
    })
}

// 64 bits with a sign if the schema bounds it so. Of others nobody knows the sign, and JSON's numbers are commonly those
// of 64 bits with a sign or without.
fn integer(schema: &Value) -> DataType {
    let bounded = |name| schema.get(name).is_some_and(Value::is_i64);
    let format = schema.get("format").and_then(Value::as_str);
    let is_named = format.is_some_and(|name| matches!(name, "int8" | "int16" | "int32" | "int64"));
    match is_named || (bounded("minimum") && bounded("maximum")) {
        true => DataType::Int64,
        false => integer_type(),
    }
}

/// Decodes messages.
pub(super) struct Decoder {
    shape: Shape,
    fields: Fields,
    record: Record,
    width: usize,
    pub(super) spent: Spent,
    /// Values that are null because they are not of their column's type, or no numbers.
    pub(super) unfit: usize,
}

impl Decoder {
    pub(super) fn new(shape: Shape, all: &Fields, wanted: &[usize]) -> Self {
        let fields: Fields = wanted.iter().map(|i| all[*i].clone()).collect();
        let width = fields.iter().map(|f| width(f.data_type())).sum();
        Self { shape, record: Record::new(&fields), fields, width, spent: Spent::default(), unfit: 0 }
    }

    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        self.spent.add(self.width)?;
        // Nothing is asked of the message: it is not parsed.
        if self.record.columns.is_empty() {
            return Ok(());
        }
        if self.shape == Shape::Text {
            self.spent.add(data.len())?;
            for column in &mut self.record.columns {
                if let Column::Text(c) = column {
                    c.push_text(data);
                }
            }
            return Ok(());
        }
        let message = self.parse(data)?;
        let message = message.as_object().ok_or(Malformed::Json)?;
        for (field, column) in self.fields.iter().zip(&mut self.record.columns) {
            push(column, field.data_type(), message.get(field.name()), &mut self.spent, &mut self.unfit)?;
        }
        Ok(())
    }

    fn parse(&mut self, data: &[u8]) -> Result<Value, Malformed> {
        Spent::default().add(data.len().saturating_mul(PARSED))?;
        let data = data.strip_prefix(BYTE_ORDER_MARK).unwrap_or(data);
        if let Ok(message) = serde_json::from_slice(data) {
            return Ok(message);
        }
        let (text, replaced) = without_no_numbers(data);
        let message = serde_json::from_slice(&text).map_err(|_| Malformed::Json)?;
        self.unfit += replaced;
        Ok(message)
    }

    pub(super) fn columns(&mut self) -> &mut [Column] {
        self.spent = Spent::default();
        &mut self.record.columns
    }
}

// The text with null in the place of NaN, infinities and numbers that 64 bits do not have, and how many there were.
fn without_no_numbers(data: &[u8]) -> (Vec<u8>, usize) {
    let mut text = Vec::with_capacity(data.len());
    let (mut replaced, mut at, mut in_string) = (0, 0, false);
    while at < data.len() {
        let rest = &data[at..];
        let name = NO_NUMBERS.iter().find(|name| !in_string && rest.starts_with(name.as_bytes()));
        let number = match name {
            Some(name) => name.len(),
            None => {
                if in_string {
                    0
                } else {
                    number_length(rest)
                }
            }
        };
        let is_none = name.is_some() || is_too_large(&rest[..number]);
        let taken = match is_none {
            true => {
                text.extend_from_slice(b"null");
                replaced += 1;
                number
            }
            false => {
                // What an escape is of does not end a string; a number is passed over as a whole.
                let taken = match in_string {
                    true if rest[0] == b'\\' => rest.len().min(2),
                    true => 1,
                    false => number.max(1),
                };
                in_string ^= rest[0] == b'"';
                text.extend_from_slice(&rest[..taken]);
                taken
            }
        };
        at += taken;
    }
    (text, replaced)
}

// Bytes of the number at the front of a text.
fn number_length(text: &[u8]) -> usize {
    text.iter().take_while(|byte| matches!(byte, b'0'..=b'9' | b'-' | b'+' | b'.' | b'e' | b'E')).count()
}

fn is_too_large(number: &[u8]) -> bool {
    let number = std::str::from_utf8(number).ok().and_then(|text| text.parse::<f64>().ok());
    number.is_some_and(f64::is_infinite)
}

fn push(
    column: &mut Column,
    kind: &DataType,
    value: Option<&Value>,
    spent: &mut Spent,
    unfit: &mut usize,
) -> Result<(), Malformed> {
    let Some(value) = value.filter(|v| !v.is_null()) else {
        column.push_null();
        return Ok(());
    };
    match (column, kind, value) {
        (Column::F64(c), _, Value::Number(n)) if n.as_f64().is_some() => c.push(n.as_f64().unwrap_or(f64::NAN)),
        (Column::I64(c), _, Value::Number(n)) => {
            let value = integer_of(n).and_then(|value| i64::try_from(value).ok());
            *unfit += usize::from(value.is_none());
            c.push_option(value);
        }
        (Column::Decimal(c), _, Value::Number(n)) => {
            let value = integer_of(n);
            *unfit += usize::from(value.is_none());
            c.push_option(value);
        }
        (Column::Bool(c), _, Value::Bool(b)) => c.push(*b),
        (Column::Text(c), _, Value::String(text)) => {
            spent.add(text.len())?;
            c.push(text.as_bytes());
        }
        (Column::Text(c), _, other) => {
            let text = other.to_string();
            spent.add(text.len())?;
            c.push(text.as_bytes());
        }
        (Column::List(list), DataType::List(child), Value::Array(values)) => {
            let each = width(child.data_type());
            for value in values {
                spent.add(each)?;
                push(&mut list.values, child.data_type(), Some(value), spent, unfit)?;
            }
            list.end_row();
        }
        (Column::Struct(record), DataType::Struct(fields), Value::Object(members)) => {
            for (field, column) in fields.iter().zip(&mut record.columns) {
                push(column, field.data_type(), members.get(field.name()), spent, unfit)?;
            }
            record.end_row();
        }
        (other, _, _) => {
            *unfit += 1;
            other.push_null();
        }
    }
    Ok(())
}

// A number without a fraction, however it is written: `1.0` and `1e3` are integers in JSON Schema.
fn integer_of(number: &Number) -> Option<i128> {
    let exact = number.as_i64().map(i128::from).or_else(|| number.as_u64().map(i128::from));
    exact.or_else(|| {
        let value = number.as_f64()?;
        (value.fract() == 0.0 && value.abs() < MOST_INTEGER).then_some(value as i128)
    })
}
