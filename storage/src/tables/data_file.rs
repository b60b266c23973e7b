//! Rows as a Parquet file, in the layout that the lake's readers want.

use std::io::{self, Write};
use std::sync::Arc;

use arrow::array::{Array, AsArray as _};
use arrow::compute::{max, max_string, min, min_string};
use arrow::datatypes::{DataType, Float32Type, Float64Type, Int32Type, Int64Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use echolake_schema::tables::{LIST_CHILD, Table};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_writer::{
    ArrowColumnChunk, ArrowColumnWriter, ArrowRowGroupWriterFactory, ArrowWriterOptions, compute_leaves,
};
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::ColumnPath;
use serde_json::{Map, Value, json};

use crate::{Error, Result};

/// Size of a data page.
const PAGE_BYTES: usize = 128 * 1024;
/// The same of lists: a reader of one response decompresses all lists of its page.
const LIST_PAGE_BYTES: usize = 32 * 1024;
/// Size that a row group grows to, before encoding.
const ROW_GROUP_BYTES: usize = 64 << 20;
/// Rows of a row group of a table without lists, at most: about sixteen runs of the paper's grid. A reader that looks
/// for the highest values reads few groups to their end, and of the others only the rows that it needs.
const ROW_GROUP_ROWS: usize = 48 << 10;
/// Most rows of a run that wait to share a row group; the eight symmetries of the paper's pairs are more.
const WAITING_ROWS: usize = ROW_GROUP_ROWS / 4;
/// Of the levels of zstd, 1: samples become 1.3 to 2.2 points larger than at 3 and are written a sixth to a half
/// faster.
const ZSTD_LEVEL: i32 = 1;
/// Least and greatest size of a block of a file in memory.
const LEAST_BLOCK_BYTES: usize = 16 << 10;
const MOST_BLOCK_BYTES: usize = 1 << 20;
/// Columns in whose order rows are, so that their differences are small.
const ASCENDING: [&str; 3] = ["pair_id", "log_time_ns", "log_time"];
/// Delta reads statistics of this many leading columns.
const STATS_COLUMNS: usize = 32;
/// Longest text that statistics keep: Delta readers compare prefixes, and parameters are long.
const STATS_TEXT: usize = 64;

/// Rows on their way into a file, a batch at a time.
///
/// ```
/// use echolake_lake::FileEncoder;
/// use echolake_schema::{Rig, tables::Table};
///
/// let empty = FileEncoder::new(Table::Runs, Table::Runs.schema(&Rig::paper())).finish()?;
/// assert_eq!(empty, echolake_lake::encode_batches(Table::Runs, &Table::Runs.schema(&Rig::paper()), &[])?);
/// # Ok::<(), echolake_lake::Error>(())
/// ```
pub struct FileEncoder {
    table: Table,
    schema: SchemaRef,
    /// Made with the first rows that are encoded, from which the size of row groups follows.
    file: Option<OpenFile>,
    /// The row group that grows; no writers if there is none.
    writers: Vec<ArrowColumnWriter>,
    group_rows: usize,
    rows: EncodedRows,
}

/// A file without row groups, and what makes them.
struct OpenFile {
    writer: SerializedFileWriter<FileBlocks>,
    groups: ArrowRowGroupWriterFactory,
    rows_a_group: usize,
}

/// A run's rows of one table, for a file that it may share with other runs. Those of a table with lists, and many rows
/// of another, are row groups already. Few rows without lists wait for those of other runs, whose row group they share.
#[derive(Debug, Default)]
pub struct EncodedRows {
    groups: Vec<Vec<ArrowColumnChunk>>,
    waiting: Vec<RecordBatch>,
    stats: StatsCollector,
}

/// A file's bytes in blocks, and Delta's statistics of it as JSON.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedFile {
    pub(crate) blocks: Vec<Bytes>,
    pub(crate) stats: String,
    pub(crate) rows: u64,
}

impl EncodedFile {
    /// Its bytes, in order.
    pub fn byte_blocks(&self) -> &[Bytes] {
        &self.blocks
    }
}

