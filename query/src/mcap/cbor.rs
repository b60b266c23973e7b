//! CBOR as JSON values: what JSON lacks is the nearest that it has.

use cbor4ii::core::Value as CborValue;
use cbor4ii::core::dec::{Decode as _, Read as _};
use cbor4ii::core::utils::SliceReader;
use serde_json::{Map, Number, Value};

use super::error::Malformed;

/// Parses one message. Bytes are text in hexadecimal, what is no number is null, keys are texts.
pub(super) fn parse(data: &[u8]) -> Result<Value, Malformed> {
    let mut reader = SliceReader::new(data);
    let value = CborValue::decode(&mut reader).map_err(|_| Malformed::Cbor)?;
    let is_whole = reader.fill(1).is_ok_and(|rest| rest.as_ref().is_empty());
    if is_whole { Ok(json_of(value)) } else { Err(Malformed::Cbor) }
}

fn json_of(value: CborValue) -> Value {
    match value {
        CborValue::Integer(integer) => number(integer),
        CborValue::Float(float) => Number::from_f64(float).map_or(Value::Null, Value::Number),
        CborValue::Bool(value) => Value::Bool(value),
        CborValue::Text(text) => Value::String(text),
        CborValue::Bytes(bytes) => Value::String(hex::encode(bytes)),
        CborValue::Array(values) => Value::Array(values.into_iter().map(json_of).collect()),
        CborValue::Map(entries) => Value::Object(entries.into_iter().map(entry).collect::<Map<_, _>>()),
        // A tag says how to read a value, such as a time, and is no part of it.
        CborValue::Tag(_, value) => json_of(*value),
        _ => Value::Null,
    }
}

fn number(integer: i128) -> Value {
    let exact = i64::try_from(integer).map(Number::from).or_else(|_| u64::try_from(integer).map(Number::from));
    exact.ok().or_else(|| Number::from_f64(integer as f64)).map_or(Value::Null, Value::Number)
}

fn entry((key, value): (CborValue, CborValue)) -> (String, Value) {
    let key = match key {
        CborValue::Text(text) => text,
        other => json_of(other).to_string(),
    };
    (key, json_of(value))
}
