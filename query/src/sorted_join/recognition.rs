//! Finds joins by order among those of an optimized plan, which DataFusion would run as a loop over all pairs of rows, or
//! over all pairs of a key.
//!
//! | condition | joined by order |
//! | --- | --- |
//! | `b.t >= a.start and b.t < a.end`, also with keys | if no key is unique on its side |
//! | `b.t >= a.start` alone | without keys, if rows have no lists |
//! | other conditions on pairs | checked of the pairs that are found |
//!
//! A join by a key that is unique on its side has few pairs, and a side of few rows makes few of them; then nothing is
//! sorted.

use std::collections::HashSet;

use arrow::datatypes::DataType;
use datafusion::common::tree_node::{Transformed, TreeNode as _};
use datafusion::common::{Column, Dependency, JoinType, NullEquality};
use datafusion::datasource::source_as_provider;
use datafusion::error::Result;
use datafusion::logical_expr::logical_plan::Join;
use datafusion::logical_expr::utils::{conjunction, split_conjunction};
use datafusion::logical_expr::{BinaryExpr, Expr, ExprSchemable as _, LogicalPlan, Operator};

use super::reduction::reduce_window;
use super::{JoinBound, JoinOrder, MatchedRows, SortedJoin, WindowSide};
use crate::views::has_table_key;

/// Rows of a side with which a loop over all pairs costs less than sorting the other one.
const FEW_ROWS: usize = 64;

/// A comparison of an expression of the left with one of the right.
struct SideComparison<'a> {
    left: &'a Expr,
    operator: Operator,
    right: &'a Expr,
    /// Its place among the conditions.
    place: usize,
}

/// A range of the window's positions.
struct FoundRange {
    window: WindowSide,
    position: Expr,
    order: JoinOrder,
    first: JoinBound<Expr>,
    last: Option<JoinBound<Expr>>,
    /// The places of its comparisons among the conditions.
    places: Vec<usize>,
}

/// Returns a plan in which joins by order are nodes of their own.
///
/// # Errors
/// If the plan is not consistent.
pub(super) fn sort_range_joins(plan: LogicalPlan) -> Result<LogicalPlan> {
    let sorted = plan.transform_down_with_subqueries(|node| {
        let sorted = match &node {
            LogicalPlan::Join(join) => recognise_join(join),
            other => SortedJoin::of_plan(other).cloned(),
        };
        Ok(match sorted {
            Some(sorted) => Transformed::yes(reduce_window(sorted)?.into_plan()),
            None => Transformed::no(node),
        })
    })?;
    Ok(sorted.data)
}

// Returns the same join by order, if a join is one and gains by it.
fn recognise_join(join: &Join) -> Option<SortedJoin> {
    let is_plain = matches!(join.join_type, JoinType::Inner | JoinType::Left)
        && join.null_equality == NullEquality::NullEqualsNothing
        && !join.null_aware;
    let filter = join.filter.as_ref().filter(|filter| is_plain && is_movable(filter))?;
    let conditions = split_conjunction(filter);
    let comparisons: Vec<_> =
        conditions.iter().enumerate().filter_map(|(place, part)| compare_sides(join, part, place)).collect();
    let range = find_band(&comparisons).or_else(|| find_half_line(join, &comparisons))?;
    if !has_fit_keys(join) || has_few_pairs(join) {
        return None;
    }
    let rest = conditions.iter().enumerate().filter(|(place, _)| !range.places.contains(place));
    Some(SortedJoin {
        left: join.left.clone(),
        right: join.right.clone(),
        keys: join.on.clone(),
        window: range.window,
        position: range.position,
        order: range.order,
        first: range.first,
        last: range.last,
        matched: MatchedRows::All,
        join_type: join.join_type,
        filter: conjunction(rest.map(|(_, part)| (*part).clone())),
        schema: join.schema.clone(),
    })
}

/// Returns whether values of a type compare as they are sorted.
pub(crate) fn is_ordered_type(kind: &DataType) -> bool {
    kind.is_integer()
        || kind.is_decimal()
        || kind.is_string()
        || matches!(
            kind,
            DataType::Float32
                | DataType::Float64
                | DataType::Boolean
                | DataType::Date32
                | DataType::Date64
                | DataType::Time32(_)
                | DataType::Time64(_)
                | DataType::Timestamp(..)
                | DataType::Duration(_)
        )
}

/// Returns whether a condition is the same however often, and wherever, it is computed.
pub(super) fn is_movable(filter: &Expr) -> bool {
    let is_outside = |part: &Expr| {
        matches!(
            part,
            Expr::Exists(_)
                | Expr::InSubquery(_)
                | Expr::ScalarSubquery(_)
                | Expr::SetComparison(_)
                | Expr::OuterReferenceColumn(..)
        )
    };
    !filter.is_volatile() && !filter.exists(|part| Ok(is_outside(part))).unwrap_or(true)
}

fn compare_sides<'a>(join: &Join, part: &'a Expr, place: usize) -> Option<SideComparison<'a>> {
    let Expr::BinaryExpr(BinaryExpr { left, op, right }) = part else { return None };
    if !matches!(op, Operator::Lt | Operator::LtEq | Operator::Gt | Operator::GtEq) {
        return None;
    }
    let comparison = match is_of(left, &join.left) && is_of(right, &join.right) {
        true => SideComparison { left, operator: *op, right, place },
        false if is_of(left, &join.right) && is_of(right, &join.left) => {
            SideComparison { left: right, operator: op.swap()?, right: left, place }
        }
        false => return None,
    };
    let kind = comparison.left.get_type(join.left.schema()).ok()?;
    let same = comparison.right.get_type(join.right.schema()).is_ok_and(|other| other == kind);
    (same && is_ordered_type(&kind)).then_some(comparison)
}