impl EncodedRows {
    /// Number of rows.
    pub(crate) fn row_count(&self) -> u64 {
        self.stats.rows as u64
    }

    /// Their size in memory, bytes.
    pub fn memory_bytes(&self) -> usize {
        let encoded = self.groups.iter().flatten().map(|chunk| chunk.close().bytes_written as usize);
        let waiting = self.waiting.iter().map(RecordBatch::get_array_memory_size);
        encoded.sum::<usize>() + waiting.sum::<usize>()
    }

    /// The same rows once more, if no row group is made of them yet.
    pub(crate) fn copy_waiting(&self) -> Option<Self> {
        let copy = || Self { groups: Vec::new(), waiting: self.waiting.clone(), stats: self.stats.clone() };
        self.groups.is_empty().then(copy)
    }

    fn waiting_rows(&self) -> usize {
        self.waiting.iter().map(RecordBatch::num_rows).sum()
    }
}

impl FileEncoder {
    /// A file of a table, whose schema is given because it depends on the lake's rig.
    pub fn new(table: Table, schema: SchemaRef) -> Self {
        let rows = EncodedRows { stats: StatsCollector::new(&schema), ..EncodedRows::default() };
        Self { table, schema, file: None, writers: Vec::new(), group_rows: 0, rows }
    }

    /// Adds rows.
    ///
    /// # Errors
    /// [`Error::Encode`] if the batch does not have the table's schema.
    pub fn write_batch(&mut self, batch: &RecordBatch) -> Result<()> {
        let [kinds, expected] = [batch.schema_ref(), &self.schema].map(|s| s.fields().iter().map(|f| f.data_type()));
        if !kinds.eq(expected) {
            let reason = "a batch has other columns than the table".to_owned();
            return Err(Error::Encode { table: self.table.name(), reason });
        }
        self.rows.stats.add_batch(batch);
        self.rows.waiting.push(batch.clone());
        let is_begun = !self.writers.is_empty() || !self.rows.groups.is_empty();
        match is_begun || has_lists(&self.schema) || self.rows.waiting_rows() > WAITING_ROWS {
            true => self.encode_waiting(),
            false => Ok(()),
        }
    }

    /// Adds the rows of a run.
    ///
    /// # Errors
    /// [`Error::Encode`] if they are not of this table.
    pub(crate) fn append_run(&mut self, mut run: EncodedRows) -> Result<()> {
        if !run.groups.is_empty() {
            self.encode_waiting()?;
            self.end_group()?;
        }
        self.rows.groups.append(&mut run.groups);
        self.rows.waiting.append(&mut run.waiting);
        self.rows.stats.add_rows(run.stats);
        self.encode_waiting()
    }

    /// Ends the rows of a run: in a table with lists, a row group has rows of one run alone.
    ///
    /// # Errors
    /// As [`Self::write_batch`].
    pub(crate) fn end_run(&mut self) -> Result<()> {
        if has_lists(&self.schema) { self.end_group() } else { Ok(()) }
    }

    /// The rows of one run, for a file that it may share with others.
    ///
    /// # Errors
    /// As [`Self::write_batch`].
    pub fn finish_run(mut self) -> Result<EncodedRows> {
        self.end_group()?;
        Ok(self.rows)
    }

    /// The file.
    ///
    /// # Errors
    /// As [`Self::write_batch`].
    pub fn finish(mut self) -> Result<EncodedFile> {
        self.encode_waiting()?;
        self.end_group()?;
        let table = self.table;
        let EncodedRows { groups, stats, .. } = std::mem::take(&mut self.rows);
        let rows = stats.rows as u64;
        let OpenFile { mut writer, .. } = match self.file.take() {
            Some(file) => file,
            None => self.open_file(&RecordBatch::new_empty(self.schema.clone()))?,
        };
        let written = groups.into_iter().try_for_each(|chunks| {
            let mut group = writer.next_row_group()?;
            chunks.into_iter().try_for_each(|chunk| chunk.append_to_row_group(&mut group))?;
            group.close().map(drop)
        });
        let blocks = written.and_then(|()| writer.into_inner()).map_err(|e| encode_error(table, e))?;
        Ok(EncodedFile { blocks: blocks.into_blocks(), rows, stats: stats.into_json().to_string() })
    }

