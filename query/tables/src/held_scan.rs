//! A scan that reads columns which this process has decoded: what DataFusion's Parquet source would read of the same
//! files. Lists are not kept: a scan of lists of few pairs finds its rows by the columns that are kept, and decodes their
//! pages.

use std::collections::BTreeSet;
use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, UInt64Array};
use arrow::compute::{concat_batches, filter_record_batch};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef, UInt64Type};
use arrow::record_batch::RecordBatch;
use datafusion::common::cast::as_boolean_array;
use datafusion::common::tree_node::TreeNodeRecursion;
use datafusion::common::{DataFusionError, Statistics};
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{FileScanConfig, FileSource as _, ParquetSource};
use datafusion::datasource::source::DataSource;
use datafusion::error::Result;
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
use datafusion::logical_expr::Operator;
use datafusion::physical_expr::expressions::{BinaryExpr, Column, InListExpr, Literal};
use datafusion::physical_expr::projection::{ProjectionExprs, Projector};
use datafusion::physical_expr::utils::{collect_columns, reassign_expr_columns};
use datafusion::physical_expr::{EquivalenceProperties, Partitioning, PhysicalExpr, split_conjunction};
use datafusion::physical_plan::DisplayFormatType;
use datafusion::physical_plan::coop::cooperative;
use datafusion::physical_plan::execution_plan::SchedulingType;
use datafusion::physical_plan::metrics::{BaselineMetrics, ExecutionPlanMetricsSet};
use datafusion::physical_plan::stream::RecordBatchStreamAdapter;
use futures::stream::BoxStream;
use futures::{FutureExt as _, StreamExt as _, TryStreamExt as _};

use crate::column_store::{ColumnStore, JOINED_ROWS, ScanMetrics, WantedColumns, batch_of_rows};
use crate::lake_table::{FileReaders, NARROW_BATCH_ROWS};
use crate::local_scans::ScanSize;
use crate::placed_rows::read_placed_rows;
use crate::run_rows::PAIR;

/// Files, or joined files, that a partition of a scan reads at once: while one is decoded, the next one is fetched.
const READ_AHEAD: usize = 2;
/// The same from an object store, where a file takes several requests.
const READ_AHEAD_REMOTE: usize = 16;

/// Pairs that a filter of a scan of lists may name: each is a page of each list.
const NAMED_PAIRS: usize = 16;

/// The scan. It stands for another one, whose partitions, orders and statistics it has.
#[derive(Debug)]
pub(crate) struct HeldScan {
    rows: Arc<PartitionRows>,
    metrics: ExecutionPlanMetricsSet,
}

/// How the rows of a partition are made.
struct PartitionRows {
    /// The scan that this one stands for, and its limit.
    scan: Arc<dyn DataSource>,
    limit: Option<usize>,
    columns: Arc<ColumnStore>,
    /// The places of files that are read together, by partition.
    files: Vec<Vec<Range<usize>>>,
    read_ahead: usize,
    /// The columns that the filters and the projection need; only those that the filters need, if there are lists beside
    /// them.
    wanted: WantedColumns,
    /// The others.
    placed: Option<WantedColumns>,
    /// All of them.
    read_schema: SchemaRef,
    /// The filters that nobody above applies, in their order but for comparisons of numbers, which are first: they are
    /// fast. What the first leaves out, no other one sees.
    filters: Vec<Arc<dyn PhysicalExpr>>,
    projector: Projector,
    schema: SchemaRef,
    /// What is read of a file is nothing that its reader may count.
    is_restricted: bool,
}

