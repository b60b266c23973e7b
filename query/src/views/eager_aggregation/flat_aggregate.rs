//! An aggregate whose expressions are written in the columns of the scan of its largest table, and of the tables that
//! are joined to it: projections and aliases between them are substituted.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::common::{Column, DFSchema, JoinType};
use datafusion::datasource::source_as_provider;
use datafusion::logical_expr::expr::AggregateFunction;
use datafusion::logical_expr::logical_plan::{Aggregate, Filter, Join, TableScan};
use datafusion::logical_expr::utils::{conjunction, split_conjunction};
use datafusion::logical_expr::{Expr, LogicalPlan};
use echolake_lake_tables::{LakeTable, TableSize};

use super::symmetry_rows::SymmetryRows;
use crate::views::LookupFunctions;

/// Nodes of all expressions together, above which they are not substituted: each projection may name a long expression
/// many times.
const MOST_NODES: usize = 2000;

/// A node between the aggregate and its rows. A row of its input becomes no row, one or several, which follow from the
/// row's columns in the node's own expressions and from other tables.
pub(super) enum RowStep {
    /// Keeps the rows that satisfy a predicate.
    Filter(Expr),
    /// Joins other rows; the side with the rows of the aggregate loses none for want of a match, or the join is inner.
    Join {
        /// The join, whose expressions are substituted, and whose side with the rows is not used.
        join: Join,
        /// Whether the rows are its left side.
        rows_on_left: bool,
    },
}

/// The aggregate.
pub(super) struct FlatAggregate {
    /// What its rows are grouped by.
    pub group: Vec<Expr>,
    /// Its functions, plain ones: not `DISTINCT`, without `FILTER` and without an order.
    pub calls: Vec<AggregateFunction>,
    /// From the aggregate down; the last one is a join, or there is none.
    pub steps: Vec<RowStep>,
    /// The largest table's rows, filtered.
    pub rows: Arc<LogicalPlan>,
    /// The predicates of these rows.
    pub predicates: Vec<Expr>,
    /// Size of the table.
    pub size: TableSize,
}

impl RowStep {
    fn exprs_mut(&mut self) -> Vec<&mut Expr> {
        match self {
            Self::Filter(predicate) => vec![predicate],
            Self::Join { join, .. } => {
                let keys = join.on.iter_mut().flat_map(|(left, right)| [left, right]);
                keys.chain(&mut join.filter).collect()
            }
        }
    }

    /// Returns its expressions.
    pub fn exprs(&self) -> Vec<&Expr> {
        match self {
            Self::Filter(predicate) => vec![predicate],
            Self::Join { join, .. } => {
                join.on.iter().flat_map(|(left, right)| [left, right]).chain(&join.filter).collect()
            }
        }
    }

    /// Returns the schema of the rows that it joins.
    pub fn joined_schema(&self) -> Option<&DFSchema> {
        match self {
            Self::Filter(_) => None,
            Self::Join { join, rows_on_left: true } => Some(join.right.schema()),
            Self::Join { join, rows_on_left: false } => Some(join.left.schema()),
        }
    }
}