    fn open_file(&self, first: &RecordBatch) -> Result<OpenFile> {
        let rows_a_group = rows_a_group(first);
        let properties = writer_properties(self.table, &self.schema);
        let options = ArrowWriterOptions::new().with_properties(properties).with_skip_arrow_metadata(true);
        ArrowWriter::try_new_with_options(FileBlocks::default(), self.schema.clone(), options)
            .and_then(ArrowWriter::into_serialized_writer)
            .map(|(writer, groups)| OpenFile { writer, groups, rows_a_group })
            .map_err(|e| encode_error(self.table, e))
    }

    fn encode_waiting(&mut self) -> Result<()> {
        for batch in std::mem::take(&mut self.rows.waiting) {
            let mut from = 0;
            while from < batch.num_rows() {
                from += self.encode_rows(&batch, from)?;
            }
        }
        Ok(())
    }

    // Encodes the rows from one on that fit into the row group; returns their number.
    fn encode_rows(&mut self, batch: &RecordBatch, from: usize) -> Result<usize> {
        let table = self.table;
        let failed = |e| encode_error(table, e);
        let file = match self.file.take() {
            Some(file) => file,
            None => self.open_file(batch)?,
        };
        let OpenFile { groups, rows_a_group, .. } = self.file.insert(file);
        if self.writers.is_empty() {
            self.writers = groups.create_column_writers(self.rows.groups.len()).map_err(failed)?;
        }
        let rows = (*rows_a_group - self.group_rows).min(batch.num_rows() - from);
        let mut writers = self.writers.iter_mut();
        for (field, column) in self.schema.fields().iter().zip(batch.slice(from, rows).columns()) {
            for (leaf, writer) in compute_leaves(field, column).map_err(failed)?.iter().zip(&mut writers) {
                writer.write(leaf).map_err(failed)?;
            }
        }
        self.group_rows += rows;
        if self.group_rows == *rows_a_group {
            self.end_group()?;
        }
        Ok(rows)
    }

    fn end_group(&mut self) -> Result<()> {
        self.group_rows = 0;
        let chunks = std::mem::take(&mut self.writers).into_iter().map(ArrowColumnWriter::close);
        let chunks: Vec<_> = chunks.collect::<std::result::Result<_, _>>().map_err(|e| encode_error(self.table, e))?;
        self.rows.groups.extend((!chunks.is_empty()).then_some(chunks));
        Ok(())
    }
}

/// Bytes that are written, in blocks that never move: one vector for all would be copied as often as it grows.
#[derive(Default)]
struct FileBlocks {
    full: Vec<Bytes>,
    last: Vec<u8>,
    /// Bytes of the full blocks.
    full_bytes: usize,
}

impl FileBlocks {
    fn into_blocks(mut self) -> Vec<Bytes> {
        self.full.push(self.last.into());
        self.full
    }
}

