//! Rows of a table's file, read as a stream: of a merged file those of one run alone.

use std::ops::Range;
use std::sync::Arc;

use arrow::array::new_null_array;
use arrow::datatypes::{FieldRef, Fields, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use bytes::Bytes;
use echolake_schema::ErrorCause;
use echolake_schema::tables::Table;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use futures::{FutureExt as _, StreamExt as _, TryFutureExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStore, ObjectStoreExt as _};
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions, RowSelection, RowSelector};
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::arrow::{ParquetRecordBatchStreamBuilder, ProjectionMask};
use parquet::errors::ParquetError;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaData, ParquetMetaDataReader};

use crate::{DataFile, Error, Lake, Result};

/// Rows per batch: those of six curves of 384 samples each make 9 MB.
const BATCH_ROWS: usize = 1024;
/// Bytes of a file's end that are read at once: footer and page index of most files.
const FOOTER_BYTES: usize = 64 * 1024;

/// A file in the store, for the Parquet reader.
struct StoredFile {
    store: Arc<dyn ObjectStore>,
    path: Path,
    bytes: u64,
}

type ParquetRead<'a, T> = BoxFuture<'a, std::result::Result<T, ParquetError>>;

impl AsyncFileReader for StoredFile {
    fn get_bytes(&mut self, range: Range<u64>) -> ParquetRead<'_, Bytes> {
        self.store.get_range(&self.path, range).map_err(|e| ParquetError::External(e.into())).boxed()
    }

    fn get_byte_ranges(&mut self, ranges: Vec<Range<u64>>) -> ParquetRead<'_, Vec<Bytes>> {
        let read = async move { self.store.get_ranges(&self.path, &ranges).await };
        read.map_err(|e| ParquetError::External(e.into())).boxed()
    }

    fn get_metadata<'a>(
        &'a mut self,
        options: Option<&'a ArrowReaderOptions>,
    ) -> ParquetRead<'a, Arc<ParquetMetaData>> {
        let bytes = self.bytes;
        let reader =
            ParquetMetaDataReader::new().with_arrow_reader_options(options).with_prefetch_hint(Some(FOOTER_BYTES));
        async move { reader.load_and_finish(self, bytes).await.map(Arc::new) }.boxed()
    }
}

impl Lake {
    /// Rows of a file, by their places in it, with the named columns or all. Pages of other rows are not fetched.
    ///
    /// ```
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    /// use echolake_schema::{Rig, tables::Table};
    /// use futures::TryStreamExt as _;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let snapshot = lake.snapshot().await?;
    /// let file = &snapshot.files(Table::Pairs)[0];
    /// let rows = lake.read_rows(Table::Pairs, file, &["pair_id", "direct_mm"], 10..13).await?;
    /// let batches: Vec<_> = rows.try_collect().await?;
    /// assert_eq!((batches[0].num_rows(), batches[0].num_columns()), (3, 2));
    /// # Ok::<(), echolake_lake::Error>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::DataFile`] if the file is not what its log says, also in the stream.
    pub async fn read_rows(
        &self,
        table: Table,
        file: &DataFile,
        columns: &[&str],
        rows: Range<u64>,
    ) -> Result<BoxStream<'static, Result<RecordBatch>>> {
        let path = file.path.clone();
        let damaged = move |e: ParquetError| unread_error(&path, e);
        let mut reader = StoredFile { store: self.store(), path: file.path.clone(), bytes: file.bytes };
        let options = ArrowReaderOptions::new().with_page_index_policy(PageIndexPolicy::Optional);
        let metadata = match reader.get_metadata(Some(&options)).await {
            Ok(metadata) => metadata,
            Err(error) => {
                // A store refuses to read behind a file's end, which is damage to the lake.
                self.check_size(file).await?;
                return Err(damaged(error));
            }
        };
        let schema = table.schema(self.rig());
        let metadata = reader_metadata(metadata, &schema).map_err(damaged.clone())?;
        let mut builder = ParquetRecordBatchStreamBuilder::new_with_metadata(reader, metadata);
        let there = u64::try_from(builder.metadata().file_metadata().num_rows()).unwrap_or(0);
        if there != file.rows {
            let source = format!("it has {there} rows, its log says {}", file.rows).into();
            return Err(Error::DataFile { file: file.path.to_string(), source });
        }
        if !columns.is_empty() {
            let mask = ProjectionMask::columns(builder.parquet_schema(), columns.iter().copied());
            builder = builder.with_projection(mask);
        }
        if rows != (0..file.rows) {
            let skip = rows.start as usize;
            let take = rows.end.saturating_sub(rows.start) as usize;
            let selection = RowSelection::from(vec![RowSelector::skip(skip), RowSelector::select(take)]);
            builder = builder.with_row_selection(selection);
        }
        let stream = builder.with_batch_size(BATCH_ROWS).build().map_err(damaged.clone())?;
        let wanted = wanted_schema(&schema, columns);
        let complete = move |batch: RecordBatch| add_missing_columns(&batch, &wanted).map_err(ParquetError::from);
        Ok(stream.map(move |batch| batch.and_then(&complete)).map_err(damaged).boxed())
    }

    /// Checks that a file has as many bytes as its log says.
    ///
    /// # Errors
    /// [`Error::DataFile`] if it has not, or is not there; or what the store says.
    pub(crate) async fn check_size(&self, file: &DataFile) -> Result<()> {
        let size = self.store().head(&file.path).await.map_err(|e| Error::unread_file(&file.path, e))?.size;
        if size == file.bytes {
            return Ok(());
        }
        let source = format!("it has {size} bytes, its log says {}", file.bytes).into();
        Err(Error::DataFile { file: file.path.to_string(), source })
    }
}

