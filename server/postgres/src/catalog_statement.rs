//! Statements about the server alone: those all of whose relations are of `pg_catalog` or `information_schema`, and
//! those without any. [`find_catalog_names`] decides; such a statement is then adapted here, by rules on its syntax
//! tree that put what DataFusion lacks in other words. A statement that names anything of the lake never comes here.

use std::collections::HashSet;
use std::ops::ControlFlow;

use arrow::array::{Array as _, RecordBatch};
use arrow::datatypes::DataType;
use datafusion::sql::sqlparser::ast::{
    AccessExpr, BinaryOperator, DataType as SqlType, Expr, Function, FunctionArg, FunctionArgExpr,
    FunctionArgumentClause, FunctionArguments, GroupByExpr, Ident, LimitClause, ObjectName, ObjectNamePart,
    OrderByExpr, OrderByKind, Query, Select, SelectItem, SetExpr, Statement, TableAliasColumnDef, TableFactor,
    TableFunctionArgs, Value, ValueWithSpan, VisitorMut,
};
use datafusion_pg_catalog::sql::rules::{
    AliasDuplicatedProjectionRewrite, CurrentUserVariableToSessionUserFunctionCall, ResolveUnqualifiedIdentifier,
    RewritePgCatalogOperator, SqlStatementRewriteRule, StripCallableQualifier, StripCollate,
};
use echolake_query::{walk_expr, walk_statement};

use super::catalog_tables::{INFORMATION_SCHEMA, PG_CATALOG};
use super::columns::{parse_expr, parse_statement, read_array};

/// Columns of `pg_type` that name a function by its number.
const FUNCTIONS: [&str; 6] = ["typinput", "typoutput", "typreceive", "typsend", "typmodin", "typmodout"];
/// The beginnings of the names of truths that clients compare with `t` and `f`.
const TRUTHS: [&str; 3] = ["attnotnull", "condefer", "indis"];
/// Aggregates that a subquery may have already.
const AGGREGATES: [&str; 8] = ["array_agg", "avg", "bool_or", "count", "max", "min", "string_agg", "sum"];
/// Functions that give a row for each element of a list, and the same in other words; `{}` is for their arguments.
const ROW_FUNCTIONS: [(&str, &str); 3] = [
    ("generate_subscripts", "unnest(generate_series(1, array_length({})))"),
    ("regexp_split_to_table", "unnest(string_to_array(regexp_replace({}, chr(1), 'g'), chr(1)))"),
    ("_pg_expandarray", "named_struct('x', unnest({}), 'n', unnest(generate_series(1, array_length({}))))"),
];
/// The list that clients compare with texts, and that has rows: of indices of the catalogue's own tables.
const INDEX_COLUMNS: &str = "indkey";
/// The table that an empty list is in FROM.
const NO_ELEMENTS: &str = "no_elements";
/// The beginning of the names of functions that read the lake's files.
const LAKE_FUNCTIONS: &str = "mcap";
/// The beginning of the names of tables and functions of `pg_catalog`, which nothing of the lake has.
const CATALOG_NAMES: &str = "pg_";
/// Rules of the library for names, operators and qualifiers; its others change what a statement answers.
const RULES: [&dyn SqlStatementRewriteRule; 6] = [
    &AliasDuplicatedProjectionRewrite,
    &ResolveUnqualifiedIdentifier,
    &StripCallableQualifier,
    &CurrentUserVariableToSessionUserFunctionCall,
    &StripCollate,
    &RewritePgCatalogOperator,
];

/// The name by which asyncpg's query for types is known, and a query with the same answer for types that are no
/// domains, ranges or rows: DataFusion does not end its recursion.
const TYPE_TREE: &str = "typeinfo_tree";
const TYPES: &str = "SELECT t.oid, n.nspname AS ns, t.typname AS name, t.typtype AS kind, \
     CAST(NULL AS oid) AS basetype, t.typelem AS elemtype, e.typdelim AS elemdelim, \
     CAST(NULL AS oid) AS range_subtype, CAST(NULL AS TEXT) AS attrtypoids, CAST(NULL AS TEXT) AS attrnames, \
     CASE WHEN array_contains($1::oid[], t.oid) THEN 0 ELSE 1 END AS depth, CAST(NULL AS TEXT) AS basetype_name, \
     e.typname AS elemtype_name, CAST(NULL AS TEXT) AS range_subtype_name \
     FROM pg_catalog.pg_type t JOIN pg_catalog.pg_namespace n ON n.oid = t.typnamespace \
     LEFT JOIN pg_catalog.pg_type e ON e.oid = t.typelem WHERE array_contains($1::oid[], t.oid) \
     OR t.oid IN (SELECT o.typelem FROM pg_catalog.pg_type o WHERE array_contains($1::oid[], o.oid)) \
     ORDER BY depth DESC";

