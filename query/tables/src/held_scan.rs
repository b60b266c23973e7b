//! A scan of a small table whose rows this process holds: what DataFusion's Parquet source would read of the same files.

use std::fmt;
use std::sync::Arc;

use arrow::array::RecordBatchOptions;
use arrow::compute::filter_record_batch;
use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::common::Statistics;
use datafusion::common::cast::as_boolean_array;
use datafusion::common::tree_node::TreeNodeRecursion;
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
use echolake_schema::tables::Table;
use futures::FutureExt as _;

use crate::held_table::HeldTable;
use crate::small_tables::SmallTables;

/// The scan. It stands for another one, whose partitions, orders and statistics it has.
#[derive(Debug)]
pub(crate) struct HeldScan {
    scan: FileScanConfig,
    rows: Arc<PartitionRows>,
    metrics: ExecutionPlanMetricsSet,
}

/// How the rows of a partition are made.
struct PartitionRows {
    small: Arc<SmallTables>,
    table: Arc<HeldTable>,
    /// Places of the files, by partition.
    places: Vec<Vec<usize>>,
    /// The held columns that the filters and the projection need.
    columns: Vec<usize>,
    /// The filters that nobody above applies, in their order: what the first leaves out, no other one sees.
    filters: Vec<Arc<dyn PhysicalExpr>>,
    projector: Projector,
    schema: SchemaRef,
    limit: Option<usize>,
}

impl HeldScan {
    /// Makes the scan that stands for another one; None if the process does not hold its rows.
    ///
    /// # Errors
    /// If the scan's expressions do not fit its columns.
    pub fn try_from_scan(
        scan: &FileScanConfig,
        source: &ParquetSource,
        small: &Arc<SmallTables>,
    ) -> Result<Option<Self>> {
        let Some(table) = scanned_table(scan) else { return Ok(None) };
        let schema = scan.file_source().table_schema().table_schema();
        let projection = match source.projection() {
            Some(projection) => projection.clone(),
            None => ProjectionExprs::from_indices(&(0..schema.fields().len()).collect::<Vec<_>>(), schema),
        };
        let is_filtered = source.table_parquet_options().global.pushdown_filters;
        let predicate = source.filter().filter(|_| is_filtered);
        let filters: Vec<_> = predicate.iter().flat_map(|predicate| split_conjunction(predicate)).cloned().collect();
        let needed: Vec<_> =
            filters.iter().cloned().chain(projection.expr_iter()).flat_map(|expr| collect_columns(&expr)).collect();
        for held in small.held_tables(table) {
            let column = |name: &str| held.schema().index_of(name).ok();
            let Some(mut columns) = needed.iter().map(|needed| column(needed.name())).collect::<Option<Vec<_>>>()
            else {
                return Ok(None);
            };
            columns.sort_unstable();
            columns.dedup();
            let Some(places) = held.find_places(scan) else { continue };
            let read = held.schema().project(&columns)?;
            let assign = |expr: Arc<dyn PhysicalExpr>| reassign_expr_columns(expr, &read);
            let rows = PartitionRows {
                small: small.clone(),
                places,
                columns,
                filters: filters.into_iter().map(assign).collect::<Result<_>>()?,
                projector: projection.try_map_exprs(assign)?.make_projector(&read)?,
                schema: scan.projected_schema()?,
                limit: scan.limit,
                table: held,
            };
            return Ok(Some(Self {
                scan: scan.clone(),
                rows: Arc::new(rows),
                metrics: ExecutionPlanMetricsSet::new(),
            }));
        }
        Ok(None)
    }
}

// The table in whose folder the files are.
fn scanned_table(scan: &FileScanConfig) -> Option<Table> {
    let file = scan.file_groups.iter().find_map(|group| group.files().first())?;
    let folder = file.object_meta.location.parts().nth(1)?;
    Table::by_name(folder.as_ref())
}

impl PartitionRows {
    async fn read_partition(&self, partition: usize) -> Result<RecordBatch> {
        let places = self.places.get(partition).map_or(&[] as &[usize], Vec::as_slice);
        let mut rows = self.table.read_rows(&self.small, places, &self.columns).await?;
        for filter in &self.filters {
            let kept = filter.evaluate(&rows)?.into_array(rows.num_rows())?;
            rows = filter_record_batch(&rows, as_boolean_array(&kept)?)?;
        }
        let limit = self.limit.map_or(rows.num_rows(), |limit| limit.min(rows.num_rows()));
        let projected = self.projector.project_batch(&rows.slice(0, limit))?;
        let options = RecordBatchOptions::new().with_row_count(Some(limit));
        Ok(RecordBatch::try_new_with_options(self.schema.clone(), projected.columns().to_vec(), &options)?)
    }
}

// Of the process' rows, plans show no more than of files.
impl fmt::Debug for PartitionRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PartitionRows").field("table", &self.table.table().name()).finish_non_exhaustive()
    }
}

impl DataSource for HeldScan {
    fn open(&self, partition: usize, _: Arc<TaskContext>) -> Result<SendableRecordBatchStream> {
        let rows = self.rows.clone();
        let metrics = BaselineMetrics::new(&self.metrics, partition);
        let read = async move {
            let read = rows.read_partition(partition).await?;
            metrics.record_output(read.num_rows());
            Ok(read)
        };
        let stream = RecordBatchStreamAdapter::new(self.rows.schema.clone(), futures::stream::once(read.boxed()));
        Ok(Box::pin(cooperative(stream)))
    }

    fn fmt_as(&self, kind: DisplayFormatType, f: &mut fmt::Formatter) -> fmt::Result {
        let table = self.rows.table.table().name();
        match kind {
            DisplayFormatType::Default | DisplayFormatType::Verbose => write!(f, "rows in memory, for ")?,
            DisplayFormatType::TreeRender => return writeln!(f, "rows in memory of {table}"),
        }
        self.scan.fmt_as(kind, f)
    }

    fn output_partitioning(&self) -> Partitioning {
        self.scan.output_partitioning()
    }

    fn eq_properties(&self) -> EquivalenceProperties {
        self.scan.eq_properties()
    }

    fn scheduling_type(&self) -> SchedulingType {
        self.scan.scheduling_type()
    }

    fn partition_statistics(&self, partition: Option<usize>) -> Result<Arc<Statistics>> {
        self.scan.partition_statistics(partition)
    }

    fn with_fetch(&self, _: Option<usize>) -> Option<Arc<dyn DataSource>> {
        None
    }

    fn fetch(&self) -> Option<usize> {
        self.scan.fetch()
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
