//! The types that a statement declares before it runs: those of its answer.
//!
//! DataFusion takes the type of the first branch of a CASE, and of the first query of a UNION, until it coerces types.
//! Clients of Postgres' protocol read an answer by the types that were declared.

use datafusion::common::config::ConfigOptions;
use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::error::Result;
use datafusion::logical_expr::{Expr, LogicalPlan};
use datafusion::optimizer::AnalyzerRule as _;
use datafusion::optimizer::analyzer::type_coercion::TypeCoercion;

/// Coerces the types of a plan whose declared ones may not be those of its answer.
pub(super) fn settle_types(plan: LogicalPlan, options: &ConfigOptions) -> Result<LogicalPlan> {
    let mut is_open = false;
    plan.apply(|node| {
        is_open |= matches!(node, LogicalPlan::Union(_));
        node.apply_expressions(|expr| {
            is_open = is_open || expr.exists(|part| Ok(matches!(part, Expr::Case(_))))?;
            Ok(if is_open { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
        })
    })?;
    match is_open {
        // What cannot be coerced yet, as a parameter of unknown type, is an error when the statement runs.
        true => Ok(TypeCoercion::new().analyze(plan.clone(), options).unwrap_or(plan)),
        false => Ok(plan),
    }
}