/// Returns the names of the common tables (WITH) of a statement about the server alone; None for any other.
pub(super) fn find_catalog_names(statement: &mut Statement) -> Option<Vec<String>> {
    let mut found = StatementRelations::default();
    // Here and below, walks never break off.
    let _ = walk_statement(statement, &mut found);
    let is_of_catalog = !found.reads_other && (found.reads_catalog || !found.has_relation);
    is_of_catalog.then_some(found.names)
}

/// The relations of a statement.
#[derive(Default)]
struct StatementRelations {
    /// Names of common tables.
    names: Vec<String>,
    reads_catalog: bool,
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
                self.reads_catalog |= name.starts_with(CATALOG_NAMES);
            }
            TableFactor::Table { name, .. } => match &name.0[..] {
                [ObjectNamePart::Identifier(name)] if self.names.contains(&name.value) => {}
                _ if is_of_catalog(name) => self.reads_catalog = true,
                _ => self.reads_other = true,
            },
            _ => {}
        }
        ControlFlow::Continue(())
    }

    // Nothing of the lake is named so, either.
    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Function(function) = expr {
            self.reads_catalog |= matches!(&function.name.0[..], [schema, _]
                if schema.as_ident().is_some_and(|schema| schema.value.eq_ignore_ascii_case(PG_CATALOG)));
        }
        ControlFlow::Continue(())
    }
}

fn is_of_catalog(name: &ObjectName) -> bool {
    let parts: Vec<_> = name.0.iter().filter_map(|part| part.as_ident()).map(|i| i.value.to_lowercase()).collect();
    match &parts[..] {
        [table] => table.starts_with(CATALOG_NAMES),
        [.., schema, _] => schema == PG_CATALOG || schema == INFORMATION_SCHEMA,
        [] => false,
    }
}

fn last_name(name: &ObjectName) -> Option<String> {
    Some(name.0.last()?.as_ident()?.value.to_lowercase())
}

/// What of the catalogue has no rows, whatever the lake.
#[derive(Debug, Default)]
pub(super) struct EmptyRelations {
    tables: HashSet<String>,
    /// Columns of lists, which are NULL in all rows. A column of `pg_catalog` has its table in its name.
    lists: HashSet<String>,
    /// Functions that give rows in Postgres, and are tables here.
    pub calls: HashSet<String>,
}

impl EmptyRelations {
    /// Adds what of a table is empty.
    pub fn add_table(&mut self, table: &str, batches: &[RecordBatch]) {
        if batches.iter().all(|batch| batch.num_rows() == 0) {
            self.tables.insert(table.to_owned());
        }
        let Some(first) = batches.first() else { return };
        for (at, field) in first.schema().fields().iter().enumerate() {
            let is_null = batches.iter().all(|batch| batch.column(at).null_count() == batch.num_rows());
            if is_null && matches!(field.data_type(), DataType::List(_)) {
                self.lists.insert(field.name().clone());
            }
        }
    }

    // A query for a default, a sequence or the like: no column has one. A count of them is 0, and any aggregate a row.
    fn has_no_rows(&self, query: &Query) -> bool {
        let SetExpr::Select(select) = query.body.as_ref() else { return false };
        let first = select.from.first().map(|from| &from.relation);
        let is_empty = matches!(first, Some(TableFactor::Table { name, args: None, .. })
            if last_name(name).is_some_and(|name| self.tables.contains(&name)));
        is_empty && !select.projection.iter().filter_map(item_value).any(has_aggregate)
    }

    fn is_empty_list(&self, expr: &Expr) -> bool {
        column_name(expr).is_some_and(|name| self.lists.contains(name))
    }

