//! The two halves of an aggregate: partial results of groups of rows, and totals of them.

use std::collections::{BTreeSet, HashSet};
use std::sync::Arc;

use arrow::datatypes::DataType;
use datafusion::common::metadata::FieldMetadata;
use datafusion::common::tree_node::TreeNode as _;
use datafusion::common::{Column, DFSchema, JoinType};
use datafusion::functions::core::coalesce;
use datafusion::functions_aggregate::count::count_udaf;
use datafusion::logical_expr::expr::{AggregateFunction, Cast, ScalarFunction};
use datafusion::logical_expr::logical_plan::{Aggregate, Filter, Join, Projection};
use datafusion::logical_expr::{
    AggregateUDF, BinaryExpr, Expr, ExprSchemable as _, LogicalPlan, Operator, cast, lit, when,
};

use super::flat_aggregate::{FlatAggregate, RowStep};
use super::{EagerAggregation, KeyDimension};

/// Scalar functions of floats that fail for no value.
const UNFAILING: [&str; 9] = ["abs", "ceil", "coalesce", "floor", "log10", "nullif", "one_nan", "one_zero", "sqrt"];

/// The halves.
pub(super) struct SplitAggregate<'a> {
    rule: &'a EagerAggregation,
    row_columns: HashSet<Column>,
    /// Columns of the rows, and of all that is joined to them.
    scope: DFSchema,
    /// Whether rows may be left out after they have been aggregated.
    is_joined: bool,
    /// Columns of the rows that the second half needs.
    keys: BTreeSet<Column>,
    partials: Vec<Expr>,
    totals: Vec<Expr>,
    /// What the aggregate's functions are, by totals.
    results: Vec<Expr>,
}

impl<'a> SplitAggregate<'a> {
    /// Splits an aggregate; None if one of its functions does not split, or no join and no lookup is saved.
    pub fn from_flat(rule: &'a EagerAggregation, flat: &FlatAggregate) -> Option<Self> {
        let mut scope = flat.rows.schema().as_ref().clone();
        flat.steps.iter().filter_map(RowStep::joined_schema).for_each(|joined| scope.merge(joined));
        let mut split = Self {
            rule,
            row_columns: flat.rows.schema().columns().into_iter().collect(),
            scope,
            is_joined: !flat.steps.is_empty(),
            keys: BTreeSet::new(),
            partials: Vec::new(),
            totals: Vec::new(),
            results: Vec::new(),
        };
        let steps = flat.steps.iter().flat_map(RowStep::exprs);
        flat.group.iter().chain(steps).for_each(|expr| split.add_keys(expr));
        let mut has_lookup = flat.group.iter().any(|expr| split.has_lookup(expr));
        let one = lit(1_i64);
        for call in &flat.calls {
            let [value] = call.params.args.as_slice() else { return None };
            // As moved pairs, which need no group of their own then.
            let value = if call.func.name() == "count" && split.is_never_null(value, flat) { &one } else { value };
            let result = if split.is_of_groups(value) {
                has_lookup |= split.has_lookup(value);
                split.add_keys(value);
                split.split_weighted(call, value)?
            } else if split.is_of_rows(value) {
                split.split_plain(call, value)?
            } else {
                return None;
            };
            split.results.push(result);
        }
        (split.is_joined || has_lookup).then_some(split)
    }

    /// Returns the columns by which rows are grouped first.
    pub fn keys(&self) -> &BTreeSet<Column> {
        &self.keys
    }

