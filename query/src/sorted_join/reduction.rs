//! Leaves out rows of a window that no row of the probe can be joined to, before they are sorted: those whose keys are
//! not among the probe's. It pays if a condition leaves few rows of the probe, such as those of one surface. Its table
//! is then read twice, the second time for the keys alone.

use std::sync::Arc;

use datafusion::common::{Column, JoinConstraint, JoinType, NullEquality};
use datafusion::error::Result;
use datafusion::logical_expr::logical_plan::{Join, Projection};
use datafusion::logical_expr::{Expr, LogicalPlan};
use datafusion::optimizer::optimize_projections::OptimizeProjections;
use datafusion::optimizer::{OptimizerContext, OptimizerRule as _};

use super::recognition::is_movable;
use super::{SortedJoin, WindowSide};
use crate::views::scanned_table;

/// Returns the join with fewer rows of the window, if the probe is a part of a table of the lake.
///
/// # Errors
/// If the plan is not consistent.
pub(super) fn reduce_window(join: SortedJoin) -> Result<SortedJoin> {
    let (probe, window) = match join.window {
        WindowSide::Left => (&join.right, &join.left),
        WindowSide::Right => (&join.left, &join.right),
    };
    // Rows of the left without a match are kept by a left join.
    let keeps_window = join.window == WindowSide::Left && join.join_type == JoinType::Left;
    if join.keys.is_empty() || keeps_window || scanned_table(probe, false).is_none() || !is_part(probe) {
        return Ok(join);
    }
    let of_probe = join.keys.iter().enumerate().map(|(place, (left, right))| {
        let key = if join.window == WindowSide::Left { right } else { left };
        key.clone().alias(key_name(place))
    });
    let keys = LogicalPlan::Projection(Projection::try_new(of_probe.collect(), probe.clone())?);
    let keys = OptimizeProjections::new().rewrite(keys, &OptimizerContext::new())?.data;
    let on = join.keys.iter().enumerate().map(|(place, (left, right))| {
        let key = if join.window == WindowSide::Left { left } else { right };
        (key.clone(), Expr::Column(Column::from_name(key_name(place))))
    });
    let reduced = Join::try_new(
        window.clone(),
        Arc::new(keys),
        on.collect(),
        None,
        JoinType::LeftSemi,
        JoinConstraint::On,
        NullEquality::NullEqualsNothing,
        false,
    )?;
    let reduced = Arc::new(LogicalPlan::Join(reduced));
    match join.window {
        WindowSide::Left => join.with_inputs(reduced, join.right.clone()),
        WindowSide::Right => join.with_inputs(join.left.clone(), reduced),
    }
}

fn key_name(place: usize) -> String {
    format!("probe_key_{place}")
}

// Whether conditions leave out some of the rows, and the same ones each time.
fn is_part(plan: &LogicalPlan) -> bool {
    match plan {
        LogicalPlan::Filter(filter) => is_movable(&filter.predicate) && is_same(&filter.input),
        LogicalPlan::TableScan(scan) => !scan.filters.is_empty() && is_same(plan),
        LogicalPlan::SubqueryAlias(alias) => is_part(&alias.input),
        LogicalPlan::Projection(projection) => is_part(&projection.input),
        _ => false,
    }
}

fn is_same(plan: &LogicalPlan) -> bool {
    match plan {
        LogicalPlan::Filter(filter) => is_movable(&filter.predicate) && is_same(&filter.input),
        LogicalPlan::TableScan(scan) => scan.fetch.is_none() && scan.filters.iter().all(is_movable),
        LogicalPlan::SubqueryAlias(alias) => is_same(&alias.input),
        LogicalPlan::Projection(projection) => is_same(&projection.input),
        _ => false,
    }
}
