//! Names and positions of results that the planner does not see: columns that a list of names behind WITH or a subquery
//! renames, and positions in ROLLUP, CUBE and GROUPING SETS.

use std::collections::HashSet;

use datafusion::sql::sqlparser::ast::{
    Expr, GroupByExpr, Ident, Select, SelectItem, SetExpr, TableAlias, Value, ValueWithSpan,
};

use super::columns::hinted_error;
use crate::Error;

/// Gives names of their own to the results of a subquery that are written alike, and that the list of names behind its
/// alias renames: `t(a, b) AS (SELECT 1, 1)`.
pub(super) fn name_listed_columns(body: &mut SetExpr, alias: &TableAlias) {
    if !alias.columns.is_empty() {
        name_equal_columns(body);
    }
}

fn name_equal_columns(body: &mut SetExpr) {
    match body {
        SetExpr::Select(select) => name_equal_items(&mut select.projection),
        SetExpr::Query(query) => name_equal_columns(&mut query.body),
        SetExpr::SetOperation { left, right, .. } => {
            name_equal_columns(left);
            name_equal_columns(right);
        }
        _ => {}
    }
}

fn name_equal_items(items: &mut [SelectItem]) {
    let mut seen = HashSet::new();
    for (at, item) in items.iter_mut().enumerate() {
        if let SelectItem::UnnamedExpr(expr) = item
            && !seen.insert(expr.to_string())
        {
            *item = SelectItem::ExprWithAlias { expr: expr.clone(), alias: Ident::new(format!("__column_{}", at + 1)) };
        }
    }
}

/// Writes out the positions of the select list in ROLLUP, CUBE and GROUPING SETS.
///
/// # Errors
/// [`Error::Query`] if a column is there twice: for PostgreSQL and DuckDB it is two columns, which are not planned.
pub(super) fn expand_grouping_positions(select: &mut Select) -> Result<(), Error> {
    let Select { group_by: GroupByExpr::Expressions(groups, _), projection, .. } = select else {
        return Ok(());
    };
    for group in groups {
        if let Expr::Rollup(sets) | Expr::Cube(sets) | Expr::GroupingSets(sets) = group {
            sets.iter_mut().flatten().for_each(|expr| expand_position(expr, projection));
        }
        if matches!(group, Expr::Rollup(sets) | Expr::Cube(sets) if has_equal(sets)) {
            let hint = "FROM (SELECT a, a AS b FROM t) GROUP BY ROLLUP(a, b)";
            return Err(hinted_error("a column is in ROLLUP or CUBE twice".into(), hint));
        }
    }
    Ok(())
}

fn has_equal(parts: &[Vec<Expr>]) -> bool {
    let mut seen = HashSet::new();
    !parts.iter().flatten().all(|expr| seen.insert(expr.to_string()))
}

fn expand_position(expr: &mut Expr, items: &[SelectItem]) {
    let Expr::Value(ValueWithSpan { value: Value::Number(digits, _), .. }) = expr else { return };
    let nth = digits.parse::<usize>().ok().and_then(|position| position.checked_sub(1));
    if let Some(SelectItem::UnnamedExpr(item) | SelectItem::ExprWithAlias { expr: item, .. }) =
        nth.and_then(|nth| items.get(nth))
    {
        *expr = item.clone();
    }
}
