//! Adaptations of clients' catalogue queries beyond those of `datafusion-pg-catalog`.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{
    AccessExpr, BinaryOperator, Expr, Function, FunctionArg, FunctionArgExpr, FunctionArgumentList, FunctionArguments,
    GroupByExpr, Ident, ObjectName, ObjectNamePart, Query, Select, SelectItem, SetExpr, Statement, TableAlias,
    TableAliasColumnDef, TableFactor, UnaryOperator, Value, ValueWithSpan, VisitorMut,
};
use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
use datafusion::sql::sqlparser::parser::Parser;
use echolake_query::{walk_expr, walk_statement};
use pgwire::api::Type;

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
const FUNCTIONS_OF_NOTHING: [(&str, &str); 2] = [
    (
        "pg_partition_tree",
        "CAST(0 AS OID) AS relid, CAST(0 AS OID) AS parentrelid, false AS isleaf, CAST(0 AS INT) AS level",
    ),
    ("pg_options_to_table", "CAST('' AS TEXT) AS option_name, CAST('' AS TEXT) AS option_value"),
];
/// Columns of lists that clients compare with texts.
const LISTS: [&str; 4] = ["confkey", "conkey", "indkey", "polroles"];
/// What `datafusion-pg-catalog` makes of a name that is cast to a number, before and after the name, and the function
/// that does the same without a subquery, and for more names.
const CASTS: [(&str, &str, &str); 4] = [
    (
        "SELECT c.oid FROM pg_catalog.pg_class c JOIN pg_catalog.pg_namespace n ON c.relnamespace = n.oid CROSS JOIN \
         (SELECT parse_ident(",
        "::TEXT) AS parts)",
        "to_regclass",
    ),
    ("SELECT oid FROM pg_catalog.pg_namespace WHERE nspname = ", "", "to_regnamespace"),
    ("SELECT oid FROM pg_catalog.pg_type WHERE typname = ", "", "to_regtype"),
    ("SELECT oid FROM pg_catalog.pg_proc WHERE proname = ", "", "to_regproc"),
];

/// Tables of `pg_catalog` that are found without its name, beside those that `datafusion-pg-catalog` knows.
const OWN_TABLES: [&str; 13] = [
    "pg_group",
    "pg_indexes",
    "pg_locks",
    "pg_policies",
    "pg_sequences",
    "pg_shadow",
    "pg_stat_activity",
    "pg_stat_ssl",
    "pg_timezone_names",
    "pg_ts_config_map",
    "pg_user",
    "pg_user_mappings",
    "pg_views",
];
const PG_CATALOG: &str = "pg_catalog";

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

/// Adapts a statement; `types` are those that its client gives its placeholders.
pub(super) fn rewrite(mut statement: Statement, types: &[Option<Type>]) -> Statement {
    if let Statement::Query(query) = &statement
        && let Some(with) = &query.with
        && with.cte_tables.first().is_some_and(|table| table.alias.name.value == TYPE_TREE)
        && let Some(known) = Parser::parse_sql(&PostgreSqlDialect {}, TYPES).ok().and_then(|mut all| all.pop())
    {
        return known;
    }
    // It never breaks off.
    let _ = walk_statement(&mut statement, &mut StatementAdapter(types));
    type_integers(&mut statement);
    statement
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

struct StatementAdapter<'a>(&'a [Option<Type>]);

impl StatementAdapter<'_> {
    // `x = ANY($1)` came here as array_contains($1, x). If a client tells that it is a text, it sends
    // the array as one.
    fn any_of_text(&self, expr: &mut Expr) -> Option<()> {
        let Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) = expr else { return None };
        if name.to_string() != "array_contains" {
            return None;
        }
        let FunctionArg::Unnamed(FunctionArgExpr::Expr(array)) = args.args.first_mut()? else { return None };
        let Expr::Value(ValueWithSpan { value: Value::Placeholder(placeholder), .. }) = array else { return None };
        let number: usize = placeholder.strip_prefix('$')?.parse().ok()?;
        let told = self.0.get(number.checked_sub(1)?).and_then(Option::as_ref);
        if told.is_some_and(|told| matches!(*told, Type::TEXT | Type::VARCHAR)) {
            let unquoted = format!("replace(replace(btrim({placeholder}, '{{}}'), '\"', ''), ', ', ',')");
            let sql = format!("string_to_array({unquoted}, ',')");
            *array = parsed(&sql)?;
        }
        Some(())
    }
}

