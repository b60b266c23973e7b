//! Statements of Postgres' clients as DataFusion plans them.
//!
//! A statement that reads the lake reaches DataFusion as it was written; only what Postgres has that changes no value is
//! added: names and types of its columns, and the syntax of arrays in texts. A statement all of whose tables are of
//! `pg_catalog` or `information_schema`, or without any relation, is a client's question about the server: what DataFusion
//! lacks for it is put in other words.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{
    AccessExpr, Array, BinaryOperator, DataType as SqlType, Expr, Function, FunctionArg, FunctionArgExpr,
    FunctionArgumentClause, FunctionArgumentList, FunctionArguments, GroupByExpr, Ident, LimitClause, ObjectName,
    ObjectNamePart, OrderByExpr, OrderByKind, Query, Select, SelectItem, SetExpr, Statement, TableAlias,
    TableAliasColumnDef, TableFactor, TableFunctionArgs, Value, ValueWithSpan, VisitorMut,
};
use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
use datafusion::sql::sqlparser::parser::Parser;
use datafusion_pg_catalog::sql::rules::{
    AliasDuplicatedProjectionRewrite, CurrentUserVariableToSessionUserFunctionCall, ResolveUnqualifiedIdentifier,
    RewritePgCatalogOperator, SqlStatementRewriteRule, StripCallableQualifier, StripCollate,
};
use echolake_query::{walk_expr, walk_statement};

use super::array_texts::array_elements;
use super::column_names::{name_columns, order_by_columns};

/// Columns of `pg_type` that name a function by its number.
const FUNCTIONS: [&str; 6] = ["typinput", "typoutput", "typreceive", "typsend", "typmodin", "typmodout"];
/// Truths that clients compare with `t` and `f`, beside those of `pg_index`.
const TRUTHS: [&str; 2] = ["condeferrable", "condeferred"];
/// Aggregates that a subquery may have already.
const AGGREGATES: [&str; 8] = ["array_agg", "avg", "bool_or", "count", "max", "min", "string_agg", "sum"];
/// Window functions whose numbers are of 64 bits.
const RANKS: [&str; 4] = ["row_number", "rank", "dense_rank", "ntile"];
/// Tables about what no table or column of the lake has.
const NOTHING: [&str; 4] = ["pg_attrdef", "pg_collation", "pg_policy", "pg_sequence"];
/// Functions that give rows about what the lake has not, and their columns.
const FUNCTIONS_OF_NOTHING: [(&str, &str); 3] = [
    (
        "pg_partition_tree",
        "CAST(0 AS OID) AS relid, CAST(0 AS OID) AS parentrelid, false AS isleaf, CAST(0 AS INT) AS level",
    ),
    ("pg_options_to_table", "CAST('' AS TEXT) AS option_name, CAST('' AS TEXT) AS option_value"),
    ("ts_token_type", "CAST(0 AS INT) AS tokid, CAST('' AS TEXT) AS alias, CAST('' AS TEXT) AS description"),
];
/// Columns of lists that clients compare with texts, and lists that no row has.
const LISTS: [&str; 4] = ["confkey", "conkey", "indkey", "polroles"];
const LISTS_OF_NOTHING: [&str; 5] = ["confkey", "conkey", "evttags", "polroles", "reloptions"];
/// The beginning of the names of functions that read the lake's files.
const LAKE_FUNCTIONS: &str = "mcap";
/// Rules of the library for names, operators and qualifiers; its others change what a statement answers.
const RULES: [&dyn SqlStatementRewriteRule; 6] = [
    &AliasDuplicatedProjectionRewrite,
    &ResolveUnqualifiedIdentifier,
    &StripCallableQualifier,
    &CurrentUserVariableToSessionUserFunctionCall,
    &StripCollate,
    &RewritePgCatalogOperator,
];
/// The beginning of the names of tables and functions of `pg_catalog`, which nothing of the lake has.
const CATALOGUE_NAMES: &str = "pg_";
const PG_CATALOG: &str = "pg_catalog";
const INFORMATION_SCHEMA: &str = "information_schema";

