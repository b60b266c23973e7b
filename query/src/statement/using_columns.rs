//! Columns of `JOIN ... USING`, of which a result has one.
//!
//! DataFusion takes them for ambiguous in WHERE. Of an outer join it takes the column of the table whose name comes
//! first, which is null where that table has no row. So they are named here: the column of the table that keeps all of
//! its rows, of a full join whichever is not null.

use std::collections::HashMap;
use std::ops::ControlFlow;

use datafusion::common::DFSchema;
use datafusion::sql::sqlparser::ast::{
    Expr, GroupByExpr, Ident, Join, JoinConstraint, JoinOperator, Query, Select, SelectItem, SetExpr, TableFactor,
    TableWithJoins, VisitorMut, WildcardAdditionalOptions,
};

use super::as_of_join::is_as_of_join;
use super::columns::hinted_error;
use super::syntax_walk::walk_mut;
use super::tree::{normalized_name, parse_expr, quoted_ident};
use crate::Error;

/// Tells the columns of a FROM.
type LookUp<'a> = dyn FnMut(Vec<TableWithJoins>) -> Result<DFSchema, Error> + 'a;

/// Names the columns of USING in a SELECT, outside of its subqueries.
///
/// # Errors
/// [`Error::Query`] of an outer join whose columns cannot be named, and of what `look_up` refuses.
pub(super) fn name_using_columns(select: &mut Select, look_up: &mut LookUp<'_>) -> Result<(), Error> {
    let joins = || select.from.iter().flat_map(|from| &from.joins);
    refuse_unnamed(&select.from)?;
    let is_outer = joins().any(is_outer_using);
    let has_columns = joins().any(|join| !using_columns(join).is_empty());
    if !has_columns || !is_outer && select.selection.is_none() {
        return Ok(());
    }
    let (schema, mut namer) = ColumnNamer::of_tables(&mut select.from, look_up)?;
    let _ = walk_mut(&mut select.selection, &mut namer);
    if is_outer {
        name_in_select(select, &schema, &mut namer)?;
    }
    Ok(())
}

/// Names the columns of outer joins by USING in ORDER BY, as far as the result has none of their names.
///
/// # Errors
/// As [`name_using_columns`].
pub(super) fn name_ordering_columns(query: &mut Query, look_up: &mut LookUp<'_>) -> Result<(), Error> {
    let (SetExpr::Select(select), Some(order_by)) = (&mut *query.body, &mut query.order_by) else { return Ok(()) };
    if select.from.iter().flat_map(|from| &from.joins).any(is_outer_using) {
        let (_, mut namer) = ColumnNamer::of_tables(&mut select.from, look_up)?;
        for item in &select.projection {
            if let SelectItem::ExprWithAlias { alias, .. } = item {
                namer.values.remove(&normalized_name(alias));
            }
        }
        let _ = walk_mut(order_by, &mut namer);
    }
    Ok(())
}

// Outer joins whose columns are not named here.
fn refuse_unnamed(from: &[TableWithJoins]) -> Result<(), Error> {
    for join in from.iter().flat_map(|from| &from.joins) {
        if is_outer(join) && matches!(constraint(join), Some(JoinConstraint::Natural)) {
            let message = "NATURAL outer joins are not supported".to_owned();
            return Err(hinted_error(message, "join by USING (column, ...)".to_owned()));
        }
    }
    for from in from {
        refuse_repeated(&from.joins)?;
    }
    let factors =
        from.iter().flat_map(|from| [&from.relation].into_iter().chain(from.joins.iter().map(|join| &join.relation)));
    for factor in factors {
        if let TableFactor::NestedJoin { table_with_joins, .. } = factor {
            refuse_unnamed(std::slice::from_ref(table_with_joins))?;
            if table_with_joins.joins.iter().any(is_outer_using) {
                let message = "an outer join by USING in parentheses is not supported".to_owned();
                return Err(hinted_error(message, "join by ON, or name it by WITH".to_owned()));
            }
        }
    }
    Ok(())
}

// After a right or full join the next join by USING would compare the column of a table that does not keep all rows.
fn refuse_repeated(joins: &[Join]) -> Result<(), Error> {
    let mut merged: Vec<String> = Vec::new();
    for join in joins {
        let columns = using_columns(join);
        if let Some(column) = columns.iter().find(|column| merged.contains(*column)) {
            let message = format!("`{column}` is joined by USING again after a RIGHT or FULL JOIN");
            return Err(hinted_error(message, "join by ON, after a FULL JOIN with coalesce(a.x, b.x)".to_owned()));
        }
        if is_outer(join) && !is_as_of_join(join) && !is_left(join) {
            merged.extend(columns);
        }
    }
    Ok(())
}

