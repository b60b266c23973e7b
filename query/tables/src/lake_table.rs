//! A table of the lake for DataFusion: a plain Parquet scan over the files of one snapshot, which any process with the
//! same lake can run.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use datafusion::catalog::{Session, TableProvider};
use datafusion::common::pruning::PrunableStatistics;
use datafusion::common::stats::Precision;
use datafusion::common::{DFSchema, Statistics};
use datafusion::datasource::TableType;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{
    FileGroup, FileScanConfigBuilder, ParquetFileReaderFactory, ParquetSource,
};
use datafusion::datasource::source::DataSourceExec;
use datafusion::datasource::table_schema::TableSchema;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::object_store::ObjectStoreUrl;
use datafusion::logical_expr::utils::conjunction;
use datafusion::logical_expr::{Expr, TableProviderFilterPushDown};
use datafusion::physical_expr::expressions::{Column, in_list, lit};
use datafusion::physical_expr::{Partitioning, PhysicalExpr};
use datafusion::physical_optimizer::pruning::PruningPredicateBuilder;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::empty::EmptyExec;
use datafusion::physical_plan::filter::{FilterExec, FilterExecBuilder};
use datafusion::physical_plan::union::UnionExec;
use echolake_lake::{DataFile, LakeSnapshot};
use echolake_schema::tables::Table;
use futures::FutureExt as _;
use futures::future::BoxFuture;

use crate::boxed_scan;
use crate::column_store::ColumnStore;
use crate::scan_files::{PartlyHidden, RUN, ScanFile, ScanFiles};

/// Rows per batch of a scan without lists: the engine's kernels are fastest with it.
pub(crate) const NARROW_BATCH_ROWS: usize = 8192;
/// Maximum rows of a table that one partition reads.
const SMALL_ROWS: u64 = 20_000;

/// Files of one table in one snapshot.
#[derive(Debug)]
pub struct LakeTable {
    table: Table,
    schema: SchemaRef,
    columns: DFSchema,
    files: ScanFiles,
    source: FileReaders,
    /// It has few rows, and no lists but the curves of `surface_stats`.
    is_small: bool,
    /// The snapshot, if it has a fault in this table: it is refused.
    faulty: Option<Arc<LakeSnapshot>>,
    /// Of `tnce_d4`: `tnce`.
    measured: Option<Arc<LakeTable>>,
}

/// What readers see of a table.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TableSize {
    /// Its rows.
    pub rows: u64,
    /// Runs with rows in it, about.
    pub runs: u64,
}

impl TableSize {
    fn from_files<'a>(files: impl Iterator<Item = &'a DataFile>) -> Self {
        files.fold(Self::default(), |size, file| Self {
            rows: size.rows + file.visible_rows(),
            runs: size.runs + if file.parts.is_empty() { 1 } else { file.visible_parts().count() as u64 },
        })
    }
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
    /// Columns that the process has decoded.
    pub columns: Arc<ColumnStore>,
    /// True if files may hold rows that are none of the reader's business: plans name what it may see of such files, and
    /// neither what it may not see nor how much that is.
    pub is_restricted: bool,
}

impl FileReaders {
    /// Makes a source of Parquet files with these columns.
    pub(crate) fn parquet_source(&self, schema: impl Into<TableSchema>) -> ParquetSource {
        let source = ParquetSource::new(schema).with_parquet_file_reader_factory(self.reader.clone());
        match self.footer_bytes {
            Some(bytes) => source.with_metadata_size_hint(bytes),
            None => source,
        }
    }
}

impl LakeTable {
    /// Makes the table of these files, which are all that it has. What an earlier snapshot's table knows of them is
    /// kept.
    ///
    /// # Errors
    /// If the schema names a column twice.
    pub fn new(
        table: Table,
        schema: SchemaRef,
        files: &[Arc<DataFile>],
        source: FileReaders,
        before: Option<&Self>,
    ) -> Result<Self> {
        let columns = DFSchema::try_from(schema.clone())?;
        let is_narrow = table == Table::SurfaceStats || !schema.fields().iter().any(|f| f.data_type().is_nested());
        let is_small = is_narrow && files.iter().map(|file| file.rows).sum::<u64>() <= SMALL_ROWS;
        let is_restricted = source.is_restricted;
        let before = before.filter(|before| before.schema == schema && before.source.is_restricted == is_restricted);
        let files = ScanFiles::new(files, &schema, is_restricted, before.map(|before| &before.files))?;
        Ok(Self { table, schema, columns, files, source, is_small, faulty: None, measured: None })
    }

    /// Makes it the table of this snapshot, which is refused if the snapshot has a fault in it.
    pub fn of_snapshot(self, snapshot: &Arc<LakeSnapshot>) -> Self {
        let faulty = snapshot.check_table(self.table).is_err().then(|| snapshot.clone());
        Self { faulty, ..self }
    }

    /// Makes it the table of the same rows moved by symmetries.
    pub fn with_measured(self, measured: &Arc<Self>) -> Self {
        Self { measured: Some(measured.clone()), ..self }
    }

    /// Returns the table whose rows this one has, moved by symmetries.
    pub fn measured_rows(&self) -> Option<&Arc<Self>> {
        self.measured.as_ref()
    }

