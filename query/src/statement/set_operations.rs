//! `EXCEPT ALL` and `INTERSECT ALL`, of which each row counts as often as it is there. DataFusion plans them as joins,
//! which leave out, or keep, all rows of one value.
//!
//! The rows of one value are numbered on both sides, so that no two are alike, and the operation without ALL counts:
//!
//! ```text
//! SELECT c1 AS x FROM (
//!     SELECT c1, row_number() OVER (PARTITION BY c1) FROM (left) AS numbered(c1)
//!     EXCEPT SELECT c1, row_number() OVER (PARTITION BY c1) FROM (right) AS numbered(c1)
//! ) AS counted(c1, row)
//! ```

use datafusion::common::DFSchema;
use datafusion::sql::sqlparser::ast::{
    Query, Select, SetExpr, SetOperator, SetQuantifier, TableFactor, TableWithJoins,
};

use super::columns::hinted_error;
use super::tree;
use crate::Error;

/// Tells the columns of a FROM.
type LookUp<'a> = dyn FnMut(Vec<TableWithJoins>) -> Result<DFSchema, Error> + 'a;

/// Rewrites the operations of a query's body, whose own subqueries are rewritten.
///
/// # Errors
/// [`Error::Query`] if the columns of the left side cannot be known.
pub(super) fn count_set_rows(body: &mut SetExpr, look_up: &mut LookUp<'_>) -> Result<(), Error> {
    let SetExpr::SetOperation { op, set_quantifier, left, right } = body else { return Ok(()) };
    count_set_rows(left, look_up)?;
    count_set_rows(right, look_up)?;
    let is_counted = matches!(op, SetOperator::Except | SetOperator::Minus | SetOperator::Intersect)
        && *set_quantifier == SetQuantifier::All;
    if !is_counted {
        return Ok(());
    }
    let name = if *op == SetOperator::Intersect { "INTERSECT" } else { "EXCEPT" };
    let sides = [into_query(left)?, into_query(right)?];
    let schema = look_up(vec![TableWithJoins { relation: derived_table(sides[0].clone()), joins: Vec::new() }]);
    let schema = schema.map_err(|_| {
        let hint = format!("{name} without ALL, or row_number() OVER (PARTITION BY x) as a column of both sides");
        hinted_error(format!("{name} ALL is not planned here, because its columns are not known"), hint)
    })?;
    let count = schema.fields().len();
    let columns = (1..=count).map(|nth| format!("c{nth}")).collect::<Vec<_>>().join(", ");
    let named: Vec<_> = schema
        .fields()
        .iter()
        .enumerate()
        .map(|(at, field)| format!("c{} AS {}", at + 1, tree::quoted_ident(field.name())))
        .collect();
    let numbered =
        format!("SELECT {columns}, row_number() OVER (PARTITION BY {columns}) FROM (SELECT 1) AS numbered({columns})");
    let named = named.join(", ");
    let sql = format!("SELECT {named} FROM ({numbered} {name} {numbered}) AS counted({columns}, \"row\")");
    let mut counted = tree::parse_query(&sql)?;
    place_sides(&mut counted, sides).ok_or_else(|| Error::failed_query("a set operation is not as it was written"))?;
    *body = *counted.body;
    Ok(())
}

fn into_query(side: &SetExpr) -> Result<Box<Query>, Error> {
    if let SetExpr::Query(query) = side {
        return Ok(query.clone());
    }
    let mut query = tree::parse_query("SELECT 1")?;
    *query.body = side.clone();
    Ok(query)
}

fn derived_table(subquery: Box<Query>) -> TableFactor {
    TableFactor::Derived { lateral: false, subquery, alias: None, sample: None }
}

// Puts the sides where `(SELECT 1)` was written.
fn place_sides(counted: &mut Query, sides: [Box<Query>; 2]) -> Option<()> {
    let operation = only_subquery(as_select(&mut counted.body)?)?;
    let SetExpr::SetOperation { left, right, .. } = &mut *operation.body else { return None };
    for (half, side) in [left, right].into_iter().zip(sides) {
        *only_subquery(as_select(half)?)? = *side;
    }
    Some(())
}

fn as_select(body: &mut SetExpr) -> Option<&mut Select> {
    match body {
        SetExpr::Select(select) => Some(select),
        _ => None,
    }
}

fn only_subquery(select: &mut Select) -> Option<&mut Query> {
    match &mut select.from.first_mut()?.relation {
        TableFactor::Derived { subquery, .. } => Some(subquery),
        _ => None,
    }
}