impl VisitorMut for StatementAdapter<'_> {
    type Break = ();

    fn pre_visit_relation(&mut self, relation: &mut ObjectName) -> ControlFlow<()> {
        if let [ObjectNamePart::Identifier(name)] = &relation.0[..]
            && OWN_TABLES.contains(&name.value.as_str())
        {
            *relation = ObjectName::from(vec![Ident::new(PG_CATALOG), name.clone()]);
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if is_whole_table(expr) {
            *expr = Expr::value(Value::Boolean(true));
        }
        if let Some(better) = array_of_query(expr)
            .or_else(|| subscripts(expr))
            .or_else(|| split_text(expr))
            .or_else(|| expanded(expr))
            .or_else(|| number_of_name(expr))
            .or_else(|| case_of_truth(expr))
            .or_else(|| time_of_text(expr))
            .or_else(|| name_of_function(expr))
            .or_else(|| number_of_text(expr))
            .or_else(|| field_of_row(expr))
            .or_else(|| compared_with_text(expr))
        {
            *expr = better;
        }
        if let Expr::Subquery(query) = expr
            && asks_for_nothing(query)
        {
            *expr = Expr::value(Value::Null);
        }
        if let Expr::Subquery(query) = expr {
            one_row(query);
        }
        self.any_of_text(expr);
        not_a_value(expr);
        escape_by_backslash(expr);
        type_of_integer(expr);
        ControlFlow::Continue(())
    }

    // The call stays within what replaces it.
    fn post_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Some(signed) = signed_rank(expr) {
            *expr = signed;
        }
        ControlFlow::Continue(())
    }

    // Names are those of the statement before it is adapted.
    fn pre_visit_query(&mut self, query: &mut Query) -> ControlFlow<()> {
        if let SetExpr::Select(select) = query.body.as_mut() {
            name_columns(select);
        }
        order_by_columns(query);
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        name_elements(factor);
        if let Some(none) = table_without_rows(factor).or_else(|| keys_of_nothing(factor)) {
            *factor = none;
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<()> {
        name_columns(select);
        series_rows(&mut select.projection);
        for item in &mut select.projection {
            if let SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } = item {
                // It never breaks off.
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

// 'name'::regclass and its like.
fn number_of_name(expr: &Expr) -> Option<Expr> {
    let Expr::Subquery(query) = expr else { return None };
    let text = query.to_string();
    let text = text.strip_suffix(" LIMIT 1").unwrap_or(&text);
    CASTS.iter().find_map(|(before, after, function)| {
        let rest = text.strip_prefix(before)?;
        let name = match after.is_empty() {
            true => rest,
            false => rest.split_once(after)?.0,
        };
        let is_value = name.starts_with(['\'', '$']);
        is_value.then(|| parsed(&format!("{function}({name})"))).flatten()
    })
}

// A text that is computed, or the name of a function with its arguments, as the number of what it names.
fn number_of_text(expr: &Expr) -> Option<Expr> {
    let Expr::Cast { expr: inner, data_type, .. } = expr else { return None };
    let kind = data_type.to_string().to_lowercase();
    let is_literal = matches!(inner.as_ref(), Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(_), .. }));
    let function = match kind.strip_prefix("pg_catalog.").unwrap_or(&kind) {
        "regprocedure" if is_literal => "to_regproc",
        "regclass" if is_text(inner) => "to_regclass",
        _ => return None,
    };
    parsed(&format!("{function}({inner})"))
}

fn is_text(expr: &Expr) -> bool {
    match expr {
        Expr::Function(function) => {
            ["format", "quote_ident", "concat"].contains(&function.name.to_string().to_lowercase().as_str())
        }
        Expr::BinaryOp { op: BinaryOperator::StringConcat, .. } => true,
        Expr::Nested(inner) => is_text(inner),
        _ => false,
    }
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

// Numbers of rows and ranks are unsigned in DataFusion, which no integer of Postgres is.
fn signed_rank(expr: &Expr) -> Option<Expr> {
    let Expr::Function(function) = expr else { return None };
    let is_rank = RANKS.contains(&function.name.to_string().to_lowercase().as_str());
    (is_rank && function.over.is_some()).then(|| parsed(&format!("CAST({function} AS BIGINT)"))).flatten()
}

// to_timestamp(text, 'YYYY-MM-DD'), whose letters are others in DataFusion.
fn time_of_text(expr: &Expr) -> Option<Expr> {
    let Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) = expr else { return None };
    let [text, FunctionArg::Unnamed(FunctionArgExpr::Expr(Expr::Value(format)))] = &args.args[..] else { return None };
    let Value::SingleQuotedString(format) = &format.value else { return None };
    if !name.to_string().eq_ignore_ascii_case("to_timestamp") || format.contains('%') {
        return None;
    }
    let letters = [
        (".US", "%.f"),
        (".MS", "%.f"),
        ("YYYY", "%Y"),
        ("MM", "%m"),
        ("DD", "%d"),
        ("HH24", "%H"),
        ("MI", "%M"),
        ("SS", "%S"),
    ];
    let format = letters.iter().fold(format.clone(), |format, (from, to)| format.replace(from, to));
    parsed(&format!("to_timestamp({text}, '{}')", format.replace('\'', "''")))
}

// CASE of a truth, WHEN 't'.
fn case_of_truth(expr: &Expr) -> Option<Expr> {
    let Expr::Case { operand: Some(operand), conditions, .. } = expr else { return None };
    let is_letter = |expr: &Expr| {
        matches!(expr, Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. })
            if text == "t" || text == "f")
    };
    let is_column = matches!(operand.as_ref(), Expr::Identifier(_) | Expr::CompoundIdentifier(_));
    if !is_column || !conditions.iter().all(|when| is_letter(&when.condition)) {
        return None;
    }
    let letter = parsed(&format!("replace(replace(CAST({operand} AS TEXT), 'true', 't'), 'false', 'f')"))?;
    let mut adapted = expr.clone();
    if let Expr::Case { operand, .. } = &mut adapted {
        *operand = Some(Box::new(letter));
    }
    Some(adapted)
}

