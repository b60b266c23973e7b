//! Adaptations of clients' catalogue queries beyond those of `datafusion-pg-catalog`.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{
    BinaryOperator, Expr, Function, FunctionArg, FunctionArgExpr, FunctionArgumentList, FunctionArguments, GroupByExpr,
    Ident, ObjectName, ObjectNamePart, Query, SelectItem, SetExpr, Statement, TableFactor, Value, ValueWithSpan,
    VisitMut as _, VisitorMut,
};
use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
use datafusion::sql::sqlparser::parser::Parser;
use pgwire::api::Type;

/// Columns of `pg_type` that name a function, as texts; Postgres has their numbers there, and 0 for none.
const FUNCTIONS: [&str; 6] = ["typinput", "typoutput", "typreceive", "typsend", "typmodin", "typmodout"];
/// Aggregates that a subquery may have already.
const AGGREGATES: [&str; 8] = ["array_agg", "avg", "bool_or", "count", "max", "min", "string_agg", "sum"];
/// Tables about what no column of the lake has.
const NOTHING: [&str; 3] = ["pg_attrdef", "pg_collation", "pg_sequence"];
/// The value of such a column that names no function.
const NONE: &str = "-";

/// Tables of `pg_catalog` that are found without its name, beside those that `datafusion-pg-catalog` knows.
pub(super) const OWN_TABLES: [&str; 2] = ["pg_indexes", "pg_timezone_names"];
const PG_CATALOG: &str = "pg_catalog";

/// Adapts a statement; `types` are those that its client gives its placeholders.
pub(super) fn rewrite(mut statement: Statement, types: &[Option<Type>]) -> Statement {
    // It never breaks off.
    let _ = statement.visit(&mut StatementAdapter(types));
    statement
}

struct StatementAdapter<'a>(&'a [Option<Type>]);

impl StatementAdapter<'_> {
    // `x = ANY($1)` came here as array_contains($1, x). A client that tells no type sends the array as a text.
    fn any_of_text(&self, expr: &mut Expr) -> Option<()> {
        let Expr::Function(Function { name, args: FunctionArguments::List(args), .. }) = expr else { return None };
        if name.to_string() != "array_contains" {
            return None;
        }
        let FunctionArg::Unnamed(FunctionArgExpr::Expr(array)) = args.args.first_mut()? else { return None };
        let Expr::Value(ValueWithSpan { value: Value::Placeholder(placeholder), .. }) = array else { return None };
        let number: usize = placeholder.strip_prefix('$')?.parse().ok()?;
        let told = self.0.get(number.checked_sub(1)?).and_then(Option::as_ref);
        if told.is_none_or(|told| matches!(*told, Type::UNKNOWN | Type::TEXT | Type::VARCHAR)) {
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
        if let Some(better) = array_of_query(expr).or_else(|| subscripts(expr)) {
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
        if let Expr::BinaryOp { left, op: BinaryOperator::Eq | BinaryOperator::NotEq, right } = expr
            && is_function_column(left)
            && matches!(right.as_ref(), Expr::Value(ValueWithSpan { value: Value::Number(n, _), .. }) if n == "0")
        {
            **right = Expr::value(Value::SingleQuotedString(NONE.to_owned()));
        }
        ControlFlow::Continue(())
    }
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

fn is_function_column(expr: &Expr) -> bool {
    let name = match expr {
        Expr::Identifier(name) => name,
        Expr::CompoundIdentifier(parts) => match parts.last() {
            Some(name) => name,
            None => return false,
        },
        _ => return false,
    };
    FUNCTIONS.iter().any(|f| name.value.eq_ignore_ascii_case(f))
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
    if select.from.iter().any(|from| unnests(&from.relation)) {
        return Some(Expr::value(Value::Null));
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
        let adapted = rewrite(statements.pop().expect("a statement"), &[None, Some(Type::TEXT_ARRAY)]).to_string();
        assert_eq!(adapted, expected);
    }

    #[test]
    fn only_what_needs_it_is_adapted() {
        check(
            "SELECT ARRAY(SELECT b.n FROM m b WHERE b.i = r.i ORDER BY 1) FROM r",
            "SELECT (SELECT array_agg(b.n) FROM m b WHERE b.i = r.i) FROM r",
        );
        check("SELECT 1 FROM t WHERE typreceive != 0", "SELECT 1 FROM t WHERE typreceive <> '-'");
        check("SELECT 1 FROM t WHERE t.typsend = 0", "SELECT 1 FROM t WHERE t.typsend = '-'");
        check("SELECT (SELECT d.x FROM pg_catalog.pg_attrdef d WHERE d.i = a.i LIMIT 1) FROM a", "SELECT NULL FROM a");
        check(
            "SELECT (SELECT count(*) FROM pg_catalog.pg_attrdef) FROM a",
            "SELECT (SELECT count(*) FROM pg_catalog.pg_attrdef) FROM a",
        );
        check(
            "SELECT (SELECT d.x FROM pg_catalog.pg_class d WHERE d.i = a.i LIMIT 1) FROM a",
            "SELECT (SELECT max(d.x) FROM pg_catalog.pg_class d WHERE d.i = a.i) FROM a",
        );
        check("SELECT (SELECT d.x FROM d) FROM a", "SELECT (SELECT d.x FROM d) FROM a");
        check("SELECT (SELECT count(*) FROM pg_class) FROM a", "SELECT (SELECT count(*) FROM pg_class) FROM a");
        check("SELECT 1 FROM pg_indexes", "SELECT 1 FROM pg_catalog.pg_indexes");
        check(
            "SELECT array_contains($1, x), array_contains($2, x) FROM t",
            "SELECT array_contains(string_to_array(replace(replace(btrim($1, '{}'), '\"', ''), ', ', ','), ','), x), array_contains($2, x) FROM t",
        );
        check(
            "SELECT 1 FROM t WHERE ctid BETWEEN '(0,0)'::tid AND '(4294967295,0)'::tid AND n < 1",
            "SELECT 1 FROM t WHERE true AND n < 1",
        );
        check(
            "SELECT 1 FROM t WHERE ctid BETWEEN '(1,0)'::tid AND '(4294967295,0)'::tid",
            "SELECT 1 FROM t WHERE ctid BETWEEN '(1,0)'::tid AND '(4294967295,0)'::tid",
        );
        check("SELECT array(SELECT 'a' || x FROM unnest(t.o) x) FROM t", "SELECT NULL FROM t");
        check(
            "SELECT unnest(i.k), generate_subscripts(i.k, $1::INT) AS n FROM i",
            "SELECT unnest(i.k), unnest(generate_series(1, array_length(i.k, $1::INT))) AS n FROM i",
        );
        check("SELECT x <> 0, ARRAY[1] FROM t", "SELECT x <> 0, ARRAY[1] FROM t");
    }
}
