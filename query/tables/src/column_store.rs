//! Columns of the lake's files that this process has decoded. A file never changes, so a column is decoded once and given
//! out again until other columns take its place: of all columns together the store keeps a fixed number of bytes.
//!
//! A column is kept in pieces of as many rows as a scan's batch, because operators count the memory of a slice as that
//! of the whole. Small files, of which some tables have one for each run, are given out joined.

use std::collections::{HashMap, HashSet};
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use arrow::array::{Array as _, ArrayRef};
use arrow::compute::{concat, concat_batches};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use datafusion::common::stats::Precision;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::ParquetFileReaderFactory;
use datafusion::error::{DataFusionError, Result};
use datafusion::physical_plan::metrics::ExecutionPlanMetricsSet;
use echolake_lake::{DataFile, Error as LakeError, add_missing_columns, reader_metadata};
use echolake_schema::RunId;
use futures::{FutureExt as _, StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use parquet::arrow::arrow_reader::ArrowReaderOptions;
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::arrow::{ParquetRecordBatchStreamBuilder, ProjectionMask};
use parquet::file::metadata::ParquetMetaData;
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::timeout;

use crate::lake_table::NARROW_BATCH_ROWS;
use crate::scan_files::partitioned_file;

/// Rows of a file below which it is given out joined with its neighbours.
pub(crate) const JOINED_ROWS: usize = 1024;
/// Share of the store that the columns of one scan may take: what would evict itself is not kept.
const SCAN_SHARE: u64 = 2;
/// Bytes of a text that a scan is taken to read: names of runs are 46 long, those of surfaces 6.
const TEXT_BYTES: u64 = 36;
/// Number of files that are read concurrently from a folder.
const TOGETHER: usize = 16;
/// The same from an object store, where waiting costs nothing else: six rounds for 350 runs.
const TOGETHER_REMOTE: usize = 64;
/// Time for which a reader waits for another one, which is about to decode the same file. Nobody polls a query whose
/// reader fetches no rows.
const READING_WAIT: Duration = Duration::from_secs(1);
/// Files whose places are remembered; above it, all are forgotten, with their columns.
const KNOWN_FILES: usize = 1 << 17;
/// Lists of small files whose joined columns may be kept.
const KNOWN_LISTS: usize = 1 << 10;
/// Bytes of a column's entry beside its values.
const ENTRY_BYTES: u64 = 128;

/// The decoded columns of a lake's files.
#[derive(Debug)]
pub struct ColumnStore {
    reader: Arc<dyn ParquetFileReaderFactory>,
    /// Bytes of a file's end that the first request for a footer fetches, if a request takes long.
    footer_bytes: Option<usize>,
    bytes: u64,
    files: Mutex<HashMap<Path, Arc<StoredFile>>>,
    /// Pieces of files whose columns are given out joined, by the pieces that they are made of.
    joined: Mutex<HashMap<Box<[u64]>, u64>>,
    next_piece: AtomicU64,
    columns: Cache<ColumnKey, StoredColumn, ColumnWeigher>,
}

/// A column of a piece of a file, or of several files.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct ColumnKey {
    piece: u64,
    name: Arc<str>,
}

#[derive(Debug, Clone)]
struct StoredColumn {
    values: ArrayRef,
    bytes: u64,
}

/// Weighs columns by their memory in bytes.
#[derive(Debug, Clone)]
struct ColumnWeigher;

impl Weighter<ColumnKey, StoredColumn> for ColumnWeigher {
    fn weight(&self, _: &ColumnKey, column: &StoredColumn) -> u64 {
        column.bytes + ENTRY_BYTES
    }
}

/// A file's place in the store.
#[derive(Debug, Default)]
struct StoredFile {
    /// Its rows in pieces, once its footer was read.
    pieces: OnceLock<Vec<RowPiece>>,
    /// Held while somebody decodes columns of the file.
    reading: AsyncMutex<()>,
    /// Runs and the rows of the file that were found to be theirs.
    owners: Mutex<HashSet<(RunId, Range<u64>)>>,
}

/// Consecutive rows of a file.
#[derive(Debug, Clone, Copy)]
struct RowPiece {
    number: u64,
    rows: usize,
    /// Its group of rows, and where that begins in the file.
    group: usize,
    group_offset: i64,
}

/// A file whose footer was read.
struct ReadFooter {
    reader: Box<dyn AsyncFileReader>,
    metadata: Arc<ParquetMetaData>,
}