    /// Returns the plan, which has the schema of the aggregate; None if it would have another one.
    pub fn build_plan(mut self, flat: FlatAggregate, schema: &DFSchema) -> Option<LogicalPlan> {
        // Without a key, no rows would be one group.
        let counted = self.keys.is_empty().then(|| self.partial(&count_udaf(), lit(1_i64)));
        let Self { keys, partials, totals, results, .. } = self;
        let keys = keys.into_iter().map(Expr::Column).collect();
        let first = Aggregate::try_new(flat.rows, keys, name_columns(partials, PARTIAL)).ok()?;
        let mut plan = Arc::new(LogicalPlan::Aggregate(first));
        if let Some(counted) = counted {
            plan = Arc::new(LogicalPlan::Filter(Filter::try_new(counted.gt(lit(0_i64)), plan).ok()?));
        }
        for step in flat.steps.into_iter().rev() {
            plan = Arc::new(match step {
                RowStep::Filter(predicate) => LogicalPlan::Filter(Filter::try_new(predicate, plan).ok()?),
                RowStep::Join { join, rows_on_left } => LogicalPlan::Join(join_again(join, plan, rows_on_left)?),
            });
        }
        let groups = flat.group.len();
        let second = Aggregate::try_new(plan, flat.group, name_columns(totals, TOTAL)).ok()?;
        let keys = second.schema.columns().into_iter().take(groups).map(Expr::Column);
        let named = keys.chain(results).zip(schema.iter()).map(|(value, (relation, field))| {
            let is_named = |column: &Column| column.relation.as_ref() == relation && column.name == *field.name();
            if value.try_as_col().is_some_and(is_named) {
                return value;
            }
            let metadata = Some(FieldMetadata::from(field.metadata())).filter(|_| !field.metadata().is_empty());
            value.alias_qualified_with_metadata(relation.cloned(), field.name(), metadata)
        });
        let named: Vec<_> = named.collect();
        let plan = Projection::try_new(named, Arc::new(LogicalPlan::Aggregate(second))).ok()?;
        let is_same = plan.schema.fields().len() == schema.fields().len()
            && plan.schema.iter().zip(schema.iter()).all(|((own, field), (relation, expected))| {
                own == relation
                    && field.name() == expected.name()
                    && field.data_type() == expected.data_type()
                    && field.is_nullable() == expected.is_nullable()
                    && field.metadata() == expected.metadata()
            });
        is_same.then_some(LogicalPlan::Projection(plan))
    }

    fn add_keys(&mut self, expr: &Expr) {
        let columns = expr.column_refs().into_iter().filter(|column| self.row_columns.contains(*column));
        self.keys.extend(columns.cloned());
    }

    fn has_lookup(&self, expr: &Expr) -> bool {
        let is_lookup = |part: &Expr| match part {
            Expr::ScalarFunction(call) => self.rule.lookups.is_lookup(&call.func),
            _ => false,
        };
        expr.exists(|part| Ok(is_lookup(part))).unwrap_or(false)
    }

    // Whether a value is the same for all rows of a group, and is better computed once: it has joined columns, or looks
    // something up.
    fn is_of_groups(&self, value: &Expr) -> bool {
        let columns = value.column_refs();
        let (of_rows, joined): (Vec<_>, Vec<_>) = columns.into_iter().partition(|c| self.row_columns.contains(*c));
        (!joined.is_empty() || self.has_lookup(value))
            && of_rows.iter().all(|column| KeyDimension::from_column(&column.name).is_some())
    }

    // Whether a value has no nulls, so that counting it counts rows. Outer joins make nulls of any column.
    fn is_never_null(&self, value: &Expr, flat: &FlatAggregate) -> bool {
        let is_outer = |step: &RowStep| matches!(step, RowStep::Join { join, .. } if join.join_type != JoinType::Inner);
        !flat.steps.iter().any(is_outer)
            && self.cannot_fail(value)
            && value.nullable(&self.scope).is_ok_and(|is_nullable| !is_nullable)
    }

    // Whether a value is of a row alone, and fails for no row, also not for one that the join would have left out.
    fn is_of_rows(&self, value: &Expr) -> bool {
        value.column_refs().into_iter().all(|column| self.row_columns.contains(column))
            && (!self.is_joined || self.cannot_fail(value))
    }

    fn cannot_fail(&self, value: &Expr) -> bool {
        let is_float = |expr: &Expr| expr.get_type(&self.scope).is_ok_and(|kind| kind == DataType::Float64);
        match value {
            Expr::Column(_) | Expr::Literal(..) => true,
            Expr::Cast(Cast { expr, field }) => {
                let from = expr.get_type(&self.scope);
                let is_wider = match (from, field.data_type()) {
                    (Ok(from), DataType::Float64) => from.is_integer() || from == DataType::Float32,
                    (Ok(from), DataType::Int64) => matches!(from, DataType::Int8 | DataType::Int16 | DataType::Int32),
                    _ => false,
                };
                is_wider && self.cannot_fail(expr)
            }
            Expr::BinaryExpr(BinaryExpr {
                left,
                op: Operator::Plus | Operator::Minus | Operator::Multiply | Operator::Divide,
                right,
            }) => is_float(left) && is_float(right) && self.cannot_fail(left) && self.cannot_fail(right),
            Expr::ScalarFunction(ScalarFunction { func, args }) => {
                let is_known = UNFAILING.contains(&func.name()) || self.rule.lookups.is_lookup(func);
                is_known && args.iter().all(|arg| self.cannot_fail(arg))
            }
            _ => false,
        }
    }

