//! Answers as text and files: table, CSV, JSON, Parquet and Arrow, written as batches arrive.

use std::collections::HashSet;
use std::fmt::Write as _;
use std::io::Write;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, RecordBatch, StringArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::util::display::{ArrayFormatter, FormatOptions};
use arrow::util::pretty::pretty_format_batches;
use echolake_schema::escape_controls;
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;

use crate::Error;

/// Number of list values shown in a table.
const SHOWN: usize = 3;
/// Maximum rows of a table: all of them are buffered to compute the column widths.
pub const TABLE_ROWS: usize = 10_000;

/// Maximum size of a row group of a Parquet answer, bytes: a row group is buffered until it ends.
const ROW_GROUP_BYTES: usize = 16 << 20;

/// A format of answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AnswerFormat {
    /// Text for people: lists are shortened, rows after [`TABLE_ROWS`] are only counted, and characters that would
    /// drive a terminal are escaped.
    Table,
    /// Comma-separated, lists as JSON.
    Csv,
    /// CSV whose texts no spreadsheet takes for formulas: `'` stands before a text, or a column's name, that begins
    /// with `=`, `+`, `-`, `@`, a tab or a carriage return. Numbers stay as they are.
    SpreadsheetCsv,
    /// One array of objects.
    Json,
    /// Parquet, zstd.
    Parquet,
    /// Arrow IPC stream.
    Arrow,
}

impl AnswerFormat {
    /// All formats.
    pub const ALL: [Self; 6] = [Self::Table, Self::Csv, Self::SpreadsheetCsv, Self::Json, Self::Parquet, Self::Arrow];

    /// Returns its name; both forms of CSV have the same.
    pub fn name(self) -> &'static str {
        match self {
            Self::Table => "table",
            Self::Csv | Self::SpreadsheetCsv => "csv",
            Self::Json => "json",
            Self::Parquet => "parquet",
            Self::Arrow => "arrow",
        }
    }

    /// Returns whether its output is binary.
    pub fn is_binary(self) -> bool {
        matches!(self, Self::Parquet | Self::Arrow)
    }
}

/// Writes the batches of one answer.
///
/// ```
/// use arrow::array::{ArrayRef, Int32Array, RecordBatch};
/// use echolake_query::output::{AnswerFormat, AnswerWriter};
///
/// let pairs: ArrayRef = std::sync::Arc::new(Int32Array::from(vec![7, 8]));
/// let batch = RecordBatch::try_from_iter([("pair_id", pairs)])?;
/// let mut text = Vec::new();
/// let mut writer = AnswerWriter::new(AnswerFormat::Json, &batch.schema(), &mut text)?;
/// writer.write(&batch)?;
/// assert_eq!(writer.finish()?, 2);
/// assert_eq!(text, b"[{\"pair_id\":7},{\"pair_id\":8}]\n");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct AnswerWriter<W: Write + Send> {
    format: AnswerFormat,
    schema: SchemaRef,
    rows: usize,
    inner: FormatWriter<W>,
}

enum FormatWriter<W: Write + Send> {
    Table(W, Vec<RecordBatch>),
    Csv(W, Vec<u8>),
    SpreadsheetCsv(W, Vec<u8>),
    Json(arrow::json::ArrayWriter<W>),
    Parquet(Box<ArrowWriter<W>>),
    Arrow(arrow::ipc::writer::StreamWriter<W>),
}

