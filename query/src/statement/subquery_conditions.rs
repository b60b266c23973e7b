//! Subqueries in conditions and as values: `EXISTS`, `IN`, `ANY` and `ALL`, with the third value of SQL, null.
//!
//! DataFusion plans them as joins in WHERE alone, takes the column on the left of `ANY` for one of the subquery's own
//! if that has its name, and has no null for `NOT IN` beside a literal, in another condition, or of a subquery that
//! depends on the row. With `l op ANY (s)`, whose column is `c`:
//!
//! | where | becomes |
//! | --- | --- |
//! | a condition, `ANY`, `IN` | `EXISTS (s WHERE l op c)`; `IN` stays |
//! | a condition, `ALL`, `NOT IN` | no row of s with `NOT l op c`, none with `c IS NULL`, and none if `l IS NULL` |
//! | a value, `ANY`, `IN` | true if a row has `l op c`; else null if `c IS NULL`, or `l IS NULL` and s has a row |
//! | a value, `ALL`, `NOT IN` | the same of `NOT l op c`, and turned round |
//!
//! Each `EXISTS` of a value is then a column of a mark join, which DataFusion's own rule for WHERE makes. A subquery of
//! the first row in an order, which depends on the row around it, becomes `first_value`.

use std::sync::Arc;

use datafusion::common::alias::AliasGenerator;
use datafusion::common::tree_node::{Transformed, TransformedResult as _, TreeNode as _, TreeNodeRecursion};
use datafusion::common::{Column, DFSchema, ExprSchema as _, plan_err};
use datafusion::error::Result;
use datafusion::functions_aggregate::first_last::first_value_udaf;
use datafusion::logical_expr::expr::{
    AggregateFunction, Exists, InSubquery, SetComparison, SetQuantifier, Sort as SortKey,
};
use datafusion::logical_expr::expr_rewriter::NamePreserver;
use datafusion::logical_expr::utils::{conjunction, merge_schema, split_conjunction_owned};
use datafusion::logical_expr::{
    BinaryExpr, Case, Expr, ExprSchemable as _, FetchType, Filter, JoinType, Limit, LogicalPlan, LogicalPlanBuilder,
    Operator, SkipType, Subquery, lit,
};
use datafusion::optimizer::decorrelate_predicate_subquery::DecorrelatePredicateSubquery;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use datafusion::scalar::ScalarValue;

/// Name of the column with which a value is compared, or that holds the first row's value.
const COMPARED: &str = "__compared";
/// What is printed of a subquery that is not planned, and what to write instead.
pub(crate) const UNPLANNED: &str = "a subquery that depends on the row around it is not planned in this form; hint: \
    JOIN ... ON, with GROUP BY for aggregates; an aggregate in the subquery; or QUALIFY row_number() OVER (PARTITION BY \
    ... ORDER BY ...) <= 1 for the first rows";

/// The rule; it is the first one.
#[derive(Debug)]
pub(crate) struct SubqueryConditions;

impl OptimizerRule for SubqueryConditions {
    fn name(&self) -> &str {
        "subquery_conditions"
    }