    // The elements of a list that no row has. DataFusion cannot unnest a column of the query around.
    fn table_of_elements(&self, factor: &TableFactor) -> Option<TableFactor> {
        let (alias, list) = match factor {
            TableFactor::UNNEST { alias, array_exprs, .. } => (alias, array_exprs.first()?),
            TableFactor::Table { name, args: Some(TableFunctionArgs { args, .. }), alias, .. } => match &args[..] {
                [FunctionArg::Unnamed(FunctionArgExpr::Expr(list))] if last_name(name)? == "unnest" => (alias, list),
                _ => return None,
            },
            _ => return None,
        };
        if !self.is_empty_list(list) {
            return None;
        }
        match parse_expr(&format!("(SELECT * FROM {PG_CATALOG}.{NO_ELEMENTS})"))? {
            Expr::Subquery(subquery) => {
                Some(TableFactor::Derived { lateral: false, subquery, alias: alias.clone(), sample: None })
            }
            _ => None,
        }
    }
}

/// Adapts a statement about the server alone, whose common tables have these names.
pub(super) fn adapt_catalog_statement(
    mut statement: Statement,
    names: Vec<String>,
    empty: &EmptyRelations,
) -> Statement {
    if names.first().is_some_and(|name| name == TYPE_TREE)
        && let Some(known) = parse_statement(TYPES)
    {
        return known;
    }
    statement = RULES.iter().fold(statement, |statement, rule| rule.rewrite(statement));
    let _ = walk_statement(&mut statement, &mut CatalogAdapter { names, empty });
    type_integers(&mut statement);
    statement
}

// The number of a name: 'name'::regclass and its like, of a text or of a placeholder for one.
fn number_of_text(text: &Expr, kind: &str) -> Option<Expr> {
    let function = match kind.strip_prefix("pg_catalog.").unwrap_or(kind) {
        "regclass" => "to_regclass",
        "regnamespace" => "to_regnamespace",
        "regtype" => "to_regtype",
        "regproc" | "regprocedure" => "to_regproc",
        _ => return None,
    };
    is_text(text).then(|| parse_expr(&format!("{function}({text})"))).flatten()
}

fn is_text(expr: &Expr) -> bool {
    match expr {
        Expr::Value(value) => matches!(value.value, Value::SingleQuotedString(_) | Value::Placeholder(_)),
        Expr::Function(function) => {
            last_name(&function.name).is_some_and(|name| ["format", "quote_ident", "concat"].contains(&name.as_str()))
        }
        Expr::BinaryOp { op: BinaryOperator::StringConcat, .. } => true,
        Expr::Cast { expr, data_type: SqlType::Text, .. } | Expr::Nested(expr) => is_text(expr),
        _ => false,
    }
}

// An integer alone is of 32 bits in Postgres.
fn type_integers(statement: &mut Statement) {
    let Statement::Query(query) = statement else { return };
    let (None, SetExpr::Select(select)) = (&query.with, query.body.as_mut()) else { return };
    for item in &mut select.projection {
        if let SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } = item {
            type_integer(expr);
        }
    }
}

fn type_integer(expr: &mut Expr) {
    if let Expr::Value(ValueWithSpan { value: Value::Number(number, _), .. }) = expr
        && number.parse::<i32>().is_ok()
        && let Some(typed) = parse_expr(&format!("CAST({number} AS INT)"))
    {
        *expr = typed;
    }
}

/// Puts in other words what DataFusion lacks.
struct CatalogAdapter<'a> {
    /// Names of common tables.
    names: Vec<String>,
    empty: &'a EmptyRelations,
}