impl<W: Write + Send> AnswerWriter<W> {
    /// Creates a writer for an answer of this schema.
    ///
    /// # Errors
    /// [`Error::Format`] or [`Error::Write`].
    pub fn new(format: AnswerFormat, schema: &SchemaRef, to: W) -> Result<Self, Error> {
        if matches!(format, AnswerFormat::Json | AnswerFormat::Parquet) {
            one_name_each(format, schema)?;
        }
        let inner = match format {
            AnswerFormat::Table => FormatWriter::Table(to, Vec::new()),
            AnswerFormat::Csv => {
                let mut to = to;
                let mut text = Vec::new();
                // A header even if there are no rows.
                write_csv(&mut to, &mut text, &RecordBatch::new_empty(flat_schema(schema)), true)?;
                FormatWriter::Csv(to, text)
            }
            AnswerFormat::SpreadsheetCsv => {
                let mut to = to;
                let mut text = Vec::new();
                let header = escape_formulas(&RecordBatch::new_empty(flat_schema(schema)));
                write_csv(&mut to, &mut text, &header.map_err(|e| arrow_error(format, e))?, true)?;
                FormatWriter::SpreadsheetCsv(to, text)
            }
            AnswerFormat::Json => {
                FormatWriter::Json(arrow::json::WriterBuilder::new().with_explicit_nulls(true).build(to))
            }
            AnswerFormat::Parquet => {
                let zstd = Compression::ZSTD(ZstdLevel::try_new(3).unwrap_or_default());
                let properties = WriterProperties::builder()
                    .set_compression(zstd)
                    .set_max_row_group_bytes(Some(ROW_GROUP_BYTES))
                    .build();
                let writer = ArrowWriter::try_new(to, schema.clone(), Some(properties));
                FormatWriter::Parquet(Box::new(writer.map_err(parquet_error)?))
            }
            AnswerFormat::Arrow => {
                let writer = arrow::ipc::writer::StreamWriter::try_new(to, schema);
                FormatWriter::Arrow(writer.map_err(|e| arrow_error(format, e))?)
            }
        };
        Ok(Self { format, schema: schema.clone(), rows: 0, inner })
    }

    /// Writes a batch.
    ///
    /// # Errors
    /// As [`AnswerWriter::new`].
    pub fn write(&mut self, batch: &RecordBatch) -> Result<(), Error> {
        let room = TABLE_ROWS.saturating_sub(self.rows).min(batch.num_rows());
        self.rows += batch.num_rows();
        let failed = |e| arrow_error(self.format, e);
        match &mut self.inner {
            FormatWriter::Table(_, batches) if room > 0 => {
                let shown = flatten_columns(&batch.slice(0, room), short_list);
                batches.push(shown.and_then(|shown| map_texts(&shown, escape_controls)).map_err(failed)?);
            }
            FormatWriter::Table(..) => {}
            FormatWriter::Csv(to, text) => {
                write_csv(to, text, &flatten_columns(batch, json_list).map_err(failed)?, false)?
            }
            FormatWriter::SpreadsheetCsv(to, text) => {
                let escaped = flatten_columns(batch, json_list).and_then(|batch| escape_formulas(&batch));
                write_csv(to, text, &escaped.map_err(failed)?, false)?;
            }
            FormatWriter::Json(writer) => writer.write(batch).map_err(failed)?,
            FormatWriter::Parquet(writer) => writer.write(batch).map_err(parquet_error)?,
            FormatWriter::Arrow(writer) => writer.write(batch).map_err(failed)?,
        }
        Ok(())
    }

    /// Ends the answer; returns its number of rows.
    ///
    /// # Errors
    /// As [`AnswerWriter::new`].
    pub fn finish(self) -> Result<usize, Error> {
        let failed = |e| arrow_error(self.format, e);
        match self.inner {
            FormatWriter::Table(mut to, batches) => {
                let batches = match batches.is_empty() {
                    true => vec![map_texts(&RecordBatch::new_empty(flat_schema(&self.schema)), escape_controls)],
                    false => batches.into_iter().map(Ok).collect(),
                };
                let batches = batches.into_iter().collect::<Result<Vec<_>, _>>().map_err(failed)?;
                writeln!(to, "{}", pretty_format_batches(&batches).map_err(failed)?)?;
                to.flush()?;
            }
            FormatWriter::Csv(mut to, _) | FormatWriter::SpreadsheetCsv(mut to, _) => to.flush()?,
            FormatWriter::Json(mut writer) => {
                writer.finish().map_err(failed)?;
                let mut to = writer.into_inner();
                writeln!(to)?;
                to.flush()?;
            }
            // `finish` flushes, and unlike `into_inner` it keeps the system's error.
            FormatWriter::Parquet(mut writer) => writer.finish().map(drop).map_err(parquet_error)?,
            FormatWriter::Arrow(writer) => writer.into_inner().map_err(failed)?.flush()?,
        }
        Ok(self.rows)
    }
}

