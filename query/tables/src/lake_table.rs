//! A table of the lake for DataFusion: a plain Parquet scan over the files of one snapshot.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::SystemTime;

use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use datafusion::catalog::{Session, TableProvider};
use datafusion::common::pruning::PrunableStatistics;
use datafusion::common::stats::Precision;
use datafusion::common::{DFSchema, ScalarValue, Statistics};
use datafusion::datasource::TableType;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::memory::MemorySourceConfig;
use datafusion::datasource::physical_plan::{
    FileGroup, FileScanConfigBuilder, FileSource, ParquetFileReaderFactory, ParquetSource,
};
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::object_store::ObjectStoreUrl;
use datafusion::logical_expr::utils::conjunction;
use datafusion::logical_expr::{Expr, TableProviderFilterPushDown};
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_expr::expressions::{Column, in_list, lit};
use datafusion::physical_optimizer::pruning::PruningPredicateBuilder;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::empty::EmptyExec;
use datafusion::physical_plan::filter::{FilterExec, FilterExecBuilder};
use datafusion::physical_plan::union::UnionExec;
use echolake_lake::{DataFile, FileName, Lake, LakeSnapshot, VisibleRun};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use object_store::ObjectMeta;
use tokio::sync::OnceCell;

use crate::boxed_scan;
use crate::part_rows::visible_rows_scan;
use crate::small_tables::SmallTables;
use crate::unfiltered_source::UnfilteredSource;

/// Delta writers truncate texts in statistics to 32 characters; a shorter text is complete.
const WHOLE_TEXT: usize = 32;
/// The column that tells the runs of a merged file apart.
const RUN: &str = "run_id";
const SURFACE: &str = "surface_id";
/// Maximum number of files whose statistics are merged for each plan; those of all files are merged once.
const FEW: usize = 8;
/// Rows per batch of a scan without lists: the engine's kernels are fastest with it.
const NARROW_BATCH_ROWS: usize = 8192;
/// Rows below which a file without wanted lists is read as a whole, whatever filters there are.
const SMALL_FILE_ROWS: u64 = 65_536;

/// Files of one table in one snapshot.
#[derive(Debug)]
pub struct LakeTable {
    table: Table,
    schema: SchemaRef,
    columns: DFSchema,
    files: Vec<ScanFile>,
    all: Statistics,
    source: FileReaders,
    /// The cached columns of all rows, if the table is small and was queried.
    rows: OnceCell<RecordBatch>,
    /// The snapshot, if it has a fault in this table: it is refused.
    faulty: Option<Arc<LakeSnapshot>>,
}

/// A file with its entry in a scan and its statistics.
#[derive(Debug)]
struct ScanFile {
    file: DataFile,
    part: PartitionedFile,
    known: Arc<Statistics>,
}

/// Readers of data files, shared by all tables.
#[derive(Debug, Clone)]
pub struct FileReaders {
    /// URL of the lake's store.
    pub url: ObjectStoreUrl,
    /// Caches footers for all sessions.
    pub reader: Arc<dyn ParquetFileReaderFactory>,
    /// Bytes of a file's end that the first request for a footer fetches, if a request takes long.
    pub footer_bytes: Option<usize>,
    /// Caches the rows of small tables.
    pub small: Arc<SmallTables>,
    /// The lake as its reader sees it, if files may hold rows that are none of its business: of such files, only the
    /// rows that it may see are read.
    pub restricted: Option<Lake>,
}

impl LakeTable {
    /// Makes the table of these files, which are all that it has.
    ///
    /// # Errors
    /// If the schema names a column twice.
    pub fn new(table: Table, schema: SchemaRef, files: Vec<DataFile>, source: FileReaders) -> Result<Self> {
        let columns = DFSchema::try_from(schema.clone())?;
        let is_restricted = source.restricted.is_some();
        let files: Vec<_> = files.into_iter().map(|file| ScanFile::new(file, &schema, is_restricted)).collect();
        let all = Statistics::try_merge_iter(files.iter().map(|f| f.known.as_ref()), &schema)?;
        Ok(Self { table, schema, columns, files, all, source, rows: OnceCell::new(), faulty: None })
    }

    /// Makes it the table of this snapshot, which is refused if the snapshot has a fault in it.
    pub fn of_snapshot(self, snapshot: &Arc<LakeSnapshot>) -> Self {
        let faulty = snapshot.check_table(self.table).is_err().then(|| snapshot.clone());
        Self { faulty, ..self }
    }

    /// Returns whether queries of it are refused.
    pub fn is_faulty(&self) -> bool {
        self.faulty.is_some()
    }

    /// Returns whether the table consists of exactly these files.
    pub fn is_of(&self, files: &[DataFile]) -> bool {
        self.files.len() == files.len() && self.files.iter().zip(files).all(|(a, b)| a.file == *b)
    }