impl VisitorMut for CatalogAdapter<'_> {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Some(better) = self.adapt_expr(expr) {
            *expr = better;
        }
        match expr {
            Expr::AnyOp { right, .. } | Expr::AllOp { right, .. } => read_array(right),
            Expr::Case { operand: Some(operand), conditions, .. } if is_truth(operand) => {
                conditions.iter_mut().for_each(|when| read_truth(&mut when.condition));
            }
            Expr::Like { pattern, escape_char, .. } | Expr::ILike { pattern, escape_char, .. } => {
                escape_by_backslash(pattern, escape_char);
            }
            Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) => {
                if let [FunctionArg::Unnamed(FunctionArgExpr::Expr(arg))] = &mut args.args[..]
                    && last_name(name).is_some_and(|name| name == "pg_typeof")
                {
                    type_integer(arg);
                }
            }
            _ => {}
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        // The one column of a list's elements has the name of their table.
        if let TableFactor::UNNEST { alias: Some(alias), array_exprs, .. } = factor
            && let ([_], true) = (&array_exprs[..], alias.columns.is_empty())
        {
            alias.columns = vec![TableAliasColumnDef { name: alias.name.clone(), data_type: None }];
        }
        if let Some(none) = self.empty.table_of_elements(factor) {
            *factor = none;
        }
        if let TableFactor::Table { name, args, .. } = factor {
            if last_name(name).is_some_and(|name| self.empty.calls.contains(&name)) {
                *args = None;
            }
            if let ([ObjectNamePart::Identifier(own)], None) = (&name.0[..], &args)
                && !self.names.contains(&own.value)
            {
                *name = ObjectName::from(vec![Ident::new(PG_CATALOG), own.clone()]);
            }
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<()> {
        for item in &mut select.projection {
            if let SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } = item {
                // A series gives a row for each of its numbers.
                if let Expr::Function(function) = &*expr
                    && last_name(&function.name).is_some_and(|name| name == "generate_series")
                    && let Some(rows) = parse_expr(&format!("unnest({expr})"))
                {
                    *expr = rows;
                }
                let _ = walk_expr(expr, &mut ExistsAdapter { depth: 0 });
            }
        }
        ControlFlow::Continue(())
    }
}

impl CatalogAdapter<'_> {
    fn adapt_expr(&self, expr: &Expr) -> Option<Expr> {
        match expr {
            Expr::Subquery(query) if self.empty.has_no_rows(query) => Some(Expr::value(Value::Null)),
            Expr::Subquery(query) => single_value(query),
            Expr::Function(Function { name, args: FunctionArguments::Subquery(query), .. })
                if last_name(name)? == "array" =>
            {
                self.array_of_query(query)
            }
            Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) => {
                let name = last_name(name)?;
                let (_, words) = ROW_FUNCTIONS.iter().find(|(known, _)| *known == name)?;
                parse_expr(&words.replace("{}", &args.to_string()))
            }
            Expr::Cast { expr: inner, data_type, .. } => {
                let kind = data_type.to_string().to_lowercase();
                if kind.ends_with("text") || kind.ends_with("varchar") {
                    // A function's number as a text is its name.
                    let names_function = FUNCTIONS.contains(&column_name(inner)?);
                    return names_function.then(|| parse_expr(&format!("function_name({inner})"))).flatten();
                }
                number_of_text(inner, &kind)
            }
            // (row).field
            Expr::CompoundFieldAccess { root, access_chain } => {
                let [AccessExpr::Dot(Expr::Identifier(field))] = &access_chain[..] else { return None };
                parse_expr(&format!("get_field({root}, {})", quote_text(&field.value)))
            }
            Expr::BinaryOp { left, op: op @ (BinaryOperator::Eq | BinaryOperator::NotEq), right } => {
                self.compared_with_text(left, op, right)
            }
            _ => None,
        }
    }

    // Truths and lists of the catalogue that are compared with texts.
    fn compared_with_text(&self, left: &Expr, op: &BinaryOperator, right: &Expr) -> Option<Expr> {
        let Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) = right else { return None };
        let name = column_name(left)?;
        if self.empty.is_empty_list(left) || name == INDEX_COLUMNS {
            let list = quote_text(text.trim_matches(['{', '}']));
            return parse_expr(&format!("array_to_string({left}, ',') {op} {list}"));
        }
        let mut truth = right.clone();
        read_truth(&mut truth);
        (is_truth(left) && truth != *right).then(|| parse_expr(&format!("{left} {op} {truth}"))).flatten()
    }

    // The rows of a query as an array: ARRAY(SELECT x ... ORDER BY y) is array_agg(x ORDER BY y), but for no rows.
    fn array_of_query(&self, query: &Query) -> Option<Expr> {
        let (select, _) = selected_value(query)?;
        // What it unnests is a column of the query around it, which DataFusion cannot do.
        let is_empty = select.from.iter().any(|from| self.empty.table_of_elements(&from.relation).is_some());
        if is_empty || self.empty.has_no_rows(query) {
            return parse_expr("CAST(ARRAY[] AS TEXT[])");
        }
        if query.limit_clause.is_some() {
            return None;
        }
        let list = Expr::Subquery(Box::new(aggregate_query(query, "array_agg")?));
        parse_expr(&format!("coalesce({list}, ARRAY[])"))
    }
}

fn is_truth(expr: &Expr) -> bool {
    column_name(expr).is_some_and(|name| TRUTHS.iter().any(|begin| name.starts_with(begin)))
}