// DuckDB reads a table by ranges of `ctid`; if `pg_class` reports one page, there is one range, of all rows.
fn is_whole_table(expr: &Expr) -> bool {
    let is_place = |expr: &Expr, place: &str| {
        matches!(expr, Expr::Cast { expr, data_type, .. }
        if data_type.to_string().eq_ignore_ascii_case("tid") && expr.to_string() == place)
    };
    matches!(expr, Expr::Between { expr, negated: false, low, high }
        if expr.to_string() == "ctid" && is_place(low, "'(0,0)'") && is_place(high, "'(4294967295,0)'"))
}

// ARRAY(SELECT x ...) is (SELECT array_agg(x) ...), but for the order.
fn array_of_query(expr: &Expr) -> Option<Expr> {
    let Expr::Function(function) = expr else { return None };
    let FunctionArguments::Subquery(query) = &function.args else { return None };
    if !function.name.to_string().eq_ignore_ascii_case("array") {
        return None;
    }
    let SetExpr::Select(select) = query.body.as_ref() else { return None };
    let [SelectItem::UnnamedExpr(item) | SelectItem::ExprWithAlias { expr: item, .. }] = &select.projection[..] else {
        return None;
    };
    // What it unnests is a column of the query around it, which DataFusion cannot do; in what clients ask, such columns
    // hold nothing here.
    let unnests = |factor: &TableFactor| match factor {
        TableFactor::UNNEST { .. } => true,
        TableFactor::Table { name, args: Some(_), .. } => name.to_string().eq_ignore_ascii_case("unnest"),
        _ => false,
    };
    if select.from.iter().any(|from| unnests(&from.relation)) || asks_for_nothing(query) {
        return parsed("CAST(NULL AS TEXT[])");
    }
    let mut select = select.clone();
    select.projection = vec![SelectItem::UnnamedExpr(call("array_agg", item.clone(), function))];
    let body = Box::new(SetExpr::Select(select));
    Some(Expr::Subquery(Box::new(Query { body, order_by: None, ..query.as_ref().clone() })))
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

// NOT $1, whose value is a truth.
fn not_a_value(expr: &mut Expr) {
    let Expr::UnaryOp { op: UnaryOperator::Not, expr: inner } = expr else { return };
    let value = match inner.as_ref() {
        Expr::Nested(value) => value.as_ref(),
        value => value,
    };
    if matches!(value, Expr::Value(ValueWithSpan { value: Value::Placeholder(_), .. }))
        && let Some(truth) = parsed(&format!("CAST({value} AS BOOLEAN)"))
    {
        **inner = truth;
    }
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
    let TableFactor::UNNEST { alias, array_exprs, .. } = factor else { return None };
    let name = match &array_exprs[..] {
        [Expr::Identifier(name)] => name,
        [Expr::CompoundIdentifier(parts)] => parts.last()?,
        _ => return None,
    };
    LISTS.contains(&name.value.as_str()).then(|| without_rows("CAST(0 AS SMALLINT)", alias.as_ref())).flatten()
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

// DataFusion wants to be sure that a scalar subquery has one row. Those that clients ask of the catalogue look one up
// by its key: its greatest is the same.
fn one_row(query: &mut Query) {
    let SetExpr::Select(select) = query.body.as_mut() else { return };
    let of_catalog = |factor: &TableFactor| {
        matches!(factor, TableFactor::Table { name, args: None, .. }
            if name.0.last().and_then(|n| n.as_ident()).is_some_and(|n| n.value.starts_with("pg_")))
    };
    let plain = select.distinct.is_none() && select.having.is_none() && !select.from.is_empty();
    let grouped = !matches!(&select.group_by, GroupByExpr::Expressions(by, _) if by.is_empty());
    let known = select.from.iter().all(|f| of_catalog(&f.relation) && f.joins.iter().all(|j| of_catalog(&j.relation)));
    if !plain || grouped || !known {
        return;
    }
    let [SelectItem::UnnamedExpr(item) | SelectItem::ExprWithAlias { expr: item, .. }] = &mut select.projection[..]
    else {
        return;
    };
    if matches!(item, Expr::Function(function) if is_aggregate(function)) {
        return;
    }
    let plain_call = Function {
        name: ObjectName::from(Vec::<Ident>::new()),
        uses_odbc_syntax: false,
        parameters: FunctionArguments::None,
        args: FunctionArguments::None,
        filter: None,
        null_treatment: None,
        over: None,
        within_group: Vec::new(),
    };
    *item = call("max", item.clone(), &plain_call);
    (query.limit_clause, query.order_by) = (None, None);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(sql: &str, expected: &str) {
        let mut statements = Parser::parse_sql(&PostgreSqlDialect {}, sql).expect(sql);
        let adapted =
            rewrite(statements.pop().expect("a statement"), &[Some(Type::TEXT), Some(Type::TEXT_ARRAY)]).to_string();
        assert_eq!(adapted, expected);
    }

    #[test]
    fn only_what_needs_it_is_adapted() {
        check(
            "SELECT ARRAY(SELECT b.n FROM m b WHERE b.i = r.i ORDER BY 1) FROM r",
            "SELECT (SELECT array_agg(b.n) AS \"array_agg\" FROM m b WHERE b.i = r.i) AS \"array\" FROM r",
        );
        check(
            "SELECT x FROM t WHERE x LIKE 'pg/_%' ESCAPE '/'",
            "SELECT x FROM t WHERE x LIKE like_escape('pg/_%', '/')",
        );
        check("SELECT x FROM t WHERE x LIKE $1 ESCAPE '\\'", "SELECT x FROM t WHERE x LIKE $1 ESCAPE '\\'");
        check("SELECT 1, 1", "SELECT CAST(1 AS INT) AS \"?column?\", CAST(1 AS INT) AS \"?column?\u{1}1\"");
        check(
            "SELECT EXISTS(SELECT 1 FROM k WHERE k.i = t.i LIMIT 1) AS e FROM t",
            "SELECT (SELECT count(*) AS \"count\" FROM k WHERE k.i = t.i) > 0 AS e FROM t",
        );
        check("SELECT x FROM t WHERE EXISTS (SELECT y FROM k)", "SELECT x FROM t WHERE EXISTS (SELECT y FROM k)");
        check(
            "SELECT (SELECT oid FROM pg_catalog.pg_type WHERE typname = 'integer' LIMIT 1)",
            "SELECT to_regtype('integer') AS \"oid\"",
        );
        check(
            "SELECT to_timestamp(x, 'YYYY-MM-DD HH24:MI:SS.US') AS t",
            "SELECT to_timestamp(x, '%Y-%m-%d %H:%M:%S%.f') AS t",
        );
        check("WITH RECURSIVE typeinfo_tree(oid) AS (SELECT 1) SELECT * FROM typeinfo_tree", &{
            let known = Parser::parse_sql(&PostgreSqlDialect {}, TYPES).expect("SQL");
            known[0].to_string()
        });
        check(
            "SELECT CASE x WHEN 't' THEN 1 ELSE 0 END",
            "SELECT CASE replace(replace(CAST(x AS TEXT), 'true', 't'), 'false', 'f') WHEN 't' THEN 1 ELSE 0 END AS \"case\"",
        );
        check(
            "SELECT (SELECT d.x FROM pg_catalog.pg_attrdef d WHERE d.i = a.i LIMIT 1) FROM a",
            "SELECT NULL AS \"x\" FROM a",
        );
        check(
            "SELECT (SELECT count(*) AS n FROM pg_catalog.pg_attrdef) AS n FROM a",
            "SELECT (SELECT count(*) AS n FROM pg_catalog.pg_attrdef) AS n FROM a",
        );
        check(
            "SELECT (SELECT d.x FROM pg_catalog.pg_class d WHERE d.i = a.i LIMIT 1) AS n FROM a",
            "SELECT (SELECT max(d.x) AS \"max\" FROM pg_catalog.pg_class d WHERE d.i = a.i) AS n FROM a",
        );
        check("SELECT (SELECT d.x FROM d) AS n FROM a", "SELECT (SELECT d.x FROM d) AS n FROM a");
        check("SELECT x FROM pg_indexes", "SELECT x FROM pg_catalog.pg_indexes");
        check(
            "SELECT x FROM t WHERE array_contains($1, x) AND array_contains($2, x)",
            "SELECT x FROM t WHERE array_contains(string_to_array(replace(replace(btrim($1, '{}'), '\"', ''), ', ', ','), ','), x) AND array_contains($2, x)",
        );
        check(
            "SELECT x FROM t WHERE ctid BETWEEN '(0,0)'::tid AND '(4294967295,0)'::tid AND n < 1",
            "SELECT x FROM t WHERE true AND n < 1",
        );
        check(
            "SELECT x FROM t WHERE ctid BETWEEN '(1,0)'::tid AND '(4294967295,0)'::tid",
            "SELECT x FROM t WHERE ctid BETWEEN '(1,0)'::tid AND '(4294967295,0)'::tid",
        );
        check(
            "SELECT array(SELECT 'a' || x FROM unnest(t.o) x) AS n, array(SELECT y FROM pg_catalog.pg_policy) AS m FROM t",
            "SELECT CAST(NULL AS TEXT[]) AS n, CAST(NULL AS TEXT[]) AS m FROM t",
        );
        check(
            "SELECT x, row_number() OVER (ORDER BY x) FROM t",
            "SELECT x, CAST(row_number() OVER (ORDER BY x) AS BIGINT) AS \"row_number\" FROM t",
        );
        check("SELECT (keys).n FROM t", "SELECT get_field((keys), 'n') AS \"n\" FROM t");
        check(
            "SELECT x FROM t WHERE i.indisprimary = 't' AND x = 't'",
            "SELECT x FROM t WHERE i.indisprimary = true AND x = 't'",
        );
        check(
            "SELECT CAST(format('%I', x) AS REGCLASS) AS n FROM t",
            "SELECT to_regclass(format('%I', x)) AS n FROM t",
        );
        check(
            "SELECT unnest(i.k) AS k, generate_subscripts(i.k, $1::INT) AS n FROM i",
            "SELECT unnest(i.k) AS k, unnest(generate_series(1, array_length(i.k, $1::INT))) AS n FROM i",
        );
        check("SELECT generate_series(1, 2) AS i", "SELECT unnest(generate_series(1, 2)) AS i");
        check(
            "SELECT regexp_split_to_table(x, ',') AS w FROM t",
            "SELECT unnest(string_to_array(regexp_replace(x, ',', chr(1), 'g'), chr(1))) AS w FROM t",
        );
        check(
            "SELECT k FROM c CROSS JOIN UNNEST(c.conkey) AS k WHERE c.condeferrable = 'f'",
            "SELECT k FROM c CROSS JOIN (SELECT CAST(0 AS SMALLINT) AS \"int2\" WHERE false) AS k (k) WHERE c.condeferrable = false",
        );
        check("SELECT k FROM UNNEST(ARRAY[1, 2]) AS k", "SELECT k FROM UNNEST(ARRAY[1, 2]) AS k (k)");
        check("SELECT x FROM t WHERE x OR NOT($1)", "SELECT x FROM t WHERE x OR NOT CAST($1 AS BOOLEAN)");
        check("SELECT x FROM c WHERE conkey = '{1,2}'", "SELECT x FROM c WHERE array_to_string(conkey, ',') = '1,2'");
        check(
            "SELECT o.option_name FROM pg_catalog.pg_options_to_table(t.o) o",
            "SELECT o.option_name FROM (SELECT CAST('' AS TEXT) AS option_name, CAST('' AS TEXT) AS option_value WHERE false) o",
        );
    }
}
