//! What ends with its statement, although it waits for nothing: a large plan would be optimized to its end after its
//! statement was cancelled, and a join would look at all pairs of a batch.

use std::sync::Arc;

use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::config::ConfigOptions;
use datafusion::error::Result;
use datafusion::logical_expr::LogicalPlan;
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use datafusion::physical_expr::ScalarFunctionExpr;
use datafusion::physical_optimizer::{PhysicalOptimizerContext, PhysicalOptimizerRule};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::joins::utils::JoinFilter;
use datafusion::physical_plan::joins::{NestedLoopJoinExec, NestedLoopJoinExecBuilder};
use echolake_functions::{check_stop, ending_condition};
use echolake_lake_tables::rewrite_children;

/// DataFusion's rule that makes a product and a condition a join by keys.
const CROSS_JOINS: &str = "eliminate_cross_join";
/// Joins of a plan above which the rule is not applied: three hundred take it a minute.
const MOST_JOINS: usize = 100;

fn count_joins(plan: &LogicalPlan) -> usize {
    let mut joins = 0;
    // Counting fails for no plan.
    let _ = plan.apply(|node| {
        joins += usize::from(matches!(node, LogicalPlan::Join(_)));
        Ok(TreeNodeRecursion::Continue)
    });
    joins
}

/// A rule that is applied to no further node once its statement has ended.
#[derive(Debug)]
pub(crate) struct EndingRule(pub Arc<dyn OptimizerRule + Send + Sync>);

impl OptimizerRule for EndingRule {
    fn name(&self) -> &str {
        self.0.name()
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        self.0.apply_order()
    }

    fn rewrite(&self, plan: LogicalPlan, config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        check_stop()?;
        // It looks at all joins again for each of them.
        if self.0.name() == CROSS_JOINS && count_joins(&plan) > MOST_JOINS {
            return Ok(Transformed::no(plan));
        }
        self.0.rewrite(plan, config)
    }
}

/// A rule of physical plans that does not begin once its statement has ended.
#[derive(Debug)]
pub(crate) struct EndingPhysicalRule(pub Arc<dyn PhysicalOptimizerRule + Send + Sync>);

impl PhysicalOptimizerRule for EndingPhysicalRule {
    fn name(&self) -> &str {
        self.0.name()
    }

    fn schema_check(&self) -> bool {
        self.0.schema_check()
    }

    fn optimize(&self, plan: Arc<dyn ExecutionPlan>, options: &ConfigOptions) -> Result<Arc<dyn ExecutionPlan>> {
        check_stop()?;
        self.0.optimize(plan, options)
    }

    fn optimize_with_context(
        &self,
        plan: Arc<dyn ExecutionPlan>,
        context: &dyn PhysicalOptimizerContext,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        check_stop()?;
        self.0.optimize_with_context(plan, context)
    }
}

/// Makes the joins of a plan that look at all pairs ask, for each row of one side, whether the statement goes on. It is
/// called just before the plan runs: no plan crosses the wire after it.
///
/// # Errors
/// None but those of DataFusion's own constructors.
pub(crate) fn end_joins(plan: Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>> {
    let plan = rewrite_children(plan, &mut end_joins)?;
    let Some(join) = plan.downcast_ref::<NestedLoopJoinExec>() else { return Ok(plan) };
    let Some(filter) = join.filter() else { return Ok(plan) };
    let field = filter.expression().return_field(filter.schema())?;
    let function = ending_condition();
    let name = function.name().to_owned();
    let args = vec![filter.expression().clone()];
    let condition = ScalarFunctionExpr::new(&name, function, args, field, Arc::new(ConfigOptions::new()));
    let filter = JoinFilter::new(Arc::new(condition), filter.column_indices().to_vec(), filter.schema().clone());
    Ok(Arc::new(NestedLoopJoinExecBuilder::from(join).with_filter(Some(filter)).build()?))
}