fn read_truth(expr: &mut Expr) {
    if let Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) = expr
        && ["t", "f"].contains(&text.as_str())
    {
        *expr = Expr::value(Value::Boolean(text == "t"));
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
            && let Some(count) = parse_expr("count(*)")
        {
            let compared = if *negated { "=" } else { ">" };
            select.projection = vec![SelectItem::UnnamedExpr(count)];
            (select.distinct, subquery.order_by, subquery.limit_clause) = (None, None, None);
            if let Some(counted) = parse_expr(&format!("({subquery}) {compared} 0")) {
                *expr = counted;
            }
        }
        ControlFlow::Continue(())
    }
}

// LIKE with an escape character of its own.
fn escape_by_backslash(pattern: &mut Expr, escape: &mut Option<ValueWithSpan>) {
    if let Some(ValueWithSpan { value: Value::SingleQuotedString(character), .. }) = escape
        && character != "\\"
        && let Some(escaped) = parse_expr(&format!("like_escape({pattern}, {})", quote_text(character)))
    {
        *pattern = escaped;
        *escape = None;
    }
}

// DataFusion wants to be sure that a scalar subquery with a column of the query around it has one row.
fn single_value(query: &Query) -> Option<Expr> {
    let (select, value) = selected_value(query)?;
    let is_first = match &query.limit_clause {
        Some(LimitClause::LimitOffset { limit: Some(limit), offset: None, limit_by }) => {
            limit_by.is_empty() && limit.to_string() == "1"
        }
        _ => false,
    };
    if select.from.is_empty() || (query.limit_clause.is_some() && !is_first) {
        return None;
    }
    let one_row = match has_aggregate(value) {
        true if is_first => Query { limit_clause: None, ..query.clone() },
        true => return None,
        false => aggregate_query(query, "first_value")?,
    };
    Some(Expr::Subquery(Box::new(one_row)))
}

fn has_aggregate(expr: &Expr) -> bool {
    match expr {
        Expr::Function(function) => last_name(&function.name).is_some_and(|name| AGGREGATES.contains(&name.as_str())),
        Expr::Cast { expr, .. } | Expr::Nested(expr) => has_aggregate(expr),
        Expr::BinaryOp { left, right, .. } => has_aggregate(left) || has_aggregate(right),
        _ => false,
    }
}

fn item_value(item: &SelectItem) -> Option<&Expr> {
    match item {
        SelectItem::UnnamedExpr(value) | SelectItem::ExprWithAlias { expr: value, .. } => Some(value),
        _ => None,
    }
}

fn column_name(expr: &Expr) -> Option<&str> {
    match expr {
        Expr::Identifier(name) => Some(&name.value),
        Expr::CompoundIdentifier(parts) => parts.last().map(|name| name.value.as_str()),
        _ => None,
    }
}

// The selection of a query and the one value that each of its rows has.
fn selected_value(query: &Query) -> Option<(&Select, &Expr)> {
    let SetExpr::Select(select) = query.body.as_ref() else { return None };
    let is_grouped = !matches!(&select.group_by, GroupByExpr::Expressions(by, _) if by.is_empty());
    if is_grouped || select.distinct.is_some() || select.having.is_some() || query.fetch.is_some() {
        return None;
    }
    let [item] = &select.projection[..] else { return None };
    Some((select, item_value(item)?))
}

// The query whose one row is an aggregate of its values, in its order.
fn aggregate_query(query: &Query, aggregate: &str) -> Option<Query> {
    let (select, value) = selected_value(query)?;
    let name = match &select.projection[..] {
        [SelectItem::ExprWithAlias { alias, .. }] => Some(&alias.value),
        _ => None,
    };
    let mut orders = match query.order_by.as_ref().map(|order| &order.kind) {
        None => Vec::new(),
        Some(OrderByKind::Expressions(orders)) => orders.clone(),
        Some(OrderByKind::All(_)) => return None,
    };
    for OrderByExpr { expr, .. } in &mut orders {
        if matches!(&*expr, Expr::Identifier(order) if Some(&order.value) == name) || expr.to_string() == "1" {
            *expr = value.clone();
        }
    }
    let Expr::Function(mut call) = parse_expr(&format!("{aggregate}({value})"))? else { return None };
    if let (FunctionArguments::List(arguments), false) = (&mut call.args, orders.is_empty()) {
        arguments.clauses.push(FunctionArgumentClause::OrderBy(orders));
    }
    let mut select = select.clone();
    select.projection = vec![SelectItem::UnnamedExpr(Expr::Function(call))];
    let body = Box::new(SetExpr::Select(Box::new(select)));
    Some(Query { body, order_by: None, limit_clause: None, ..query.clone() })
}

