//! The lake's Parquet files by themselves: their rows read back, and written again by the parquet crate alone.

use anyhow::ensure;
use arrow::array::RecordBatchReader as _;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use echolake_lake::Lake;
use echolake_schema::RunId;
use echolake_schema::tables::{Source, Table};
use object_store::ObjectStoreExt as _;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::arrow::arrow_writer::ArrowWriterOptions;
use parquet::basic::{Compression, Encoding, Type, ZstdLevel};
use parquet::errors::Result as ParquetResult;
use parquet::file::metadata::ParquetMetaData;
use parquet::file::properties::{EnabledStatistics, WriterProperties, WriterPropertiesBuilder};

/// The lake's level of zstd and its sizes of pages, which its files do not record.
pub(crate) const LEVEL: i32 = 1;
const PAGE_BYTES: usize = 128 * 1024;
const LIST_PAGE_BYTES: usize = 32 * 1024;
/// Rows in a batch, about as many as ingest encodes at a time.
const BATCH_ROWS: usize = 512;

/// A file that ingest wrote.
pub(crate) struct StoredTableFile {
    pub table: Table,
    /// It is of references' runs.
    pub of_reference: bool,
    pub bytes: Bytes,
}

/// A file's rows, and how they were written.
pub(crate) struct FileRows {
    pub schema: SchemaRef,
    pub batches: Vec<RecordBatch>,
    pub properties: WriterProperties,
    /// Size as it was.
    pub bytes: u64,
    /// Its numbers as raw f32 and f64.
    pub raw: u64,
}

/// Encoding of columns of numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NumberEncoding {
    /// As in the file.
    AsStored,
    Plain,
    Dictionary,
}

pub(crate) fn zstd_compression(level: i32) -> Compression {
    Compression::ZSTD(ZstdLevel::try_new(level).unwrap_or_default())
}

/// All files that ingest wrote.
pub(crate) async fn read_table_files(lake: &Lake) -> anyhow::Result<Vec<StoredTableFile>> {
    let snapshot = lake.snapshot().await?;
    let references = &lake.config().references;
    let of_references = [&references.flat, &references.foam];
    let is_reference = |run: &RunId| snapshot.run(run).is_some_and(|run| of_references.contains(&&run.surface));
    let mut found = Vec::new();
    for table in Table::ALL.into_iter().filter(|t| t.source() != Source::Rig) {
        for file in snapshot.files(table) {
            let runs = file.shown_runs();
            let of_reference = runs.iter().any(is_reference);
            ensure!(runs.iter().all(is_reference) == of_reference, "`{}` has references and others", file.path);
            let bytes = lake.store().get(&file.path).await?.bytes().await?;
            found.push(StoredTableFile { table, of_reference, bytes });
        }
    }
    Ok(found)
}

impl FileRows {
    pub fn read(StoredTableFile { bytes: file, .. }: &StoredTableFile) -> anyhow::Result<Self> {
        let builder = ParquetRecordBatchReaderBuilder::try_new(file.clone())?.with_batch_size(BATCH_ROWS);
        let properties = builder_as(builder.metadata(), NumberEncoding::AsStored);
        let properties = with_stored_pages(properties, builder.metadata()).build();
        let raw = raw_bytes(builder.metadata());
        let reader = builder.build()?;
        let schema = reader.schema();
        let batches = reader.collect::<Result<_, _>>()?;
        Ok(Self { schema, batches, properties, bytes: file.len() as u64, raw })
    }

    /// Writes them with the parquet crate and nothing else.
    pub fn write(&self, properties: &WriterProperties) -> ParquetResult<Vec<u8>> {
        let options = ArrowWriterOptions::new().with_properties(properties.clone()).with_skip_arrow_metadata(true);
        let mut writer = ArrowWriter::try_new_with_options(Vec::new(), self.schema.clone(), options)?;
        self.batches.iter().try_for_each(|batch| writer.write(batch))?;
        writer.into_inner()
    }
}

/// Reads all rows, and returns how many they are.
pub(crate) fn read_all(file: &Bytes) -> anyhow::Result<usize> {
    let reader = ParquetRecordBatchReaderBuilder::try_new(file.clone())?.with_batch_size(BATCH_ROWS).build()?;
    reader.map(|batch| Ok(batch?.num_rows())).sum()
}

/// Bytes of a file's floating-point values, without any encoding.
pub(crate) fn raw_bytes(metadata: &ParquetMetaData) -> u64 {
    let columns = metadata.row_groups().iter().flat_map(|group| group.columns());
    let raw = columns.map(|column| match column.column_type() {
        Type::FLOAT => 4 * column.num_values() as u64,
        Type::DOUBLE => 8 * column.num_values() as u64,
        _ => 0,
    });
    raw.sum()
}

/// Adds the lake's sizes of pages.
pub(crate) fn with_stored_pages(
    builder: WriterPropertiesBuilder,
    metadata: &ParquetMetaData,
) -> WriterPropertiesBuilder {
    let columns = metadata.file_metadata().schema_descr().columns();
    let lists = columns.iter().filter(|column| column.max_rep_level() > 0).map(|column| column.path().clone());
    let limit = |builder: WriterPropertiesBuilder, list| builder.set_column_data_page_size_limit(list, LIST_PAGE_BYTES);
    lists.fold(builder.set_data_page_size_limit(PAGE_BYTES), limit)
}

/// Writer properties as a file records them, its numbers' encoding apart; compressed as the lake's files are.
pub(crate) fn builder_as(metadata: &ParquetMetaData, numbers: NumberEncoding) -> WriterPropertiesBuilder {
    let mut builder = WriterProperties::builder()
        .set_compression(zstd_compression(LEVEL))
        .set_statistics_enabled(EnabledStatistics::Page);
    let Some(group) = metadata.row_groups().first() else { return builder };
    builder = builder.set_max_row_group_row_count(Some(group.num_rows().max(1) as usize));
    for column in group.columns() {
        let path = column.column_path().clone();
        if column.compression() == Compression::UNCOMPRESSED {
            builder = builder.set_column_compression(path.clone(), Compression::UNCOMPRESSED);
        }
        let has_encoding = |wanted| column.encodings().any(|encoding| encoding == wanted);
        if has_encoding(Encoding::DELTA_BINARY_PACKED) {
            builder = builder.set_column_encoding(path.clone(), Encoding::DELTA_BINARY_PACKED);
        }
        if column.dictionary_page_offset().is_none() && numbers != NumberEncoding::Dictionary {
            builder = builder.set_column_dictionary_enabled(path.clone(), false);
        }
        if has_encoding(Encoding::BYTE_STREAM_SPLIT) && numbers == NumberEncoding::AsStored {
            builder = builder.set_column_encoding(path.clone(), Encoding::BYTE_STREAM_SPLIT);
        }
        if column.statistics().is_none() {
            builder = builder.set_column_statistics_enabled(path, EnabledStatistics::None);
        }
    }
    builder
}