/// The name by which asyncpg's query for types is known, and a query with the same answer for types that are no domains,
/// ranges or rows: DataFusion does not end its recursion.
const TYPE_TREE: &str = "typeinfo_tree";
const TYPES: &str = "SELECT t.oid, n.nspname AS ns, t.typname AS name, t.typtype AS kind, CAST(NULL AS oid) AS basetype, \
     t.typelem AS elemtype, e.typdelim AS elemdelim, CAST(NULL AS oid) AS range_subtype, \
     CAST(NULL AS TEXT) AS attrtypoids, CAST(NULL AS TEXT) AS attrnames, \
     CASE WHEN array_contains($1::oid[], t.oid) THEN 0 ELSE 1 END AS depth, CAST(NULL AS TEXT) AS basetype_name, \
     e.typname AS elemtype_name, CAST(NULL AS TEXT) AS range_subtype_name \
     FROM pg_catalog.pg_type t JOIN pg_catalog.pg_namespace n ON n.oid = t.typnamespace \
     LEFT JOIN pg_catalog.pg_type e ON e.oid = t.typelem WHERE array_contains($1::oid[], t.oid) \
     OR t.oid IN (SELECT o.typelem FROM pg_catalog.pg_type o WHERE array_contains($1::oid[], o.oid)) ORDER BY depth DESC";

/// Adapts a statement.
pub(super) fn rewrite(mut statement: Statement) -> Statement {
    // Here and below, walks never break off.
    let _ = walk_statement(&mut statement, &mut ColumnAdapter);
    let Some(names) = catalogue_names(&mut statement) else { return statement };
    if names.first().is_some_and(|name| name == TYPE_TREE)
        && let Some(known) = Parser::parse_sql(&PostgreSqlDialect {}, TYPES).ok().and_then(|mut all| all.pop())
    {
        return known;
    }
    // Before qualifiers are gone.
    let _ = walk_statement(&mut statement, &mut NumberAdapter);
    statement = RULES.iter().fold(statement, |statement, rule| rule.rewrite(statement));
    let _ = walk_statement(&mut statement, &mut CatalogueAdapter { names });
    type_integers(&mut statement);
    statement
}

/// Returns the names of the common tables of a statement about the server; None for one that reads anything else.
pub(super) fn catalogue_names(statement: &mut Statement) -> Option<Vec<String>> {
    let mut found = StatementRelations::default();
    let _ = walk_statement(statement, &mut found);
    let is_of_catalogue = !found.reads_other && (found.reads_catalogue || !found.has_relation);
    is_of_catalogue.then_some(found.names)
}

/// The relations of a statement.
#[derive(Default)]
struct StatementRelations {
    /// Names of common tables, WITH.
    names: Vec<String>,
    reads_catalogue: bool,
    reads_other: bool,
    has_relation: bool,
}

impl VisitorMut for StatementRelations {
    type Break = ();

    fn pre_visit_query(&mut self, query: &mut Query) -> ControlFlow<()> {
        let tables = query.with.iter().flat_map(|with| &with.cte_tables);
        self.names.extend(tables.map(|table| table.alias.name.value.clone()));
        self.reads_other |= matches!(query.body.as_ref(), SetExpr::Table(_));
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        self.has_relation = true;
        match factor {
            TableFactor::Table { name, args: Some(_), .. } => {
                let name = last_name(name).unwrap_or_default();
                self.reads_other |= name.starts_with(LAKE_FUNCTIONS);
                self.reads_catalogue |= name.starts_with(CATALOGUE_NAMES);
            }
            TableFactor::Table { name, .. } => match &name.0[..] {
                [ObjectNamePart::Identifier(name)] if self.names.contains(&name.value) => {}
                _ if is_of_catalogue(name) => self.reads_catalogue = true,
                _ => self.reads_other = true,
            },
            _ => {}
        }
        ControlFlow::Continue(())
    }
}

fn is_of_catalogue(name: &ObjectName) -> bool {
    let parts: Vec<_> = name.0.iter().filter_map(|part| part.as_ident()).map(|i| i.value.to_lowercase()).collect();
    match &parts[..] {
        [table] => table.starts_with(CATALOGUE_NAMES),
        [.., schema, _] => schema == PG_CATALOG || schema == INFORMATION_SCHEMA,
        [] => false,
    }
}

fn last_name(name: &ObjectName) -> Option<String> {
    Some(name.0.last()?.as_ident()?.value.to_lowercase())
}

/// Gives columns Postgres' names and types, and arrays their syntax.
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
        if let Some(signed) = signed_rank(expr) {
            *expr = signed;
        }
        ControlFlow::Continue(())
    }
}

// '{a,"b c"}' as an array of texts.
fn read_array(expr: &mut Expr) {
    let Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) = expr else { return };
    let Some(elements) = array_elements(text) else { return };
    let value = |element: Option<String>| Expr::value(element.map_or(Value::Null, Value::SingleQuotedString));
    *expr = Expr::Array(Array { elem: elements.into_iter().map(value).collect(), named: true });
}