fn quote_text(text: &str) -> String {
    format!("'{}'", text.replace('\'', "''"))
}

#[cfg(test)]
mod tests {
    use super::super::columns::adapt_columns;
    use super::*;

    fn check(sql: &str, expected: &str) {
        let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        let empty = EmptyRelations {
            tables: names(&["pg_attrdef", "pg_constraint", "pg_policy"]),
            lists: names(&["conkey", "polroles"]),
            calls: names(&["pg_options_to_table"]),
        };
        let mut statement = parse_statement(sql).expect(sql);
        adapt_columns(&mut statement);
        let names = find_catalog_names(&mut statement).expect("it is about the server");
        assert_eq!(adapt_catalog_statement(statement, names, &empty).to_string(), expected);
    }

    #[test]
    fn statements_on_the_lake_are_not_about_the_server() {
        for sql in [
            "SELECT x FROM runs WHERE x LIKE 'a/_' ESCAPE '/'",
            "SELECT ARRAY(SELECT y FROM pg_catalog.pg_policy) AS n FROM runs",
            "SELECT (SELECT relname FROM pg_class ORDER BY 1 LIMIT 1) AS n FROM public.pg_own",
            "SELECT k FROM UNNEST(ARRAY[3, 1]) AS k",
            "SELECT ARRAY(SELECT x FROM UNNEST(ARRAY[3, 1]) AS t (x)) AS n",
            "SELECT x FROM (VALUES (1)) AS t (x) WHERE 1 = 1",
            "SELECT pg_catalog.upper(surface_id) AS n FROM runs",
            "SELECT value AS regclass FROM mcap('a', '/b')",
            "WITH pg AS (SELECT 1 AS x) SELECT x FROM pg, runs",
        ] {
            assert_eq!(find_catalog_names(&mut parse_statement(sql).expect(sql)), None, "{sql}");
        }
    }

    #[test]
    fn what_has_no_rows_is_not_asked() {
        check(
            "SELECT ARRAY(SELECT y FROM pg_policy) AS m, ARRAY(SELECT y FROM unnest(t.conkey) y) AS k FROM pg_class t",
            "SELECT CAST(ARRAY[] AS TEXT[]) AS m, CAST(ARRAY[] AS TEXT[]) AS k FROM pg_catalog.pg_class t",
        );
        check(
            "SELECT (SELECT d.x FROM pg_attrdef d WHERE d.i = a.i LIMIT 1) FROM pg_type a",
            "SELECT NULL AS \"x\" FROM pg_catalog.pg_type a",
        );
        check(
            "SELECT (SELECT count(*)::int AS n FROM pg_attrdef) AS n FROM pg_type",
            "SELECT (SELECT count(*)::INT AS n FROM pg_catalog.pg_attrdef) AS n FROM pg_catalog.pg_type",
        );
        check(
            "SELECT k FROM pg_constraint c CROSS JOIN UNNEST(c.conkey) AS k WHERE c.condeferrable = 'f'",
            "SELECT k FROM pg_catalog.pg_constraint c CROSS JOIN (SELECT * FROM pg_catalog.no_elements) AS k (k) \
             WHERE c.condeferrable = false",
        );
        check(
            "SELECT conkey FROM pg_constraint WHERE conkey = '{1,2}'",
            "SELECT conkey FROM pg_catalog.pg_constraint WHERE array_to_string(conkey, ',') = '1,2'",
        );
        check(
            "SELECT o.option_name FROM pg_catalog.pg_options_to_table(t.o) o",
            "SELECT o.option_name FROM pg_catalog.pg_options_to_table o",
        );
    }

