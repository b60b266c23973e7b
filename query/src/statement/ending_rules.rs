//! Rules of the optimizer that end with their statement: planning waits for nothing, so that a large plan would be
//! optimized to its end after its statement was cancelled.

use std::sync::Arc;

use datafusion::common::tree_node::Transformed;
use datafusion::error::Result;
use datafusion::logical_expr::LogicalPlan;
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use echolake_functions::check_stop;

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
        self.0.rewrite(plan, config)
    }
}