// Numbers of rows and ranks are unsigned in DataFusion, which no integer of Postgres is.
fn signed_rank(expr: &Expr) -> Option<Expr> {
    let Expr::Function(function) = expr else { return None };
    let is_rank = RANKS.contains(&function.name.to_string().to_lowercase().as_str());
    (is_rank && function.over.is_some()).then(|| parsed(&format!("CAST({function} AS BIGINT)"))).flatten()
}

/// Finds the numbers of names: 'name'::regclass and its like.
struct NumberAdapter;

impl VisitorMut for NumberAdapter {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Some(number) = number_of_text(expr) {
            *expr = number;
        }
        ControlFlow::Continue(())
    }
}

// Of a text, or of a placeholder for one.
fn number_of_text(expr: &Expr) -> Option<Expr> {
    let Expr::Cast { expr: inner, data_type, .. } = expr else { return None };
    let kind = data_type.to_string().to_lowercase();
    let function = match kind.strip_prefix("pg_catalog.").unwrap_or(&kind) {
        "regclass" => "to_regclass",
        "regnamespace" => "to_regnamespace",
        "regtype" => "to_regtype",
        "regproc" | "regprocedure" => "to_regproc",
        _ => return None,
    };
    is_text(inner).then(|| parsed(&format!("{function}({inner})"))).flatten()
}

fn is_text(expr: &Expr) -> bool {
    match expr {
        Expr::Value(ValueWithSpan { value, .. }) => {
            matches!(value, Value::SingleQuotedString(_) | Value::Placeholder(_))
        }
        Expr::Function(function) => {
            last_name(&function.name).is_some_and(|name| ["format", "quote_ident", "concat"].contains(&name.as_str()))
        }
        Expr::BinaryOp { op: BinaryOperator::StringConcat, .. } => true,
        Expr::Cast { expr, data_type: SqlType::Text, .. } => is_text(expr),
        Expr::Nested(inner) => is_text(inner),
        _ => false,
    }
}

// An integer alone is of 32 bits in Postgres.
fn type_integers(statement: &mut Statement) {
    let Statement::Query(query) = statement else { return };
    let (None, SetExpr::Select(select)) = (&query.with, query.body.as_mut()) else { return };
    for item in &mut select.projection {
        let (SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. }) = item else { continue };
        type_integer(expr);
    }
}

fn type_integer(expr: &mut Expr) {
    if let Expr::Value(ValueWithSpan { value: Value::Number(number, _), .. }) = expr
        && number.parse::<i32>().is_ok()
        && let Some(typed) = parsed(&format!("CAST({number} AS INT)"))
    {
        *expr = typed;
    }
}

fn type_of_integer(expr: &mut Expr) {
    if let Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) = expr
        && name.to_string().eq_ignore_ascii_case("pg_typeof")
        && let [FunctionArg::Unnamed(FunctionArgExpr::Expr(arg))] = &mut args.args[..]
    {
        type_integer(arg);
    }
}

/// Puts in other words what DataFusion lacks.
struct CatalogueAdapter {
    /// Names of common tables, WITH.
    names: Vec<String>,
}

impl VisitorMut for CatalogueAdapter {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::AnyOp { right, .. } | Expr::AllOp { right, .. } = expr {
            read_array(right);
        }
        if let Expr::Subquery(query) = expr
            && asks_for_nothing(query)
        {
            *expr = Expr::value(Value::Null);
        }
        if let Some(better) = array_of_query(expr)
            .or_else(|| subscripts(expr))
            .or_else(|| split_text(expr))
            .or_else(|| expanded(expr))
            .or_else(|| name_of_function(expr))
            .or_else(|| field_of_row(expr))
            .or_else(|| compared_with_text(expr))
            .or_else(|| single_value(expr))
        {
            *expr = better;
        }
        escape_by_backslash(expr);
        type_of_integer(expr);
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        name_elements(factor);
        if let Some(none) = table_without_rows(factor).or_else(|| keys_of_nothing(factor)) {
            *factor = none;
        }
        if let TableFactor::Table { name, args: None, .. } = factor
            && let [ObjectNamePart::Identifier(own)] = &name.0[..]
            && !self.names.contains(&own.value)
        {
            *name = ObjectName::from(vec![Ident::new(PG_CATALOG), own.clone()]);
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<()> {
        series_rows(&mut select.projection);
        for item in &mut select.projection {
            if let SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } = item {
                let _ = walk_expr(expr, &mut ExistsAdapter { depth: 0 });
            }
        }
        ControlFlow::Continue(())
    }
}