// Through a buffer: arrow's writer turns the system's error into text, and a closed pipe could not be recognised.
fn write_csv(to: &mut impl Write, text: &mut Vec<u8>, batch: &RecordBatch, header: bool) -> Result<(), Error> {
    text.clear();
    arrow::csv::WriterBuilder::new()
        .with_header(header)
        .build(&mut *text)
        .write(batch)
        .map_err(|e| arrow_error(AnswerFormat::Csv, e))?;
    Ok(to.write_all(text)?)
}

// Texts and names as `AnswerFormat::SpreadsheetCsv` has them.
fn escape_formulas(batch: &RecordBatch) -> Result<RecordBatch, ArrowError> {
    map_texts(batch, |text| match text.starts_with(['=', '+', '-', '@', '\t', '\r']) {
        true => format!("'{text}"),
        false => text.to_owned(),
    })
}

// Changes the texts and the names of columns.
fn map_texts(batch: &RecordBatch, escaped: impl Fn(&str) -> String) -> Result<RecordBatch, ArrowError> {
    let schema = batch.schema();
    let mut fields = Vec::with_capacity(batch.num_columns());
    let mut columns = Vec::with_capacity(batch.num_columns());
    for (field, column) in schema.fields().iter().zip(batch.columns()) {
        let kind = match field.data_type() {
            DataType::Dictionary(_, values) => values,
            other => other,
        };
        let is_text = matches!(kind, DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View);
        let column = match is_text {
            true => {
                let texts = cast(column, &DataType::Utf8)?;
                let texts: StringArray = texts.as_string::<i32>().iter().map(|text| text.map(&escaped)).collect();
                Arc::new(texts) as ArrayRef
            }
            false => column.clone(),
        };
        fields.push(Field::new(escaped(field.name()), column.data_type().clone(), true));
        columns.push(column);
    }
    RecordBatch::try_new(Arc::new(Schema::new(fields)), columns)
}

// Readers of JSON objects and of Parquet find columns by name.
fn one_name_each(format: AnswerFormat, schema: &SchemaRef) -> Result<(), Error> {
    let mut seen = HashSet::new();
    match schema.fields().iter().find(|field| !seen.insert(field.name())) {
        None => Ok(()),
        Some(field) => {
            let source = format!("two columns are called `{}`; hint: name one with AS", field.name()).into();
            Err(Error::Format { format: format.name(), source })
        }
    }
}

// Keeps the system's own error, so that a closed pipe can be recognised.
fn arrow_error(format: AnswerFormat, error: ArrowError) -> Error {
    match error {
        ArrowError::IoError(_, source) => Error::Write(source),
        other => Error::Format { format: format.name(), source: other.into() },
    }
}

fn parquet_error(error: ParquetError) -> Error {
    match error {
        ParquetError::External(source) => match source.downcast::<std::io::Error>() {
            Ok(source) => Error::Write(*source),
            Err(other) => Error::Format { format: "parquet", source: other },
        },
        other => Error::Format { format: "parquet", source: other.into() },
    }
}

fn flat_schema(schema: &SchemaRef) -> SchemaRef {
    let fields = schema.fields().iter().map(|field| match field.data_type().is_nested() {
        true => Field::new(field.name(), DataType::Utf8, true),
        false => field.as_ref().clone(),
    });
    Arc::new(Schema::new(fields.collect::<Vec<_>>()))
}

