//! An optimizer rule: sorts nulls last if a sort key has none. It changes no answer, and it lets the scan beneath a
//! `limit` skip files: with nulls first, the default of `desc`, every file might contain one.

use datafusion::common::tree_node::Transformed;
use datafusion::error::Result;
use datafusion::logical_expr::{ExprSchemable as _, LogicalPlan};
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};

/// The rule.
#[derive(Debug)]
pub(crate) struct SortedNulls;

impl OptimizerRule for SortedNulls {
    fn name(&self) -> &str {
        "sorted_nulls"
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        Some(ApplyOrder::TopDown)
    }

    fn rewrite(&self, plan: LogicalPlan, _config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        let LogicalPlan::Sort(mut sort) = plan else { return Ok(Transformed::no(plan)) };
        let mut is_changed = false;
        for key in sort.expr.iter_mut().filter(|key| key.nulls_first) {
            if !key.expr.nullable(sort.input.schema().as_ref())? {
                key.nulls_first = false;
                is_changed = true;
            }
        }
        let sort = LogicalPlan::Sort(sort);
        Ok(if is_changed { Transformed::yes(sort) } else { Transformed::no(sort) })
    }
}