impl Write for FileBlocks {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.last.len() == self.last.capacity() {
            // A file is small or large.
            let block = Vec::with_capacity(self.full_bytes.clamp(LEAST_BLOCK_BYTES, MOST_BLOCK_BYTES));
            let full = std::mem::replace(&mut self.last, block);
            self.full_bytes += full.len();
            self.full.extend((!full.is_empty()).then(|| Bytes::from(full)));
        }
        let fitting = bytes.len().min(self.last.capacity() - self.last.len());
        self.last.extend_from_slice(&bytes[..fitting]);
        Ok(fitting)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn encode_error(table: Table, error: ParquetError) -> Error {
    Error::Encode { table: table.name(), reason: error.to_string() }
}

/// Encodes rows that are all in memory.
///
/// # Errors
/// [`Error::Encode`] if the batches do not have the table's schema.
pub fn encode_batches(table: Table, schema: &SchemaRef, batches: &[RecordBatch]) -> Result<EncodedFile> {
    encode_all(table, schema, batches)?.finish()
}

/// Encodes the rows of a run, all of which are in memory, for a file that it may share with other runs.
///
/// # Errors
/// As [`encode_batches`].
pub fn encode_run_rows(table: Table, schema: &SchemaRef, batches: &[RecordBatch]) -> Result<EncodedRows> {
    encode_all(table, schema, batches)?.finish_run()
}

fn encode_all(table: Table, schema: &SchemaRef, batches: &[RecordBatch]) -> Result<FileEncoder> {
    let mut encoder = FileEncoder::new(table, schema.clone());
    batches.iter().try_for_each(|batch| encoder.write_batch(batch))?;
    Ok(encoder)
}

fn has_lists(schema: &SchemaRef) -> bool {
    schema.fields().iter().any(|field| field.data_type().is_nested())
}

fn rows_a_group(first: &RecordBatch) -> usize {
    let rows = first.num_rows();
    let most_rows = if has_lists(first.schema_ref()) { usize::MAX } else { ROW_GROUP_ROWS };
    (ROW_GROUP_BYTES * rows / first.get_array_memory_size().max(1)).clamp(1, most_rows)
}

// Samples do not repeat, so a dictionary only costs; their bytes by significance compress best
// (measured on dB spectra: 0.74 of raw f32 against 1.00 with the defaults).
//
// Single values of measurements are not compressed (zstd makes them an eighth smaller): a reader copies them, and makes
// no decompressor for each column of each file, which takes longer than reading three thousand of them. Numbers of
// `tnce_d4` have a dictionary: a row has most of its numbers from the seven beside it. So have maps of heights: a run's
// eight are one map, turned and mirrored.
fn writer_properties(table: Table, schema: &SchemaRef) -> WriterProperties {
    let mut builder = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(ZSTD_LEVEL).unwrap_or_default()))
        .set_created_by(concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned())
        .set_data_page_size_limit(PAGE_BYTES)
        .set_statistics_enabled(EnabledStatistics::Page);
    let of_measurements = matches!(table, Table::Measurements | Table::Nce | Table::Tnce | Table::TnceD4);
    for field in schema.fields() {
        let name = field.name().clone();
        let kind = field.data_type();
        if kind.is_numeric() || (of_measurements && !kind.is_nested()) {
            builder = builder.set_column_compression(ColumnPath::from(name.as_str()), Compression::UNCOMPRESSED);
        }
        if ASCENDING.contains(&name.as_str()) && kind.primitive_width().is_some() {
            let column = ColumnPath::from(name.as_str());
            builder = builder
                .set_column_dictionary_enabled(column.clone(), false)
                .set_column_encoding(column, Encoding::DELTA_BINARY_PACKED);
            continue;
        }
        let is_list = matches!(kind, DataType::List(child) if child.data_type().is_floating());
        let column = match is_list {
            true => ColumnPath::new(vec![name, "list".into(), LIST_CHILD.into()]),
            false if kind.is_floating() => ColumnPath::new(vec![name]),
            false => continue,
        };
        if !matches!(table, Table::TnceD4 | Table::Heightmaps) {
            builder = builder.set_column_dictionary_enabled(column.clone(), false);
        }
        if is_list {
            builder = builder
                .set_column_data_page_size_limit(column.clone(), LIST_PAGE_BYTES)
                .set_column_encoding(column.clone(), Encoding::BYTE_STREAM_SPLIT)
                .set_column_statistics_enabled(column, EnabledStatistics::None);
        }
    }
    builder.build()
}

/// Delta's statistics of a file, gathered batch by batch.
#[derive(Debug, Clone, Default)]
struct StatsCollector {
    rows: usize,
    columns: Vec<ColumnStats>,
}

#[derive(Debug, Clone)]
struct ColumnStats {
    name: String,
    index: usize,
    nulls: usize,
    /// None before the first batch with a value.
    extremes: Option<(Value, Value)>,
    /// A batch had no extremes that are known, so the file has none either.
    unknown: bool,
}