// DataFusion cannot compute EXISTS outside of WHERE, but can count.
struct ExistsAdapter {
    /// Queries around what is visited, whose own WHERE may have it.
    depth: usize,
}

impl VisitorMut for ExistsAdapter {
    type Break = ();

    fn pre_visit_query(&mut self, _: &mut Query) -> ControlFlow<()> {
        self.depth += 1;
        ControlFlow::Continue(())
    }

    fn post_visit_query(&mut self, _: &mut Query) -> ControlFlow<()> {
        self.depth -= 1;
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if self.depth == 0
            && let Expr::Exists { subquery, negated } = expr
            && let SetExpr::Select(select) = subquery.body.as_mut()
            && matches!(&select.group_by, GroupByExpr::Expressions(by, _) if by.is_empty())
            && select.having.is_none()
        {
            let compared = if *negated { "=" } else { ">" };
            if let Some(count) = parsed("count(*)") {
                select.projection = vec![SelectItem::UnnamedExpr(count)];
                (select.distinct, subquery.order_by, subquery.limit_clause) = (None, None, None);
                if let Some(counted) = parsed(&format!("({subquery}) {compared} 0")) {
                    *expr = counted;
                }
            }
        }
        ControlFlow::Continue(())
    }
}

// LIKE with an escape character of its own.
fn escape_by_backslash(expr: &mut Expr) {
    let (Expr::Like { pattern, escape_char, .. } | Expr::ILike { pattern, escape_char, .. }) = expr else { return };
    let Some(ValueWithSpan { value: Value::SingleQuotedString(escape), .. }) = escape_char else { return };
    if escape == "\\" {
        return;
    }
    if let Some(escaped) = parsed(&format!("like_escape({pattern}, '{}')", escape.replace('\'', "''"))) {
        (**pattern, *escape_char) = (escaped, None);
    }
}

// _pg_expandarray(list) gives a row for each element of a list.
fn expanded(expr: &Expr) -> Option<Expr> {
    let Expr::Function(function @ Function { name, .. }) = expr else { return None };
    let asked = name.0.last()?.as_ident()?.value == "_pg_expandarray";
    // The function within is in capitals, so that it is not adapted again.
    asked.then(|| {
        call(
            "unnest",
            Expr::Function(Function {
                name: ObjectName::from(vec![Ident::new("_PG_EXPANDARRAY")]),
                ..function.clone()
            }),
            function,
        )
    })
}

// (row).field
fn field_of_row(expr: &Expr) -> Option<Expr> {
    let Expr::CompoundFieldAccess { root, access_chain } = expr else { return None };
    let [AccessExpr::Dot(Expr::Identifier(field))] = &access_chain[..] else { return None };
    parsed(&format!("get_field({root}, '{}')", field.value.replace('\'', "''")))
}

// Truths and lists of the catalogue that are compared with texts.
fn compared_with_text(expr: &Expr) -> Option<Expr> {
    let Expr::BinaryOp { left, op: op @ (BinaryOperator::Eq | BinaryOperator::NotEq), right } = expr else {
        return None;
    };
    let Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) = right.as_ref() else { return None };
    let name = match left.as_ref() {
        Expr::Identifier(name) => name,
        Expr::CompoundIdentifier(parts) => parts.last()?,
        _ => return None,
    };
    match (name.value.as_str(), text.as_str()) {
        (column, list) if LISTS.contains(&column) => {
            parsed(&format!("array_to_string({left}, ',') {op} '{}'", list.trim_matches(['{', '}'])))
        }
        (truth, "t" | "f") if truth.starts_with("indis") || TRUTHS.contains(&truth) => {
            parsed(&format!("{left} {op} {}", text == "t"))
        }
        _ => None,
    }
}

// A function's number as a text is its name.
fn name_of_function(expr: &Expr) -> Option<Expr> {
    let Expr::Cast { expr: inner, data_type, .. } = expr else { return None };
    let name = match inner.as_ref() {
        Expr::Identifier(name) => name,
        Expr::CompoundIdentifier(parts) => parts.last()?,
        _ => return None,
    };
    let kind = data_type.to_string().to_lowercase();
    let is_text = kind.ends_with("text") || kind.ends_with("varchar");
    let names_function = FUNCTIONS.iter().any(|column| name.value.eq_ignore_ascii_case(column));
    (is_text && names_function).then(|| parsed(&format!("function_name({inner})"))).flatten()
}