    /// Returns which table it is.
    pub fn table(&self) -> Table {
        self.table
    }

    // Prunes files by their statistics in the log. DataFusion would prune them, too, but only after opening each; a
    // query for one surface should not open the files of others.
    fn kept_files(&self, state: &dyn Session, filters: &[Expr]) -> Result<Vec<&ScanFile>> {
        // A file without rows has no extremes, and one without extremes keeps all others.
        let files: Vec<_> = self.files.iter().filter(|file| file.file.rows > 0).collect();
        let Some(filter) = conjunction(filters.iter().cloned()) else { return Ok(files) };
        let filter = state.create_physical_expr(filter, &self.columns)?;
        let predicate = PruningPredicateBuilder::new().with_file_schema(self.schema.clone()).build(filter);
        let Some(predicate) = predicate else { return Ok(files) };
        let known = files.iter().map(|f| f.known.clone()).collect();
        let may = predicate.prune(&PrunableStatistics::new(known, self.schema.clone()))?;
        Ok(files.into_iter().zip(may).filter(|(_, may)| *may).map(|(file, _)| file).collect())
    }

    // A plain scan of files, in groups of about the same size; DataFusion splits files further if that pays.
    fn scan_files(
        &self,
        files: &[&ScanFile],
        state: &dyn Session,
        projection: Option<Vec<usize>>,
        limit: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let lists = self.reads_lists(projection.as_ref());
        let mut source = ParquetSource::new(self.schema.clone())
            .with_table_parquet_options(state.table_options().parquet.clone())
            .with_parquet_file_reader_factory(self.source.reader.clone())
            .with_pushdown_filters(lists);
        if let Some(bytes) = self.source.footer_bytes {
            source = source.with_metadata_size_hint(bytes);
        }
        let rows: u64 = files.iter().map(|file| file.file.rows).sum();
        let source: Arc<dyn FileSource> = match !lists && rows < files.len() as u64 * SMALL_FILE_ROWS {
            true => Arc::new(UnfilteredSource(Arc::new(source))),
            false => Arc::new(source),
        };
        let config = FileScanConfigBuilder::new(self.source.url.clone(), source)
            .with_file_groups(file_groups(files, state.config().target_partitions()))
            .with_statistics(self.known_statistics(files)?)
            .with_batch_size((!lists).then_some(NARROW_BATCH_ROWS))
            .with_projection_indices(projection)?
            .with_limit(limit)
            .build();
        Ok(DataSourceExec::from_data_source(config))
    }

    // The columns in memory, if the table is small and the wanted ones are among them: each one's place in the cache.
    async fn cached_rows(&self, projection: Option<&Vec<usize>>) -> Result<Option<(RecordBatch, Vec<usize>)>> {
        let files = || self.files.iter().map(|f| &f.file);
        let Some(columns) = SmallTables::cached_columns(self.table, &self.schema, files()) else { return Ok(None) };
        let place = |column: usize| columns.iter().position(|cached| *cached == column);
        let wanted = match projection {
            Some(wanted) => wanted.iter().map(|column| place(*column)).collect(),
            None => (0..self.schema.fields().len()).map(place).collect::<Option<Vec<_>>>(),
        };
        let Some(wanted) = wanted else { return Ok(None) };
        let read = async || {
            let schema = Arc::new(self.schema.project(&columns)?);
            self.source.small.read_rows(self.table, &schema, &files().collect::<Vec<_>>()).await
        };
        let rows = self.rows.get_or_try_init(read).await?;
        Ok(Some((rows.clone(), wanted)))
    }

    fn known_statistics(&self, files: &[&ScanFile]) -> Result<Statistics> {
        if files.len() == self.files.len() {
            return Ok(self.all.clone());
        }
        if files.len() <= FEW {
            return Statistics::try_merge_iter(files.iter().map(|f| f.known.as_ref()), &self.schema);
        }
        let mut known = Statistics::new_unknown(&self.schema);
        known.num_rows = Precision::Exact(files.iter().map(|f| f.file.rows as usize).sum());
        Ok(known)
    }