impl HeldScan {
    /// Makes the scan that stands for another one; None if the process does not keep what it reads. `bounds` are the ids of
    /// filters that leave out rows which nodes above leave out as fast.
    ///
    /// # Errors
    /// If the scan's expressions do not fit its columns.
    pub fn try_from_scan(
        data_source: &Arc<dyn DataSource>,
        scan: &FileScanConfig,
        source: &ParquetSource,
        readers: &FileReaders,
        bounds: &[u64],
    ) -> Result<Option<Self>> {
        let Some(size) = ScanSize::from_scan(scan) else { return Ok(None) };
        let schema = scan.file_source().table_schema().table_schema();
        let is_selective = |filter: Arc<dyn PhysicalExpr>| selects_groups(&filter, schema, bounds);
        if size.has_large_files() && (scan.limit.is_some() || source.filter().is_some_and(is_selective)) {
            return Ok(None);
        }
        let projection = match source.projection() {
            Some(projection) => projection.clone(),
            None => ProjectionExprs::from_indices(&(0..schema.fields().len()).collect::<Vec<_>>(), schema),
        };
        let is_filtered = source.table_parquet_options().global.pushdown_filters;
        let predicate = source.filter().filter(|_| is_filtered);
        let mut filters: Vec<_> =
            predicate.iter().flat_map(|predicate| split_conjunction(predicate)).cloned().collect();
        filters.sort_by_key(|filter| !compares_numbers(filter, schema));
        let filtered = places_of(filters.iter().cloned(), schema)?;
        let needed = places_of(filters.iter().cloned().chain(projection.expr_iter()), schema)?;
        let is_list = |place: &usize| schema.field(*place).data_type().is_nested();
        let (kept, placed) = if needed.iter().any(is_list) {
            if filtered.iter().any(is_list) || !filters.iter().any(names_pairs) {
                return Ok(None);
            }
            let placed = needed.into_iter().filter(|place| !filtered.contains(place)).collect();
            (filtered, placed)
        } else {
            (needed, Vec::new())
        };
        let kinds = kept.iter().map(|place| schema.field(*place).data_type());
        if !readers.columns.is_kept(kinds, size.rows as u64) {
            return Ok(None);
        }
        let wanted = WantedColumns::new(schema, &kept)?;
        let placed = if placed.is_empty() { None } else { Some(WantedColumns::new(schema, &placed)?) };
        let all_fields = wanted.schema().fields().iter().chain(placed.iter().flat_map(|it| it.schema().fields()));
        let read_schema: SchemaRef = Arc::new(Schema::new(all_fields.cloned().collect::<Vec<_>>()));
        let assign = |expr: Arc<dyn PhysicalExpr>| reassign_expr_columns(expr, &read_schema);
        let read_together = |files: &[PartitionedFile]| match placed {
            Some(_) => (0..files.len()).map(|place| place..place + 1).collect(),
            None => join_small_files(files),
        };
        let rows = PartitionRows {
            columns: readers.columns.clone(),
            files: scan.file_groups.iter().map(|group| read_together(group.files())).collect(),
            read_ahead: if readers.footer_bytes.is_some() { READ_AHEAD_REMOTE } else { READ_AHEAD },
            filters: filters.into_iter().map(assign).collect::<Result<_>>()?,
            projector: projection.try_map_exprs(assign)?.make_projector(&read_schema)?,
            schema: scan.projected_schema()?,
            is_restricted: readers.is_restricted,
            wanted,
            placed,
            read_schema,
            scan: data_source.clone(),
            limit: scan.limit,
        };
        Ok(Some(Self { rows: Arc::new(rows), metrics: ExecutionPlanMetricsSet::new() }))
    }
}

// Whether a filter may leave out groups of rows by their statistics. Rows are in the order of their keys; what is measured
// has no order.
fn selects_groups(filter: &Arc<dyn PhysicalExpr>, schema: &SchemaRef, bounds: &[u64]) -> bool {
    let is_bound = |part: &Arc<dyn PhysicalExpr>| part.expression_id().is_some_and(|id| bounds.contains(&id));
    let is_measured = |name: &str| schema.field_with_name(name).is_ok_and(|field| field.data_type().is_floating());
    let selects = |part: &Arc<dyn PhysicalExpr>| {
        !is_bound(part) && !collect_columns(part).iter().all(|column| is_measured(column.name()))
    };
    split_conjunction(filter).into_iter().any(selects)
}

// Whether a filter compares a column of numbers with a number, which cannot fail.
fn compares_numbers(filter: &Arc<dyn PhysicalExpr>, schema: &SchemaRef) -> bool {
    filter.downcast_ref::<BinaryExpr>().is_some_and(|binary| {
        let column = binary.left().downcast_ref::<Column>();
        let kind = column.and_then(|column| schema.field_with_name(column.name()).ok()).map(|field| field.data_type());
        let is_comparison =
            matches!(binary.op(), Operator::Eq | Operator::Lt | Operator::LtEq | Operator::Gt | Operator::GtEq);
        is_comparison && kind.is_some_and(DataType::is_numeric) && binary.right().is::<Literal>()
    })
}

