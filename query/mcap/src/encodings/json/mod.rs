//! JSON messages into columns: by their schema's properties, else as one column `json` with the text.
//!
//! A value that does not fit its column's type is null and counted: nothing in a JSON channel binds its writer to the
//! schema.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;
use serde_json::{Map, Number, Value};

use super::{Malformed, MessageDecoder, MessageEncoding, MessageType, RawSchema, RowTally, strip_byte_order_mark};
use crate::column::{Column, DEEPEST, MOST_LEAVES, append_text, integer_type, value_width};

/// A parsed value takes about this many bytes for each byte of its text, at worst.
const PARSED: usize = 16;
/// Integers are below this, 2^64.
const MOST_INTEGER: f64 = 18_446_744_073_709_551_616.0;
/// Numbers that JSON's grammar lacks and that many writers write all the same. Others, as `1e400`, exceed 64 bits.
const NO_NUMBERS: [&str; 3] = ["-Infinity", "Infinity", "NaN"];
const NO_OBJECT: Malformed = Malformed::Invalid("it is no JSON object");

/// JSON, with a JSON schema or without.
pub(super) struct JsonEncoding;

impl MessageEncoding for JsonEncoding {
    fn encoding_names(&self) -> &'static [(&'static str, &'static str)] {
        &[("json", "jsonschema"), ("json", "")]
    }

    fn parse_schema(&self, channel: &RawSchema) -> Result<(Fields, Box<dyn MessageType>), String> {
        let schema = strip_byte_order_mark(&channel.data);
        if !schema.iter().all(u8::is_ascii_whitespace) {
            let schema: Value = serde_json::from_slice(schema).map_err(|e| format!("its schema is no JSON: {e}"))?;
            if let Some(properties) = object_properties(&schema) {
                return Ok((object_fields(properties, 1, &mut 0)?, Box::new(JsonType::Properties)));
            }
        }
        Ok((Fields::from(vec![Field::new("json", DataType::Utf8, true)]), Box::new(JsonType::Text)))
    }
}

/// The source of the columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum JsonType {
    /// Each is a property.
    Properties,
    /// There is one, the text.
    Text,
}

impl MessageType for JsonType {
    fn create_decoder(&self, _: &[usize], fields: &Fields) -> Box<dyn MessageDecoder> {
        Box::new(JsonDecoder { json_type: *self, fields: fields.clone() })
    }
}

fn object_properties(schema: &Value) -> Option<&Map<String, Value>> {
    schema.get("properties")?.as_object().filter(|p| !p.is_empty())
}

fn object_fields(properties: &Map<String, Value>, depth: usize, leaves: &mut usize) -> Result<Fields, String> {
    let one = |(name, schema): (&String, &Value)| Ok(Field::new(name, column_type(schema, depth, leaves)?, true));
    properties.iter().map(one).collect()
}

// What has no type of its own, such as a choice of several, is given as JSON.
fn column_type(schema: &Value, depth: usize, leaves: &mut usize) -> Result<DataType, String> {
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
        Some("integer") => integer_type_of(schema),
        Some("boolean") => DataType::Boolean,
        Some("array") if depth < DEEPEST => match schema.get("items") {
            Some(items) => {
                let child = column_type(items, depth + 1, leaves)?;
                DataType::List(Arc::new(Field::new(LIST_CHILD, child, true)))
            }
            None => DataType::Utf8,
        },
        Some("object") if depth < DEEPEST => match object_properties(schema) {
            Some(properties) => DataType::Struct(object_fields(properties, depth + 1, leaves)?),
            None => DataType::Utf8,
        },
        _ => DataType::Utf8,
    })
}

// 64 bits with a sign if the schema bounds it so. Of others nobody knows the sign, and JSON's numbers are commonly
// those of 64 bits with a sign or without.
fn integer_type_of(schema: &Value) -> DataType {
    let bounded = |name| schema.get(name).is_some_and(Value::is_i64);
    let format = schema.get("format").and_then(Value::as_str);
    let is_named = format.is_some_and(|name| matches!(name, "int8" | "int16" | "int32" | "int64"));
    match is_named || (bounded("minimum") && bounded("maximum")) {
        true => DataType::Int64,
        false => integer_type(),
    }
}

