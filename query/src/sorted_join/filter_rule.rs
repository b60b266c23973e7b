//! An optimizer rule: moves conditions on an as-of join below it. One that is about rows of the left alone leaves them
//! out before the join. If it is about keys, it also leaves out rows of the right that no such row is joined to. A
//! condition on other columns of the right stays above: there it is about the nearest row, below it would choose
//! another one.

use std::collections::HashMap;
use std::sync::Arc;

use datafusion::common::Column;
use datafusion::common::tree_node::{Transformed, TreeNode as _};
use datafusion::error::Result;
use datafusion::logical_expr::utils::{conjunction, split_conjunction};
use datafusion::logical_expr::{Expr, ExprSchemable as _, Filter, LogicalPlan};
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};

use super::SortedJoin;
use super::recognition::is_movable;

/// The rule.
#[derive(Debug)]
pub(crate) struct AsOfFilter;

impl OptimizerRule for AsOfFilter {
    fn name(&self) -> &str {
        "as_of_filter"
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        Some(ApplyOrder::TopDown)
    }

    fn rewrite(&self, plan: LogicalPlan, _config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        let LogicalPlan::Filter(filter) = &plan else { return Ok(Transformed::no(plan)) };
        let Some(join) = SortedJoin::of_plan(&filter.input) else { return Ok(Transformed::no(plan)) };
        let (moved, kept): (Vec<_>, Vec<_>) =
            split_conjunction(&filter.predicate).into_iter().cloned().partition(|part| is_about_left(part, join));
        if moved.is_empty() {
            return Ok(Transformed::no(plan));
        }
        let keys: HashMap<_, _> =
            join.keys.iter().filter_map(|(left, right)| same_columns(join, left, right)).collect();
        let about_keys = moved.iter().filter_map(|part| rename_keys(part, &keys)).collect();
        let left = filter_rows(&join.left, moved)?;
        let right = filter_rows(&join.right, about_keys)?;
        let join = Arc::new(join.with_inputs(left, right)?.into_plan());
        Ok(Transformed::yes(Arc::unwrap_or_clone(filter_rows(&join, kept)?)))
    }
}

fn is_about_left(part: &Expr, join: &SortedJoin) -> bool {
    let columns = part.column_refs();
    let is_left = columns.iter().all(|column| join.left.schema().has_column(column));
    is_left && !columns.is_empty() && is_movable(part)
}

// Columns of a key that are the same value in both sides. Floats are not: -0.0 equals 0.0.
fn same_columns<'a>(join: &SortedJoin, left: &'a Expr, right: &'a Expr) -> Option<(&'a Column, &'a Column)> {
    let is_float = left.get_type(join.left.schema()).is_ok_and(|kind| kind.is_floating());
    Some((left.try_as_col()?, right.try_as_col()?)).filter(|_| !is_float)
}

// The same of the right; None if it is about other columns than keys.
fn rename_keys(part: &Expr, keys: &HashMap<&Column, &Column>) -> Option<Expr> {
    if !part.column_refs().iter().all(|column| keys.contains_key(column)) {
        return None;
    }
    let renamed = part.clone().transform(|part| match &part {
        Expr::Column(column) => Ok(match keys.get(column) {
            Some(other) => Transformed::yes(Expr::Column((*other).clone())),
            None => Transformed::no(part),
        }),
        _ => Ok(Transformed::no(part)),
    });
    renamed.ok().map(|renamed| renamed.data)
}

fn filter_rows(plan: &Arc<LogicalPlan>, parts: Vec<Expr>) -> Result<Arc<LogicalPlan>> {
    match conjunction(parts) {
        Some(predicate) => Ok(Arc::new(LogicalPlan::Filter(Filter::try_new(predicate, plan.clone())?))),
        None => Ok(plan.clone()),
    }
}