// The places of the columns that expressions need, in order.
fn places_of(expressions: impl Iterator<Item = Arc<dyn PhysicalExpr>>, schema: &SchemaRef) -> Result<Vec<usize>> {
    let columns: BTreeSet<_> =
        expressions.flat_map(|expr| collect_columns(&expr)).map(|it| it.name().to_owned()).collect();
    let mut places = columns.iter().map(|name| schema.index_of(name)).collect::<Result<Vec<_>, _>>()?;
    places.sort_unstable();
    Ok(places)
}

// Whether a filter leaves one row for each pair that it names, and each run.
fn names_pairs(filter: &Arc<dyn PhysicalExpr>) -> bool {
    let is_pair = |expr: &Arc<dyn PhysicalExpr>| expr.downcast_ref::<Column>().is_some_and(|it| it.name() == PAIR);
    if let Some(list) = filter.downcast_ref::<InListExpr>() {
        return !list.negated() && is_pair(list.expr()) && list.len() <= NAMED_PAIRS;
    }
    filter.downcast_ref::<BinaryExpr>().is_some_and(|binary| match binary.op() {
        Operator::Eq => is_pair(binary.left()) && binary.right().is::<Literal>(),
        Operator::Or => names_pairs(binary.left()) && names_pairs(binary.right()),
        _ => false,
    })
}

// Returns the ranges of a partition's files that are read together, in order.
fn join_small_files(files: &[PartitionedFile]) -> Vec<Range<usize>> {
    let mut ranges: Vec<Range<usize>> = Vec::new();
    // Of the last range.
    let mut joined_rows = NARROW_BATCH_ROWS;
    for (place, file) in files.iter().enumerate() {
        let known = file.statistics.as_ref().and_then(|known| known.num_rows.get_value().copied());
        let rows = known.filter(|rows| *rows < JOINED_ROWS).unwrap_or(NARROW_BATCH_ROWS);
        match ranges.last_mut() {
            Some(last) if joined_rows + rows <= NARROW_BATCH_ROWS => {
                last.end = place + 1;
                joined_rows += rows;
            }
            _ => {
                ranges.push(place..place + 1);
                joined_rows = rows;
            }
        }
    }
    ranges
}

impl PartitionRows {
    async fn read_range(
        self: Arc<Self>,
        partition: usize,
        files: Range<usize>,
        metrics: ExecutionPlanMetricsSet,
    ) -> Result<Vec<RecordBatch>> {
        let scan = self.scan.downcast_ref::<FileScanConfig>();
        let group = scan.and_then(|scan| scan.file_groups.get(partition)).and_then(|group| group.files().get(files));
        let files = group.ok_or_else(|| DataFusionError::Internal(format!("no files of partition {partition}")))?;
        let metrics = ScanMetrics { metrics: &metrics, partition };
        if let (Some(placed), [file]) = (&self.placed, files) {
            return self.read_placed(file, placed, metrics).await;
        }
        let read = self.columns.read_files(files, &self.wanted, metrics).await?;
        read.into_iter().map(|rows| self.project_rows(&self.filter_rows(rows)?)).collect()
    }

    // Reads what the filters need of the rows of a file, and the rest of the rows that they leave.
    async fn read_placed(
        &self,
        file: &PartitionedFile,
        placed: &WantedColumns,
        metrics: ScanMetrics<'_>,
    ) -> Result<Vec<RecordBatch>> {
        let (mut start, read) = self.columns.read_part(file, &self.wanted, metrics).await?;
        let place = Arc::new(Field::new("place", DataType::UInt64, false));
        let fields: Vec<_> = self.wanted.schema().fields().iter().cloned().chain([place]).collect();
        let numbered_schema: SchemaRef = Arc::new(Schema::new(fields));
        let mut left = Vec::with_capacity(read.len());
        for rows in read {
            let end = start + rows.num_rows();
            let places: ArrayRef = Arc::new(UInt64Array::from_iter_values(start as u64..end as u64));
            let columns = rows.columns().iter().cloned().chain([places]).collect();
            left.push(self.filter_rows(RecordBatch::try_new(numbered_schema.clone(), columns)?)?);
            start = end;
        }
        let left = concat_batches(&numbered_schema, &left)?;
        let Some((places, columns)) = left.columns().split_last().filter(|_| left.num_rows() > 0) else {
            return Ok(Vec::new());
        };
        let places: Vec<_> = places.as_primitive::<UInt64Type>().values().iter().map(|place| *place as usize).collect();
        let found = read_placed_rows(self.columns.open_file(file, metrics)?, placed, &places).await?;
        let columns = columns.iter().chain(found.columns()).cloned().collect();
        Ok(vec![self.project_rows(&batch_of_rows(&self.read_schema, columns, left.num_rows())?)?])
    }

