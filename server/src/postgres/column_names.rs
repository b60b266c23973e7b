//! Names of an answer's columns, as Postgres gives them to what has none: a call has its function's, a cast that of what
//! it casts. Columns may have the same name there.

use datafusion::sql::sqlparser::ast::{
    AccessExpr, Distinct, Expr, Ident, OrderByKind, Query, Select, SelectItem, SetExpr, TypedString, Value,
    ValueWithSpan,
};

use super::functions::short_type_name;

/// Begins what tells columns of one name apart; clients do not see it.
pub(super) const REPEATED: char = '\u{1}';
/// Postgres' name of a column without one.
const UNNAMED: &str = "?column?";

/// Gives each column of a selection a name, and tells those of one name apart.
pub(super) fn name_columns(select: &mut Select) {
    let items = &mut select.projection;
    let texts: Vec<_> = items.iter().map(ToString::to_string).collect();
    let columns: Vec<_> = items.iter().filter_map(plain_column).collect();
    let has_all = items.iter().any(|item| matches!(item, SelectItem::Wildcard(_) | SelectItem::QualifiedWildcard(..)));
    let mut seen: Vec<String> = Vec::new();
    for (at, item) in items.iter_mut().enumerate() {
        let Some(name) = item_name(item) else { continue };
        let repeats_name = columns.contains(&name) || seen.contains(&name);
        let alias = format!("{name}{REPEATED}{at}");
        let alias = match &*item {
            SelectItem::UnnamedExpr(_) if plain_column(item).is_some() => {
                texts[..at].contains(&texts[at]).then_some(alias)
            }
            // All columns may hold the one that is cast.
            SelectItem::UnnamedExpr(expr) if repeats_name || (has_all && is_cast_column(expr)) => Some(alias),
            SelectItem::UnnamedExpr(_) => Some(name.clone()),
            _ => repeats_name.then_some(alias),
        };
        if plain_column(item).is_none() {
            seen.push(name);
        }
        if let Some(alias) = alias {
            set_alias(item, Ident::with_quote('"', alias));
        }
    }
}

fn item_name(item: &SelectItem) -> Option<String> {
    match item {
        SelectItem::UnnamedExpr(expr) => Some(column_name(expr)),
        SelectItem::ExprWithAlias { alias, .. } => Some(alias_name(alias)),
        _ => None,
    }
}

fn set_alias(item: &mut SelectItem, alias: Ident) {
    match item {
        SelectItem::UnnamedExpr(expr) => *item = SelectItem::ExprWithAlias { expr: expr.clone(), alias },
        SelectItem::ExprWithAlias { alias: own, .. } => *own = alias,
        _ => {}
    }
}

/// Orders distinct rows by the columns that an expression is: DataFusion knows them by name alone.
pub(super) fn order_by_columns(query: &mut Query) {
    let SetExpr::Select(select) = query.body.as_ref() else { return };
    let Some(OrderByKind::Expressions(orders)) = query.order_by.as_mut().map(|order| &mut order.kind) else { return };
    if select.distinct != Some(Distinct::Distinct) {
        return;
    }
    for order in orders {
        let is_same =
            |item: &&SelectItem| matches!(item, SelectItem::ExprWithAlias { expr, .. } if *expr == order.expr);
        if let Some(SelectItem::ExprWithAlias { alias, .. }) = select.projection.iter().find(is_same) {
            order.expr = Expr::Identifier(alias.clone());
        }
    }
}

fn alias_name(alias: &Ident) -> String {
    match alias.quote_style {
        Some(_) => alias.value.clone(),
        None => alias.value.to_lowercase(),
    }
}

fn plain_column(item: &SelectItem) -> Option<String> {
    match item {
        SelectItem::UnnamedExpr(expr @ (Expr::Identifier(_) | Expr::CompoundIdentifier(_))) => Some(column_name(expr)),
        _ => None,
    }
}

fn is_cast_column(expr: &Expr) -> bool {
    match expr {
        Expr::Identifier(_) | Expr::CompoundIdentifier(_) => true,
        Expr::Cast { expr, .. } | Expr::Nested(expr) => is_cast_column(expr),
        _ => false,
    }
}

fn column_name(expr: &Expr) -> String {
    own_name(expr).unwrap_or_else(|| match expr {
        Expr::Cast { data_type, .. } | Expr::TypedString(TypedString { data_type, .. }) => {
            let name = data_type.to_string().to_lowercase();
            let name = name.split(['(', '[']).next().unwrap_or_default();
            short_type_name(name.rsplit('.').next().unwrap_or(name)).to_owned()
        }
        Expr::Case { .. } => "case".to_owned(),
        Expr::Value(ValueWithSpan { value: Value::Boolean(_), .. }) => "bool".to_owned(),
        _ => UNNAMED.to_owned(),
    })
}