    // A scan of merged files without the rows of runs that have been replaced since. The limit counts the remaining
    // rows, so it is not passed to the scan.
    fn partly_hidden(
        &self,
        files: &[&ScanFile],
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        if let Some(lake) = &self.source.restricted {
            let files = files.iter().map(|file| file.file.clone());
            return visible_rows_scan(lake, self.table, &self.schema, files, projection);
        }
        let mut columns = projection.cloned().unwrap_or_else(|| (0..self.schema.fields().len()).collect());
        let wanted: Vec<_> = (0..columns.len()).collect();
        let run = self.schema.index_of(RUN)?;
        let at = columns.iter().position(|c| *c == run).unwrap_or_else(|| {
            columns.push(run);
            columns.len() - 1
        });
        let scan = self.scan_files(files, state, Some(columns), None)?;
        let hidden: BTreeSet<_> = files.iter().flat_map(|f| f.file.hidden.iter().map(|r| r.as_str())).collect();
        let hidden: Vec<Arc<dyn PhysicalExpr>> = hidden.into_iter().map(lit).collect();
        let shown = in_list(Arc::new(Column::new(RUN, at)), hidden, &true, &scan.schema())?;
        let filter: FilterExec = FilterExecBuilder::new(shown, scan).apply_projection(Some(wanted))?.build()?;
        Ok(Arc::new(filter))
    }

    // With pushed-down filters, lists are decoded only for the remaining rows. Scans of narrow columns would get
    // slower.
    fn reads_lists(&self, projection: Option<&Vec<usize>>) -> bool {
        let nested = |i: usize| self.schema.field(i).data_type().is_nested();
        match projection {
            Some(columns) => columns.iter().any(|i| nested(*i)),
            None => (0..self.schema.fields().len()).any(nested),
        }
    }
}

impl ScanFile {
    fn new(file: DataFile, schema: &SchemaRef, is_restricted: bool) -> Self {
        let meta = ObjectMeta {
            location: file.path.clone(),
            // A name stands for its content, so that what is cached of a file stays valid.
            last_modified: SystemTime::UNIX_EPOCH.into(),
            size: file.bytes,
            e_tag: None,
            version: None,
        };
        // A restricted lake's scan does not read hidden rows; other scans filter them out.
        let only_visible = is_restricted && !file.hidden.is_empty();
        let known = Arc::new(if only_visible { known_of_parts(&file, schema) } else { file_statistics(&file, schema) });
        let part = PartitionedFile::new_from_meta(meta).with_statistics(known.clone());
        Self { file, part, known }
    }
}

// Statistics of a file from the log, so that a query for one surface does not open the files of others.
fn file_statistics(file: &DataFile, schema: &SchemaRef) -> Statistics {
    let mut known = Statistics::new_unknown(schema);
    known.num_rows = Precision::Exact(file.rows as usize);
    for (field, column) in schema.fields().iter().zip(&mut known.column_statistics) {
        if !field.is_nullable() {
            column.null_count = Precision::Exact(0);
        }
        let Some(stats) = &file.stats else { continue };
        let kind = field.data_type();
        let least = stats.min.get(field.name()).and_then(|v| scalar_bound(kind, v.as_str(), v.as_i64()));
        let greatest = stats.max.get(field.name()).and_then(|v| scalar_bound(kind, v.as_str(), v.as_i64()));
        if let (Some(least), Some(greatest)) = (least, greatest) {
            column.min_value = Precision::Exact(least);
            column.max_value = Precision::Exact(greatest);
        }
    }
    // Names of runs are too long for the log's extremes.
    let named = if file.hidden.is_empty() { named_runs(file) } else { Vec::new() };
    let surfaces = named.iter().map(|(surface, _)| surface.as_str());
    let runs = named.iter().map(|(_, run)| run.as_str());
    for (name, extremes) in [(SURFACE, text_range(surfaces)), (RUN, text_range(runs))] {
        let Some((column, (least, greatest))) = schema.index_of(name).ok().zip(extremes) else { continue };
        let column = &mut known.column_statistics[column];
        if column.min_value == Precision::Absent {
            column.min_value = Precision::Exact(least);
            column.max_value = Precision::Exact(greatest);
        }
    }
    known
}

// The surfaces and runs with rows, as a file's name or its parts tell.
fn named_runs(file: &DataFile) -> Vec<(SurfaceId, RunId)> {
    match FileName::parse(&file.path) {
        Some(FileName::Rows { surface, run, .. } | FileName::Pointer(VisibleRun { surface, run, .. }))
            if file.rows > 0 =>
        {
            vec![(surface, run)]
        }
        Some(FileName::Merged { .. }) => {
            let parts = file.visible_parts().map(|(part, _)| part).filter(|part| part.rows > 0);
            parts.map(|part| (part.surface.clone(), part.run.clone())).collect()
        }
        _ => Vec::new(),
    }
}

fn text_range<'a>(texts: impl Iterator<Item = &'a str>) -> Option<(ScalarValue, ScalarValue)> {
    let texts: BTreeSet<_> = texts.collect();
    Some((ScalarValue::from(*texts.first()?), ScalarValue::from(*texts.last()?)))
}

