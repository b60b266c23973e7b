//! A scan that reads columns which this process has decoded: what DataFusion's Parquet source would read of the same
//! files.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use arrow::compute::filter_record_batch;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use datafusion::common::cast::as_boolean_array;
use datafusion::common::tree_node::TreeNodeRecursion;
use datafusion::common::{DataFusionError, Statistics};
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{FileScanConfig, FileSource as _, ParquetSource};
use datafusion::datasource::source::DataSource;
use datafusion::error::Result;
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
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

use crate::column_store::{ColumnStore, JOINED_ROWS, ScanMetrics, WantedColumns};
use crate::lake_table::{FileReaders, NARROW_BATCH_ROWS};
use crate::local_scans::ScanSize;

/// Files, or joined files, that a partition of a scan reads at once: while one is decoded, the next one is fetched.
const READ_AHEAD: usize = 2;
/// The same from an object store, where a file takes several requests.
const READ_AHEAD_REMOTE: usize = 16;

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
    /// The columns that the filters and the projection need.
    wanted: WantedColumns,
    /// The filters that nobody above applies, in their order: what the first leaves out, no other one sees.
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
        let filters: Vec<_> = predicate.iter().flat_map(|predicate| split_conjunction(predicate)).cloned().collect();
        let needed = filters.iter().cloned().chain(projection.expr_iter()).flat_map(|expr| collect_columns(&expr));
        let mut places = needed.map(|column| schema.index_of(column.name())).collect::<Result<Vec<_>, _>>()?;
        places.sort_unstable();
        places.dedup();
        let kinds = places.iter().map(|place| schema.field(*place).data_type());
        if !readers.columns.is_kept(kinds, size.rows as u64) {
            return Ok(None);
        }
        let wanted = WantedColumns::new(schema, &places)?;
        let assign = |expr: Arc<dyn PhysicalExpr>| reassign_expr_columns(expr, wanted.schema());
        let rows = PartitionRows {
            columns: readers.columns.clone(),
            files: scan.file_groups.iter().map(|group| join_small_files(group.files())).collect(),
            read_ahead: if readers.footer_bytes.is_some() { READ_AHEAD_REMOTE } else { READ_AHEAD },
            filters: filters.into_iter().map(assign).collect::<Result<_>>()?,
            projector: projection.try_map_exprs(assign)?.make_projector(wanted.schema())?,
            schema: scan.projected_schema()?,
            is_restricted: readers.is_restricted,
            wanted,
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
        let read = self.columns.read_files(files, &self.wanted, ScanMetrics { metrics: &metrics, partition }).await?;
        read.into_iter().map(|rows| self.finish_rows(rows)).collect()
    }

    fn finish_rows(&self, mut rows: RecordBatch) -> Result<RecordBatch> {
        for filter in &self.filters {
            let kept = filter.evaluate(&rows)?.into_array(rows.num_rows())?;
            rows = filter_record_batch(&rows, as_boolean_array(&kept)?)?;
        }
        let projected = self.projector.project_batch(&rows)?;
        let options = RecordBatchOptions::new().with_row_count(Some(rows.num_rows()));
        Ok(RecordBatch::try_new_with_options(self.schema.clone(), projected.columns().to_vec(), &options)?)
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
    use arrow::datatypes::{DataType, Field, Schema};
    use datafusion::common::stats::Precision;
    use datafusion::logical_expr::Operator;
    use datafusion::physical_expr::expressions::{DynamicFilterPhysicalExpr, binary, col, lit};

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
        check(&[5000], &[0..1]);
        check(&[1, 1, 1], &[0..3]);
        check(&[2951, 1, 1, 2951, 2951, 1], &[0..1, 1..3, 3..4, 4..5, 5..6]);
        check(&[1000; 17], &[0..8, 8..16, 16..17]);
    }
}
