//! Floats that are equal have the same bits wherever DataFusion compares bits: there is one NaN, which is the greatest
//! number, and -0.0 is 0.0, as in PostgreSQL and DuckDB.
//!
//! Processors give the NaN of `0.0 / 0.0` a sign, and in Arrow's order that NaN is less than all numbers. So a NaN is
//! made the positive one where it comes into being. Comparisons, joins and groups know that -0.0 is 0.0; where they do
//! not, it becomes 0.0.
//!
//! | expression | becomes |
//! | --- | --- |
//! | `x / y`, `sqrt(x)`, text as a float | `one_nan(x / y)`; of nested operators only the outermost |
//! | `sum(x)` and other aggregates, also of windows | a projection above them |
//! | keys of windows, arguments of `nullif`, `CASE x WHEN`, `count(DISTINCT x)`, keys of an order but the last | `one_zero(x)` |
//! | `x IN (0.0, ...)` | `x IN (0.0, ..., -0.0)` |
//!
//! It costs one pass over the results of operators that can make a NaN: 0.3 ns a value, where a division takes 1 ns.
//! Columns of the lake's tables hold neither NaN nor -0.0 and stay as they are, so that conditions and orders of them
//! still skip files. Only files that were written before `BatchBuilder` made 0.0 of -0.0 may have one. Values inside
//! lists and structs stay as they are, too.

use std::collections::HashSet;

use arrow::datatypes::DataType;
use datafusion::common::config::ConfigOptions;
use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::common::{Column, DFSchema};
use datafusion::datasource::source_as_provider;
use datafusion::error::Result;
use datafusion::logical_expr::expr::{Cast, InList, ScalarFunction, Sort as SortKey, TryCast};
use datafusion::logical_expr::expr_rewriter::NamePreserver;
use datafusion::logical_expr::utils::merge_schema;
use datafusion::logical_expr::{
    BinaryExpr, Distinct, Expr, ExprSchemable as _, LogicalPlan, LogicalPlanBuilder, Operator,
};
use datafusion::optimizer::AnalyzerRule;
use datafusion::scalar::ScalarValue;
use echolake_functions::{FloatForm, UnifiedFloat};
use echolake_lake_tables::LakeTable;

/// Functions and aggregates that return one of their arguments, or whole numbers, so that they make no NaN.
const PASSING: [&str; 19] = [
    "checked_add",
    "checked_subtract",
    "checked_multiply",
    "coalesce",
    "nullif",
    "greatest",
    "least",
    "get_field",
    "abs",
    "round",
    "floor",
    "ceil",
    "trunc",
    "min",
    "max",
    "first_value",
    "last_value",
    "nth_value",
    "random",
];

/// The rule; it follows the coercion of types.
#[derive(Debug)]
pub(crate) struct FloatForms;

impl AnalyzerRule for FloatForms {
    fn name(&self) -> &str {
        "float_forms"
    }

    fn analyze(&self, plan: LogicalPlan, _: &ConfigOptions) -> Result<LogicalPlan> {
        Ok(plan.transform_up_with_subqueries(unify_node)?.data)
    }
}

fn unify_node(node: LogicalPlan) -> Result<Transformed<LogicalPlan>> {
    if !has_candidate(&node)? {
        return Ok(Transformed::no(node));
    }
    let scope = FloatScope { schema: merge_schema(&node.inputs()), stored: stored_columns(&node)? };
    let names = NamePreserver::new(&node);
    let unified = node.map_expressions(|expr| {
        let name = names.save(&expr);
        let unified = expr.transform_up(|expr| Ok(scope.unify_expr(expr)))?;
        Ok(unified.update_data(|expr| name.restore(expr)))
    })?;
    unified.transform_data(|node| match node {
        LogicalPlan::Sort(mut sort) => {
            scope.unify_keys(&mut sort.expr);
            Ok(Transformed::yes(LogicalPlan::Sort(sort)))
        }
        LogicalPlan::Distinct(Distinct::On(mut distinct)) => {
            let mut seen = HashSet::new();
            distinct.on_expr.retain(|expr| seen.insert(expr.clone()));
            distinct.sort_expr.iter_mut().for_each(|keys| scope.unify_keys(keys));
            Ok(Transformed::yes(LogicalPlan::Distinct(Distinct::On(distinct))))
        }
        LogicalPlan::Aggregate(_) | LogicalPlan::Window(_) => unify_results(node),
        node => Ok(Transformed::no(node)),
    })
}