    /// Returns whether queries of it are refused.
    pub fn is_faulty(&self) -> bool {
        self.faulty.is_some()
    }

    /// Returns whether the table consists of exactly these files.
    pub fn is_of(&self, files: &[Arc<DataFile>]) -> bool {
        self.files.is_of(files)
    }

    /// Returns which table it is.
    pub fn table(&self) -> Table {
        self.table
    }

    /// Returns how many rows and runs it has.
    pub fn table_size(&self) -> TableSize {
        TableSize::from_files(self.files.files.iter().map(|file| &*file.file))
    }

    // Prunes files by their statistics in the log. DataFusion would prune them, too, but only after opening each; a
    // query for one surface should not open the files of others.
    fn kept_files(&self, state: &dyn Session, filters: &[Expr]) -> Result<Vec<&ScanFile>> {
        // A file without rows has no extremes, and one without extremes keeps all others.
        let files: Vec<_> = self.files.files.iter().map(|file| &**file).filter(|file| file.file.rows > 0).collect();
        let Some(filter) = conjunction(filters.iter().cloned()) else { return Ok(files) };
        let filter = state.create_physical_expr(filter, &self.columns)?;
        let predicate = PruningPredicateBuilder::new().with_file_schema(self.schema.clone()).build(filter);
        let Some(predicate) = predicate else { return Ok(files) };
        let known = files.iter().map(|f| f.known.clone()).collect();
        let may = predicate.prune(&PrunableStatistics::new(known, self.schema.clone()))?;
        Ok(files.into_iter().zip(may).filter(|(_, may)| *may).map(|(file, _)| file).collect())
    }

    // A plain scan of files, in groups of about the same size; DataFusion splits files further if that pays. The scan
    // itself applies the predicate, before any other.
    fn scan_files(
        &self,
        files: &[&ScanFile],
        state: &dyn Session,
        projection: Option<Vec<usize>>,
        limit: Option<usize>,
        predicate: Option<Arc<dyn PhysicalExpr>>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let lists = self.reads_lists(projection.as_ref());
        let mut source = self
            .source
            .parquet_source(self.schema.clone())
            .with_table_parquet_options(state.table_options().parquet.clone())
            .with_pushdown_filters(lists || predicate.is_some());
        if let Some(predicate) = predicate {
            source = source.with_predicate(predicate);
        }
        // More partitions than one would cost a small table more than it takes to read it. What is declared is not
        // divided by the optimizer, neither here nor for other processes.
        let declared = self.is_small.then_some(Partitioning::UnknownPartitioning(1));
        let groups = declared.as_ref().map_or(state.config().target_partitions(), Partitioning::partition_count);
        let config = FileScanConfigBuilder::new(self.source.url.clone(), Arc::new(source))
            .with_file_groups(file_groups(files, groups))
            .with_statistics(self.files.statistics_of(files, &self.schema)?)
            .with_batch_size((!lists).then_some(NARROW_BATCH_ROWS))
            .with_projection_indices(projection)?
            .with_limit(limit)
            .with_output_partitioning(declared)
            .build();
        Ok(DataSourceExec::from_data_source(config))
    }

    // A scan of merged files without the rows of runs that have been replaced since, or are of other projects. The limit
    // counts the remaining rows, so it is not passed to the scan.
    fn partly_hidden(
        &self,
        parts: &PartlyHidden<'_>,
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let run = self.schema.index_of(RUN)?;
        if self.source.is_restricted {
            let shown: Vec<Arc<dyn PhysicalExpr>> = parts.shown.iter().map(|run| lit(*run)).collect();
            let shown = in_list(Arc::new(Column::new(RUN, run)), shown, &false, &self.schema)?;
            return self.scan_files(&parts.files, state, projection.cloned(), None, Some(shown));
        }
        let mut columns = projection.cloned().unwrap_or_else(|| (0..self.schema.fields().len()).collect());
        let wanted: Vec<_> = (0..columns.len()).collect();
        let at = columns.iter().position(|c| *c == run).unwrap_or_else(|| {
            columns.push(run);
            columns.len() - 1
        });
        let scan = self.scan_files(&parts.files, state, Some(columns), None, None)?;
        let hidden: Vec<Arc<dyn PhysicalExpr>> = parts.hidden.iter().map(|run| lit(*run)).collect();
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
        let mut statistics = self.files.all.clone();
        if self.files.files.iter().any(|f| !f.file.hidden.is_empty()) {
            statistics = statistics.to_inexact();
        }
        let rows: u64 = self.files.files.iter().map(|f| f.file.visible_rows()).sum();
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
            self.files_rows(state, projection, filters, limit)
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
        let mut scans = Vec::new();
        if !whole.is_empty() {
            scans.push(self.scan_files(&whole, state, projection.cloned(), limit, None)?);
        }
        for parts in PartlyHidden::from_files(partial) {
            scans.push(self.partly_hidden(&parts, state, projection)?);
        }
        match scans.len() {
            0 => {
                let schema = match projection {
                    Some(columns) => Arc::new(self.schema.project(columns)?),
                    None => self.schema.clone(),
                };
                Ok(Arc::new(EmptyExec::new(schema)))
            }
            1 => Ok(scans.remove(0)),
            _ => UnionExec::try_new(scans),
        }
    }
}