// The rows of a query as an array: ARRAY(SELECT x ... ORDER BY y) is array_agg(x ORDER BY y), but for no rows.
fn array_of_query(expr: &Expr) -> Option<Expr> {
    let Expr::Function(function) = expr else { return None };
    let FunctionArguments::Subquery(query) = &function.args else { return None };
    if !function.name.to_string().eq_ignore_ascii_case("array") {
        return None;
    }
    let (select, _) = selected_value(query)?;
    // What it unnests is a column of the query around it, which DataFusion cannot do.
    let is_of_nothing = select.from.iter().any(|from| keys_of_nothing(&from.relation).is_some());
    if is_of_nothing || asks_for_nothing(query) {
        return parsed("CAST(ARRAY[] AS TEXT[])");
    }
    if query.limit_clause.is_some() || query.fetch.is_some() {
        return None;
    }
    let list = Expr::Subquery(Box::new(aggregated(query, "array_agg")?));
    parsed(&format!("coalesce({list}, ARRAY[])"))
}

// DataFusion wants to be sure that a scalar subquery with a column of the query around it has one row.
fn single_value(expr: &Expr) -> Option<Expr> {
    let Expr::Subquery(query) = expr else { return None };
    let (select, value) = selected_value(query)?;
    if select.from.is_empty() {
        return None;
    }
    let is_first = match &query.limit_clause {
        None => false,
        Some(LimitClause::LimitOffset { limit: Some(limit), offset: None, limit_by })
            if limit_by.is_empty() && limit.to_string() == "1" =>
        {
            true
        }
        Some(_) => return None,
    };
    let one_row = match (is_first, has_aggregate(value)) {
        (true, true) => Query { limit_clause: None, ..query.as_ref().clone() },
        (true, false) => aggregated(query, "first_value")?,
        (false, true) => return None,
        (false, false) => return parsed(&format!("single_value(({}))", aggregated(query, "array_agg")?)),
    };
    Some(Expr::Subquery(Box::new(one_row)))
}

fn has_aggregate(expr: &Expr) -> bool {
    match expr {
        Expr::Function(function) => is_aggregate(function),
        Expr::Cast { expr, .. } | Expr::Nested(expr) => has_aggregate(expr),
        Expr::BinaryOp { left, right, .. } => has_aggregate(left) || has_aggregate(right),
        _ => false,
    }
}

// The selection of a query and the one value that each of its rows has.
fn selected_value(query: &Query) -> Option<(&Select, &Expr)> {
    let SetExpr::Select(select) = query.body.as_ref() else { return None };
    let is_grouped = !matches!(&select.group_by, GroupByExpr::Expressions(by, _) if by.is_empty());
    if is_grouped || select.distinct.is_some() || select.having.is_some() || query.fetch.is_some() {
        return None;
    }
    match &select.projection[..] {
        [SelectItem::UnnamedExpr(value) | SelectItem::ExprWithAlias { expr: value, .. }] => Some((select, value)),
        _ => None,
    }
}

// The query whose one row is an aggregate of its values, in its order.
fn aggregated(query: &Query, aggregate: &str) -> Option<Query> {
    let (select, value) = selected_value(query)?;
    let mut select = select.clone();
    let is_value = |order: &Expr| {
        let is_name = matches!(&select.projection[0], SelectItem::ExprWithAlias { alias, .. }
            if matches!(order, Expr::Identifier(name) if name.value == alias.value));
        is_name || order.to_string() == "1"
    };
    let orders = match query.order_by.as_ref().map(|order| &order.kind) {
        None => Vec::new(),
        Some(OrderByKind::Expressions(orders)) => orders.clone(),
        Some(OrderByKind::All(_)) => return None,
    };
    let by_value = |order: OrderByExpr| match is_value(&order.expr) {
        true => OrderByExpr { expr: value.clone(), ..order },
        false => order,
    };
    let orders: Vec<_> = orders.into_iter().map(by_value).collect();
    let Expr::Function(mut call) = parsed(&format!("{aggregate}({value})"))? else { return None };
    if let (FunctionArguments::List(arguments), false) = (&mut call.args, orders.is_empty()) {
        arguments.clauses.push(FunctionArgumentClause::OrderBy(orders));
    }
    select.projection = vec![SelectItem::UnnamedExpr(Expr::Function(call))];
    let body = Box::new(SetExpr::Select(Box::new(select)));
    Some(Query { body, order_by: None, limit_clause: None, ..query.clone() })
}