    fn filter_rows(&self, mut rows: RecordBatch) -> Result<RecordBatch> {
        for filter in &self.filters {
            let kept = filter.evaluate(&rows)?.into_array(rows.num_rows())?;
            rows = filter_record_batch(&rows, as_boolean_array(&kept)?)?;
        }
        Ok(rows)
    }

    fn project_rows(&self, rows: &RecordBatch) -> Result<RecordBatch> {
        let projected = self.projector.project_batch(rows)?;
        batch_of_rows(&self.schema, projected.columns().to_vec(), rows.num_rows())
    }

    fn stream_partition(
        self: &Arc<Self>,
        partition: usize,
        metrics: &ExecutionPlanMetricsSet,
    ) -> BoxStream<'static, Result<RecordBatch>> {
        let metrics = if self.is_restricted { ExecutionPlanMetricsSet::new() } else { metrics.clone() };
        let files = self.files.get(partition).cloned().unwrap_or_default();
        let rows = self.clone();
        let reads =
            files.into_iter().map(move |files| rows.clone().read_range(partition, files, metrics.clone()).boxed());
        let read = futures::stream::iter(reads).buffered(self.read_ahead);
        read.map_ok(|batches| futures::stream::iter(batches.into_iter().map(Ok))).try_flatten().boxed()
    }
}

// Returns the first rows of a stream.
fn limit_rows(rows: BoxStream<'static, Result<RecordBatch>>, limit: usize) -> BoxStream<'static, Result<RecordBatch>> {
    let next = |(mut rows, left): (BoxStream<'static, Result<RecordBatch>>, usize)| async move {
        if left == 0 {
            return Ok(None);
        }
        let next: Option<RecordBatch> = rows.try_next().await?;
        Ok::<_, DataFusionError>(next.map(|batch| {
            let kept = batch.num_rows().min(left);
            (batch.slice(0, kept), (rows, left - kept))
        }))
    };
    futures::stream::try_unfold((rows, limit), next).boxed()
}

// Of the process' rows, plans show no more than of files.
impl fmt::Debug for PartitionRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PartitionRows").field("schema", &self.schema).finish_non_exhaustive()
    }
}

impl DataSource for HeldScan {
    fn open(&self, partition: usize, _: Arc<TaskContext>) -> Result<SendableRecordBatchStream> {
        let mut rows = self.rows.stream_partition(partition, &self.metrics);
        if let Some(limit) = self.rows.limit {
            rows = limit_rows(rows, limit);
        }
        let metrics = BaselineMetrics::new(&self.metrics, partition);
        let counted = rows.inspect_ok(move |batch| metrics.record_output(batch.num_rows())).boxed();
        Ok(Box::pin(cooperative(RecordBatchStreamAdapter::new(self.rows.schema.clone(), counted))))
    }

    fn fmt_as(&self, kind: DisplayFormatType, f: &mut fmt::Formatter) -> fmt::Result {
        match kind {
            DisplayFormatType::Default | DisplayFormatType::Verbose => write!(f, "rows in memory, for ")?,
            DisplayFormatType::TreeRender => return writeln!(f, "rows in memory"),
        }
        self.rows.scan.fmt_as(kind, f)
    }

    fn output_partitioning(&self) -> Partitioning {
        self.rows.scan.output_partitioning()
    }

    fn eq_properties(&self) -> EquivalenceProperties {
        self.rows.scan.eq_properties()
    }

    fn scheduling_type(&self) -> SchedulingType {
        self.rows.scan.scheduling_type()
    }

    fn partition_statistics(&self, partition: Option<usize>) -> Result<Arc<Statistics>> {
        self.rows.scan.partition_statistics(partition)
    }

    fn with_fetch(&self, _: Option<usize>) -> Option<Arc<dyn DataSource>> {
        None
    }

    fn fetch(&self) -> Option<usize> {
        self.rows.scan.fetch()
    }

    fn metrics(&self) -> ExecutionPlanMetricsSet {
        self.metrics.clone()
    }

    fn try_swapping_with_projection(&self, _: &ProjectionExprs) -> Result<Option<Arc<dyn DataSource>>> {
        Ok(None)
    }