impl FlatAggregate {
    /// Substitutes what is between an aggregate and the scan of its largest table; None if there are other nodes than
    /// projections, filters and joins, or other functions than plain ones.
    pub fn from_aggregate(aggregate: &Aggregate, lookups: &LookupFunctions) -> Option<Self> {
        let calls = aggregate.aggr_expr.iter().map(plain_call).collect::<Option<Vec<_>>>()?;
        let mut flat = Self {
            group: aggregate.group_expr.iter().cloned().map(strip_aliases).collect::<Option<_>>()?,
            calls,
            steps: Vec::new(),
            rows: aggregate.input.clone(),
            predicates: Vec::new(),
            size: TableSize::default(),
        };
        let mut plan = aggregate.input.clone();
        loop {
            plan = match plan.as_ref() {
                LogicalPlan::Projection(projection) => {
                    flat.substitute(&projection.schema, projection.expr.iter().cloned())?;
                    projection.input.clone()
                }
                LogicalPlan::SubqueryAlias(alias) => {
                    let columns = alias.input.schema().columns();
                    flat.substitute(&alias.schema, columns.into_iter().map(Expr::Column))?;
                    alias.input.clone()
                }
                LogicalPlan::Filter(filter) => {
                    flat.steps.push(RowStep::Filter(filter.predicate.clone()));
                    filter.input.clone()
                }
                LogicalPlan::Join(join) => {
                    let rows_on_left = count_rows(&join.left) >= count_rows(&join.right);
                    match (join.join_type, rows_on_left) {
                        (JoinType::Inner, _) | (JoinType::Left, true) | (JoinType::Right, false) => {}
                        _ => return None,
                    }
                    let rows = if rows_on_left { join.left.clone() } else { join.right.clone() };
                    flat.steps.push(RowStep::Join { join: join.clone(), rows_on_left });
                    rows
                }
                LogicalPlan::TableScan(scan) => match SymmetryRows::from_scan(scan, lookups) {
                    Some(SymmetryRows { columns, join }) => {
                        flat.substitute(&scan.projected_schema, columns.into_iter())?;
                        let measured = join.right.clone();
                        flat.steps.push(RowStep::Join { join, rows_on_left: false });
                        measured
                    }
                    None => {
                        flat.size = table_size(scan)?;
                        break;
                    }
                },
                _ => return None,
            };
        }
        flat.end_steps(plan)
    }

    // The filters below the last join are those of the table's rows, and those just above it that are of these rows.
    fn end_steps(mut self, scan: Arc<LogicalPlan>) -> Option<Self> {
        let columns: HashSet<_> = scan.schema().columns().into_iter().collect();
        let is_of_rows = |predicate: &Expr| predicate.column_refs().into_iter().all(|column| columns.contains(column));
        while let Some(step) = self.steps.pop_if(|step| matches!(step, RowStep::Filter(_))) {
            self.predicates.extend(step.exprs().into_iter().cloned());
        }
        if let Some(join) = self.steps.pop() {
            let mut kept = Vec::new();
            while let Some(step) = self.steps.pop_if(|step| matches!(step, RowStep::Filter(_))) {
                let parts = step.exprs().into_iter().flat_map(split_conjunction);
                let (of_rows, joined): (Vec<_>, Vec<_>) = parts.cloned().partition(is_of_rows);
                self.predicates.extend(of_rows);
                kept.extend(conjunction(joined).map(RowStep::Filter));
            }
            self.steps.extend(kept.into_iter().rev());
            self.steps.push(join);
        }
        let mut rows = scan;
        for predicate in &self.predicates {
            rows = Arc::new(LogicalPlan::Filter(Filter::try_new(predicate.clone(), rows).ok()?));
        }
        self.rows = rows;
        let has_own_names = self.joined_columns().all(|column| !self.rows.schema().has_column(&column));
        (has_own_names && self.exprs().all(is_movable)).then_some(self)
    }

    fn exprs(&self) -> impl Iterator<Item = &Expr> {
        let calls = self.calls.iter().flat_map(|call| &call.params.args);
        let steps = self.steps.iter().flat_map(RowStep::exprs);
        self.group.iter().chain(calls).chain(steps).chain(&self.predicates)
    }

    fn joined_columns(&self) -> impl Iterator<Item = Column> {
        self.steps.iter().filter_map(RowStep::joined_schema).flat_map(DFSchema::columns)
    }