impl ColumnStats {
    fn widen(&mut self, (low, high): (Value, Value)) {
        self.extremes = Some(match self.extremes.take() {
            Some((l, h)) => (if is_less(&low, &l) { low } else { l }, if is_less(&h, &high) { high } else { h }),
            None => (low, high),
        });
    }
}

impl StatsCollector {
    fn new(schema: &SchemaRef) -> Self {
        let told = |kind: &DataType| !matches!(kind, DataType::List(_) | DataType::Boolean | DataType::Timestamp(..));
        let columns = schema.fields().iter().enumerate().take(STATS_COLUMNS).filter(|(_, f)| told(f.data_type()));
        let column = |(index, field): (usize, &Arc<arrow::datatypes::Field>)| ColumnStats {
            name: field.name().clone(),
            index,
            nulls: 0,
            extremes: None,
            unknown: false,
        };
        Self { rows: 0, columns: columns.map(column).collect() }
    }

    fn add_batch(&mut self, batch: &RecordBatch) {
        self.rows += batch.num_rows();
        for column in self.columns.iter_mut().filter(|c| c.index < batch.num_columns()) {
            let values = batch.column(column.index);
            column.nulls += values.null_count();
            if values.null_count() == values.len() {
                continue;
            }
            let Some((low, high)) = extremes_of(values) else {
                column.unknown = true;
                continue;
            };
            column.widen((low, high));
        }
    }

    /// Adds the statistics of other rows of the table.
    fn add_rows(&mut self, other: Self) {
        self.rows += other.rows;
        for (column, other) in self.columns.iter_mut().zip(other.columns) {
            column.nulls += other.nulls;
            column.unknown |= other.unknown;
            other.extremes.into_iter().for_each(|extremes| column.widen(extremes));
        }
    }

    fn into_json(self) -> Value {
        let mut least = Map::new();
        let mut greatest = Map::new();
        let mut nulls = Map::new();
        for column in self.columns {
            nulls.insert(column.name.clone(), column.nulls.into());
            if let (Some((low, high)), false) = (column.extremes, column.unknown) {
                least.insert(column.name.clone(), low);
                greatest.insert(column.name, high);
            }
        }
        json!({ "numRecords": self.rows, "minValues": least, "maxValues": greatest, "nullCount": nulls })
    }
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
            finite_extremes(f64::from(min(floats)?), f64::from(max(floats)?))
        }
        DataType::Float64 => {
            let doubles = column.as_primitive::<Float64Type>();
            finite_extremes(min(doubles)?, max(doubles)?)
        }
        DataType::Utf8 => {
            let texts = column.as_string::<i32>();
            let low = min_string(texts)?;
            let high = max_string(texts)?;
            (low.len() <= STATS_TEXT && high.len() <= STATS_TEXT).then(|| (low.into(), high.into()))
        }
        _ => None,
    }
}

// Arrow orders NaN above all numbers, JSON has none: a column with one gets no statistics.
fn finite_extremes(low: f64, high: f64) -> Option<(Value, Value)> {
    (low.is_finite() && high.is_finite()).then(|| (low.into(), high.into()))
}

fn is_less(a: &Value, b: &Value) -> bool {
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
    fn blocks_are_the_bytes_that_were_written() {
        for sizes in [vec![], vec![0, 3], vec![10_000; 5], vec![8_192; 500], vec![3 << 20, 1, 2 << 20]] {
            let mut blocks = FileBlocks::default();
            let mut expected = Vec::new();
            for (number, size) in sizes.into_iter().enumerate() {
                let bytes: Vec<u8> = (0..size).map(|at| (at * 31 + number) as u8).collect();
                blocks.write_all(&bytes).expect("memory");
                expected.extend_from_slice(&bytes);
            }
            let blocks = blocks.into_blocks();
            assert!(blocks.iter().all(|block| block.len() <= MOST_BLOCK_BYTES));
            assert_eq!(blocks.concat(), expected);
        }
    }

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
        let mut stats = StatsCollector::new(&schema);
        batches.iter().for_each(|b| stats.add_batch(b));
        assert_eq!(stats.into_json(), expected);
    }
}