// Returns the batch with each nested column as text.
fn flatten_columns(
    batch: &RecordBatch,
    text: fn(&ArrayRef) -> Result<Vec<String>, ArrowError>,
) -> Result<RecordBatch, ArrowError> {
    let columns = batch.columns().iter().map(|column| {
        if !column.data_type().is_nested() {
            return Ok(column.clone());
        }
        let mut texts = Vec::with_capacity(column.len());
        for row in 0..column.len() {
            let value = match column.is_null(row) {
                true => None,
                false => Some(match column.as_list_opt::<i32>() {
                    Some(list) => join_values(&text(&list.value(row))?, list.value(row).len()),
                    None => display_value(column, row)?,
                }),
            };
            texts.push(value);
        }
        Ok(Arc::new(StringArray::from(texts)) as ArrayRef)
    });
    RecordBatch::try_new(flat_schema(&batch.schema()), columns.collect::<Result<_, ArrowError>>()?)
}

fn join_values(shown: &[String], count: usize) -> String {
    let mut text = format!("[{}", shown.join(","));
    if shown.len() < count {
        let _ = write!(text, ", ... {count} values");
    }
    text.push(']');
    text
}

fn short_list(values: &ArrayRef) -> Result<Vec<String>, ArrowError> {
    (0..values.len().min(SHOWN)).map(|i| display_value(values, i)).collect()
}

fn json_list(values: &ArrayRef) -> Result<Vec<String>, ArrowError> {
    let is_text = matches!(values.data_type(), DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View);
    let one = |i| match (values.is_null(i), is_text) {
        (true, _) => Ok("null".to_owned()),
        (false, true) => Ok(serde_json::Value::from(display_value(values, i)?).to_string()),
        (false, false) => display_value(values, i),
    };
    (0..values.len()).map(one).collect()
}

fn display_value(array: &ArrayRef, row: usize) -> Result<String, ArrowError> {
    Ok(ArrayFormatter::try_new(array, &FormatOptions::default())?.value(row).to_string())
}

#[cfg(test)]
mod tests {
    use arrow::array::{Float32Array, Int64Array, ListArray, TimestampMicrosecondArray};
    use arrow::buffer::OffsetBuffer;
    use arrow::datatypes::TimeUnit;
    use expect_test::expect;

    use super::*;

