//! Rows as a Parquet file, in the layout that the lake's readers want.

use std::sync::Arc;

use arrow::array::{Array, AsArray as _};
use arrow::compute::{max, max_string, min, min_string};
use arrow::datatypes::{DataType, Float32Type, Float64Type, Int32Type, Int64Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use echolake_schema::tables::{LIST_CHILD, Table};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_writer::ArrowWriterOptions;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;
use serde_json::{Map, Value, json};

use crate::{Error, Result};

/// Size of a data page: a reader of one response fetches one page, which also bounds what it decodes.
const PAGE_BYTES: usize = 128 * 1024;
/// Size that a row group grows to, before encoding.
const ROW_GROUP_BYTES: usize = 64 << 20;
/// Delta reads statistics of this many leading columns.
const STATS_COLUMNS: usize = 32;
/// Longest text that statistics keep: Delta readers compare prefixes, and parameters are long.
const STATS_TEXT: usize = 64;

/// Encodes rows; returns the file's bytes and Delta's statistics of it as JSON.
///
/// # Errors
/// [`Error::Encode`] where the batches do not have the table's schema.
pub fn encode(table: Table, schema: &SchemaRef, batches: &[RecordBatch]) -> Result<(Bytes, String)> {
    let failed = |e: ParquetError| Error::Encode { table: table.name(), reason: e.to_string() };
    let options = ArrowWriterOptions::new().with_properties(properties(schema, batches)).with_skip_arrow_metadata(true);
    let mut writer = ArrowWriter::try_new_with_options(Vec::new(), schema.clone(), options).map_err(failed)?;
    for batch in batches {
        writer.write(batch).map_err(failed)?;
    }
    let bytes = writer.into_inner().map_err(failed)?;
    Ok((bytes.into(), stats(schema, batches).to_string()))
}

// Samples do not repeat, so a dictionary only costs; their bytes by significance compress best
// (measured on dB spectra: 0.74 of raw f32 against 1.00 with the defaults).
fn properties(schema: &SchemaRef, batches: &[RecordBatch]) -> WriterProperties {
    let rows: usize = batches.iter().map(RecordBatch::num_rows).sum();
    let bytes: usize = batches.iter().map(RecordBatch::get_array_memory_size).sum();
    let rows_a_group = (ROW_GROUP_BYTES * rows.max(1) / bytes.max(1)).max(1);
    let mut builder = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(3).unwrap_or_default()))
        .set_created_by(concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned())
        .set_data_page_size_limit(PAGE_BYTES)
        .set_max_row_group_row_count(Some(rows_a_group))
        .set_statistics_enabled(EnabledStatistics::Page);
    for field in schema.fields() {
        let name = field.name().clone();
        let column = match field.data_type() {
            DataType::List(_) => ColumnPath::new(vec![name, "list".into(), LIST_CHILD.into()]),
            DataType::Float32 | DataType::Float64 => ColumnPath::new(vec![name]),
            _ => continue,
        };
        builder = builder
            .set_column_dictionary_enabled(column.clone(), false)
            .set_column_encoding(column.clone(), Encoding::BYTE_STREAM_SPLIT);
        if matches!(field.data_type(), DataType::List(_)) {
            builder = builder.set_column_statistics_enabled(column, EnabledStatistics::None);
        }
    }
    builder.build()
}

fn stats(schema: &SchemaRef, batches: &[RecordBatch]) -> Value {
    let rows: usize = batches.iter().map(RecordBatch::num_rows).sum();
    let (mut least, mut greatest, mut nulls) = (Map::new(), Map::new(), Map::new());
    for (index, field) in schema.fields().iter().enumerate().take(STATS_COLUMNS) {
        let columns: Vec<_> = batches.iter().map(|b| b.column(index).clone()).collect();
        if matches!(field.data_type(), DataType::List(_) | DataType::Boolean | DataType::Timestamp(..)) {
            continue;
        }
        let count: usize = columns.iter().map(|c| c.null_count()).sum();
        nulls.insert(field.name().clone(), count.into());
        if let Some((low, high)) = extremes(&columns) {
            least.insert(field.name().clone(), low);
            greatest.insert(field.name().clone(), high);
        }
    }
    json!({ "numRecords": rows, "minValues": least, "maxValues": greatest, "nullCount": nulls })
}

fn extremes(columns: &[Arc<dyn Array>]) -> Option<(Value, Value)> {
    let pairs: Vec<_> = columns.iter().map(extremes_of).collect::<Option<Vec<_>>>()?;
    let low = pairs.iter().map(|p| &p.0).reduce(|a, b| if less(b, a) { b } else { a })?;
    let high = pairs.iter().map(|p| &p.1).reduce(|a, b| if less(a, b) { b } else { a })?;
    Some((low.clone(), high.clone()))
}

fn extremes_of(column: &Arc<dyn Array>) -> Option<(Value, Value)> {
    match column.data_type() {
        DataType::Int32 => {
            let ints = column.as_primitive::<Int32Type>();
            Some((min(ints)?.into(), max(ints)?.into()))
        }
        DataType::Int64 => {
            let longs = column.as_primitive::<Int64Type>();
            Some((min(longs)?.into(), max(longs)?.into()))
        }
        DataType::Float32 => {
            let floats = column.as_primitive::<Float32Type>();
            finite(f64::from(min(floats)?), f64::from(max(floats)?))
        }
        DataType::Float64 => {
            let doubles = column.as_primitive::<Float64Type>();
            finite(min(doubles)?, max(doubles)?)
        }
        DataType::Utf8 => {
            let texts = column.as_string::<i32>();
            let (low, high) = (min_string(texts)?, max_string(texts)?);
            (low.len() <= STATS_TEXT && high.len() <= STATS_TEXT).then(|| (low.into(), high.into()))
        }
        _ => None,
    }
}

// Arrow orders NaN above all numbers, JSON has none: a column with one gets no statistics.
fn finite(low: f64, high: f64) -> Option<(Value, Value)> {
    (low.is_finite() && high.is_finite()).then(|| (low.into(), high.into()))
}

fn less(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::String(a), Value::String(b)) => a < b,
        _ => match (a.as_i64(), b.as_i64()) {
            (Some(a), Some(b)) => a < b,
            _ => a.as_f64() < b.as_f64(),
        },
    }
}

#[cfg(test)]
mod tests {
    use arrow::array::{Float64Array, Int32Array, StringArray};
    use arrow::datatypes::{Field, Schema};

    use super::*;

    #[test]
    fn statistics_span_the_batches_and_skip_nan() {
        let schema: SchemaRef = Arc::new(Schema::new(vec![
            Field::new("id", DataType::Int32, false),
            Field::new("name", DataType::Utf8, true),
            Field::new("x", DataType::Float64, false),
        ]));
        let batch = |ids: Vec<i32>, names: Vec<Option<&str>>, x: Vec<f64>| {
            let columns: Vec<Arc<dyn Array>> = vec![
                Arc::new(Int32Array::from(ids)),
                Arc::new(StringArray::from(names)),
                Arc::new(Float64Array::from(x)),
            ];
            RecordBatch::try_new(schema.clone(), columns).expect("a batch")
        };
        let batches = [
            batch(vec![7, -2], vec![Some("b"), None], vec![1.0, f64::NAN]),
            batch(vec![3], vec![Some("a")], vec![0.0]),
        ];
        let expected = json!({
            "numRecords": 3,
            "minValues": { "id": -2, "name": "a" },
            "maxValues": { "id": 7, "name": "b" },
            "nullCount": { "id": 0, "name": 1, "x": 0 },
        });
        assert_eq!(stats(&schema, &batches), expected);
    }
}