// generate_subscripts(list, dimension): a row for each place of a list.
fn subscripts(expr: &Expr) -> Option<Expr> {
    let Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) = expr else { return None };
    let asked = name.to_string().eq_ignore_ascii_case("generate_subscripts");
    asked.then(|| parsed(&format!("unnest(generate_series(1, array_length({args})))"))).flatten()
}

// A series in a select list gives a row for each of its numbers.
fn series_rows(items: &mut [SelectItem]) {
    for item in items {
        let (SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. }) = item else { continue };
        let Expr::Function(function) = &*expr else { continue };
        if function.name.0.last().and_then(|name| name.as_ident()).is_some_and(|name| name.value == "generate_series") {
            *expr = call("unnest", expr.clone(), &function.clone());
        }
    }
}

// regexp_split_to_table(text, pattern): a row for each part of a text.
fn split_text(expr: &Expr) -> Option<Expr> {
    let Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) = expr else { return None };
    let [text, pattern] = &args.args[..] else { return None };
    let asked = name.0.last()?.as_ident()?.value == "regexp_split_to_table";
    let parts = format!("string_to_array(regexp_replace({text}, {pattern}, chr(1), 'g'), chr(1))");
    asked.then(|| parsed(&format!("unnest({parts})"))).flatten()
}

// The one column of a list's elements has the name of their table.
fn name_elements(factor: &mut TableFactor) {
    if let TableFactor::UNNEST { alias: Some(alias), array_exprs, .. } = factor
        && let ([_], true) = (&array_exprs[..], alias.columns.is_empty())
    {
        alias.columns = vec![TableAliasColumnDef { name: alias.name.clone(), data_type: None }];
    }
}

// The elements of a key, of which no table has one. DataFusion cannot unnest a column of the query around.
fn keys_of_nothing(factor: &TableFactor) -> Option<TableFactor> {
    let (alias, list) = match factor {
        TableFactor::UNNEST { alias, array_exprs, .. } => (alias, array_exprs.first()?),
        TableFactor::Table { name, args: Some(TableFunctionArgs { args, .. }), alias, .. } => match &args[..] {
            [FunctionArg::Unnamed(FunctionArgExpr::Expr(list))] if last_name(name)? == "unnest" => (alias, list),
            _ => return None,
        },
        _ => return None,
    };
    let name = match list {
        Expr::Identifier(name) => name,
        Expr::CompoundIdentifier(parts) => parts.last()?,
        _ => return None,
    };
    LISTS_OF_NOTHING
        .contains(&name.value.as_str())
        .then(|| without_rows("CAST(0 AS SMALLINT)", alias.as_ref()))
        .flatten()
}

fn without_rows(columns: &str, alias: Option<&TableAlias>) -> Option<TableFactor> {
    let Expr::Subquery(subquery) = parsed(&format!("(SELECT {columns} WHERE false)"))? else { return None };
    Some(TableFactor::Derived { lateral: false, subquery, alias: alias.cloned(), sample: None })
}

fn table_without_rows(factor: &TableFactor) -> Option<TableFactor> {
    let TableFactor::Table { name, args: Some(_), alias, .. } = factor else { return None };
    let name = &name.0.last()?.as_ident()?.value;
    let (_, columns) = FUNCTIONS_OF_NOTHING.iter().find(|(known, _)| known == name)?;
    without_rows(columns, alias.as_ref())
}

fn parsed(sql: &str) -> Option<Expr> {
    Parser::new(&PostgreSqlDialect {}).try_with_sql(sql).ok()?.parse_expr().ok()
}

fn call(name: &str, argument: Expr, like: &Function) -> Expr {
    let args = FunctionArguments::List(FunctionArgumentList {
        duplicate_treatment: None,
        args: vec![FunctionArg::Unnamed(FunctionArgExpr::Expr(argument))],
        clauses: Vec::new(),
    });
    Expr::Function(Function { name: ObjectName::from(vec![Ident::new(name)]), args, ..like.clone() })
}

// Queries for a column's default, sequence or collation: no column has one.
fn asks_for_nothing(query: &Query) -> bool {
    let SetExpr::Select(select) = query.body.as_ref() else { return false };
    let counts = |item: &SelectItem| {
        matches!(item, SelectItem::UnnamedExpr(Expr::Function(f)) | SelectItem::ExprWithAlias { expr: Expr::Function(f), .. }
            if is_aggregate(f))
    };
    let first = select.from.first().map(|from| &from.relation);
    let of_none = matches!(first, Some(TableFactor::Table { name, args: None, .. })
        if name.0.last().and_then(|n| n.as_ident()).is_some_and(|n| NOTHING.contains(&n.value.as_str())));
    of_none && !select.projection.iter().any(counts)
}