    fn batch() -> RecordBatch {
        let child = Arc::new(Field::new("element", DataType::Float32, false));
        let values = Float32Array::from(vec![0.5, -1.0, 2.0, 3.0, 1e-9]);
        let list = ListArray::new(child.clone(), OffsetBuffer::from_lengths([4, 1]), Arc::new(values), None);
        let time = TimestampMicrosecondArray::from(vec![Some(1_767_600_000_000_000), None]).with_timezone("UTC");
        let schema = Schema::new(vec![
            Field::new("id", DataType::Int64, true),
            Field::new("name", DataType::Utf8, true),
            Field::new("ir", DataType::List(child), true),
            Field::new("at", DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into())), true),
        ]);
        let columns: Vec<ArrayRef> = vec![
            Arc::new(Int64Array::from(vec![Some(1), None])),
            Arc::new(StringArray::from(vec![Some("a,\"b\""), None])),
            Arc::new(list),
            Arc::new(time),
        ];
        RecordBatch::try_new(Arc::new(schema), columns).expect("a batch")
    }

    fn written(format: AnswerFormat) -> Vec<u8> {
        let (batch, mut out) = (batch(), Vec::new());
        let mut writer = AnswerWriter::new(format, &batch.schema(), &mut out).expect("begun");
        writer.write(&batch).expect("written");
        assert_eq!(writer.finish().expect("finished"), 2);
        out
    }

    fn text(format: AnswerFormat) -> String {
        String::from_utf8(written(format)).expect("text")
    }

    #[test]
    fn text_formats() {
        expect![[r#"
            +----+-------+------------------------------+----------------------+
            | id | name  | ir                           | at                   |
            +----+-------+------------------------------+----------------------+
            | 1  | a,"b" | [0.5,-1.0,2.0, ... 4 values] | 2026-01-05T08:00:00Z |
            |    |       | [1e-9]                       |                      |
            +----+-------+------------------------------+----------------------+
        "#]]
        .assert_eq(&text(AnswerFormat::Table));
        expect![[r#"
            id,name,ir,at
            1,"a,""b""","[0.5,-1.0,2.0,3.0]",2026-01-05T08:00:00Z
            ,,[1e-9],
        "#]]
        .assert_eq(&text(AnswerFormat::Csv));
        expect![[r#"
            [{"id":1,"name":"a,\"b\"","ir":[0.5,-1.0,2.0,3.0],"at":"2026-01-05T08:00:00Z"},{"id":null,"name":null,"ir":[1.0e-9],"at":null}]
        "#]].assert_eq(&text(AnswerFormat::Json));
    }

    /// E12: texts and names of columns do not drive the terminal that shows them.
    #[test]
    fn a_table_has_no_control_characters() {
        let texts: ArrayRef = Arc::new(StringArray::from(vec![Some("a\u{1b}[31m\u{9b}2J"), None]));
        let coded = cast(&texts, &DataType::Dictionary(Box::new(DataType::Int8), Box::new(DataType::Utf8)));
        let field = Arc::new(Field::new("element", DataType::Utf8, true));
        let lists = ListArray::new(field, OffsetBuffer::from_lengths([1, 1]), texts.clone(), None);
        let columns =
            [("\u{1b}[1m", texts.clone()), ("coded", coded.expect("coded")), ("lists", Arc::new(lists) as ArrayRef)];
        let batch = RecordBatch::try_from_iter(columns).expect("a batch");
        for rows in [2, 0] {
            let mut out = Vec::new();
            let mut writer = AnswerWriter::new(AnswerFormat::Table, &batch.schema(), &mut out).expect("begun");
            writer.write(&batch.slice(0, rows)).expect("written");
            writer.finish().expect("finished");
            let text = String::from_utf8(out).expect("text");
            assert!(text.chars().all(|character| character == '\n' || !character.is_control()), "{text:?}");
            assert_eq!(text.matches("a\\u{1b}[31m\\u{9b}2J").count(), if rows == 0 { 0 } else { 3 }, "{text}");
        }
    }

    #[test]
    fn texts_are_no_formulas_in_a_spreadsheet_and_numbers_stay() {
        let texts = ["=1+1", "+1", "-1", "@sum(a1)", "\t=1", "\r=1", "a=1", "'=1", ""];
        let levels = Float32Array::from_iter_values((0..texts.len()).map(|i| -0.5 * i as f32));
        let plain: ArrayRef = Arc::new(StringArray::from_iter_values(texts));
        let coded = cast(&plain, &DataType::Dictionary(Box::new(DataType::Int8), Box::new(DataType::Utf8)));
        let batch = RecordBatch::try_from_iter([
            ("-level_db", Arc::new(levels) as ArrayRef),
            ("plain", plain.clone()),
            ("coded", coded.expect("coded")),
            ("viewed", cast(&plain, &DataType::Utf8View).expect("viewed")),
        ]);
        let batch = batch.expect("a batch");
        let mut out = Vec::new();
        let mut writer = AnswerWriter::new(AnswerFormat::SpreadsheetCsv, &batch.schema(), &mut out).expect("begun");
        writer.write(&batch).expect("written");
        assert_eq!(writer.finish().expect("finished"), texts.len());
        let mut expected = "'-level_db,plain,coded,viewed\n".to_owned();
        for (i, text) in ["'=1+1", "'+1", "'-1", "'@sum(a1)", "'\t=1", "\"'\r=1\"", "a=1", "'=1", ""].iter().enumerate()
        {
            let _ = writeln!(expected, "{:.1},{text},{text},{text}", -0.5 * i as f32);
        }
        assert_eq!(String::from_utf8(out).expect("text"), expected);
    }

    #[test]
    fn binary_formats_read_back() {
        let parquet = bytes::Bytes::from(written(AnswerFormat::Parquet));
        let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(parquet).expect("Parquet");
        let back: Vec<_> = reader.build().expect("a reader").map(|b| b.expect("a batch")).collect();
        assert_eq!(back, [batch()]);
        let arrow = written(AnswerFormat::Arrow);
        let reader = arrow::ipc::reader::StreamReader::try_new(&arrow[..], None).expect("Arrow");
        assert_eq!(reader.map(|b| b.expect("a batch")).collect::<Vec<_>>(), [batch()]);
    }

    #[test]
    fn a_long_parquet_answer_has_row_groups_of_a_bounded_size() {
        let chance = |n: u32| f64::from(n.wrapping_mul(2_654_435_761)).sqrt();
        let numbers =
            |from: u32| Arc::new(arrow::array::Float64Array::from_iter_values((from..from + 100_000).map(chance)));
        let batch = |from| RecordBatch::try_from_iter([("x", numbers(from) as ArrayRef)]).expect("a batch");
        let mut out = Vec::new();
        let mut writer = AnswerWriter::new(AnswerFormat::Parquet, &batch(0).schema(), &mut out).expect("begun");
        (0..30).for_each(|n| writer.write(&batch(n * 100_000)).expect("written"));
        writer.finish().expect("finished");
        let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(bytes::Bytes::from(out));
        assert!(reader.expect("Parquet").metadata().num_row_groups() > 1);
    }

    #[test]
    fn long_tables_are_cut_and_counted() {
        let schema = Arc::new(Schema::new(vec![Field::new("n", DataType::Int64, false)]));
        let column: ArrayRef = Arc::new(Int64Array::from_iter_values(0..6_000));
        let batch = RecordBatch::try_new(schema.clone(), vec![column]).expect("a batch");
        let mut out = Vec::new();
        let mut writer = AnswerWriter::new(AnswerFormat::Table, &schema, &mut out).expect("begun");
        (0..3).for_each(|_| writer.write(&batch).expect("written"));
        assert_eq!(writer.finish().expect("finished"), 18_000);
        let lines = String::from_utf8(out).expect("text").lines().count();
        assert_eq!(lines, TABLE_ROWS + 4);
    }

    #[test]
    fn a_name_twice_is_refused_where_columns_go_by_name() {
        let field = || Field::new("run_id", DataType::Int64, false);
        let schema = Arc::new(Schema::new(vec![field(), field()]));
        for format in AnswerFormat::ALL {
            let begun = AnswerWriter::new(format, &schema, Vec::new());
            let by_name = matches!(format, AnswerFormat::Json | AnswerFormat::Parquet);
            assert_eq!(begun.is_err(), by_name, "{}", format.name());
        }
    }

    #[test]
    fn a_closed_pipe_is_known_in_every_format() {
        struct Closed;
        impl Write for Closed {
            fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
                Err(std::io::ErrorKind::BrokenPipe.into())
            }
            fn flush(&mut self) -> std::io::Result<()> {
                Ok(())
            }
        }
        for format in AnswerFormat::ALL {
            let batch = batch();
            let failed = AnswerWriter::new(format, &batch.schema(), Closed)
                .and_then(|mut writer| writer.write(&batch).and_then(|()| writer.finish()))
                .expect_err(format.name());
            assert!(matches!(&failed, Error::Write(e) if e.kind() == std::io::ErrorKind::BrokenPipe), "{failed:?}");
        }
    }

    #[test]
    fn lists_of_texts_are_json() {
        let mut list = arrow::array::ListBuilder::new(arrow::array::StringBuilder::new());
        list.values().append_value("tab\t\"quote\"\u{1}");
        list.append(true);
        let column: ArrayRef = Arc::new(list.finish());
        let batch = RecordBatch::try_from_iter([("texts", column)]).expect("a batch");
        let flat = flatten_columns(&batch, json_list).expect("flat");
        assert_eq!(flat.column(0).as_string::<i32>().value(0), r#"["tab\t\"quote\"\u0001"]"#);
    }

    #[test]
    fn an_answer_without_rows_still_has_its_columns() {
        for (format, expected) in [(AnswerFormat::Csv, "id,name,ir,at\n"), (AnswerFormat::Json, "[]\n")] {
            let mut out = Vec::new();
            AnswerWriter::new(format, &batch().schema(), &mut out).expect("begun").finish().expect("finished");
            assert_eq!(String::from_utf8(out).expect("text"), expected);
        }
    }
}