// The name that also stands through a cast.
fn own_name(expr: &Expr) -> Option<String> {
    match expr {
        Expr::Identifier(name) => Some(alias_name(name)),
        Expr::CompoundIdentifier(parts) => parts.last().map(alias_name),
        Expr::Function(function) => function.name.0.last().and_then(|name| name.as_ident()).map(alias_name),
        Expr::Cast { expr, .. } | Expr::Nested(expr) => own_name(expr),
        Expr::Case { else_result: Some(otherwise), .. } => own_name(otherwise),
        Expr::Subquery(query) => match query.body.as_ref() {
            SetExpr::Select(select) => match select.projection.first()? {
                SelectItem::ExprWithAlias { alias, .. } => Some(alias_name(alias)),
                SelectItem::UnnamedExpr(expr) => Some(column_name(expr)),
                _ => None,
            },
            _ => None,
        },
        Expr::Interval(_) => Some("interval".to_owned()),
        Expr::Exists { .. } => Some("exists".to_owned()),
        Expr::Array(_) => Some("array".to_owned()),
        Expr::Extract { .. } => Some("extract".to_owned()),
        Expr::Substring { .. } => Some("substring".to_owned()),
        Expr::Position { .. } => Some("position".to_owned()),
        Expr::Trim { .. } => Some("btrim".to_owned()),
        Expr::Ceil { .. } => Some("ceil".to_owned()),
        Expr::Floor { .. } => Some("floor".to_owned()),
        Expr::AtTimeZone { .. } => Some("timezone".to_owned()),
        Expr::CompoundFieldAccess { root, access_chain } => match access_chain.last()? {
            AccessExpr::Dot(Expr::Identifier(field)) => Some(alias_name(field)),
            _ => own_name(root),
        },
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use datafusion::sql::sqlparser::ast::Statement;
    use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
    use datafusion::sql::sqlparser::parser::Parser;

    use super::*;

    fn check(sql: &str, expected: &str) {
        let statement = Parser::parse_sql(&PostgreSqlDialect {}, sql).expect(sql).pop();
        let Some(Statement::Query(mut query)) = statement else { panic!("{sql} is no query") };
        let SetExpr::Select(select) = query.body.as_mut() else { panic!("{sql} is no selection") };
        name_columns(select);
        order_by_columns(&mut query);
        assert_eq!(query.to_string(), expected);
    }

    #[test]
    fn columns_have_postgres_names() {
        check("SELECT a.x, b.x, y AS \"Z\" FROM a, b", "SELECT a.x, b.x, y AS \"Z\" FROM a, b");
        check("SELECT count(*), Upper('a') FROM t", "SELECT count(*) AS \"count\", Upper('a') AS \"upper\" FROM t");
        check("SELECT 1, 1, x + 1", "SELECT 1 AS \"?column?\", 1 AS \"?column?\u{1}1\", x + 1 AS \"?column?\u{1}2\"");
        check(
            "SELECT x, x::text, 1::int, NULL::varchar(3), true",
            "SELECT x, x::TEXT AS \"x\u{1}1\", 1::INT AS \"int4\", NULL::VARCHAR(3) AS \"varchar\", true AS \"bool\"",
        );
        check(
            "SELECT CASE WHEN x THEN 1 END, (SELECT max(y) FROM u), array[1]",
            "SELECT CASE WHEN x THEN 1 END AS \"case\", (SELECT max(y) FROM u) AS \"max\", ARRAY[1] AS \"array\"",
        );
        check("SELECT x, x, y AS k, z AS k", "SELECT x, x AS \"x\u{1}1\", y AS k, z AS \"k\u{1}3\"");
        check("SELECT x, y AS x, *, z::int", "SELECT x, y AS \"x\u{1}1\", *, z::INT AS \"z\u{1}3\"");
    }

    #[test]
    fn distinct_rows_are_ordered_by_their_columns() {
        check(
            "SELECT DISTINCT lower(x) FROM t ORDER BY lower(x) DESC",
            "SELECT DISTINCT lower(x) AS \"lower\" FROM t ORDER BY \"lower\" DESC",
        );
        check("SELECT lower(x) AS l FROM t ORDER BY lower(x)", "SELECT lower(x) AS l FROM t ORDER BY lower(x)");
    }
}