    fn rewrite(&self, plan: LogicalPlan, config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        let mut is_there = false;
        plan.apply_with_subqueries(|node| {
            is_there |= has_subquery(node)?;
            Ok(if is_there { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
        })?;
        match is_there {
            true => plan.transform_up_with_subqueries(|node| rewrite_node(node, config)),
            false => Ok(Transformed::no(plan)),
        }
    }
}

fn is_subquery(expr: &Expr) -> bool {
    match expr {
        Expr::Exists(_) | Expr::InSubquery(_) | Expr::SetComparison(_) => true,
        Expr::ScalarSubquery(subquery) => !subquery.outer_ref_columns.is_empty(),
        _ => false,
    }
}

fn has_subquery(node: &LogicalPlan) -> Result<bool> {
    let mut is_there = false;
    node.apply_expressions(|expr| {
        is_there = is_there || expr.exists(|part| Ok(is_subquery(part)))?;
        Ok(if is_there { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
    })?;
    Ok(is_there)
}

fn rewrite_node(node: LogicalPlan, config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
    if !has_subquery(&node)? {
        return Ok(Transformed::no(node));
    }
    let names = NamePreserver::new(&node);
    let first_rows = node.map_expressions(|expr| {
        let name = names.save(&expr);
        let taken = expr.transform_up(|part| take_first_row(part)?.transform_data(project_aliases))?;
        Ok(taken.update_data(|expr| name.restore(expr)))
    })?;
    let changed = first_rows.transformed;
    let rewritten = match first_rows.data {
        LogicalPlan::Filter(filter) => rewrite_filter(filter, config)?,
        LogicalPlan::Join(join) if join.join_type == JoinType::Inner && join.filter.is_some() => {
            rewrite_join(LogicalPlan::Join(join), config)?
        }
        node @ (LogicalPlan::Projection(_) | LogicalPlan::Aggregate(_) | LogicalPlan::Window(_)) => {
            join_marks(node, config)?
        }
        node => Transformed::no(node),
    };
    Ok(Transformed { transformed: changed || rewritten.transformed, ..rewritten })
}

fn rewrite_filter(filter: Filter, config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
    let scope = ConditionScope { schema: filter.input.schema(), aliases: config.alias_generator() };
    let before = filter.predicate.clone();
    let conditions = split_conjunction_owned(filter.predicate).into_iter().map(|expr| scope.condition(expr, true));
    let after = conjunction(conditions.collect::<Result<Vec<_>>>()?).unwrap_or_else(|| lit(true));
    let is_changed = after != before;
    let plan = LogicalPlan::Filter(Filter::try_new(after, filter.input)?);
    Ok(if is_changed { Transformed::yes(plan) } else { Transformed::no(plan) })
}

// The subqueries of ON are conditions of the joined rows.
fn rewrite_join(plan: LogicalPlan, config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
    let LogicalPlan::Join(mut join) = plan else { return Ok(Transformed::no(plan)) };
    let (subqueries, others): (Vec<_>, Vec<_>) =
        split_conjunction_owned(join.filter.take().unwrap_or_else(|| lit(true)))
            .into_iter()
            .partition(|expr| expr.exists(|part| Ok(is_subquery(part))).unwrap_or(false));
    join.filter = conjunction(others);
    let Some(condition) = conjunction(subqueries) else { return Ok(Transformed::no(LogicalPlan::Join(join))) };
    let filter = Filter::try_new(condition, Arc::new(LogicalPlan::Join(join)))?;
    Ok(Transformed::yes(rewrite_filter(filter, config)?.data))
}

// DataFusion's rule makes mark joins for the subqueries of a WHERE. It is given one that holds the expressions.
fn join_marks(node: LogicalPlan, config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
    let inputs = node.inputs();
    let [input] = inputs.as_slice() else { return Ok(Transformed::no(node)) };
    let schema = merge_schema(&inputs);
    let scope = ConditionScope { schema: &schema, aliases: config.alias_generator() };
    let preserver = NamePreserver::new(&node);
    let names: Vec<_> = node.expressions().iter().map(|expr| preserver.save(expr)).collect();
    let mut exprs = node.expressions().into_iter().map(|expr| scope.value(expr)).collect::<Result<Vec<_>>>()?;
    let is_mark = |expr: &Expr| expr.exists(|part| Ok(matches!(part, Expr::Exists(_) | Expr::InSubquery(_))));
    let mut marked = Vec::new();
    for (at, expr) in exprs.iter().enumerate() {
        if is_mark(expr)? {
            marked.push(at);
        }
    }
    let mut joined = (*input).clone();
    let held = marked.iter().rev().fold(None, |held: Option<Expr>, at| {
        let one = Expr::IsNotNull(Box::new(exprs[*at].clone()));
        Some(held.map_or(one.clone(), |held| one.or(held)))
    });
    if let Some(held) = held {
        let holder = LogicalPlan::Filter(Filter::try_new(held, Arc::new(joined))?);
        let holder = DecorrelatePredicateSubquery::new().rewrite(holder, config)?.data;
        let LogicalPlan::Projection(columns) = holder else { return plan_err!("{UNPLANNED}") };
        let LogicalPlan::Filter(filter) = Arc::unwrap_or_clone(columns.input) else { return plan_err!("{UNPLANNED}") };
        joined = Arc::unwrap_or_clone(filter.input);
        let mut held = filter.predicate;
        for (nth, at) in marked.iter().enumerate() {
            let one = match held {
                Expr::BinaryExpr(BinaryExpr { left, op: Operator::Or, right }) if nth + 1 < marked.len() => {
                    held = *right;
                    *left
                }
                ref last => last.clone(),
            };
            let Expr::IsNotNull(expr) = one else { return plan_err!("{UNPLANNED}") };
            if is_mark(&expr)? {
                return plan_err!("{UNPLANNED}");
            }
            exprs[*at] = *expr;
        }
    }
    let exprs = exprs.into_iter().zip(names).map(|(expr, name)| name.restore(expr)).collect();
    let columns = node.schema().columns();
    let is_window = matches!(node, LogicalPlan::Window(_));
    let plan = node.with_new_exprs(exprs, vec![joined])?;
    Ok(Transformed::yes(match is_window && !marked.is_empty() {
        true => LogicalPlanBuilder::from(plan).project(columns.into_iter().map(Expr::Column))?.build()?,
        false => plan,
    }))
}

/// The rows whose conditions are rewritten.
struct ConditionScope<'a> {
    schema: &'a DFSchema,
    aliases: &'a AliasGenerator,
}

/// `left op ANY (subquery)`, or of ALL.
struct SubqueryComparison {
    left: Expr,
    operator: Operator,
    subquery: Subquery,
    quantifier: SetQuantifier,
}

impl SubqueryComparison {
    fn negated(self) -> Option<Self> {
        let quantifier = match self.quantifier {
            SetQuantifier::Any => SetQuantifier::All,
            SetQuantifier::All => SetQuantifier::Any,
        };
        Some(Self { operator: self.operator.negate()?, quantifier, ..self })
    }

    // `IN` is `= ANY`, and `NOT IN` is `<> ALL`.
    fn from_expr(expr: Expr) -> std::result::Result<Self, Expr> {
        match expr {
            Expr::InSubquery(InSubquery { expr, subquery, negated }) => {
                let (operator, quantifier) =
                    if negated { (Operator::NotEq, SetQuantifier::All) } else { (Operator::Eq, SetQuantifier::Any) };
                Ok(Self { left: *expr, operator, subquery, quantifier })
            }
            Expr::SetComparison(SetComparison { expr, subquery, op, quantifier }) => {
                Ok(Self { left: *expr, operator: op, subquery, quantifier })
            }
            other => Err(other),
        }
    }

    // Returns whether the comparison is IN (false) or NOT IN (true); None if it is neither.
    fn membership(&self) -> Option<bool> {
        match (self.operator, self.quantifier) {
            (Operator::Eq, SetQuantifier::Any) => Some(false),
            (Operator::NotEq, SetQuantifier::All) => Some(true),
            _ => None,
        }
    }

    fn into_membership(self, negated: bool) -> Expr {
        Expr::InSubquery(InSubquery { expr: Box::new(self.left), subquery: self.subquery, negated })
    }

    fn is_correlated(&self) -> bool {
        !self.subquery.outer_ref_columns.is_empty()
    }

    // An aggregate without groups has one row, whatever its rows depend on.
    fn has_only_row(&self) -> bool {
        self.is_correlated() && has_one_row(&self.subquery.subquery)
    }

    fn into_row_comparison(self) -> Expr {
        binary_expr(self.left, self.operator, Expr::ScalarSubquery(self.subquery))
    }
}

impl ConditionScope<'_> {
    /// Rewrites a condition, of which null is as false. `is_top` is true if a join may be made of it.
    fn condition(&self, expr: Expr, is_top: bool) -> Result<Expr> {
        match expr {
            Expr::BinaryExpr(BinaryExpr { left, op: op @ (Operator::And | Operator::Or), right }) => {
                let is_top = is_top && op == Operator::And;
                Ok(binary_expr(self.condition(*left, is_top)?, op, self.condition(*right, is_top)?))
            }
            Expr::Not(inner) => match *inner {
                Expr::Exists(Exists { subquery, negated }) => {
                    self.condition(Expr::Exists(Exists { subquery, negated: !negated }), is_top)
                }
                Expr::Not(inner) => self.condition(*inner, is_top),
                other => match SubqueryComparison::from_expr(other) {
                    Ok(comparison) => match comparison.negated() {
                        Some(negated) => self.compared_condition(negated, is_top),
                        None => plan_err!("{UNPLANNED}"),
                    },
                    Err(other) => self.value(!other),
                },
            },
            other => match SubqueryComparison::from_expr(other) {
                Ok(comparison) => self.compared_condition(comparison, is_top),
                Err(other) => self.value(other),
            },
        }
    }

    fn compared_condition(&self, comparison: SubqueryComparison, is_top: bool) -> Result<Expr> {
        if comparison.has_only_row() {
            return Ok(comparison.into_row_comparison());
        }
        let (left_null, right_null) = self.may_be_null(&comparison)?;
        let has_null_join = is_top && !comparison.is_correlated() && comparison.left.any_column_refs();
        let is_any = comparison.quantifier == SetQuantifier::Any;
        if let Some(negated) = comparison.membership()
            && (is_any || !left_null && !right_null || has_null_join)
        {
            return Ok(comparison.into_membership(negated));
        }
        if is_any {
            return self.some_row(&comparison, comparison.operator, false);
        }
        let Some(operator) = comparison.operator.negate() else { return plan_err!("{UNPLANNED}") };
        let mut conditions = vec![self.some_row(&comparison, operator, true)?];
        if right_null {
            conditions.push(self.some_null(&comparison, true)?);
        }
        if left_null {
            let none = self.any_row(&comparison, true)?;
            conditions.push(comparison.left.is_not_null().or(none));
        }
        Ok(conjunction(conditions).unwrap_or_else(|| lit(true)))
    }

    /// Rewrites an expression that has subqueries as values.
    fn value(&self, expr: Expr) -> Result<Expr> {
        let rewrite = |expr: Expr| match expr {
            Expr::Exists(Exists { subquery, negated }) if has_one_row(&subquery.subquery) => {
                Ok(Transformed::yes(lit(!negated)))
            }
            other => match SubqueryComparison::from_expr(other) {
                Ok(comparison) => self.compared_value(comparison).map(Transformed::yes),
                Err(other) => Ok(Transformed::no(other)),
            },
        };
        expr.transform_up(rewrite).data()
    }

    fn compared_value(&self, comparison: SubqueryComparison) -> Result<Expr> {
        if comparison.has_only_row() {
            return Ok(comparison.into_row_comparison());
        }
        let (left_null, right_null) = self.may_be_null(&comparison)?;
        if let Some(negated) = comparison.membership()
            && !left_null
            && !right_null
        {
            return Ok(comparison.into_membership(negated));
        }
        let is_any = comparison.quantifier == SetQuantifier::Any;
        let operator = if is_any { Some(comparison.operator) } else { comparison.operator.negate() };
        let Some(operator) = operator else { return plan_err!("{UNPLANNED}") };
        let decided = self.some_row(&comparison, operator, false)?;
        let mut cases = vec![(Box::new(decided), Box::new(lit(is_any)))];
        let right = right_null.then(|| self.some_null(&comparison, false)).transpose()?;
        let left = left_null.then(|| self.any_row(&comparison, false)).transpose()?;
        let left = left.map(|any| comparison.left.clone().is_null().and(any));
        if let Some(unknown) = right.into_iter().chain(left).reduce(Expr::or) {
            cases.push((Box::new(unknown), Box::new(Expr::Literal(ScalarValue::Boolean(None), None))));
        }
        Ok(Expr::Case(Case { expr: None, when_then_expr: cases, else_expr: Some(Box::new(lit(!is_any))) }))
    }

    fn may_be_null(&self, comparison: &SubqueryComparison) -> Result<(bool, bool)> {
        let [column] = comparison.subquery.subquery.schema().fields().as_ref() else {
            return plan_err!("a subquery that is compared has one column; hint: (a, b) IN (SELECT x, y ...)");
        };
        Ok((comparison.left.nullable(self.schema)?, column.is_nullable()))
    }

    // EXISTS (subquery WHERE left op column).
    fn some_row(&self, comparison: &SubqueryComparison, operator: Operator, negated: bool) -> Result<Expr> {
        let left = self.outer_reference(comparison.left.clone())?;
        self.exists(comparison, negated, |column| binary_expr(left, operator, column))
    }

    // EXISTS (subquery WHERE column IS NULL).
    fn some_null(&self, comparison: &SubqueryComparison, negated: bool) -> Result<Expr> {
        self.exists(comparison, negated, Expr::is_null)
    }

    // EXISTS (subquery).
    fn any_row(&self, comparison: &SubqueryComparison, negated: bool) -> Result<Expr> {
        exists_expr(LogicalPlan::clone(&comparison.subquery.subquery), negated)
    }

    // The name tells the column from those of the rows around.
    fn exists(
        &self,
        comparison: &SubqueryComparison,
        negated: bool,
        condition: impl FnOnce(Expr) -> Expr,
    ) -> Result<Expr> {
        let plan = LogicalPlan::clone(&comparison.subquery.subquery);
        let name = self.aliases.next(COMPARED);
        let column = Expr::Column(Column::from(plan.schema().qualified_field(0)));
        let compared = Expr::Column(Column::new_unqualified(name.clone()));
        let plan = LogicalPlanBuilder::from(plan).project([column.alias(name)])?;
        exists_expr(plan.filter(condition(compared))?.build()?, negated)
    }

    fn outer_reference(&self, expr: Expr) -> Result<Expr> {
        let refer = |part: Expr| match part {
            Expr::Column(column) => {
                let field = self.schema.field_from_column(&column)?.clone();
                Ok(Transformed::yes(Expr::OuterReferenceColumn(field, column)))
            }
            other => Ok(Transformed::no(other)),
        };
        expr.transform_up(refer).data()
    }
}

// One row is enough of a subquery that is the same for all rows around.
fn exists_expr(plan: LogicalPlan, negated: bool) -> Result<Expr> {
    let outer_ref_columns = plan.all_out_ref_exprs();
    let plan = match outer_ref_columns.is_empty() {
        true => LogicalPlanBuilder::from(plan).limit(0, Some(1))?.build()?,
        false => plan,
    };
    let subquery = Subquery { subquery: Arc::new(plan), outer_ref_columns, spans: Default::default() };
    Ok(Expr::Exists(Exists { subquery, negated }))
}

fn binary_expr(left: Expr, operator: Operator, right: Expr) -> Expr {
    Expr::BinaryExpr(BinaryExpr::new(Box::new(left), operator, Box::new(right)))
}

/// Returns whether a plan is an aggregate of all its rows, which has one row.
pub(super) fn has_one_row(plan: &LogicalPlan) -> bool {
    match plan {
        LogicalPlan::Projection(projection) => has_one_row(&projection.input),
        LogicalPlan::SubqueryAlias(alias) => has_one_row(&alias.input),
        LogicalPlan::Sort(sort) => sort.fetch != Some(0) && has_one_row(&sort.input),
        LogicalPlan::Aggregate(aggregate) => aggregate.group_expr.is_empty(),
        _ => false,
    }
}

// `(SELECT x FROM t WHERE ... ORDER BY y LIMIT 1)` becomes `(SELECT first_value(x ORDER BY y) FROM t WHERE ...)`.
fn take_first_row(expr: Expr) -> Result<Transformed<Expr>> {
    let Expr::ScalarSubquery(subquery) = &expr else { return Ok(Transformed::no(expr)) };
    let LogicalPlan::Limit(limit) = subquery.subquery.as_ref() else { return Ok(Transformed::no(expr)) };
    if subquery.outer_ref_columns.is_empty() || !takes_one_row(limit)? {
        return Ok(Transformed::no(expr));
    }
    let plan = limit.input.as_ref();
    let column = |plan: &LogicalPlan| Expr::Column(Column::from(plan.schema().qualified_field(0)));
    let (value, order, rows): (Expr, Vec<SortKey>, &Arc<LogicalPlan>) = match plan {
        LogicalPlan::Sort(sort) if sort.fetch.is_none() => (column(plan), sort.expr.clone(), &sort.input),
        LogicalPlan::Projection(projection) => match (projection.input.as_ref(), projection.expr.as_slice()) {
            (LogicalPlan::Sort(sort), [value]) if sort.fetch.is_none() => {
                (value.clone().unalias(), sort.expr.clone(), &sort.input)
            }
            _ => (column(plan), Vec::new(), &limit.input),
        },
        _ => (column(plan), Vec::new(), &limit.input),
    };
    let first = AggregateFunction::new_udf(first_value_udaf(), vec![value], false, None, order, None);
    let plan = LogicalPlanBuilder::from(Arc::clone(rows))
        .aggregate(Vec::<Expr>::new(), vec![Expr::AggregateFunction(first).alias(COMPARED)])?
        .build()?;
    let outer_ref_columns = plan.all_out_ref_exprs();
    let subquery = Subquery { subquery: Arc::new(plan), outer_ref_columns, spans: subquery.spans.clone() };
    Ok(Transformed::yes(Expr::ScalarSubquery(subquery)))
}

// When DataFusion takes the conditions on outer rows out of a subquery, projections get the columns that these need. An
// alias over them keeps the columns that it had, so a projection takes its place.
fn project_aliases(mut expr: Expr) -> Result<Transformed<Expr>> {
    let subquery = match &mut expr {
        Expr::Exists(Exists { subquery, .. })
        | Expr::InSubquery(InSubquery { subquery, .. })
        | Expr::SetComparison(SetComparison { subquery, .. })
        | Expr::ScalarSubquery(subquery)
            if !subquery.outer_ref_columns.is_empty() =>
        {
            subquery
        }
        _ => return Ok(Transformed::no(expr)),
    };
    let projected = LogicalPlan::clone(&subquery.subquery).transform_up(|node| match node {
        LogicalPlan::SubqueryAlias(alias) if !alias.input.all_out_ref_exprs().is_empty() => {
            let columns = alias.input.schema().columns().into_iter().map(|column| {
                let name = column.name.clone();
                Expr::Column(column).alias_qualified(Some(alias.alias.clone()), name)
            });
            let plan = LogicalPlanBuilder::from(Arc::clone(&alias.input)).project(columns.collect::<Vec<_>>())?;
            Ok(Transformed::yes(plan.build()?))
        }
        other => Ok(Transformed::no(other)),
    })?;
    subquery.subquery = Arc::new(projected.data);
    Ok(if projected.transformed { Transformed::yes(expr) } else { Transformed::no(expr) })
}

fn takes_one_row(limit: &Limit) -> Result<bool> {
    let is_first = matches!(limit.get_skip_type()?, SkipType::Literal(0));
    Ok(is_first && matches!(limit.get_fetch_type()?, FetchType::Literal(Some(1))))
}
