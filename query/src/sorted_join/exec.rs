//! The node of a physical plan that joins by order.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use arrow::compute::SortOptions;
use arrow::datatypes::{Schema, SchemaRef};
use datafusion::common::JoinType;
use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::memory_pool::MemoryConsumer;
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
use datafusion::physical_expr::expressions::Column;
use datafusion::physical_expr::{EquivalenceProperties, LexOrdering, OrderingRequirements, PhysicalSortExpr};
use datafusion::physical_plan::coop::make_cooperative;
use datafusion::physical_plan::execution_plan::{Boundedness, EmissionType, SchedulingType};
use datafusion::physical_plan::joins::utils::build_join_schema;
use datafusion::physical_plan::metrics::{BaselineMetrics, ExecutionPlanMetricsSet, MetricsSet};
use datafusion::physical_plan::projection::{EmbeddedProjection, ProjectionExec, try_embed_projection};
use datafusion::physical_plan::stream::RecordBatchStreamAdapter;
use datafusion::physical_plan::{
    ChildrenPropertiesMode, DisplayAs, DisplayFormatType, Distribution, ExecutionPlan, ExecutionPlanProperties as _,
    InputDistributionRequirements, Partitioning, PhysicalExpr, PlanProperties, ReplaceChildrenOptions,
    apply_expression_roots,
};
use futures::stream;

use super::merge::{MergeSides, SortedMerge};
use super::node::describe_range;
use super::window::{JoinWindow, KeyEncoder};
use super::{JoinBound, JoinOrder, MatchedRows, WindowSide};

/// An expression of a plan.
pub(super) type ExprRef = Arc<dyn PhysicalExpr>;

/// What a join compares, with expressions over the columns of its inputs. Floats among keys, positions and bounds have
/// one zero.
#[derive(Debug)]
pub(super) struct MergedJoin {
    pub keys: Vec<(ExprRef, ExprRef)>,
    pub window: WindowSide,
    pub position: ExprRef,
    pub order: JoinOrder,
    pub first: JoinBound<ExprRef>,
    pub last: Option<JoinBound<ExprRef>>,
    pub matched: MatchedRows,
    pub join_type: JoinType,
    /// Over the columns of the left and then those of the right.
    pub filter: Option<ExprRef>,
}

impl MergedJoin {
    /// Returns the keys of the window, or else of the probe.
    pub fn side_keys(&self, of_window: bool) -> impl Iterator<Item = &ExprRef> {
        let is_left = (self.window == WindowSide::Left) == of_window;
        self.keys.iter().map(move |(left, right)| if is_left { left } else { right })
    }

    /// Returns whether rows of the window without a match are in the result.
    pub fn keeps_window(&self) -> bool {
        self.join_type == JoinType::Left && self.window == WindowSide::Left
    }

    /// Returns whether rows of the probe without a match are in the result.
    pub fn keeps_probe(&self) -> bool {
        self.join_type == JoinType::Left && self.window == WindowSide::Right
    }

    /// Returns the options by which positions are sorted.
    pub fn position_options(&self) -> SortOptions {
        SortOptions { descending: self.order == JoinOrder::Descending, nulls_first: false }
    }

    // Null keys and positions match nothing, wherever they are.
    fn side_order(&self, is_left: bool) -> Result<LexOrdering> {
        let of_window = (self.window == WindowSide::Left) == is_left;
        let last = if of_window { &self.position } else { &self.first.expr };
        let keys = self.side_keys(of_window).map(|key| PhysicalSortExpr::new(key.clone(), KEY_OPTIONS));
        let order = keys.chain([PhysicalSortExpr::new(last.clone(), self.position_options())]);
        LexOrdering::new(order).ok_or_else(|| DataFusionError::Internal("a join by no order".to_owned()))
    }
}

/// The options by which keys are sorted.
pub(super) const KEY_OPTIONS: SortOptions = SortOptions { descending: false, nulls_first: false };