fn is_aggregate(function: &Function) -> bool {
    let name = function.name.to_string();
    AGGREGATES.iter().any(|a| name.eq_ignore_ascii_case(a))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(sql: &str, expected: &str) {
        let mut statements = Parser::parse_sql(&PostgreSqlDialect {}, sql).expect(sql);
        assert_eq!(rewrite(statements.pop().expect("a statement")).to_string(), expected);
    }

    #[test]
    fn a_statement_on_the_lake_is_as_it_was_written() {
        for sql in [
            "SELECT x FROM runs WHERE x LIKE 'a/_' ESCAPE '/'",
            "SELECT CASE x WHEN 't' THEN 1 END AS n FROM runs",
            "SELECT ARRAY(SELECT y FROM UNNEST(o) AS y ORDER BY 1) AS n FROM runs",
            "SELECT ARRAY(SELECT y FROM pg_catalog.pg_policy) AS n FROM runs",
            "SELECT (SELECT relname FROM pg_class ORDER BY 1 LIMIT 1) AS n FROM public.pg_own",
            "SELECT x FROM runs WHERE x = ANY($1) AND y <> ALL('{a,b}')",
            "SELECT to_timestamp(x, 'YYYY') AS t, EXISTS (SELECT 1 AS n) AS e, indisprimary = 't' AS p FROM runs",
            "SELECT generate_series(1, 2) AS i, 1 AS n FROM runs",
            "SELECT k FROM UNNEST(ARRAY[3, 1]) AS k",
            "SELECT ARRAY(SELECT x FROM UNNEST(ARRAY[3, 1]) AS t (x)) AS n",
            "SELECT x FROM (VALUES (1)) AS t (x) WHERE 1 = 1",
            "SELECT value AS regclass FROM mcap('a', '/b')",
            "WITH pg AS (SELECT 1 AS x) SELECT x FROM pg, runs",
        ] {
            check(sql, sql);
        }
        check(
            "SELECT 1, count(*), row_number() OVER (ORDER BY x), '{a,\"b,c\"}'::text[] FROM runs",
            "SELECT 1 AS \"?column?\", count(*) AS \"count\", CAST(row_number() OVER (ORDER BY x) AS BIGINT) AS \
             \"row_number\", ARRAY['a', 'b,c']::TEXT[] AS \"text\" FROM runs",
        );
    }

    #[test]
    fn what_asks_for_values_of_the_catalogue_is_right_or_left() {
        check(
            "SELECT ARRAY(SELECT b.n FROM pg_class b WHERE b.i = r.i ORDER BY 1 DESC) FROM pg_type r",
            "SELECT coalesce((SELECT array_agg(b.n ORDER BY b.n DESC) FROM pg_catalog.pg_class b WHERE b.i = r.i), \
             ARRAY[]) AS \"array\" FROM pg_catalog.pg_type r",
        );
        check(
            "SELECT ARRAY(SELECT y FROM pg_policy) AS m, ARRAY(SELECT y FROM unnest(t.conkey) y) AS k FROM pg_class t",
            "SELECT CAST(ARRAY[] AS TEXT[]) AS m, CAST(ARRAY[] AS TEXT[]) AS k FROM pg_catalog.pg_class t",
        );
        check(
            "SELECT (SELECT d.x FROM pg_attrdef d WHERE d.i = a.i LIMIT 1) FROM pg_type a",
            "SELECT NULL AS \"x\" FROM pg_catalog.pg_type a",
        );
        check(
            "SELECT (SELECT d.x FROM pg_class d WHERE d.i = a.i) AS n FROM pg_type a",
            "SELECT single_value((SELECT array_agg(d.x) FROM pg_catalog.pg_class d WHERE d.i = a.i)) AS n \
             FROM pg_catalog.pg_type a",
        );
        check(
            "SELECT (SELECT d.x FROM pg_class d WHERE d.i = a.i ORDER BY d.y DESC LIMIT 1) AS n FROM pg_type a",
            "SELECT (SELECT first_value(d.x ORDER BY d.y DESC) FROM pg_catalog.pg_class d WHERE d.i = a.i) AS n \
             FROM pg_catalog.pg_type a",
        );
        for left in [
            "SELECT (SELECT d.x FROM pg_catalog.pg_class d WHERE d.i = a.i LIMIT 2) AS n FROM pg_catalog.pg_type a",
            "SELECT (SELECT d.x FROM pg_catalog.pg_class d ORDER BY 1 LIMIT 1 OFFSET 1) AS n FROM pg_catalog.pg_type a",
            "SELECT (SELECT count(*) AS n FROM pg_catalog.pg_attrdef) AS n FROM pg_catalog.pg_type a",
            "SELECT CASE relname WHEN 't' THEN 1 END AS n FROM pg_catalog.pg_class",
        ] {
            check(left, left);
        }
    }

    #[test]
    fn only_what_needs_it_is_adapted() {
        check(
            "SELECT relname FROM pg_class WHERE relname LIKE 'pg/_%' ESCAPE '/'",
            "SELECT relname FROM pg_catalog.pg_class WHERE relname LIKE like_escape('pg/_%', '/')",
        );
        check("SELECT 1, 1", "SELECT CAST(1 AS INT) AS \"?column?\", CAST(1 AS INT) AS \"?column?\u{1}1\"");
        check(
            "SELECT EXISTS(SELECT 1 FROM pg_class k WHERE k.i = t.i LIMIT 1) AS e FROM pg_type t",
            "SELECT (SELECT count(*) FROM pg_catalog.pg_class k WHERE k.i = t.i) > 0 AS e FROM pg_catalog.pg_type t",
        );
        check("SELECT 'pairs'::regclass", "SELECT to_regclass('pairs') AS \"regclass\"");
        check("SELECT $1::pg_catalog.regtype AS n", "SELECT to_regtype($1) AS n");
        check("SELECT format('%I', 'x')::regclass AS n", "SELECT to_regclass(format('%I', 'x')) AS n");
        check("WITH RECURSIVE typeinfo_tree(oid) AS (SELECT 1) SELECT * FROM typeinfo_tree, pg_type", &{
            let known = Parser::parse_sql(&PostgreSqlDialect {}, TYPES).expect("SQL");
            known[0].to_string()
        });
        check(
            "SELECT relname FROM pg_class WHERE relkind = ANY('{r,\"v\"}')",
            "SELECT relname FROM pg_catalog.pg_class WHERE relkind = ANY(ARRAY['r', 'v'])",
        );
        check("SELECT (keys).n FROM pg_index", "SELECT get_field((keys), 'n') AS \"n\" FROM pg_catalog.pg_index");
        check(
            "SELECT x FROM pg_index i WHERE i.indisprimary = 't' AND x = 't'",
            "SELECT x FROM pg_catalog.pg_index i WHERE i.indisprimary = true AND x = 't'",
        );
        check(
            "SELECT generate_subscripts(i.k, 1) AS n, generate_series(1, 2) AS m FROM pg_index i",
            "SELECT unnest(generate_series(1, array_length(i.k, 1))) AS n, unnest(generate_series(1, 2)) AS m \
             FROM pg_catalog.pg_index i",
        );
        check(
            "SELECT regexp_split_to_table(x, ',') AS w FROM pg_class",
            "SELECT unnest(string_to_array(regexp_replace(x, ',', chr(1), 'g'), chr(1))) AS w FROM pg_catalog.pg_class",
        );
        check(
            "SELECT k FROM pg_constraint c CROSS JOIN UNNEST(c.conkey) AS k WHERE c.condeferrable = 'f'",
            "SELECT k FROM pg_catalog.pg_constraint c CROSS JOIN (SELECT CAST(0 AS SMALLINT) WHERE false) AS k (k) \
             WHERE c.condeferrable = false",
        );
        check(
            "SELECT indkey FROM pg_index CROSS JOIN UNNEST(indkey) AS k",
            "SELECT indkey FROM pg_catalog.pg_index CROSS JOIN UNNEST(indkey) AS k (k)",
        );
        check(
            "SELECT conkey FROM pg_constraint WHERE conkey = '{1,2}'",
            "SELECT conkey FROM pg_catalog.pg_constraint WHERE array_to_string(conkey, ',') = '1,2'",
        );
        check(
            "SELECT o.option_name FROM pg_catalog.pg_options_to_table(t.o) o",
            "SELECT o.option_name FROM (SELECT CAST('' AS TEXT) AS option_name, CAST('' AS TEXT) AS option_value WHERE false) o",
        );
    }
}
