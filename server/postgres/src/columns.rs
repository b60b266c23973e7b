//! What every statement is given, none of which changes a value: Postgres' names of its columns, ranks of signed
//! integers, and the syntax of arrays that clients write as texts, `{a,"b, c",NULL}`.
//!
//! In Postgres a column without a name has that of a call's function, and a cast that of what it casts; columns may
//! have the same name.

use std::iter::Peekable;
use std::ops::ControlFlow;
use std::str::Chars;

use datafusion::sql::sqlparser::ast::{
    AccessExpr, Array, DataType as SqlType, Distinct, Expr, Ident, OrderByKind, Query, Select, SelectItem, SetExpr,
    Statement, TypedString, Value, ValueWithSpan, VisitorMut,
};
use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
use datafusion::sql::sqlparser::parser::Parser;
use echolake_query::walk_statement;

use super::names::short_type_name;

/// Begins what tells columns of one name apart; clients do not see it.
pub(super) const REPEATED: char = '\u{1}';
/// Postgres' name of a column without one.
const UNNAMED: &str = "?column?";
/// Window functions whose numbers are unsigned in DataFusion, which no integer of Postgres is.
const RANKS: [&str; 4] = ["row_number", "rank", "dense_rank", "ntile"];

/// Names and types a statement's columns as Postgres does, and reads its arrays.
pub(super) fn adapt_columns(statement: &mut Statement) {
    // The walk never breaks off.
    let _ = walk_statement(statement, &mut ColumnAdapter);
}

struct ColumnAdapter;

impl VisitorMut for ColumnAdapter {
    type Break = ();

    fn pre_visit_query(&mut self, query: &mut Query) -> ControlFlow<()> {
        if let SetExpr::Select(select) = query.body.as_mut() {
            name_columns(select);
        }
        order_by_columns(query);
        ControlFlow::Continue(())
    }

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<()> {
        name_columns(select);
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Cast { expr: text, data_type: SqlType::Array(_), .. } = expr {
            read_array(text);
        }
        ControlFlow::Continue(())
    }

    // The call stays within what replaces it.
    fn post_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Function(function) = &*expr
            && function.over.is_some()
            && RANKS.contains(&function.name.to_string().to_lowercase().as_str())
            && let Some(signed) = parse_expr(&format!("CAST({function} AS BIGINT)"))
        {
            *expr = signed;
        }
        ControlFlow::Continue(())
    }
}

/// Parses an expression that the server wrote.
pub(super) fn parse_expr(sql: &str) -> Option<Expr> {
    Parser::new(&PostgreSqlDialect {}).try_with_sql(sql).ok()?.parse_expr().ok()
}

/// Parses a statement that the server wrote.
pub(super) fn parse_statement(sql: &str) -> Option<Statement> {
    Parser::parse_sql(&PostgreSqlDialect {}, sql).ok()?.pop()
}

/// Makes of a text such as `'{a,"b c"}'` an array of texts.
pub(super) fn read_array(expr: &mut Expr) {
    let Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) = expr else { return };
    let Some(elements) = array_elements(text) else { return };
    let elements = elements.into_iter().map(|text| text.map_or(Value::Null, Value::SingleQuotedString));
    *expr = Expr::Array(Array { elem: elements.map(Expr::value).collect(), named: true });
}

/// Returns the elements of an array of one dimension, None for NULL; None if the text is no such array.
pub(super) fn array_elements(text: &str) -> Option<Vec<Option<String>>> {
    let inner = text.trim().strip_prefix('{')?.strip_suffix('}')?;
    let mut elements = Vec::new();
    let mut characters = inner.chars().peekable();
    skip_spaces(&mut characters);
    if characters.peek().is_none() {
        return Some(elements);
    }
    loop {
        skip_spaces(&mut characters);
        let mut element = String::new();
        let is_quoted = characters.next_if_eq(&'"').is_some();
        // A space that is escaped is not one at the end.
        let mut kept = 0;
        loop {
            match characters.peek() {
                Some('"') if is_quoted => break,
                None | Some(',') if !is_quoted => break,
                Some('{' | '}' | '"') if !is_quoted => return None,
                None => return None,
                Some('\\') => {
                    characters.next();
                    element.push(characters.next()?);
                    kept = element.len();
                }
                Some(_) => element.extend(characters.next()),
            }
        }
        if is_quoted {
            characters.next();
            skip_spaces(&mut characters);
        } else {
            let trimmed = element.trim_end().len();
            element.truncate(trimmed.max(kept));
            if element.is_empty() {
                return None;
            }
        }
        let is_null = !is_quoted && kept == 0 && element.eq_ignore_ascii_case("null");
        elements.push((!is_null).then_some(element));
        match characters.next() {
            None => return Some(elements),
            Some(',') => {}
            Some(_) => return None,
        }
    }
}

fn skip_spaces(characters: &mut Peekable<Chars<'_>>) {
    while characters.next_if(|c| c.is_whitespace()).is_some() {}
}

// Gives each column of a selection a name, and tells those of one name apart.
fn name_columns(select: &mut Select) {
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

// Orders distinct rows by the columns that an expression is: DataFusion knows them by name alone.
fn order_by_columns(query: &mut Query) {
    let SetExpr::Select(select) = query.body.as_ref() else { return };
    let Some(OrderByKind::Expressions(orders)) = query.order_by.as_mut().map(|order| &mut order.kind) else { return };
    if select.distinct != Some(Distinct::Distinct) {
        return;
    }
    for order in orders {
        for item in &select.projection {
            if let SelectItem::ExprWithAlias { expr, alias } = item
                && *expr == order.expr
            {
                order.expr = Expr::Identifier(alias.clone());
            }
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
    use super::*;

    fn check(sql: &str, expected: &str) {
        let mut statement = parse_statement(sql).expect(sql);
        adapt_columns(&mut statement);
        assert_eq!(statement.to_string(), expected);
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
            "SELECT CASE WHEN x THEN 1 END AS \"case\", (SELECT max(y) AS \"max\" FROM u) AS \"max\", \
             ARRAY[1] AS \"array\"",
        );
        check("SELECT x, x, y AS k, z AS k", "SELECT x, x AS \"x\u{1}1\", y AS k, z AS \"k\u{1}3\"");
        check(
            "SELECT row_number() OVER (ORDER BY x), '{a,\"b,c\"}'::text[] FROM runs",
            "SELECT CAST(row_number() OVER (ORDER BY x) AS BIGINT) AS \"row_number\", \
             ARRAY['a', 'b,c']::TEXT[] AS \"text\" FROM runs",
        );
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

    #[test]
    fn elements_are_read_as_in_postgres() {
        let read = |text: &str| array_elements(text).map(|all| format!("{all:?}").replace("Some", ""));
        for (text, expected) in [
            ("{}", "[]"),
            (" { 1 , 2 } ", r#"[("1"), ("2")]"#),
            (r#"{"a,b", c d ,"\" \\ e"}"#, r#"[("a,b"), ("c d"), ("\" \\ e")]"#),
            (r#"{NULL,"NULL","",null,\null}"#, r#"[None, ("NULL"), (""), None, ("null")]"#),
            ("{a\\ }", r#"[("a ")]"#),
        ] {
            assert_eq!(read(text).as_deref(), Some(expected), "{text}");
        }
        for text in ["", "a,b", "{a,}", "{,a}", "{{1},{2}}", "{\"a}", "{\"a\"b}", "{a\"b}", "{a\\}", "[0:1]={1,2}"] {
            assert_eq!(read(text), None, "{text}");
        }
    }
}