/// The columns that a scan reads.
#[derive(Debug)]
pub(crate) struct WantedColumns {
    /// All columns of the table.
    table_schema: SchemaRef,
    /// The wanted ones.
    schema: SchemaRef,
    names: Vec<Arc<str>>,
}

impl WantedColumns {
    /// Makes the list of some columns of a table.
    ///
    /// # Errors
    /// If the table does not have so many.
    pub fn new(table_schema: &SchemaRef, columns: &[usize]) -> Result<Self> {
        let schema = Arc::new(table_schema.project(columns)?);
        let names = schema.fields().iter().map(|field| field.name().as_str().into()).collect();
        Ok(Self { table_schema: table_schema.clone(), schema, names })
    }

    /// Makes the list of the columns of these names.
    ///
    /// # Errors
    /// If the table does not have one.
    pub fn from_names(table_schema: &SchemaRef, names: &[&str]) -> Result<Self> {
        let places =
            names.iter().map(|name| table_schema.index_of(name)).collect::<std::result::Result<Vec<_>, _>>()?;
        Self::new(table_schema, &places)
    }

    fn with_all_scalars(&self) -> Result<Self> {
        let fields = self.table_schema.fields();
        let scalars = (0..fields.len()).filter(|column| value_bytes(fields[*column].data_type()).is_some());
        Self::new(&self.table_schema, &scalars.collect::<Vec<_>>())
    }

    /// Returns the schema of the columns.
    pub fn schema(&self) -> &SchemaRef {
        &self.schema
    }
}

/// Room in the store that columns may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StoreRoom {
    None,
    /// The room that other columns leave.
    Free,
    /// A share of the store, whatever it has now.
    Share,
}

/// Who reads, for `EXPLAIN ANALYZE`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ScanMetrics<'a> {
    pub metrics: &'a ExecutionPlanMetricsSet,
    pub partition: usize,
}

impl ColumnStore {
    /// Creates an empty store of at most so many bytes, for the files of a reader; `footer_bytes` is what it fetches of
    /// a file's end at first, if a request takes long.
    pub fn new(reader: Arc<dyn ParquetFileReaderFactory>, footer_bytes: Option<usize>, bytes: u64) -> Self {
        // So few items are two parts, in one of which a column may take all the room.
        let columns = Cache::with_weighter(64, bytes, ColumnWeigher);
        let next_piece = AtomicU64::default();
        Self { reader, footer_bytes, bytes, files: Mutex::default(), joined: Mutex::default(), next_piece, columns }
    }

    /// Returns the bytes of the columns that it has now.
    pub fn bytes_used(&self) -> u64 {
        self.columns.weight()
    }