// The log's extremes are those of hidden rows, too; of the rows that are seen, the parts tell surfaces and runs.
fn known_of_parts(file: &DataFile, schema: &SchemaRef) -> Statistics {
    let mut known = Statistics::new_unknown(schema);
    known.num_rows = Precision::Exact(file.visible_rows() as usize);
    let surfaces = file.visible_parts().map(|(part, _)| part.surface.as_str());
    let runs = file.visible_parts().map(|(part, _)| part.run.as_str());
    for (name, extremes) in [(SURFACE, text_range(surfaces)), (RUN, text_range(runs))] {
        let Some((column, (least, greatest))) = schema.index_of(name).ok().zip(extremes) else { continue };
        let column = &mut known.column_statistics[column];
        column.null_count = Precision::Exact(0);
        column.min_value = Precision::Exact(least);
        column.max_value = Precision::Exact(greatest);
    }
    known
}

// Only for integers and texts, as keys are. JSON does not represent every float exactly, so the file's own statistics
// serve for those.
fn scalar_bound(kind: &DataType, text: Option<&str>, int: Option<i64>) -> Option<ScalarValue> {
    match kind {
        DataType::Utf8 => text.filter(|t| t.chars().count() < WHOLE_TEXT).map(ScalarValue::from),
        DataType::Int32 => int.and_then(|v| i32::try_from(v).ok()).map(ScalarValue::from),
        DataType::Int64 => int.map(ScalarValue::from),
        _ => None,
    }
}

fn file_groups(files: &[&ScanFile], count: usize) -> Vec<FileGroup> {
    let mut groups: Vec<(u64, Vec<PartitionedFile>)> = vec![(0, Vec::new()); count.clamp(1, files.len().max(1))];
    for file in files {
        if let Some((bytes, group)) = groups.iter_mut().min_by_key(|g| g.0) {
            *bytes += file.file.bytes;
            group.push(file.part.clone());
        }
    }
    groups.into_iter().map(|(_, files)| FileGroup::new(files)).collect()
}

impl TableProvider for LakeTable {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    fn table_type(&self) -> TableType {
        TableType::Base
    }

    // DataFusion keeps its filter, and its physical optimizer pushes it down to the Parquet reader, which prunes row
    // groups and pages by statistics, and filters rows if lists are read.
    fn supports_filters_pushdown(&self, filters: &[&Expr]) -> Result<Vec<TableProviderFilterPushDown>> {
        Ok(vec![TableProviderFilterPushDown::Inexact; filters.len()])
    }

    fn statistics(&self) -> Option<Statistics> {
        if self.is_faulty() {
            return None;
        }
        let mut statistics = self.all.clone();
        if self.files.iter().any(|f| !f.file.hidden.is_empty()) {
            statistics = statistics.to_inexact();
        }
        let rows: u64 = self.files.iter().map(|f| f.file.visible_rows()).sum();
        statistics.num_rows = Precision::Exact(rows as usize);
        Some(statistics)
    }

    boxed_scan!(self, state, projection, filters, limit => self.scan_rows(state, projection, filters, limit));
}

impl LakeTable {
    fn scan_rows<'a>(
        &'a self,
        state: &'a dyn Session,
        projection: Option<&'a Vec<usize>>,
        filters: &'a [Expr],
        limit: Option<usize>,
    ) -> BoxFuture<'a, Result<Arc<dyn ExecutionPlan>>> {
        let rows = async move {
            if let Some(snapshot) = &self.faulty {
                snapshot.check_table(self.table).map_err(|fault| DataFusionError::External(fault.into()))?;
            }
            match self.cached_rows(projection).await? {
                Some((rows, wanted)) => {
                    let schema = rows.schema();
                    let rows = MemorySourceConfig::try_new_exec(&[vec![rows]], schema, Some(wanted))?;
                    Ok(rows as Arc<dyn ExecutionPlan>)
                }
                None => self.files_rows(state, projection, filters, limit),
            }
        };
        rows.boxed()
    }

    // The rows of its files.
    fn files_rows(
        &self,
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
        filters: &[Expr],
        limit: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let kept = self.kept_files(state, filters)?;
        let (whole, partial): (Vec<_>, Vec<_>) = kept.into_iter().partition(|f| f.file.hidden.is_empty());
        match (whole.is_empty(), partial.is_empty()) {
            (true, true) => {
                let schema = match projection {
                    Some(columns) => Arc::new(self.schema.project(columns)?),
                    None => self.schema.clone(),
                };
                Ok(Arc::new(EmptyExec::new(schema)))
            }
            (false, true) => self.scan_files(&whole, state, projection.cloned(), limit),
            (true, false) => self.partly_hidden(&partial, state, projection),
            (false, false) => UnionExec::try_new(vec![
                self.scan_files(&whole, state, projection.cloned(), limit)?,
                self.partly_hidden(&partial, state, projection)?,
            ]),
        }
    }
}