    #[test]
    fn queries_that_are_values_have_one_row() {
        check(
            "SELECT ARRAY(SELECT b.n FROM pg_class b WHERE b.i = r.i ORDER BY 1 DESC) FROM pg_type r",
            "SELECT coalesce((SELECT array_agg(b.n ORDER BY b.n DESC) FROM pg_catalog.pg_class b WHERE b.i = r.i), \
             ARRAY[]) AS \"array\" FROM pg_catalog.pg_type r",
        );
        check(
            "SELECT (SELECT d.x FROM pg_class d WHERE d.i = a.i ORDER BY d.y DESC LIMIT 1) AS n FROM pg_type a",
            "SELECT (SELECT first_value(d.x ORDER BY d.y DESC) FROM pg_catalog.pg_class d WHERE d.i = a.i) AS n \
             FROM pg_catalog.pg_type a",
        );
        check(
            "SELECT EXISTS(SELECT 1 FROM pg_class k WHERE k.i = t.i LIMIT 1) AS e FROM pg_type t",
            "SELECT (SELECT count(*) FROM pg_catalog.pg_class k WHERE k.i = t.i) > 0 AS e FROM pg_catalog.pg_type t",
        );
        for left in [
            "SELECT (SELECT d.x FROM pg_catalog.pg_class d WHERE d.i = a.i LIMIT 2) AS n FROM pg_catalog.pg_type a",
            "SELECT (SELECT d.x FROM pg_catalog.pg_class d ORDER BY 1 LIMIT 1 OFFSET 1) AS n FROM pg_catalog.pg_type a",
            "SELECT CASE relname WHEN 't' THEN 1 END AS n FROM pg_catalog.pg_class",
        ] {
            check(left, left);
        }
    }

    #[test]
    fn only_what_needs_it_is_adapted() {
        for (sql, expected) in [
            (
                "SELECT relname FROM pg_class WHERE relname LIKE 'pg/_%' ESCAPE '/'",
                "SELECT relname FROM pg_catalog.pg_class WHERE relname LIKE like_escape('pg/_%', '/')",
            ),
            ("SELECT 1, 1", "SELECT CAST(1 AS INT) AS \"?column?\", CAST(1 AS INT) AS \"?column?\u{1}1\""),
            ("SELECT 'pairs'::regclass", "SELECT to_regclass('pairs') AS \"regclass\""),
            ("SELECT $1::pg_catalog.regtype AS n", "SELECT to_regtype($1) AS n"),
            ("SELECT format('%I', 'x')::regclass AS n", "SELECT to_regclass(format('%I', 'x')) AS n"),
            (
                "SELECT relname FROM pg_class WHERE relkind = ANY('{r,\"v\"}')",
                "SELECT relname FROM pg_catalog.pg_class WHERE relkind = ANY(ARRAY['r', 'v'])",
            ),
            (
                "SELECT CASE a.attnotnull WHEN 't' THEN 0 END AS n FROM pg_attribute a",
                "SELECT CASE a.attnotnull WHEN true THEN 0 END AS n FROM pg_catalog.pg_attribute a",
            ),
            (
                "SELECT pg_catalog.format_type(tp, 1) AS n FROM (VALUES (23)) AS s (tp)",
                "SELECT format_type(tp, 1) AS n FROM (VALUES (23)) AS s (tp)",
            ),
            ("SELECT (keys).n FROM pg_index", "SELECT get_field((keys), 'n') AS \"n\" FROM pg_catalog.pg_index"),
            (
                "SELECT x FROM pg_index i WHERE i.indisprimary = 't' AND x = 't'",
                "SELECT x FROM pg_catalog.pg_index i WHERE i.indisprimary = true AND x = 't'",
            ),
            (
                "SELECT generate_subscripts(i.k, 1) AS n, generate_series(1, 2) AS m FROM pg_index i",
                "SELECT unnest(generate_series(1, array_length(i.k, 1))) AS n, unnest(generate_series(1, 2)) AS m \
                 FROM pg_catalog.pg_index i",
            ),
            (
                "SELECT regexp_split_to_table(x, ',') AS w FROM pg_class",
                "SELECT unnest(string_to_array(regexp_replace(x, ',', chr(1), 'g'), chr(1))) AS w \
                 FROM pg_catalog.pg_class",
            ),
            (
                "SELECT i FROM pg_index CROSS JOIN UNNEST(list) AS k",
                "SELECT i FROM pg_catalog.pg_index CROSS JOIN UNNEST(list) AS k (k)",
            ),
            (
                "WITH RECURSIVE typeinfo_tree(oid) AS (SELECT 1) SELECT * FROM typeinfo_tree, pg_type",
                &parse_statement(TYPES).expect("SQL").to_string(),
            ),
        ] {
            check(sql, expected);
        }
    }
}