fn has_candidate(node: &LogicalPlan) -> Result<bool> {
    if matches!(node, LogicalPlan::Sort(_) | LogicalPlan::Distinct(Distinct::On(_))) {
        return Ok(true);
    }
    let mut is_there = false;
    node.apply_expressions(|expr| {
        is_there = is_there || expr.exists(|part| Ok(!matches!(part, Expr::Column(_) | Expr::Alias(_))))?;
        Ok(if is_there { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
    })?;
    Ok(is_there)
}

// A projection has the aggregates' results in its form, under their names.
fn unify_results(node: LogicalPlan) -> Result<Transformed<LogicalPlan>> {
    let mut is_needed = false;
    let exprs = node.expressions();
    let width = node.schema().fields().len();
    let columns = node.schema().iter().enumerate().map(|(at, (relation, field))| {
        let column = Expr::Column(Column::from((relation, field)));
        let expr = (at + exprs.len()).checked_sub(width).and_then(|nth| exprs.get(nth));
        let makes_nan = expr.is_some_and(makes_aggregate_nan);
        if !field.data_type().is_floating() || !makes_nan {
            return column;
        }
        is_needed = true;
        call(FloatForm::OneNan, field.data_type().clone(), column).alias_qualified(relation.cloned(), field.name())
    });
    let columns: Vec<_> = columns.collect();
    match is_needed {
        true => Ok(Transformed::yes(LogicalPlanBuilder::from(node).project(columns)?.build()?)),
        false => Ok(Transformed::no(node)),
    }
}

fn makes_aggregate_nan(expr: &Expr) -> bool {
    match expr {
        Expr::Alias(alias) => makes_aggregate_nan(&alias.expr),
        Expr::AggregateFunction(aggregate) => !PASSING.contains(&aggregate.func.name()),
        Expr::WindowFunction(window) => !PASSING.contains(&window.fun.name()),
        _ => false,
    }
}

fn call(form: FloatForm, kind: DataType, value: Expr) -> Expr {
    let function = UnifiedFloat::new_function(form, kind);
    Expr::ScalarFunction(ScalarFunction::new_udf(function.into(), vec![value]))
}

fn unified_float(expr: &Expr) -> Option<&UnifiedFloat> {
    let Expr::ScalarFunction(function) = expr else { return None };
    function.func.inner().downcast_ref::<UnifiedFloat>()
}

// The operand of `one_nan`, for an operator that is within another one.
fn strip_nan_form(mut expr: Expr) -> Expr {
    if unified_float(&expr).is_some_and(|unified| unified.float_form() == FloatForm::OneNan)
        && let Expr::ScalarFunction(function) = &mut expr
    {
        return function.args.pop().unwrap_or_default();
    }
    expr
}

/// The columns of a node's inputs.
struct FloatScope {
    schema: DFSchema,
    /// Those that are columns of the lake's tables.
    stored: HashSet<Column>,
}

impl FloatScope {
    fn unify_expr(&self, mut expr: Expr) -> Transformed<Expr> {
        match &mut expr {
            Expr::Literal(ScalarValue::Float64(Some(x)), _) if x.is_nan() => *x = f64::NAN,
            Expr::Literal(ScalarValue::Float32(Some(x)), _) if x.is_nan() => *x = f32::NAN,
            Expr::BinaryExpr(binary) => match self.operator_type(binary) {
                Some(kind) => {
                    *binary.left = strip_nan_form(std::mem::take(binary.left.as_mut()));
                    *binary.right = strip_nan_form(std::mem::take(binary.right.as_mut()));
                    expr = call(FloatForm::OneNan, kind, expr);
                }
                None => return Transformed::no(expr),
            },
            Expr::Negative(operand) => match self.float_type(operand) {
                Some(kind) if !self.is_stored(operand) => {
                    **operand = strip_nan_form(std::mem::take(operand.as_mut()));
                    expr = call(FloatForm::OneNan, kind, expr);
                }
                _ => return Transformed::no(expr),
            },
            Expr::ScalarFunction(function) if !function.func.inner().is::<UnifiedFloat>() => match function.name() {
                "nullif" => function.args.iter_mut().for_each(|value| self.unify_zero(value)),
                name if PASSING.contains(&name) => return Transformed::no(expr),
                _ => match self.float_type(&expr) {
                    Some(kind) => expr = call(FloatForm::OneNan, kind, expr),
                    None => return Transformed::no(expr),
                },
            },
            Expr::Cast(_) | Expr::TryCast(_) => match self.float_type(&expr) {
                Some(kind) if self.is_cast_of_text(&expr) => expr = call(FloatForm::OneNan, kind, expr),
                _ => return Transformed::no(expr),
            },
            Expr::InList(list) => self.unify_list(list),
            Expr::Case(case) => match &mut case.expr {
                Some(compared) => {
                    self.unify_zero(compared);
                    case.when_then_expr.iter_mut().for_each(|(when, _)| self.unify_zero(when));
                }
                None => return Transformed::no(expr),
            },
            Expr::AggregateFunction(aggregate) => {
                self.unify_keys(&mut aggregate.params.order_by);
                if aggregate.params.distinct {
                    aggregate.params.args.iter_mut().for_each(|value| self.unify_zero(value));
                }
            }
            Expr::WindowFunction(window) => {
                let keys = window.params.order_by.iter_mut().map(|key| &mut key.expr);
                keys.chain(&mut window.params.partition_by).for_each(|key| self.unify_zero(key));
            }
            _ => return Transformed::no(expr),
        }
        Transformed::yes(expr)
    }

    fn float_type(&self, expr: &Expr) -> Option<DataType> {
        let kind = match unified_float(expr).and_then(UnifiedFloat::float_type) {
            Some(kind) => kind.clone(),
            // A type that is not known yet is an error when the statement runs.
            None => expr.get_type(&self.schema).ok()?,
        };
        matches!(kind, DataType::Float32 | DataType::Float64).then_some(kind)
    }

    // The type of an operator that can make a NaN of other values: with a plain number, or of finite ones, it cannot.
    fn operator_type(&self, BinaryExpr { left, op, right }: &BinaryExpr) -> Option<DataType> {
        let is_finite = self.is_stored(left) && self.is_stored(right);
        let makes_nan = match op {
            Operator::Plus | Operator::Minus | Operator::Multiply if is_finite => false,
            Operator::Plus | Operator::Minus => !is_plain_number(left, true) && !is_plain_number(right, true),
            Operator::Multiply | Operator::Divide => !is_plain_number(left, false) && !is_plain_number(right, false),
            Operator::Modulo => true,
            _ => false,
        };
        let kind = makes_nan.then(|| self.float_type(right))??;
        (self.float_type(left)? == kind).then_some(kind)
    }

    fn is_cast_of_text(&self, expr: &Expr) -> bool {
        let (Expr::Cast(Cast { expr, .. }) | Expr::TryCast(TryCast { expr, .. })) = expr else { return false };
        expr.get_type(&self.schema).is_ok_and(|kind| kind.is_string())
    }

    fn is_stored(&self, expr: &Expr) -> bool {
        matches!(expr, Expr::Column(column) if self.stored.contains(column))
    }

    fn unify_zero(&self, value: &mut Expr) {
        let is_plain = self.is_stored(value) || is_plain_number(value, false) || unified_zero(value);
        if !is_plain && let Some(kind) = self.float_type(value) {
            *value = call(FloatForm::OneZero, kind, strip_nan_form(std::mem::take(value)));
        }
    }

    // What the last key finds equal has no order. A key that is there twice makes DataFusion panic.
    fn unify_keys(&self, keys: &mut Vec<SortKey>) {
        let mut seen = HashSet::new();
        keys.retain(|key| seen.insert(key.expr.clone()));
        let before = keys.len().saturating_sub(1);
        keys[..before].iter_mut().for_each(|key| self.unify_zero(&mut key.expr));
    }

    // A list of constants stays one, of which files are skipped: it gets the other zero.
    fn unify_list(&self, list: &mut InList) {
        let InList { expr, list, .. } = list;
        if !list.iter().all(|value| matches!(value, Expr::Literal(..))) {
            return std::iter::once(expr.as_mut()).chain(list).for_each(|value| self.unify_zero(value));
        }
        let zeros: HashSet<_> = list.iter().filter_map(literal_zero).collect();
        let others = zeros.iter().filter_map(|zero| zero.arithmetic_negate().ok()).filter(|zero| !zeros.contains(zero));
        list.extend(others.map(|zero| Expr::Literal(zero, None)).collect::<Vec<_>>());
    }
}

fn literal_zero(expr: &Expr) -> Option<ScalarValue> {
    match expr {
        Expr::Literal(zero @ (ScalarValue::Float64(Some(0.0)) | ScalarValue::Float32(Some(0.0))), _) => {
            Some(zero.clone())
        }
        _ => None,
    }
}

fn unified_zero(expr: &Expr) -> bool {
    unified_float(expr).is_some_and(|unified| unified.float_form() == FloatForm::OneZero)
}

// A finite number, not zero or, if `zero`, also zero.
fn is_plain_number(expr: &Expr, zero: bool) -> bool {
    match expr {
        Expr::Literal(number, _) => match number.cast_to(&DataType::Float64) {
            Ok(ScalarValue::Float64(Some(x))) => x.is_finite() && (zero || x != 0.0),
            _ => false,
        },
        Expr::Cast(cast) if cast.field.data_type().is_floating() => match cast.expr.as_ref() {
            Expr::Literal(number, _) => number
                .cast_to(cast.field.data_type())
                .is_ok_and(|number| is_plain_number(&Expr::Literal(number, None), zero)),
            _ => false,
        },
        _ => false,
    }
}

fn stored_columns(node: &LogicalPlan) -> Result<HashSet<Column>> {
    let mut stored = HashSet::new();
    node.apply_expressions(|expr| {
        for column in expr.column_refs() {
            if !stored.contains(column) && node.inputs().into_iter().any(|input| is_stored_in(input, column)) {
                stored.insert(column.clone());
            }
        }
        Ok(TreeNodeRecursion::Continue)
    })?;
    Ok(stored)
}

fn is_stored_in(plan: &LogicalPlan, column: &Column) -> bool {
    let place = || plan.schema().maybe_index_of_column(column);
    match plan {
        LogicalPlan::TableScan(scan) => {
            let provider = source_as_provider(&scan.source).ok();
            let is_lake = |provider: &dyn std::any::Any| provider.is::<LakeTable>();
            place().is_some() && provider.is_some_and(|provider| is_lake(provider.as_ref()))
        }
        LogicalPlan::SubqueryAlias(alias) => place().is_some_and(|place| {
            is_stored_in(&alias.input, &Column::from(alias.input.schema().qualified_field(place)))
        }),
        LogicalPlan::Projection(projection) => {
            let inner = place().and_then(|place| projection.expr.get(place)).map(|expr| expr.clone().unalias());
            matches!(inner, Some(Expr::Column(inner)) if is_stored_in(&projection.input, &inner))
        }
        LogicalPlan::Filter(_)
        | LogicalPlan::Sort(_)
        | LogicalPlan::Limit(_)
        | LogicalPlan::Window(_)
        | LogicalPlan::Join(_) => plan.inputs().into_iter().any(|input| is_stored_in(input, column)),
        _ => false,
    }
}