fn unread_error(path: &Path, error: ParquetError) -> Error {
    let damaged = |source: ErrorCause| Error::DataFile { file: path.to_string(), source };
    match error {
        ParquetError::External(source) => match source.downcast::<StoreError>() {
            Ok(fault) => Error::unread_file(path, *fault),
            Err(source) => damaged(source),
        },
        error => damaged(error.into()),
    }
}

/// Prepares to read a file with its table's types. Columns that came to the table after the file was written are
/// absent: [`add_missing_columns`] adds them.
///
/// # Errors
/// Columns of other types.
pub fn reader_metadata(
    metadata: Arc<ParquetMetaData>,
    schema: &Schema,
) -> std::result::Result<ArrowReaderMetadata, ParquetError> {
    let in_file = metadata.file_metadata().schema_descr().root_schema().get_fields();
    let there = |field: &&FieldRef| in_file.iter().any(|column| column.name() == field.name());
    let fields: Fields = schema.fields().iter().filter(there).cloned().collect();
    ArrowReaderMetadata::try_new(metadata, ArrowReaderOptions::new().with_schema(Arc::new(Schema::new(fields))))
}

/// Returns the fields of the named columns, in the table's order; all if none is named.
pub fn wanted_schema(schema: &SchemaRef, columns: &[&str]) -> SchemaRef {
    if columns.is_empty() {
        return schema.clone();
    }
    let wanted: Fields = schema.fields().iter().filter(|f| columns.contains(&f.name().as_str())).cloned().collect();
    Arc::new(Schema::new(wanted))
}

/// Adds the columns of the schema that a batch lacks: nulls.
///
/// # Errors
/// A column that may not be null, or of another type.
pub fn add_missing_columns(batch: &RecordBatch, schema: &SchemaRef) -> std::result::Result<RecordBatch, ArrowError> {
    let column = |field: &FieldRef| match batch.column_by_name(field.name()) {
        Some(column) => column.clone(),
        None => new_null_array(field.data_type(), batch.num_rows()),
    };
    let columns = schema.fields().iter().map(column).collect();
    let rows = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
    RecordBatch::try_new_with_options(schema.clone(), columns, &rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    // Damage is mended by deleting tables, which nobody should do because a cable is loose.
    #[test]
    fn a_store_that_does_not_answer_is_no_damage_and_an_absent_file_is() {
        let path = Path::from("tables/nce/x.parquet");
        let fault = |fault: StoreError| unread_error(&path, ParquetError::External(Box::new(fault)));
        let source: ErrorCause = "connection reset".into();
        let away = fault(StoreError::Generic { store: "S3", source });
        assert_eq!(away.to_string(), "cannot read `tables/nce/x.parquet`: connection reset");
        let absent = fault(StoreError::NotFound { path: path.to_string(), source: "404".into() });
        assert!(absent.to_string().starts_with("`tables/nce/x.parquet` is damaged: it is not there; "), "{absent}");
        let damaged = unread_error(&path, ParquetError::EOF("too short".into()));
        assert!(matches!(damaged, Error::DataFile { .. }), "{damaged}");
    }
}
