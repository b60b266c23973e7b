//! A table of the lake for DataFusion: a plain Parquet scan over the files of one snapshot, which any process with the
//! same lake can run.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::SystemTime;

use arrow::datatypes::{DataType, SchemaRef};
use datafusion::catalog::{Session, TableProvider};
use datafusion::common::pruning::PrunableStatistics;
use datafusion::common::stats::Precision;
use datafusion::common::{DFSchema, ScalarValue, Statistics};
use datafusion::datasource::TableType;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::parquet::ParquetRowSelection;
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
use echolake_lake::{DataFile, FileName, LakeSnapshot, VisibleRun};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use object_store::ObjectMeta;
use parquet::arrow::arrow_reader::{RowSelection, RowSelector};

use crate::boxed_scan;
use crate::held_table::HeldTable;
use crate::small_tables::SmallTables;

/// Delta writers truncate texts in statistics to 32 characters; a shorter text is complete.
const WHOLE_TEXT: usize = 32;
/// The column that tells the runs of a merged file apart.
const RUN: &str = "run_id";
const SURFACE: &str = "surface_id";
/// Maximum number of files whose statistics are merged for each plan; those of all files are merged once.
const FEW: usize = 8;
/// Rows per batch of a scan without lists: the engine's kernels are fastest with it.
const NARROW_BATCH_ROWS: usize = 8192;

/// Files of one table in one snapshot.
#[derive(Debug)]
pub struct LakeTable {
    table: Table,
    schema: SchemaRef,
    columns: DFSchema,
    files: Vec<ScanFile>,
    all: Statistics,
    source: FileReaders,
    /// What the process holds of its rows, if the table is small.
    held: Option<Arc<HeldTable>>,
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
    /// Makes the table of these files, which are all that it has.
    ///
    /// # Errors
    /// If the schema names a column twice.
    pub fn new(table: Table, schema: SchemaRef, files: Vec<DataFile>, source: FileReaders) -> Result<Self> {
        let columns = DFSchema::try_from(schema.clone())?;
        let held = HeldTable::from_files(table, &schema, &files)?.map(Arc::new);
        held.iter().for_each(|held| source.small.add_table(held));
        let files: Vec<_> = files.into_iter().map(|file| ScanFile::new(file, &schema, source.is_restricted)).collect();
        let all = Statistics::try_merge_iter(files.iter().map(|f| f.known.as_ref()), &schema)?;
        Ok(Self { table, schema, columns, files, all, source, held, faulty: None })
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
        let declared = self.held.is_some().then_some(Partitioning::UnknownPartitioning(1));
        let groups = declared.as_ref().map_or(state.config().target_partitions(), Partitioning::partition_count);
        let config = FileScanConfigBuilder::new(self.source.url.clone(), Arc::new(source))
            .with_file_groups(file_groups(files, groups))
            .with_statistics(self.known_statistics(files)?)
            .with_batch_size((!lists).then_some(NARROW_BATCH_ROWS))
            .with_projection_indices(projection)?
            .with_limit(limit)
            .with_output_partitioning(declared)
            .build();
        Ok(DataSourceExec::from_data_source(config))
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
        let part = PartitionedFile::new_from_meta(meta);
        if !is_restricted || file.hidden.is_empty() {
            let known = Arc::new(file_statistics(&file, schema));
            let part = part.with_statistics(known.clone());
            return Self { file, part, known };
        }
        // The scan's predicate leaves out the hidden rows. Here they are not even read, so that no other predicate meets
        // them and nothing counts them. The selection does not cross the wire. Exact statistics would be taken for
        // those of all rows: a column with one value is not read.
        let known = known_of_parts(&file, schema);
        let part = part.with_statistics(Arc::new(known.clone().to_inexact()));
        let part = part.with_extension(ParquetRowSelection::from(visible_selection(&file)));
        Self { file, part, known: Arc::new(known) }
    }
}