    // Writes the expressions in the columns of a node's input. None if a name means a joined column, too, or if they
    // become too long.
    fn substitute(&mut self, outputs: &DFSchema, inputs: impl Iterator<Item = Expr>) -> Option<()> {
        let inputs = inputs.map(strip_aliases).collect::<Option<Vec<_>>>()?;
        let inputs: HashMap<Column, Expr> = outputs.columns().into_iter().zip(inputs).collect();
        if self.joined_columns().any(|column| inputs.contains_key(&column)) {
            return None;
        }
        let sizes: HashMap<&Column, usize> = inputs.iter().map(|(column, expr)| (column, count_nodes(expr))).collect();
        let mut nodes = 0;
        for expr in self.exprs() {
            nodes += count_nodes(expr);
            for (column, uses) in expr.column_refs_counts() {
                nodes += uses * sizes.get(column).unwrap_or(&0);
            }
        }
        if nodes > MOST_NODES {
            return None;
        }
        let calls = self.calls.iter_mut().flat_map(|call| &mut call.params.args);
        let steps = self.steps.iter_mut().flat_map(RowStep::exprs_mut);
        for expr in self.group.iter_mut().chain(calls).chain(steps) {
            let written = std::mem::take(expr).transform_up(|part| match &part {
                Expr::Column(column) => match inputs.get(column) {
                    Some(input) => Ok(Transformed::yes(input.clone())),
                    None => Ok(Transformed::no(part)),
                },
                _ => Ok(Transformed::no(part)),
            });
            *expr = written.ok()?.data;
        }
        Some(())
    }
}

/// Returns how many rows the largest table has that a plan of projections, filters and joins reads.
pub(super) fn count_rows(plan: &LogicalPlan) -> u64 {
    match plan {
        LogicalPlan::TableScan(scan) => table_size(scan).map_or(0, |size| size.rows),
        LogicalPlan::Projection(projection) => count_rows(&projection.input),
        LogicalPlan::Filter(filter) => count_rows(&filter.input),
        LogicalPlan::SubqueryAlias(alias) => count_rows(&alias.input),
        LogicalPlan::Join(join) => count_rows(&join.left).max(count_rows(&join.right)),
        _ => 0,
    }
}

fn table_size(scan: &TableScan) -> Option<TableSize> {
    let provider = source_as_provider(&scan.source).ok()?;
    let provider: &dyn std::any::Any = provider.as_ref();
    provider.downcast_ref::<LakeTable>().map(LakeTable::table_size)
}

fn plain_call(expr: &Expr) -> Option<AggregateFunction> {
    let mut expr = expr;
    while let Expr::Alias(alias) = expr {
        expr = &alias.expr;
    }
    let Expr::AggregateFunction(call) = expr else { return None };
    let params = &call.params;
    let is_plain =
        !params.distinct && params.filter.is_none() && params.order_by.is_empty() && params.null_treatment.is_none();
    if !is_plain {
        return None;
    }
    let mut call = call.clone();
    call.params.args = call.params.args.into_iter().map(strip_aliases).collect::<Option<_>>()?;
    Some(call)
}

// Whether the expression means the same over other rows with the same columns, and however often it is computed.
fn is_movable(expr: &Expr) -> bool {
    let is_bound = |part: &Expr| {
        part.is_volatile_node()
            || matches!(
                part,
                Expr::ScalarSubquery(_)
                    | Expr::Exists(_)
                    | Expr::InSubquery(_)
                    | Expr::SetComparison(_)
                    | Expr::OuterReferenceColumn(..)
                    | Expr::GroupingSet(_)
                    | Expr::AggregateFunction(_)
                    | Expr::WindowFunction(_)
                    | Expr::Unnest(_)
                    | Expr::HigherOrderFunction(_)
            )
    };
    expr.exists(|part| Ok(is_bound(part))).is_ok_and(|is_bound| !is_bound)
}

fn strip_aliases(expr: Expr) -> Option<Expr> {
    let stripped = expr.transform_up(|part| match part {
        Expr::Alias(alias) => Ok(Transformed::yes(*alias.expr)),
        part => Ok(Transformed::no(part)),
    });
    stripped.ok().map(|stripped| stripped.data)
}

fn count_nodes(expr: &Expr) -> usize {
    let mut nodes = 0;
    let counted = expr.apply(|_| {
        nodes += 1;
        Ok(TreeNodeRecursion::Continue)
    });
    counted.map_or(MOST_NODES + 1, |_| nodes)
}
