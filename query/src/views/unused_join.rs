//! An optimizer rule: removes a left join that finds one row at most and of which no column is used. It lets a view
//! offer columns of tables that most of its queries do not need.

use std::collections::HashSet;
use std::sync::Arc;

use datafusion::common::tree_node::Transformed;
use datafusion::common::{Column, JoinType};
use datafusion::error::Result;
use datafusion::logical_expr::logical_plan::{Aggregate, Join, Projection};
use datafusion::logical_expr::{Expr, LogicalPlan};
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use echolake_schema::Table;

use super::pair_join::scanned_table;

/// The rule.
#[derive(Debug)]
pub(crate) struct UnusedJoin;

impl OptimizerRule for UnusedJoin {
    fn name(&self) -> &str {
        "unused_join"
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        Some(ApplyOrder::TopDown)
    }

    fn rewrite(&self, plan: LogicalPlan, _config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        match plan {
            LogicalPlan::Projection(mut projection) => match left_of(&projection.input, projection.expr.iter()) {
                Some(left) => {
                    projection.input = left;
                    let Projection { expr, input, .. } = projection;
                    Ok(Transformed::yes(LogicalPlan::Projection(Projection::try_new(expr, input)?)))
                }
                None => Ok(Transformed::no(LogicalPlan::Projection(projection))),
            },
            LogicalPlan::Aggregate(aggregate) => {
                match left_of(&aggregate.input, aggregate.group_expr.iter().chain(&aggregate.aggr_expr)) {
                    Some(left) => {
                        let rest = Aggregate::try_new_with_schema(
                            left,
                            aggregate.group_expr,
                            aggregate.aggr_expr,
                            aggregate.schema,
                        )?;
                        Ok(Transformed::yes(LogicalPlan::Aggregate(rest)))
                    }
                    None => Ok(Transformed::no(LogicalPlan::Aggregate(aggregate))),
                }
            }
            other => Ok(Transformed::no(other)),
        }
    }
}

// Returns the left side of such a join, if `input` is one. Several may be nested.
fn left_of<'a>(input: &Arc<LogicalPlan>, used: impl Iterator<Item = &'a Expr>) -> Option<Arc<LogicalPlan>> {
    let mut columns = HashSet::new();
    for expr in used {
        columns.extend(expr.column_refs().into_iter().cloned());
    }
    let mut left = None;
    let mut at = input;
    while let LogicalPlan::Join(join) = at.as_ref()
        && changes_nothing(join, &columns)
    {
        left = Some(join.left.clone());
        at = &join.left;
    }
    left
}

fn changes_nothing(join: &Join, used: &HashSet<Column>) -> bool {
    join.join_type == JoinType::Left
        && join.filter.is_none()
        && !used.iter().any(|column| join.right.schema().has_column(column))
        && finds_one(&join.right, &join.on)
}

fn finds_one(right: &LogicalPlan, on: &[(Expr, Expr)]) -> bool {
    has_table_key(right, on.iter().filter_map(|(_, key)| key.try_as_col()).map(|key| key.name.as_str()))
}

/// Returns whether rows of a table of the lake are in a plan, each determined by the columns of these names.
pub(crate) fn has_table_key<'a>(plan: &LogicalPlan, columns: impl Iterator<Item = &'a str>) -> bool {
    let columns: HashSet<_> = columns.collect();
    let key = scanned_table(plan, false).map_or(&[] as &[_], Table::key);
    !key.is_empty() && key.iter().all(|column| columns.contains(column))
}