/// Decodes messages.
struct JsonDecoder {
    json_type: JsonType,
    fields: Fields,
}

impl MessageDecoder for JsonDecoder {
    fn decode_message(
        &mut self,
        message: &[u8],
        columns: &mut [Column],
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        match (self.json_type, columns) {
            // Nothing is asked of the message: it is not parsed.
            (_, []) => Ok(()),
            (JsonType::Text, [Column::Text(text), ..]) => {
                tally.add_bytes(message.len())?;
                append_text(text, message);
                Ok(())
            }
            (_, columns) => {
                let message = parse_message(message, tally)?;
                let message = message.as_object().ok_or(NO_OBJECT)?;
                push_members(columns, &self.fields, message, tally)
            }
        }
    }
}

fn parse_message(message: &[u8], tally: &mut RowTally) -> Result<Value, Malformed> {
    RowTally::default().add_bytes(message.len().saturating_mul(PARSED))?;
    let message = strip_byte_order_mark(message);
    if let Ok(message) = serde_json::from_slice(message) {
        return Ok(message);
    }
    let (text, replaced) = without_no_numbers(message);
    let message = serde_json::from_slice(&text).map_err(|_| NO_OBJECT)?;
    tally.unfit += replaced;
    Ok(message)
}

// The text with null in the place of NaN, infinities and numbers that 64 bits do not have, and how many there were.
fn without_no_numbers(data: &[u8]) -> (Vec<u8>, usize) {
    let mut text = Vec::with_capacity(data.len());
    let mut replaced = 0;
    let mut at = 0;
    let mut in_string = false;
    while at < data.len() {
        let rest = &data[at..];
        let name = NO_NUMBERS.iter().find(|name| !in_string && rest.starts_with(name.as_bytes()));
        let number = match name {
            Some(name) => name.len(),
            None if in_string => 0,
            None => number_length(rest),
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

fn push_members(
    columns: &mut [Column],
    fields: &Fields,
    members: &Map<String, Value>,
    tally: &mut RowTally,
) -> Result<(), Malformed> {
    for (field, column) in fields.iter().zip(columns) {
        push_value(column, field.data_type(), members.get(field.name()), tally)?;
    }
    Ok(())
}

fn push_value(
    column: &mut Column,
    kind: &DataType,
    value: Option<&Value>,
    tally: &mut RowTally,
) -> Result<(), Malformed> {
    let Some(value) = value.filter(|v| !v.is_null()) else {
        column.append_null();
        return Ok(());
    };
    match (column, kind, value) {
        (Column::F64(c), _, Value::Number(n)) if n.as_f64().is_some() => c.append_option(n.as_f64()),
        (Column::I64(c), _, Value::Number(n)) => {
            let value = integer_of(n).and_then(|value| i64::try_from(value).ok());
            tally.unfit += usize::from(value.is_none());
            c.append_option(value);
        }
        (Column::Decimal(c), _, Value::Number(n)) => {
            let value = integer_of(n);
            tally.unfit += usize::from(value.is_none());
            c.append_option(value);
        }
        (Column::Bool(c), _, Value::Bool(b)) => c.append_value(*b),
        (Column::Text(c), _, Value::String(text)) => {
            tally.add_bytes(text.len())?;
            c.append_value(text.as_bytes());
        }
        (Column::Text(c), _, other) => {
            let text = other.to_string();
            tally.add_bytes(text.len())?;
            c.append_value(text.as_bytes());
        }
        (Column::List(list), DataType::List(child), Value::Array(values)) => {
            let each = value_width(child.data_type());
            for value in values {
                tally.add_bytes(each)?;
                push_value(&mut list.values, child.data_type(), Some(value), tally)?;
            }
            list.end_row();
        }
        (Column::Struct(record), DataType::Struct(fields), Value::Object(members)) => {
            push_members(&mut record.columns, fields, members, tally)?;
            record.end_row();
        }
        (other, _, _) => {
            tally.unfit += 1;
            other.append_null();
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

#[cfg(test)]
mod tests;
