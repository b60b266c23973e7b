//! Checkpoints: the reconciled actions up to a version as one Parquet file, so that a reader starts there.
//!
//! Rows go from actions to Arrow and back as JSON, which both sides already speak.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields, Schema};
use arrow::error::ArrowError;
use bytes::Bytes;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::arrow::arrow_writer::{ArrowWriter, ArrowWriterOptions};
use parquet::basic::{Compression, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;

use super::actions::LogLine;

/// Errors of reading or writing a checkpoint.
#[derive(Debug, thiserror::Error)]
pub(super) enum CheckpointError {
    #[error(transparent)]
    Parquet(#[from] ParquetError),
    #[error(transparent)]
    Arrow(#[from] ArrowError),
    #[error(transparent)]
    Action(#[from] serde_json::Error),
}

/// A checkpoint's bytes.
pub(super) fn encode_checkpoint(lines: &[LogLine]) -> Result<Vec<u8>, CheckpointError> {
    let schema = Arc::new(checkpoint_schema());
    let mut decoder =
        arrow::json::ReaderBuilder::new(schema.clone()).with_batch_size(lines.len().max(1)).build_decoder()?;
    decoder.serialize(lines)?;
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::try_new(1)?)).build();
    let options = ArrowWriterOptions::new().with_properties(properties).with_skip_arrow_metadata(true);
    let mut writer = ArrowWriter::try_new_with_options(Vec::new(), schema, options)?;
    if let Some(rows) = decoder.flush()? {
        writer.write(&rows)?;
    }
    Ok(writer.into_inner()?)
}

/// A checkpoint's actions.
pub(super) fn decode_checkpoint(file: Bytes) -> Result<Vec<LogLine>, CheckpointError> {
    let builder = ParquetRecordBatchReaderBuilder::try_new(file)?;
    // What other writers repeat in columns of the table's own types is in the JSON beside them, too.
    let known = builder.parquet_schema().columns().iter().enumerate().filter_map(|(leaf, column)| {
        let repeated = column.path().parts().get(1).is_some_and(|name| name.ends_with("_parsed"));
        (!repeated).then_some(leaf)
    });
    let mask = ProjectionMask::leaves(builder.parquet_schema(), known);
    let mut lines = Vec::new();
    for batch in builder.with_projection(mask).build()? {
        let mut json = arrow::json::LineDelimitedWriter::new(Vec::new());
        json.write(&batch?)?;
        json.finish()?;
        for line in serde_json::Deserializer::from_slice(&json.into_inner()).into_iter() {
            lines.push(line?);
        }
    }
    Ok(lines)
}

fn checkpoint_schema() -> Schema {
    let text = |name: &str| Field::new(name, DataType::Utf8, true);
    let long = |name: &str| Field::new(name, DataType::Int64, true);
    let int = |name: &str| Field::new(name, DataType::Int32, true);
    let flag = |name: &str| Field::new(name, DataType::Boolean, true);
    let action = |name: &str, fields: Vec<Field>| Field::new_struct(name, fields, true);
    Schema::new(vec![
        action("txn", vec![text("appId"), long("version"), long("lastUpdated")]),
        action(
            "add",
            vec![
                text("path"),
                text_map("partitionValues"),
                long("size"),
                long("modificationTime"),
                flag("dataChange"),
                text("stats"),
                text_map("tags"),
            ],
        ),
        action(
            "remove",
            vec![
                text("path"),
                long("deletionTimestamp"),
                flag("dataChange"),
                flag("extendedFileMetadata"),
                text_map("partitionValues"),
                long("size"),
            ],
        ),
        action(
            "metaData",
            vec![
                text("id"),
                text("name"),
                text("description"),
                action("format", vec![text("provider"), text_map("options")]),
                text("schemaString"),
                Field::new_list("partitionColumns", Field::new("element", DataType::Utf8, true), true),
                text_map("configuration"),
                long("createdTime"),
            ],
        ),
        action("protocol", vec![int("minReaderVersion"), int("minWriterVersion")]),
    ])
}

fn text_map(name: &str) -> Field {
    let entries =
        Fields::from(vec![Field::new("key", DataType::Utf8, false), Field::new("value", DataType::Utf8, true)]);
    Field::new_map(name, "key_value", entries[0].clone(), entries[1].clone(), false, true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_come_back_as_they_were_written() {
        let lines: Vec<LogLine> = [
            r#"{"protocol":{"minReaderVersion":1,"minWriterVersion":2}}"#,
            r#"{"metaData":{"id":"x","name":"nce","format":{"provider":"parquet","options":{}},
                "schemaString":"{\"type\":\"struct\"}","partitionColumns":[],"configuration":{"a":"b"},"createdTime":5}}"#,
            r#"{"txn":{"appId":"spark","version":7}}"#,
            r#"{"add":{"path":"a","partitionValues":{},"size":1,"modificationTime":1,"dataChange":false,
                "stats":"{\"numRecords\":3}","tags":{"echolake.parts":"x"}}}"#,
            r#"{"add":{"path":"b","partitionValues":{},"size":9007199254740993,"modificationTime":1,"dataChange":true}}"#,
            r#"{"remove":{"path":"c","deletionTimestamp":5,"dataChange":false,"extendedFileMetadata":true,
                "partitionValues":{},"size":3}}"#,
        ]
        .iter()
        .map(|json| serde_json::from_str(json).expect("a line"))
        .collect();
        let file = encode_checkpoint(&lines).expect("encoded");
        assert_eq!(decode_checkpoint(file.into()).expect("decoded"), lines);
    }

    #[test]
    fn what_is_no_checkpoint_is_an_error() {
        for bytes in [&b""[..], b"PAR1 but no more", b"{}"] {
            assert!(decode_checkpoint(Bytes::from_static(bytes)).is_err(), "{bytes:?}");
        }
    }
}