fn name_in_select(select: &mut Select, schema: &DFSchema, namer: &mut ColumnNamer) -> Result<(), Error> {
    let mut projection = Vec::with_capacity(select.projection.len());
    for item in std::mem::take(&mut select.projection) {
        match item {
            SelectItem::Wildcard(options) if options == WildcardAdditionalOptions::default() => {
                let first = |name| schema.fields().iter().position(|field| field.name() == name);
                let kept = schema.iter().enumerate().filter(|(at, (_, field))| {
                    !namer.values.contains_key(field.name()) || first(field.name()) == Some(*at)
                });
                projection.extend(kept.map(|(_, (table, field))| {
                    let column = quoted_ident(field.name());
                    let named = table.map(|table| vec![quoted_ident(table.table()), column.clone()]);
                    let otherwise = named.map_or(Expr::Identifier(column.clone()), Expr::CompoundIdentifier);
                    let expr = namer.values.get(field.name()).cloned().unwrap_or(otherwise);
                    SelectItem::ExprWithAlias { expr, alias: column }
                }));
            }
            SelectItem::Wildcard(_) => {
                return Err(hinted_error(
                    "`*` with options, over an outer join by USING, is not supported".to_owned(),
                    "name the columns, or join by ON".to_owned(),
                ));
            }
            SelectItem::UnnamedExpr(Expr::Identifier(column)) => projection.push(match namer.value(&column).cloned() {
                Some(expr) => SelectItem::ExprWithAlias { expr, alias: column },
                None => SelectItem::UnnamedExpr(Expr::Identifier(column)),
            }),
            mut other => {
                let _ = walk_mut(&mut other, namer);
                projection.push(other);
            }
        }
    }
    select.projection = projection;
    if let GroupByExpr::Expressions(expressions, _) = &mut select.group_by {
        let _ = walk_mut(expressions, namer);
    }
    let _ = walk_mut(&mut select.distinct, namer);
    let _ = walk_mut(&mut select.named_window, namer);
    let _ = walk_mut(&mut select.having, namer);
    let _ = walk_mut(&mut select.qualify, namer);
    Ok(())
}

// Adds the value of each column that a join of `from` has by USING.
fn add_values(
    values: &mut HashMap<String, Expr>,
    from: &mut TableWithJoins,
    look_up: &mut LookUp<'_>,
) -> Result<(), Error> {
    for at in 0..from.joins.len() {
        let mut namer = ColumnNamer { values: values.clone(), subqueries: 0 };
        let _ = walk_mut(&mut from.joins[at].join_operator, &mut namer);
        let join = &from.joins[at];
        let columns = using_columns(join);
        let right = table_name(&join.relation);
        if columns.is_empty() {
            continue;
        }
        let before = TableWithJoins { relation: from.relation.clone(), joins: from.joins[..at].to_vec() };
        let mut schema = None;
        for column in columns {
            let left = match values.get(&column) {
                Some(known) => Some(known.clone()),
                None => {
                    let schema = match &schema {
                        Some(known) => known,
                        None => schema.insert(look_up(vec![before.clone()])?),
                    };
                    let mut found = schema.iter().filter(|(_, field)| *field.name() == column);
                    let only = found.next().filter(|_| found.next().is_none());
                    only.and_then(|(table, _)| Some(column_of(&quoted_ident(table?.table()), &column)))
                }
            };
            let right = right.as_ref().map(|table| column_of(table, &column));
            let value = match (&join.join_operator, left, right) {
                (JoinOperator::Right(_) | JoinOperator::RightOuter(_), _, right) => right,
                (JoinOperator::FullOuter(_), Some(left), Some(right)) => {
                    Some(parse_expr(&format!("coalesce({left}, {right})"))?)
                }
                (JoinOperator::FullOuter(_), ..) => None,
                (_, left, _) => left,
            };
            match value {
                Some(value) => drop(values.insert(column, value)),
                None if is_outer_using(join) => {
                    let message = format!("which table has column `{column}` of USING is not known");
                    return Err(hinted_error(message, "name the tables, or join by ON".to_owned()));
                }
                None => {}
            }
        }
    }
    Ok(())
}

