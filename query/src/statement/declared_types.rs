//! The types that a statement declares before it runs: those of its answer.
//!
//! DataFusion takes the type of the first branch of a CASE, and of the first query of a UNION, until it coerces types.
//! Clients of Postgres' protocol read an answer by the types that were declared. It also takes a subquery for a value
//! that is never null if its column is none, although a subquery without a row is null.

use std::sync::Arc;

use datafusion::common::Column;
use datafusion::common::config::ConfigOptions;
use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::error::Result;
use datafusion::functions::math::random;
use datafusion::logical_expr::{EmptyRelation, Expr, LogicalPlan, LogicalPlanBuilder, lit, when};
use datafusion::optimizer::AnalyzerRule as _;
use datafusion::optimizer::analyzer::type_coercion::TypeCoercion;

use super::subquery_conditions::has_one_row;

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

/// Lets a subquery that is a value be null if it may have no row.
pub(super) fn allow_null(mut expr: Expr) -> Result<Transformed<Expr>> {
    let Expr::ScalarSubquery(subquery) = &mut expr else { return Ok(Transformed::no(expr)) };
    let plan = &subquery.subquery;
    let is_right = plan.schema().field(0).is_nullable() || always_has_row(plan);
    // What depends on the row around it becomes an outer join, whose columns may be null.
    if is_right || !subquery.outer_ref_columns.is_empty() {
        return Ok(Transformed::no(expr));
    }
    let column = Column::from(plan.schema().qualified_field(0));
    let name = column.name.clone();
    // A condition that is always true, and that no optimizer folds: CASE without ELSE may be null.
    let always = random().call(Vec::new()).gt_eq(lit(0.0));
    let value = when(always, Expr::Column(column)).end()?.alias(name);
    subquery.subquery = Arc::new(LogicalPlanBuilder::from(Arc::clone(plan)).project([value])?.build()?);
    Ok(Transformed::yes(expr))
}

fn always_has_row(plan: &LogicalPlan) -> bool {
    let is_constant =
        |plan: &LogicalPlan| matches!(plan, LogicalPlan::EmptyRelation(EmptyRelation { produce_one_row: true, .. }));
    has_one_row(plan) || matches!(plan, LogicalPlan::Projection(projection) if is_constant(&projection.input))
}
