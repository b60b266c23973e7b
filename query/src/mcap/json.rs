//! JSON messages into columns: by their schema's properties, else as one column `json` with the text.
//!
//! A value that does not fit its column's type is null: nothing in a JSON channel binds its writer to the schema.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;
use serde_json::{Map, Value};

use super::column::{Column, DEEPEST, MOST_LEAVES, Record, width};
use super::error::{Malformed, Spent};

/// A parsed value takes about this many bytes for each byte of its text, at worst.
const PARSED: usize = 16;

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
        Some("integer") => DataType::Int64,
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

/// Decodes messages.
pub(super) struct Decoder {
    shape: Shape,
    fields: Fields,
    record: Record,
    width: usize,
    pub(super) spent: Spent,
}

impl Decoder {
    pub(super) fn new(shape: Shape, all: &Fields, wanted: &[usize]) -> Self {
        let fields: Fields = wanted.iter().map(|i| all[*i].clone()).collect();
        let width = fields.iter().map(|f| width(f.data_type())).sum();
        Self { shape, record: Record::new(&fields), fields, width, spent: Spent::default() }
    }

    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        self.spent.add(self.width)?;
        if self.shape == Shape::Text {
            self.spent.add(data.len())?;
            for column in &mut self.record.columns {
                if let Column::Text(c) = column {
                    c.push_text(data);
                }
            }
            return Ok(());
        }
        // Nothing is asked of the message: it is not parsed.
        if self.record.columns.is_empty() {
            return Ok(());
        }
        Spent::default().add(data.len().saturating_mul(PARSED))?;
        let message: Value = serde_json::from_slice(data).map_err(|_| Malformed::Json)?;
        let message = message.as_object().ok_or(Malformed::Json)?;
        for (field, column) in self.fields.iter().zip(&mut self.record.columns) {
            push(column, field.data_type(), message.get(field.name()), &mut self.spent)?;
        }
        Ok(())
    }

    pub(super) fn columns(&mut self) -> &mut [Column] {
        self.spent = Spent::default();
        &mut self.record.columns
    }
}

fn push(column: &mut Column, kind: &DataType, value: Option<&Value>, spent: &mut Spent) -> Result<(), Malformed> {
    let Some(value) = value.filter(|v| !v.is_null()) else {
        column.push_null();
        return Ok(());
    };
    match (column, kind, value) {
        (Column::F64(c), _, Value::Number(n)) if n.as_f64().is_some() => c.push(n.as_f64().unwrap_or(f64::NAN)),
        (Column::I64(c), _, Value::Number(n)) if n.as_i64().is_some() => c.push(n.as_i64().unwrap_or(0)),
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
                push(&mut list.values, child.data_type(), Some(value), spent)?;
            }
            list.end_row();
        }
        (Column::Struct(record), DataType::Struct(fields), Value::Object(members)) => {
            for (field, column) in fields.iter().zip(&mut record.columns) {
                push(column, field.data_type(), members.get(field.name()), spent)?;
            }
            record.end_row();
        }
        (other, _, _) => other.push_null(),
    }
    Ok(())
}