fn constraint(join: &Join) -> Option<&JoinConstraint> {
    match &join.join_operator {
        JoinOperator::Join(constraint)
        | JoinOperator::Inner(constraint)
        | JoinOperator::Left(constraint)
        | JoinOperator::LeftOuter(constraint)
        | JoinOperator::Right(constraint)
        | JoinOperator::RightOuter(constraint)
        | JoinOperator::FullOuter(constraint) => Some(constraint),
        _ => None,
    }
}

// The time of an as-of join differs between its sides, as columns of outer joins do.
fn is_outer(join: &Join) -> bool {
    let is_inner = matches!(join.join_operator, JoinOperator::Join(_) | JoinOperator::Inner(_));
    constraint(join).is_some() && (!is_inner || is_as_of_join(join))
}

fn is_left(join: &Join) -> bool {
    matches!(join.join_operator, JoinOperator::Left(_) | JoinOperator::LeftOuter(_))
}

fn is_outer_using(join: &Join) -> bool {
    is_outer(join) && matches!(constraint(join), Some(JoinConstraint::Using(_)))
}

// Normalized names; none of a join that is not by USING, or keeps the columns of one table.
fn using_columns(join: &Join) -> Vec<String> {
    let Some(JoinConstraint::Using(columns)) = constraint(join) else { return Vec::new() };
    columns.iter().filter_map(|column| Some(normalized_name(column.0.last()?.as_ident()?))).collect()
}

fn table_name(factor: &TableFactor) -> Option<Ident> {
    match factor {
        TableFactor::Table { alias: Some(alias), .. } | TableFactor::Derived { alias: Some(alias), .. } => {
            Some(alias.name.clone())
        }
        TableFactor::Table { name, .. } => name.0.last()?.as_ident().cloned(),
        _ => None,
    }
}

fn column_of(table: &Ident, column: &str) -> Expr {
    Expr::CompoundIdentifier(vec![table.clone(), quoted_ident(column)])
}

struct ColumnNamer {
    /// By normalized name.
    values: HashMap<String, Expr>,
    /// Number of subqueries around.
    subqueries: usize,
}

impl ColumnNamer {
    // Returns the columns of `SELECT *`, too.
    fn of_tables(from: &mut [TableWithJoins], look_up: &mut LookUp<'_>) -> Result<(DFSchema, Self), Error> {
        let mut values = HashMap::new();
        let mut ambiguous = Vec::new();
        for from in &mut *from {
            let mut own = HashMap::new();
            add_values(&mut own, from, look_up)?;
            ambiguous.extend(own.keys().filter(|column| values.contains_key(*column)).cloned());
            values.extend(own);
        }
        let is_outer = from.iter().flat_map(|from| &from.joins).any(is_outer_using);
        if let (Some(column), true) = (ambiguous.first(), is_outer) {
            let message = format!("two parts of FROM have column `{column}` of USING");
            return Err(hinted_error(message, "join one of them by ON".to_owned()));
        }
        ambiguous.iter().for_each(|column| drop(values.remove(column)));
        let schema = look_up(from.to_vec())?;
        // DataFusion leaves as many as joins name it. Another one is of a table that is joined otherwise: which is
        // meant is not known then.
        values.retain(|column, _| {
            let named = from.iter().flat_map(|from| &from.joins).flat_map(using_columns);
            let found = schema.fields().iter().filter(|field| field.name() == column).count();
            found <= named.filter(|name| name == column).count()
        });
        Ok((schema, Self { values, subqueries: 0 }))
    }

    fn value(&self, column: &Ident) -> Option<&Expr> {
        self.values.get(&normalized_name(column))
    }
}

impl VisitorMut for ColumnNamer {
    type Break = ();

    fn pre_visit_query(&mut self, _: &mut Query) -> ControlFlow<()> {
        self.subqueries += 1;
        ControlFlow::Continue(())
    }

    fn post_visit_query(&mut self, _: &mut Query) -> ControlFlow<()> {
        self.subqueries -= 1;
        ControlFlow::Continue(())
    }

    fn post_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Identifier(column) = expr
            && self.subqueries == 0
            && let Some(value) = self.value(column)
        {
            *expr = value.clone();
        }
        ControlFlow::Continue(())
    }
}