/// Merged files that one filter on runs can read: none of them shows a run that another one hides.
#[derive(Default)]
struct PartlyHidden<'a> {
    files: Vec<&'a ScanFile>,
    shown: BTreeSet<&'a str>,
    hidden: BTreeSet<&'a str>,
}

impl<'a> PartlyHidden<'a> {
    // As few as possible: mostly one.
    fn from_files(files: Vec<&'a ScanFile>) -> Vec<Self> {
        let mut all: Vec<Self> = Vec::new();
        for file in files {
            let shown: BTreeSet<_> = file.file.visible_parts().map(|(part, _)| part.run.as_str()).collect();
            let hidden: BTreeSet<_> = file.file.hidden.iter().map(|run| run.as_str()).collect();
            let fits = |parts: &Self| parts.shown.is_disjoint(&hidden) && parts.hidden.is_disjoint(&shown);
            let place = all.iter().position(fits).unwrap_or_else(|| {
                all.push(Self::default());
                all.len() - 1
            });
            let parts = &mut all[place];
            parts.files.push(file);
            parts.shown.extend(shown);
            parts.hidden.extend(hidden);
        }
        all
    }
}

fn visible_selection(file: &DataFile) -> RowSelection {
    let mut selectors = Vec::new();
    let mut end = 0;
    for range in file.visible_ranges() {
        selectors.push(RowSelector::skip(range.start.saturating_sub(end) as usize));
        selectors.push(RowSelector::select(range.end.saturating_sub(range.start) as usize));
        end = range.end;
    }
    selectors.push(RowSelector::skip(file.rows.saturating_sub(end) as usize));
    RowSelection::from(selectors)
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

#[cfg(test)]
mod tests {
    use echolake_lake::RunPart;
    use object_store::path::Path;

    use super::*;

    // A file of one row for each of these runs.
    fn merged_file(runs: &[&str], hidden: &[&str]) -> ScanFile {
        let id = |run: &&str| -> RunId { run.parse().expect("an id") };
        let part = |run: &&str| RunPart {
            surface: "flat".parse().expect("an id"),
            run: id(run),
            derivation: "ab".to_owned(),
            rows: 1,
            row_version: None,
            row_counts: None,
        };
        let file = DataFile {
            path: Path::from("tables/events/merged.ab.parquet"),
            bytes: 1,
            rows: runs.len() as u64,
            log_version: 0,
            seen_runs: 0,
            stats: None,
            parts: runs.iter().map(part).collect(),
            hidden: hidden.iter().map(id).collect(),
            row_counts: None,
        };
        ScanFile::new(file, &Arc::new(arrow::datatypes::Schema::empty()), true)
    }

    #[test]
    fn one_filter_reads_files_that_agree_on_what_is_hidden() {
        let files = [
            merged_file(&["a", "b", "c"], &["b"]),
            merged_file(&["d", "e"], &["e"]),
            merged_file(&["b", "f"], &["f"]),
            merged_file(&["g", "b"], &["b"]),
        ];
        let groups = PartlyHidden::from_files(files.iter().collect());
        let runs: Vec<_> = groups.iter().map(|parts| parts.shown.iter().copied().collect::<String>()).collect();
        assert_eq!(runs, ["acdg", "b"]);
        assert_eq!(groups.iter().map(|parts| parts.files.len()).collect::<Vec<_>>(), [3, 1]);
    }

    #[test]
    fn hidden_rows_are_neither_selected_nor_known() {
        let file = merged_file(&["a", "b", "c", "d"], &["a", "c"]);
        let selectors: Vec<RowSelector> = visible_selection(&file.file).into();
        let rows: Vec<_> = selectors.iter().map(|s| (s.skip, s.row_count)).collect();
        assert_eq!(rows, [(true, 1), (false, 1), (true, 1), (false, 1)]);
        assert!(file.part.extension::<ParquetRowSelection>().is_some());
        assert_eq!(file.part.statistics.expect("known").num_rows, Precision::Inexact(2));
    }
}
