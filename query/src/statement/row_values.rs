//! `(a, b) IN (SELECT x, y ...)`, of which DataFusion knows one column only: `EXISTS` with a condition of all columns.
//!
//! As a value it is null if no row is equal, and one may be equal where it has nulls. In WHERE, null is as false.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{BinaryOperator, Expr, Query, Select, SetExpr, TableFactor, Visitor};

use super::columns::hinted_error;
use super::syntax_walk::walk_syntax;
use super::tree;
use crate::Error;

/// Rewrites the conditions of WHERE that compare rows.
///
/// # Errors
/// [`Error::Query`] as [`rewrite_row_value`].
pub(super) fn rewrite_row_conditions(condition: &mut Expr) -> Result<(), Error> {
    match condition {
        Expr::BinaryOp { left, op: BinaryOperator::And, right } => {
            rewrite_row_conditions(left)?;
            rewrite_row_conditions(right)?;
        }
        Expr::Nested(inner) => rewrite_row_conditions(inner)?,
        Expr::InSubquery { expr, subquery, negated } => {
            if let Some(row) = row_columns(expr) {
                let comparison = RowComparison { row, subquery };
                *condition = if *negated { comparison.no_row()? } else { comparison.some_row("", false)? };
            }
        }
        _ => {}
    }
    Ok(())
}

/// Rewrites a comparison of rows that is a value.
///
/// # Errors
/// [`Error::Query`] if both sides differ in their number of columns, or the row has an aggregate.
pub(super) fn rewrite_row_value(expr: &mut Expr, is_aggregate: &dyn Fn(&str) -> bool) -> Result<(), Error> {
    let Expr::InSubquery { expr: row, subquery, negated } = expr else { return Ok(()) };
    let Some(row) = row_columns(row) else { return Ok(()) };
    let has_aggregate = |value| walk_syntax(value, &mut AggregateVisitor { is_aggregate, depth: 0 }).is_break();
    if row.iter().any(has_aggregate) {
        let hint = "SELECT ... FROM (SELECT x, count(*) AS n FROM t GROUP BY x) WHERE (x, n) IN (...)";
        return Err(hinted_error("a row with an aggregate is not compared with a subquery".into(), hint));
    }
    let comparison = RowComparison { row, subquery };
    let mut value = tree::parse_expr(&format!(
        "CASE WHEN a THEN {} WHEN b THEN NULL ELSE {} END",
        if *negated { "FALSE" } else { "TRUE" },
        if *negated { "TRUE" } else { "FALSE" },
    ))?;
    if let Expr::Case { conditions, .. } = &mut value
        && let [equal, unknown] = conditions.as_mut_slice()
    {
        equal.condition = comparison.some_row("", false)?;
        unknown.condition = comparison.some_row("IS NULL", false)?;
    }
    *expr = value;
    Ok(())
}

/// Ends at a call of an aggregate outside of subqueries.
struct AggregateVisitor<'a> {
    is_aggregate: &'a dyn Fn(&str) -> bool,
    depth: usize,
}

impl Visitor for AggregateVisitor<'_> {
    type Break = ();

    fn pre_visit_query(&mut self, _: &Query) -> ControlFlow<()> {
        self.depth += 1;
        ControlFlow::Continue(())
    }

    fn post_visit_query(&mut self, _: &Query) -> ControlFlow<()> {
        self.depth -= 1;
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<()> {
        match expr {
            Expr::Function(function)
                if self.depth == 0
                    && tree::plain_name(&function.name).is_some_and(|name| (self.is_aggregate)(&name)) =>
            {
                ControlFlow::Break(())
            }
            _ => ControlFlow::Continue(()),
        }
    }
}

/// A row and the subquery in which it may be.
struct RowComparison<'a> {
    row: &'a [Expr],
    subquery: &'a Query,
}

impl RowComparison<'_> {
    fn no_row(&self) -> Result<Expr, Error> {
        self.some_row("IS NOT FALSE", true)
    }

    // EXISTS (SELECT 1 FROM (subquery) AS __compared(__1, __2) WHERE (a = __1 AND b = __2) test).
    fn some_row(&self, test: &str, negated: bool) -> Result<Expr, Error> {
        if let SetExpr::Select(select) = &*self.subquery.body
            && has_other_width(select, self.row.len())
        {
            let message = format!("a row of {} values is compared with {}", self.row.len(), select.projection.len());
            return Err(hinted_error(message, "(a, b) IN (SELECT x, y FROM t)".to_owned()));
        }
        let names: Vec<_> = (1..=self.row.len()).map(|nth| format!("__{nth}")).collect();
        let pairs: Vec<_> = names.iter().map(|name| format!("NULL = {name}")).collect();
        let not = if negated { "NOT " } else { "" };
        let mut exists = tree::parse_expr(&format!(
            "{not}EXISTS (SELECT 1 FROM (SELECT 1) AS __compared({}) WHERE ({}) {test})",
            names.join(", "),
            pairs.join(" AND "),
        ))?;
        let broken = || Error::failed_query("a comparison of rows is not as it was written");
        let select = exists_select(&mut exists).ok_or_else(broken)?;
        let from = select.from.first_mut().map(|from| &mut from.relation);
        let Some(TableFactor::Derived { subquery, .. }) = from else { return Err(broken()) };
        **subquery = self.subquery.clone();
        let mut values = self.row.iter();
        if let Some(condition) = &mut select.selection {
            let _ = place_values(condition, &mut values);
        }
        Ok(exists)
    }
}

fn row_columns(expr: &Expr) -> Option<&[Expr]> {
    match expr {
        Expr::Tuple(row) if row.len() > 1 => Some(row),
        Expr::Nested(inner) => row_columns(inner),
        _ => None,
    }
}

fn has_other_width(select: &Select, width: usize) -> bool {
    use datafusion::sql::sqlparser::ast::SelectItem::{ExprWithAlias, UnnamedExpr};
    let is_one = |item: &_| matches!(item, UnnamedExpr(_) | ExprWithAlias { .. });
    select.projection.iter().all(is_one) && select.projection.len() != width
}

fn exists_select(expr: &mut Expr) -> Option<&mut Select> {
    match expr {
        Expr::UnaryOp { expr, .. } => exists_select(expr),
        Expr::Exists { subquery, .. } => match &mut *subquery.body {
            SetExpr::Select(select) => Some(select),
            _ => None,
        },
        _ => None,
    }
}

// The left sides of the comparisons, in their order.
fn place_values<'a>(condition: &mut Expr, values: &mut impl Iterator<Item = &'a Expr>) -> ControlFlow<()> {
    match condition {
        Expr::BinaryOp { left, op: BinaryOperator::Eq, .. } => match values.next() {
            Some(value) => {
                **left = Expr::Nested(Box::new(value.clone()));
                ControlFlow::Continue(())
            }
            None => ControlFlow::Break(()),
        },
        Expr::BinaryOp { left, right, .. } => {
            place_values(left, values)?;
            place_values(right, values)
        }
        Expr::Nested(inner) | Expr::IsNull(inner) | Expr::IsNotFalse(inner) => place_values(inner, values),
        _ => ControlFlow::Continue(()),
    }
}