    fn apply_expressions(
        &self,
        visit: &mut dyn FnMut(&Arc<dyn PhysicalExpr>) -> Result<TreeNodeRecursion>,
    ) -> Result<TreeNodeRecursion> {
        // Other filters of the scan are nothing that a join above would need to prepare.
        for filter in &self.rows.filters {
            if visit(filter)? == TreeNodeRecursion::Stop {
                return Ok(TreeNodeRecursion::Stop);
            }
        }
        Ok(TreeNodeRecursion::Continue)
    }
}

#[cfg(test)]
mod tests {
    use datafusion::common::stats::Precision;
    use datafusion::physical_expr::expressions::{DynamicFilterPhysicalExpr, binary, col, in_list, lit};

    use super::*;

    #[test]
    fn filters_of_keys_select_groups_of_rows_and_those_of_measured_values_do_not() {
        let fields = [("surface_id", DataType::Utf8), ("pair_id", DataType::Int32), ("level", DataType::Float32)];
        let schema: SchemaRef = Arc::new(Schema::new(fields.map(|(name, kind)| Field::new(name, kind, true)).to_vec()));
        let column = |name: &str| col(name, &schema).expect("a column");
        let join = |left, operator, right| binary(left, operator, right, &schema).expect("an expression");
        let level = join(column("level"), Operator::Gt, lit(0.5_f32));
        let pair = join(column("pair_id"), Operator::Eq, lit(7_i32));
        let both = join(level.clone(), Operator::And, pair.clone());
        let either = join(level.clone(), Operator::Or, pair.clone());
        let dynamic: Arc<dyn PhysicalExpr> =
            Arc::new(DynamicFilterPhysicalExpr::new(vec![column("pair_id")], lit(true)));
        let id = dynamic.expression_id().expect("an id");
        let with_dynamic = join(dynamic.clone(), Operator::And, level.clone());
        let check = |filter, bounds: &[u64], expected| assert_eq!(selects_groups(filter, &schema, bounds), expected);
        check(&level, &[], false);
        check(&pair, &[], true);
        check(&both, &[], true);
        check(&either, &[], true);
        check(&dynamic, &[], true);
        check(&with_dynamic, &[id], false);
        check(&with_dynamic, &[id + 1], true);
    }

    #[test]
    fn filters_name_pairs_if_each_of_their_alternatives_does() {
        let fields = [("pair_id", DataType::Int32), ("speaker", DataType::Int32)];
        let schema: SchemaRef = Arc::new(Schema::new(fields.map(|(name, kind)| Field::new(name, kind, true)).to_vec()));
        let column = |name: &str| col(name, &schema).expect("a column");
        let join = |left, operator, right| binary(left, operator, right, &schema).expect("an expression");
        let pair = |number: i32| join(column("pair_id"), Operator::Eq, lit(number));
        let speaker = join(column("speaker"), Operator::Eq, lit(7_i32));
        let list = |count: i32, is_negated| {
            in_list(column("pair_id"), (0..count).map(lit).collect(), &is_negated, &schema).expect("a list")
        };
        for (filter, expected) in [
            (pair(7), true),
            (join(pair(7), Operator::Or, pair(8)), true),
            (list(16, false), true),
            (list(17, false), false),
            (list(3, true), false),
            (speaker.clone(), false),
            (join(pair(7), Operator::Or, speaker), false),
            (join(column("pair_id"), Operator::Gt, lit(7_i32)), false),
            (join(column("pair_id"), Operator::Eq, column("speaker")), false),
        ] {
            assert_eq!(names_pairs(&filter), expected, "{filter}");
        }
    }

    #[test]
    fn small_files_are_joined_up_to_a_batch_and_no_others() {
        let check = |rows: &[usize], expected: &[Range<usize>]| {
            let file = |rows: &usize| {
                let known = Statistics { num_rows: Precision::Exact(*rows), ..Statistics::default() };
                PartitionedFile::new("tables/x/y.parquet", 1).with_statistics(Arc::new(known))
            };
            let files: Vec<_> = rows.iter().map(file).collect();
            assert_eq!(join_small_files(&files), expected, "{rows:?}");
        };
        check(&[], &[]);
        check(&[5000], std::slice::from_ref(&(0..1)));
        check(&[1, 1, 1], std::slice::from_ref(&(0..3)));
        check(&[2951, 1, 1, 2951, 2951, 1], &[0..1, 1..3, 3..4, 4..5, 5..6]);
        check(&[1000; 17], &[0..8, 8..16, 16..17]);
    }
}