fn is_of(expr: &Expr, plan: &LogicalPlan) -> bool {
    let columns = expr.column_refs();
    !columns.is_empty() && columns.iter().all(|column| plan.schema().has_column(column))
}

// Two comparisons of one expression, one from below and one from above.
fn find_band(comparisons: &[SideComparison<'_>]) -> Option<FoundRange> {
    [WindowSide::Right, WindowSide::Left].into_iter().find_map(|window| {
        let parts: Vec<_> = comparisons.iter().map(|comparison| comparison.seen_from(window)).collect();
        parts.iter().find_map(|first| {
            let from_below = matches!(first.operator, Operator::Gt | Operator::GtEq);
            let ends = |last: &&WindowComparison<'_>| {
                last.position == first.position && matches!(last.operator, Operator::Lt | Operator::LtEq)
            };
            let last = parts.iter().find(ends).filter(|_| from_below)?;
            Some(FoundRange {
                window,
                position: first.position.clone(),
                order: JoinOrder::Ascending,
                first: first.to_bound(),
                last: Some(last.to_bound()),
                places: vec![first.place, last.place],
            })
        })
    })
}

// One comparison. With keys half of their pairs are the answer, so that a join by keys has little to lose.
fn find_half_line(join: &Join, comparisons: &[SideComparison<'_>]) -> Option<FoundRange> {
    let has_lists = |plan: &LogicalPlan| plan.schema().fields().iter().any(|field| field.data_type().is_nested());
    if !join.on.is_empty() || has_lists(&join.left) || has_lists(&join.right) {
        return None;
    }
    let part = comparisons.first()?.seen_from(WindowSide::Right);
    let is_ascending = matches!(part.operator, Operator::Gt | Operator::GtEq);
    Some(FoundRange {
        window: WindowSide::Right,
        position: part.position.clone(),
        order: if is_ascending { JoinOrder::Ascending } else { JoinOrder::Descending },
        first: part.to_bound(),
        last: None,
        places: vec![part.place],
    })
}

/// A comparison of a position with a bound.
struct WindowComparison<'a> {
    position: &'a Expr,
    operator: Operator,
    bound: &'a Expr,
    place: usize,
}

impl<'a> SideComparison<'a> {
    fn seen_from(&self, window: WindowSide) -> WindowComparison<'a> {
        let Self { left, operator, right, place } = *self;
        let swapped = operator.swap().unwrap_or(operator);
        match window {
            WindowSide::Left => WindowComparison { position: left, operator, bound: right, place },
            WindowSide::Right => WindowComparison { position: right, operator: swapped, bound: left, place },
        }
    }
}

impl WindowComparison<'_> {
    fn to_bound(&self) -> JoinBound<Expr> {
        let is_strict = matches!(self.operator, Operator::Lt | Operator::Gt);
        JoinBound { expr: self.bound.clone(), is_strict }
    }
}

// Keys whose equality is that of their bytes, as the merge compares them.
fn has_fit_keys(join: &Join) -> bool {
    join.on.iter().all(|(left, right)| {
        let kinds = (left.get_type(join.left.schema()), right.get_type(join.right.schema()));
        matches!(kinds, (Ok(left), Ok(right)) if left == right && is_ordered_type(&left))
    })
}

fn has_few_pairs(join: &Join) -> bool {
    let is_small = |plan: &LogicalPlan| most_rows(plan).is_some_and(|rows| rows <= FEW_ROWS);
    let [left, right] = [join.on.iter().map(|on| &on.0).collect(), join.on.iter().map(|on| &on.1).collect()];
    is_small(&join.left) || is_small(&join.right) || is_unique(&join.left, left) || is_unique(&join.right, right)
}

// Whether a plan has at most one row of each value of the keys.
fn is_unique(plan: &LogicalPlan, keys: Vec<&Expr>) -> bool {
    let columns: HashSet<&Column> = keys.into_iter().filter_map(find_column).collect();
    let schema = plan.schema();
    let places: HashSet<usize> = columns.iter().filter_map(|column| schema.maybe_index_of_column(column)).collect();
    let is_determined = schema.functional_dependencies().iter().any(|dependence| {
        dependence.mode == Dependency::Single && dependence.source_indices.iter().all(|place| places.contains(place))
    });
    is_determined || has_table_key(plan, columns.iter().map(|column| column.name.as_str()))
}

// Casts of keys are to wider types.
fn find_column(key: &Expr) -> Option<&Column> {
    match key {
        Expr::Cast(cast) => find_column(&cast.expr),
        key => key.try_as_col(),
    }
}

// At most so many rows, if it is known.
fn most_rows(plan: &LogicalPlan) -> Option<usize> {
    match plan {
        LogicalPlan::TableScan(scan) => {
            let rows = || source_as_provider(&scan.source).ok()?.statistics()?.num_rows.get_value().copied();
            scan.fetch.or_else(rows)
        }
        LogicalPlan::SubqueryAlias(alias) => most_rows(&alias.input),
        LogicalPlan::Projection(projection) => most_rows(&projection.input),
        LogicalPlan::Filter(filter) => most_rows(&filter.input),
        LogicalPlan::Join(_) => None,
        other => other.max_rows(),
    }
}