    /// Returns whether columns of these types may be kept for so many rows: lists, and more than a share of the store,
    /// may not.
    pub(crate) fn is_kept<'a>(&self, mut types: impl Iterator<Item = &'a DataType>, rows: u64) -> bool {
        let bytes = types.try_fold(0, |bytes, kind| Some(bytes + value_bytes(kind)?));
        bytes.is_some_and(|bytes| rows.saturating_mul(bytes) <= self.bytes / SCAN_SHARE)
    }

    /// Returns the columns of these files that readers see, in one batch.
    ///
    /// # Errors
    /// If a file does not agree with its log.
    pub async fn read_rows(
        &self,
        schema: &SchemaRef,
        files: &[Arc<DataFile>],
        columns: &[&str],
    ) -> Result<RecordBatch> {
        let wanted = WantedColumns::from_names(schema, columns)?;
        let metrics = ExecutionPlanMetricsSet::new();
        let parts: Vec<_> = files.iter().map(|file| partitioned_file(file)).collect();
        let read = self.read_each(&parts, &wanted, ScanMetrics { metrics: &metrics, partition: 0 }).await?;
        let mut visible = Vec::new();
        for (file, pieces) in files.iter().zip(read) {
            let rows = concat_batches(wanted.schema(), &pieces)?;
            check_rows(&file.path, file.rows, rows.num_rows())?;
            visible.extend(
                file.visible_ranges()
                    .into_iter()
                    .map(|range| rows.slice(range.start as usize, range.end.saturating_sub(range.start) as usize)),
            );
        }
        Ok(concat_batches(wanted.schema(), &visible)?)
    }

    /// Reads wanted columns of some rows of a file, in batches. Of a large file no more is decoded than the groups of rows
    /// that have them.
    ///
    /// # Errors
    /// If the file cannot be read, or has other rows than its log says.
    pub(crate) async fn read_range(
        &self,
        file: &DataFile,
        rows: Range<u64>,
        wanted: &WantedColumns,
    ) -> Result<Vec<RecordBatch>> {
        let metrics = ExecutionPlanMetricsSet::new();
        let metrics = ScanMetrics { metrics: &metrics, partition: 0 };
        let stored = self.stored_file(&file.path);
        let Some(part) = self.find_part(&stored, file, &rows, metrics).await? else { return Ok(Vec::new()) };
        let (first, read) = self.read_part(&part, wanted, metrics).await?;
        let mut start = first as u64;
        let mut found = Vec::new();
        for batch in read {
            let end = start + batch.num_rows() as u64;
            let kept = rows.start.clamp(start, end)..rows.end.clamp(start, end);
            if !kept.is_empty() {
                found.push(batch.slice((kept.start - start) as usize, (kept.end - kept.start) as usize));
            }
            start = end;
        }
        Ok(found)
    }

    /// Returns whether these columns of some rows of a file are kept, or may be kept, lists as well.
    ///
    /// # Errors
    /// As [`Self::read_range`].
    pub(crate) async fn has_room(
        &self,
        file: &DataFile,
        rows: Range<u64>,
        wanted: &WantedColumns,
        room: StoreRoom,
    ) -> Result<bool> {
        let most = match room {
            StoreRoom::None => return Ok(false),
            StoreRoom::Free => self.bytes.saturating_sub(self.columns.weight()),
            StoreRoom::Share => self.bytes / SCAN_SHARE,
        };
        let metrics = ExecutionPlanMetricsSet::new();
        let metrics = ScanMetrics { metrics: &metrics, partition: 0 };
        let stored = self.stored_file(&file.path);
        let Some(part) = self.find_part(&stored, file, &rows, metrics).await? else { return Ok(true) };
        if self.known_rows(&stored, &part, wanted)?.is_some() {
            return Ok(true);
        }
        let footer = self.read_footer(&part, metrics).await?;
        let pieces = stored.pieces.get().map_or(&[] as &[RowPiece], Vec::as_slice);
        let mut groups: Vec<_> = pieces_in_range(pieces, &part).map(|piece| piece.group).collect();
        groups.dedup();
        let names = wanted.names.iter().map(|name| &**name);
        let mask = ProjectionMask::columns(footer.metadata.file_metadata().schema_descr(), names);
        let columns = groups.iter().flat_map(|group| footer.metadata.row_group(*group).columns().iter().enumerate());
        let columns = columns.filter(|(place, _)| mask.leaf_included(*place));
        let bytes: u64 = columns.map(|(_, column)| column.uncompressed_size().unsigned_abs()).sum();
        Ok(bytes <= most)
    }

    /// Returns whether rows of a file were found to be those of a run.
    pub(crate) fn is_owner_known(&self, path: &Path, run: &RunId, rows: &Range<u64>) -> bool {
        let stored = self.stored_file(path);
        let owners = stored.owners.lock().unwrap_or_else(PoisonError::into_inner);
        owners.contains(&(run.clone(), rows.clone()))
    }

    /// Remembers that rows of a file are those of a run.
    pub(crate) fn note_owner(&self, path: &Path, run: &RunId, rows: &Range<u64>) {
        let stored = self.stored_file(path);
        stored.owners.lock().unwrap_or_else(PoisonError::into_inner).insert((run.clone(), rows.clone()));
    }

    // The range of a file with all groups of rows that have some of these rows; None if there is none.
    async fn find_part(
        &self,
        stored: &StoredFile,
        file: &DataFile,
        rows: &Range<u64>,
        metrics: ScanMetrics<'_>,
    ) -> Result<Option<PartitionedFile>> {
        let part = partitioned_file(file);
        let pieces = match stored.pieces.get() {
            Some(pieces) => pieces,
            None => {
                let footer = self.read_footer(&part, metrics).await?;
                stored.pieces.get_or_init(|| self.number_pieces(&footer.metadata))
            }
        };
        check_rows(&file.path, file.rows, pieces.iter().map(|piece| piece.rows).sum())?;
        let mut end = 0;
        let has_wanted = |piece: &&RowPiece| {
            end += piece.rows as u64;
            end > rows.start && end - (piece.rows as u64) < rows.end
        };
        let groups: Vec<_> = pieces.iter().filter(has_wanted).map(|piece| piece.group_offset).collect();
        let (Some(first), Some(last)) = (groups.first(), groups.last()) else { return Ok(None) };
        Ok(Some(part.with_range(*first, last + 1)))
    }

    /// Reads wanted columns of a file, or of a range of it, each of its pieces a batch; returns the place of their first
    /// row in the file with them.
    ///
    /// # Errors
    /// As [`Self::read_files`].
    pub(crate) async fn read_part(
        &self,
        file: &PartitionedFile,
        wanted: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<(usize, Vec<RecordBatch>)> {
        let stored = self.stored_file(&file.object_meta.location);
        let read = self.read_stored(&stored, file, wanted, metrics).await?;
        // Whoever read rows knows the pieces.
        let pieces = stored.pieces.get().map_or(&[] as &[RowPiece], Vec::as_slice);
        let is_before = |piece: &&RowPiece| file.range.as_ref().is_some_and(|range| piece.group_offset < range.start);
        Ok((pieces.iter().take_while(is_before).map(|piece| piece.rows).sum(), read))
    }

    /// Reads wanted columns of files, each of its pieces a batch; those of several files in one batch.
    ///
    /// # Errors
    /// If a file cannot be read, or has other rows than is known of it.
    pub(crate) async fn read_files(
        &self,
        files: &[PartitionedFile],
        wanted: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<Vec<RecordBatch>> {
        if let [file] = files {
            return self.read_file(file, wanted, metrics).await;
        }
        if let Some(known) = self.joined_piece(files).and_then(|piece| self.known_batch(piece, wanted).transpose()) {
            return Ok(vec![known?]);
        }
        let read: Vec<_> = self.read_each(files, wanted, metrics).await?.into_iter().flatten().collect();
        if read.is_empty() {
            return Ok(read);
        }
        let rows = read.iter().map(RecordBatch::num_rows).sum();
        let join = |column: usize| {
            let parts: Vec<_> = read.iter().map(|batch| batch.column(column).as_ref()).collect();
            concat(&parts)
        };
        let columns = (0..wanted.names.len()).map(join).collect::<std::result::Result<Vec<_>, _>>()?;
        if let Some((piece, _)) = self.joined_piece(files) {
            wanted.names.iter().zip(&columns).for_each(|(name, values)| self.keep_column(piece, name, values));
        }
        Ok(vec![batch_of_rows(wanted.schema(), columns, rows)?])
    }

    async fn read_each(
        &self,
        files: &[PartitionedFile],
        wanted: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<Vec<Vec<RecordBatch>>> {
        let together = if self.footer_bytes.is_some() { TOGETHER_REMOTE } else { TOGETHER };
        let mut reads = Vec::with_capacity(files.len());
        for file in files {
            reads.push(self.read_file(file, wanted, metrics).boxed());
        }
        futures::stream::iter(reads).buffered(together).try_collect().await
    }

    async fn read_file(
        &self,
        file: &PartitionedFile,
        wanted: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<Vec<RecordBatch>> {
        self.read_stored(&self.stored_file(&file.object_meta.location), file, wanted, metrics).await
    }

    async fn read_stored(
        &self,
        stored: &StoredFile,
        file: &PartitionedFile,
        wanted: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<Vec<RecordBatch>> {
        if let Some(known) = self.known_rows(stored, file, wanted)? {
            return Ok(known);
        }
        let _reading = timeout(READING_WAIT, stored.reading.lock()).await;
        match self.known_rows(stored, file, wanted)? {
            Some(known) => Ok(known),
            None => self.decode_file(stored, file, wanted, metrics).await,
        }
    }

    // Returns the rows of a file if all wanted columns are there.
    fn known_rows(
        &self,
        stored: &StoredFile,
        file: &PartitionedFile,
        wanted: &WantedColumns,
    ) -> Result<Option<Vec<RecordBatch>>> {
        let Some(pieces) = stored.pieces.get() else { return Ok(None) };
        pieces_in_range(pieces, file).map(|piece| self.known_batch((piece.number, piece.rows), wanted)).collect()
    }

    fn known_batch(&self, (piece, rows): (u64, usize), wanted: &WantedColumns) -> Result<Option<RecordBatch>> {
        let columns = wanted.names.iter().map(|name| self.find_column(piece, name)).collect::<Option<Vec<_>>>();
        columns.map(|columns| batch_of_rows(wanted.schema(), columns, rows)).transpose()
    }

    fn find_column(&self, piece: u64, name: &Arc<str>) -> Option<ArrayRef> {
        self.columns.get(&ColumnKey { piece, name: name.clone() }).map(|column| column.values)
    }

    fn keep_column(&self, piece: u64, name: &Arc<str>, values: &ArrayRef) {
        let column = StoredColumn { values: values.clone(), bytes: values.get_array_memory_size() as u64 };
        self.columns.insert(ColumnKey { piece, name: name.clone() }, column);
    }

    // Decodes the columns that are missing, and keeps them.
    async fn decode_file(
        &self,
        stored: &StoredFile,
        file: &PartitionedFile,
        wanted: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<Vec<RecordBatch>> {
        let footer = self.read_footer(file, metrics).await?;
        let pieces = stored.pieces.get_or_init(|| self.number_pieces(&footer.metadata));
        let rows: usize = pieces.iter().map(|piece| piece.rows).sum();
        if let Some(Precision::Exact(expected)) = file.statistics.as_ref().map(|known| known.num_rows) {
            check_rows(&file.object_meta.location, expected as u64, rows)?;
        }
        let pieces: Vec<_> = pieces_in_range(pieces, file).copied().collect();
        // One request fetches all of a small file.
        if self.footer_bytes.is_none() || rows >= JOINED_ROWS {
            return self.complete_pieces(footer, &pieces, wanted).await;
        }
        let all = wanted.with_all_scalars()?;
        let places = wanted.names.iter().map(|name| all.schema.index_of(name));
        let places = places.collect::<std::result::Result<Vec<_>, _>>()?;
        let read = self.complete_pieces(footer, &pieces, &all).await?;
        Ok(read.iter().map(|rows| rows.project(&places)).collect::<std::result::Result<_, _>>()?)
    }

    /// Makes a reader of a file.
    ///
    /// # Errors
    /// What the store's readers say.
    pub(crate) fn open_file(
        &self,
        file: &PartitionedFile,
        ScanMetrics { metrics, partition }: ScanMetrics<'_>,
    ) -> Result<Box<dyn AsyncFileReader>> {
        Ok(self.reader.create_reader(partition, file.clone(), self.footer_bytes, metrics)?)
    }

    async fn read_footer(&self, file: &PartitionedFile, metrics: ScanMetrics<'_>) -> Result<ReadFooter> {
        let mut reader = self.open_file(file, metrics)?;
        let metadata = reader.get_metadata(Some(&ArrowReaderOptions::new())).await?;
        Ok(ReadFooter { reader, metadata })
    }

    async fn complete_pieces(
        &self,
        footer: ReadFooter,
        pieces: &[RowPiece],
        wanted: &WantedColumns,
    ) -> Result<Vec<RecordBatch>> {
        let find_columns =
            |piece: &RowPiece| wanted.names.iter().map(|name| self.find_column(piece.number, name)).collect();
        let mut found: Vec<Vec<Option<ArrayRef>>> = pieces.iter().map(find_columns).collect();
        let is_missing = |column: &usize| found.iter().any(|columns| columns[*column].is_none());
        let missing: Vec<_> = (0..wanted.names.len()).filter(is_missing).collect();
        if !missing.is_empty() {
            let decoded = decode_pieces(footer, pieces, wanted, &missing).await?;
            for ((piece, columns), batch) in pieces.iter().zip(&mut found).zip(decoded) {
                for (column, values) in missing.iter().zip(batch.columns()) {
                    self.keep_column(piece.number, &wanted.names[*column], values);
                    columns[*column] = Some(values.clone());
                }
            }
        }
        let complete = |(piece, columns): (&RowPiece, Vec<Option<ArrayRef>>)| {
            batch_of_rows(wanted.schema(), columns.into_iter().flatten().collect(), piece.rows)
        };
        pieces.iter().zip(found).map(complete).collect()
    }

    fn stored_file(&self, path: &Path) -> Arc<StoredFile> {
        let mut files = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = files.get(path) {
            return known.clone();
        }
        if files.len() >= KNOWN_FILES {
            files.clear();
        }
        files.entry(path.clone()).or_default().clone()
    }

    fn number_pieces(&self, metadata: &ParquetMetaData) -> Vec<RowPiece> {
        let mut pieces = Vec::new();
        for (group, described) in metadata.row_groups().iter().enumerate() {
            // As DataFusion decides which range of a file a group of rows is in.
            let first = described.columns().first();
            let group_offset =
                first.map_or(0, |column| column.dictionary_page_offset().unwrap_or_else(|| column.data_page_offset()));
            let all = usize::try_from(described.num_rows()).unwrap_or(0);
            for start in (0..all).step_by(NARROW_BATCH_ROWS) {
                let rows = NARROW_BATCH_ROWS.min(all - start);
                pieces.push(RowPiece { number: self.next_number(), rows, group, group_offset });
            }
        }
        pieces
    }

    fn next_number(&self) -> u64 {
        self.next_piece.fetch_add(1, Ordering::Relaxed)
    }

    // Returns the number and the rows of what several files are joined to; None if one of them was not opened yet.
    fn joined_piece(&self, files: &[PartitionedFile]) -> Option<(u64, usize)> {
        let mut numbers = Vec::with_capacity(files.len());
        let mut rows = 0;
        {
            let known = self.files.lock().unwrap_or_else(PoisonError::into_inner);
            for file in files {
                for piece in pieces_in_range(known.get(&file.object_meta.location)?.pieces.get()?, file) {
                    numbers.push(piece.number);
                    rows += piece.rows;
                }
            }
        }
        let mut joined = self.joined.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(number) = joined.get(numbers.as_slice()) {
            return Some((*number, rows));
        }
        if joined.len() >= KNOWN_LISTS {
            joined.clear();
        }
        let number = self.next_number();
        joined.insert(numbers.into(), number);
        Some((number, rows))
    }
}

// Decodes columns of pieces of a file, which are all pieces of their groups of rows.
async fn decode_pieces(
    ReadFooter { reader, metadata }: ReadFooter,
    pieces: &[RowPiece],
    wanted: &WantedColumns,
    columns: &[usize],
) -> Result<Vec<RecordBatch>> {
    let metadata = reader_metadata(metadata, &wanted.table_schema)?;
    let builder = ParquetRecordBatchStreamBuilder::new_with_metadata(reader, metadata);
    let names = columns.iter().map(|column| &*wanted.names[*column]);
    let mask = ProjectionMask::columns(builder.parquet_schema(), names);
    let mut groups: Vec<_> = pieces.iter().map(|piece| piece.group).collect();
    groups.dedup();
    let builder = builder.with_projection(mask).with_row_groups(groups).with_batch_size(NARROW_BATCH_ROWS);
    let schema = Arc::new(wanted.schema.project(columns)?);
    let mut read = Vec::with_capacity(pieces.len());
    let mut stream = builder.build()?;
    while let Some(batch) = stream.try_next().await? {
        read.push(add_missing_columns(&batch, &schema)?);
    }
    // A reader ends a batch with its group of rows, as pieces do.
    if read.iter().map(RecordBatch::num_rows).eq(pieces.iter().map(|piece| piece.rows)) {
        return Ok(read);
    }
    let all = concat_batches(&schema, &read)?;
    let expected: usize = pieces.iter().map(|piece| piece.rows).sum();
    if all.num_rows() != expected {
        let text = format!("{} rows were decoded, expected {expected}", all.num_rows());
        return Err(DataFusionError::Execution(text));
    }
    let mut start = 0;
    let slices = pieces.iter().map(|piece| {
        start += piece.rows;
        all.slice(start - piece.rows, piece.rows)
    });
    Ok(slices.collect())
}

fn pieces_in_range<'a>(pieces: &'a [RowPiece], file: &'a PartitionedFile) -> impl Iterator<Item = &'a RowPiece> {
    pieces.iter().filter(|piece| file.range.as_ref().is_none_or(|range| range.contains(piece.group_offset)))
}

/// Makes a batch of columns of so many rows, of which there may be none.
///
/// # Errors
/// If the columns are not those of the schema.
pub(crate) fn batch_of_rows(schema: &SchemaRef, columns: Vec<ArrayRef>, rows: usize) -> Result<RecordBatch> {
    let options = RecordBatchOptions::new().with_row_count(Some(rows));
    Ok(RecordBatch::try_new_with_options(schema.clone(), columns, &options)?)
}

fn check_rows(path: &Path, expected: u64, there: usize) -> Result<()> {
    if there as u64 == expected {
        return Ok(());
    }
    let source = format!("it has {there} rows, its log says {expected}").into();
    Err(DataFusionError::External(Box::new(LakeError::DataFile { file: path.to_string(), source })))
}

// The bytes of a value in memory, about; None for lists.
fn value_bytes(kind: &DataType) -> Option<u64> {
    match kind {
        DataType::Boolean => Some(1),
        kind if kind.is_nested() => None,
        kind => Some(kind.primitive_width().map_or(TEXT_BYTES, |width| width as u64)),
    }
}

#[cfg(test)]
mod tests;