/// Joins two inputs that are sorted and partitioned by the keys.
#[derive(Debug, Clone)]
pub(super) struct SortedJoinExec {
    left: Arc<dyn ExecutionPlan>,
    right: Arc<dyn ExecutionPlan>,
    join: Arc<MergedJoin>,
    /// The columns of the result, among those of the left and then those of the right.
    projection: Vec<usize>,
    schema: SchemaRef,
    properties: Arc<PlanProperties>,
    orders: [LexOrdering; 2],
    metrics: ExecutionPlanMetricsSet,
}

impl SortedJoinExec {
    /// Creates a join, of all columns or of those of a projection.
    ///
    /// # Errors
    /// If the projection has other columns than the inputs.
    pub fn try_new(
        left: Arc<dyn ExecutionPlan>,
        right: Arc<dyn ExecutionPlan>,
        join: Arc<MergedJoin>,
        projection: Option<Vec<usize>>,
    ) -> Result<Self> {
        let (all, _) = build_join_schema(&left.schema(), &right.schema(), &join.join_type);
        let projection = projection.unwrap_or_else(|| (0..all.fields().len()).collect());
        let schema: SchemaRef = Arc::new(all.project(&projection)?);
        // Inputs have as many partitions as each other once they are partitioned by the keys.
        let partitions = if join.keys.is_empty() { 1 } else { left.output_partitioning().partition_count() };
        let properties = PlanProperties::new(
            EquivalenceProperties::new(schema.clone()),
            Partitioning::UnknownPartitioning(partitions),
            EmissionType::Incremental,
            Boundedness::Bounded,
        );
        let orders = [join.side_order(true)?, join.side_order(false)?];
        Ok(Self {
            left,
            right,
            join,
            projection,
            schema,
            properties: Arc::new(properties.with_scheduling_type(SchedulingType::Cooperative)),
            orders,
            metrics: ExecutionPlanMetricsSet::new(),
        })
    }

    // The filter's columns, and the filter over these alone.
    fn plan_filter(&self) -> Result<Option<(Vec<usize>, SchemaRef, ExprRef)>> {
        let Some(filter) = &self.join.filter else { return Ok(None) };
        let (all, _) = build_join_schema(&self.left.schema(), &self.right.schema(), &JoinType::Inner);
        let mut columns = BTreeSet::new();
        filter.apply(|part| {
            columns.extend(part.downcast_ref::<Column>().map(Column::index));
            Ok(TreeNodeRecursion::Continue)
        })?;
        let columns: Vec<_> = columns.into_iter().collect();
        let over_these = filter.clone().transform(|part| {
            let column = part.downcast_ref::<Column>().map(|column| (column.name(), column.index()));
            Ok(match column.and_then(|(name, index)| Some((name, columns.binary_search(&index).ok()?))) {
                Some((name, place)) => Transformed::yes(Arc::new(Column::new(name, place)) as ExprRef),
                None => Transformed::no(part),
            })
        })?;
        let schema = Arc::new(Schema::project(&all, &columns)?);
        Ok(Some((columns, schema, over_these.data)))
    }
}

impl EmbeddedProjection for SortedJoinExec {
    fn with_projection(&self, projection: Option<Vec<usize>>) -> Result<Self> {
        let places = projection.map(|places| places.into_iter().map(|place| self.projection[place]).collect());
        let projection = places.unwrap_or_else(|| self.projection.clone());
        Self::try_new(self.left.clone(), self.right.clone(), self.join.clone(), Some(projection))
    }
}

impl DisplayAs for SortedJoinExec {
    fn fmt_as(&self, _: DisplayFormatType, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let MergedJoin { keys, position, order, first, last, matched, join_type, filter, .. } = self.join.as_ref();
        let keys: Vec<_> = keys.iter().map(|(left, right)| format!("({left}, {right})")).collect();
        write!(f, "SortedJoinExec: matched={matched:?}, join_type={join_type:?}, on=[{}]", keys.join(", "))?;
        write!(f, ", range=[{}]", describe_range(position, *order, first, last.as_ref()))?;
        if let Some(filter) = filter {
            write!(f, ", filter={filter}")?;
        }
        let columns: Vec<_> = self.schema.fields().iter().map(|field| field.name().as_str()).collect();
        write!(f, ", columns=[{}]", columns.join(", "))
    }
}