    // A function of a value of each row.
    fn split_plain(&mut self, call: &AggregateFunction, value: &Expr) -> Option<Expr> {
        match call.func.name() {
            "count" => Some(self.total_count(value)),
            "sum" | "min" | "max" => {
                let partial = self.partial(&call.func, value.clone());
                Some(self.total(&call.func, partial))
            }
            "avg" if value.get_type(&self.scope).ok()? == DataType::Float64 => {
                let sum = self.partial(&self.rule.sum, value.clone());
                let sum = self.total(&self.rule.sum, sum);
                Some(divide_by_count(sum, self.total_count(value)))
            }
            _ => None,
        }
    }

    fn total_count(&mut self, value: &Expr) -> Expr {
        let count = self.partial(&count_udaf(), value.clone());
        self.whole_total(count)
    }

    // A function of a value of each group, which counts once for each of the group's rows.
    fn split_weighted(&mut self, call: &AggregateFunction, value: &Expr) -> Option<Expr> {
        let is_float = value.get_type(&self.scope).ok()? == DataType::Float64;
        match call.func.name() {
            "count" => self.weighted_count(value),
            "min" | "max" => Some(self.total(&call.func, value.clone())),
            "sum" if is_float => Some(self.weighted_sum(value)),
            "avg" if is_float => {
                let sum = self.weighted_sum(value);
                Some(divide_by_count(sum, self.weighted_count(value)?))
            }
            _ => None,
        }
    }

    fn weighted_sum(&mut self, value: &Expr) -> Expr {
        let rows = self.partial(&count_udaf(), lit(1_i64));
        self.total(&self.rule.sum, value.clone() * cast(rows, DataType::Float64))
    }

    fn weighted_count(&mut self, value: &Expr) -> Option<Expr> {
        let rows = self.partial(&count_udaf(), lit(1_i64));
        let counted = when(value.clone().is_not_null(), rows).otherwise(lit(0_i64)).ok()?;
        Some(self.whole_total(counted))
    }

    // The sum of whole numbers is a decimal, and null without rows.
    fn whole_total(&mut self, counts: Expr) -> Expr {
        let sum = self.total(&self.rule.sum, counts);
        coalesce().call(vec![cast(sum, DataType::Int64), lit(0_i64)])
    }

    fn partial(&mut self, function: &Arc<AggregateUDF>, value: Expr) -> Expr {
        add_column(&mut self.partials, PARTIAL, function, value)
    }

    fn total(&mut self, function: &Arc<AggregateUDF>, value: Expr) -> Expr {
        add_column(&mut self.totals, TOTAL, function, value)
    }
}

/// Names of the columns with partial results and totals begin so.
const PARTIAL: &str = "__partial_";
const TOTAL: &str = "__total_";

// Adds the call, if it is not there, and returns its column.
fn add_column(calls: &mut Vec<Expr>, prefix: &str, function: &Arc<AggregateUDF>, value: Expr) -> Expr {
    let call = AggregateFunction::new_udf(function.clone(), vec![value], false, None, Vec::new(), None);
    let call = Expr::AggregateFunction(call);
    let place = calls.iter().position(|known| *known == call).unwrap_or_else(|| {
        calls.push(call);
        calls.len() - 1
    });
    Expr::Column(Column::from_name(format!("{prefix}{place}")))
}

fn name_columns(calls: Vec<Expr>, prefix: &str) -> Vec<Expr> {
    calls.into_iter().enumerate().map(|(place, call)| call.alias(format!("{prefix}{place}"))).collect()
}

// Null if there are no values: their sum is null.
fn divide_by_count(sum: Expr, count: Expr) -> Expr {
    sum / cast(count, DataType::Float64)
}

fn join_again(join: Join, rows: Arc<LogicalPlan>, rows_on_left: bool) -> Option<Join> {
    let Join { left, right, on, filter, join_type, join_constraint, null_equality, null_aware, .. } = join;
    let (left, right) = if rows_on_left { (rows, right) } else { (left, rows) };
    Join::try_new(left, right, on, filter, join_type, join_constraint, null_equality, null_aware).ok()
}
