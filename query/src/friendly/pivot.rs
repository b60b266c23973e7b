//! `PIVOT` and `UNPIVOT` as aggregates with filters, and as lists that are unnested.

use std::collections::BTreeSet;
use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{
    Array, BinaryOperator, Expr, ExprWithAlias, Function, GroupByExpr, Ident, NullInclusion, Select, SelectItem,
    TableFactor, TableWithJoins, Value, ValueWithSpan, Visitor, WildcardAdditionalOptions,
};

use super::budget::RewriteBudget;
use super::columns::{ChosenColumn, SourceColumns};
use super::tree;
use crate::Error;
use crate::syntax_walk::walk;

/// Returns the select that has a column per value and aggregate: `sum(x) FILTER (WHERE column = value) AS "value"`.
///
/// # Errors
/// [`Error::Query`] if an aggregate is no function, a value has no name, or there are too many columns.
pub(super) fn pivoted(
    groups: Vec<Expr>,
    aggregates: &[ExprWithAlias],
    column: &Expr,
    values: &[ExprWithAlias],
    from: Vec<TableWithJoins>,
    budget: &mut RewriteBudget,
) -> Result<Select, Error> {
    let mut projection: Vec<_> = groups.iter().map(|group| tree::item(group.clone(), None)).collect();
    for aggregate in aggregates {
        budget.take_copies(&aggregate.expr, values.len())?;
        budget.take_copies(column, values.len())?;
    }
    for value in values {
        budget.take_copies(&value.expr, aggregates.len())?;
        let name = value_name(value)?;
        for ExprWithAlias { expr, alias } in aggregates {
            let Expr::Function(function) = expr else { return Err(no_aggregate(expr)) };
            let name = match (aggregates.len(), alias) {
                (1, _) => name.clone(),
                (_, Some(alias)) => format!("{name}_{}", alias.value),
                (_, None) => format!("{name}_{expr}"),
            };
            let filtered = filtered(function, is_value(column, &value.expr));
            projection.push(tree::item(Expr::Function(filtered), Some(tree::quoted(&name))));
        }
    }
    let mut select = tree::select(projection, from);
    select.group_by = GroupByExpr::Expressions(groups, Vec::new());
    Ok(select)
}

/// Returns the columns by which a PIVOT without GROUP BY groups: all that it does not name.
pub(super) fn groups(source: &SourceColumns, aggregates: &[ExprWithAlias], column: &Expr) -> Vec<Expr> {
    let mut named = NameVisitor::default();
    let exprs = aggregates.iter().map(|aggregate| &aggregate.expr).chain([column]);
    for expr in exprs {
        let ControlFlow::<()>::Continue(()) = walk(expr, &mut named) else { continue };
    }
    source.iter().filter(|column| !named.0.contains(&column.name)).map(|column| column.expr()).collect()
}

/// Returns the select that has a row per row and column: the column's name, and its value.
pub(super) fn unpivoted(
    source: &SourceColumns,
    columns: &[ChosenColumn],
    name: &Ident,
    value: &Ident,
    nulls: Option<&NullInclusion>,
    from: Vec<TableWithJoins>,
) -> Select {
    let is_other = |name: &str| columns.iter().all(|column| column.source != name);
    let others = source.iter().filter(|column| is_other(&column.name));
    let mut projection: Vec<_> = others.map(|column| tree::item(column.expr(), None)).collect();
    let unnested = |elem| tree::call("unnest", [Expr::Array(Array { elem, named: false })]);
    let names = columns.iter().map(|column| tree::text(&column.name)).collect();
    let values = columns.iter().map(|column| column.expr.clone()).collect();
    projection.push(tree::item(unnested(names), Some(name.clone())));
    projection.push(tree::item(unnested(values), Some(value.clone())));
    let inner = tree::select(projection, from);
    if nulls == Some(&NullInclusion::IncludeNulls) {
        return inner;
    }
    let all = SelectItem::Wildcard(WildcardAdditionalOptions::default());
    let relation =
        TableFactor::Derived { lateral: false, subquery: Box::new(tree::query(inner)), alias: None, sample: None };
    let mut outer = tree::select(vec![all], tree::from(relation));
    outer.selection = Some(Expr::IsNotNull(Box::new(Expr::Identifier(value.clone()))));
    outer
}

fn filtered(function: &Function, condition: Expr) -> Function {
    let mut function = function.clone();
    let condition = match function.filter.take() {
        Some(filter) => tree::and(*filter, condition),
        None => condition,
    };
    function.filter = Some(Box::new(condition));
    function
}

fn is_value(column: &Expr, value: &Expr) -> Expr {
    let operand = |expr: &Expr| Box::new(Expr::Nested(Box::new(expr.clone())));
    match value {
        Expr::Value(ValueWithSpan { value: Value::Null, .. }) => Expr::IsNull(operand(column)),
        _ => Expr::BinaryOp { left: operand(column), op: BinaryOperator::Eq, right: operand(value) },
    }
}

fn value_name(value: &ExprWithAlias) -> Result<String, Error> {
    if let Some(alias) = &value.alias {
        return Ok(tree::normalized(alias));
    }
    match &value.expr {
        Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) => Ok(text.clone()),
        Expr::Value(ValueWithSpan { value, .. }) => Ok(value.to_string().to_lowercase()),
        Expr::UnaryOp { .. } => Ok(value.expr.to_string()),
        other => Err(Error::Query {
            message: format!("`{other}` of a PIVOT is no literal"),
            place: None,
            hint: Some("IN (1, 'two'), or give it a name with AS".to_owned()),
        }),
    }
}

fn no_aggregate(expr: &Expr) -> Error {
    Error::Query {
        message: format!("`{expr}` of a PIVOT is no aggregate function"),
        place: None,
        hint: Some("USING sum(x), avg(y) AS mean; compute with the columns in a query around it".to_owned()),
    }
}

/// Names of columns that an expression contains.
#[derive(Default)]
struct NameVisitor(BTreeSet<String>);

impl Visitor for NameVisitor {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<()> {
        match expr {
            Expr::Identifier(name) => drop(self.0.insert(tree::normalized(name))),
            Expr::CompoundIdentifier(names) => self.0.extend(names.iter().map(tree::normalized)),
            _ => {}
        }
        ControlFlow::Continue(())
    }
}