impl ExecutionPlan for SortedJoinExec {
    fn name(&self) -> &'static str {
        "SortedJoinExec"
    }

    fn properties(&self) -> &Arc<PlanProperties> {
        &self.properties
    }

    fn input_distribution_requirements(&self) -> InputDistributionRequirements {
        if self.join.keys.is_empty() {
            return InputDistributionRequirements::new(vec![Distribution::SinglePartition; 2]);
        }
        let (left, right) = self.join.keys.iter().cloned().unzip();
        let by_keys = vec![Distribution::KeyPartitioned(left), Distribution::KeyPartitioned(right)];
        InputDistributionRequirements::co_partitioned(by_keys)
    }

    fn required_input_ordering(&self) -> Vec<Option<OrderingRequirements>> {
        self.orders.iter().map(|order| Some(OrderingRequirements::from(order.clone()))).collect()
    }

    fn children(&self) -> Vec<&Arc<dyn ExecutionPlan>> {
        vec![&self.left, &self.right]
    }

    fn apply_expressions(
        &self,
        visit: &mut dyn FnMut(&Arc<dyn PhysicalExpr>) -> Result<TreeNodeRecursion>,
    ) -> Result<TreeNodeRecursion> {
        let join = &self.join;
        let keys = join.keys.iter().flat_map(|(left, right)| [left, right]);
        let bounds = [&join.first].into_iter().chain(&join.last).map(|bound| &bound.expr);
        apply_expression_roots(keys.chain([&join.position]).chain(bounds).chain(&join.filter), visit)
    }

    fn replace_children(
        self: Arc<Self>,
        children: Vec<Arc<dyn ExecutionPlan>>,
        _: ReplaceChildrenOptions,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let wrong = |_| DataFusionError::Internal("a join of two inputs has others".to_owned());
        let [left, right] = <[Arc<dyn ExecutionPlan>; 2]>::try_from(children).map_err(wrong)?;
        Ok(Arc::new(Self::try_new(left, right, self.join.clone(), Some(self.projection.clone()))?))
    }

    fn with_new_children(self: Arc<Self>, children: Vec<Arc<dyn ExecutionPlan>>) -> Result<Arc<dyn ExecutionPlan>> {
        self.replace_children(children, ReplaceChildrenOptions::new(ChildrenPropertiesMode::Recompute))
    }

    fn metrics(&self) -> Option<MetricsSet> {
        Some(self.metrics.clone_inner())
    }

    fn try_swapping_with_projection(&self, projection: &ProjectionExec) -> Result<Option<Arc<dyn ExecutionPlan>>> {
        try_embed_projection(projection, self)
    }

    fn execute(&self, partition: usize, context: Arc<TaskContext>) -> Result<SendableRecordBatchStream> {
        let [left, right] = [&self.left, &self.right];
        let counts = [left, right].map(|side| side.output_partitioning().partition_count());
        if counts[0] != counts[1] {
            return Err(DataFusionError::Internal(format!("a join of {} and {} partitions", counts[0], counts[1])));
        }
        let width = left.schema().fields().len();
        let (window, probe) = match self.join.window {
            WindowSide::Left => (left, right),
            WindowSide::Right => (right, left),
        };
        let sides = MergeSides {
            window_schema: window.schema(),
            width,
            projection: self.projection.clone(),
            schema: self.schema.clone(),
            filter: self.plan_filter()?,
        };
        let encoder = Arc::new(KeyEncoder::try_new(&self.join, &window.schema())?);
        let register = |name: &str| MemoryConsumer::new(name).register(context.memory_pool());
        let window = JoinWindow::new(
            window.execute(partition, context.clone())?,
            self.join.clone(),
            encoder,
            register("SortedJoinExec's window"),
        );
        let merge = SortedMerge::new(
            sides,
            probe.execute(partition, context.clone())?,
            window,
            register("SortedJoinExec"),
            context.session_config().batch_size(),
            BaselineMetrics::new(&self.metrics, partition),
        );
        let batches =
            stream::try_unfold(
                merge,
                |mut merge| async move { Ok(merge.next_batch().await?.map(|batch| (batch, merge))) },
            );
        Ok(make_cooperative(Box::pin(RecordBatchStreamAdapter::new(self.schema.clone(), batches))))
    }
}
