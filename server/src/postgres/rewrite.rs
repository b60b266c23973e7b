//! What clients' own questions to the catalogue need beyond what `datafusion-pg-catalog` adapts.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{
    BinaryOperator, Expr, Function, FunctionArg, FunctionArgExpr, FunctionArgumentList, FunctionArguments, Ident,
    ObjectName, Query, SelectItem, SetExpr, Statement, Value, ValueWithSpan, VisitMut as _, VisitorMut,
};

/// Columns of `pg_type` that name a function, as texts; Postgres has their numbers there, and 0 for none.
const FUNCTIONS: [&str; 6] = ["typinput", "typoutput", "typreceive", "typsend", "typmodin", "typmodout"];
/// How such a column says that there is none.
const NONE: &str = "-";

/// Adapts a statement.
pub(super) fn rewrite(mut statement: Statement) -> Statement {
    // It never breaks off.
    let _ = statement.visit(&mut Adapt);
    statement
}

struct Adapt;

impl VisitorMut for Adapt {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Some(better) = array_of_query(expr) {
            *expr = better;
        }
        if let Expr::BinaryOp { left, op: BinaryOperator::Eq | BinaryOperator::NotEq, right } = expr
            && is_function_column(left)
            && matches!(right.as_ref(), Expr::Value(ValueWithSpan { value: Value::Number(n, _), .. }) if n == "0")
        {
            **right = Expr::value(Value::SingleQuotedString(NONE.to_owned()));
        }
        ControlFlow::Continue(())
    }
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
    let mut select = select.clone();
    select.projection = vec![SelectItem::UnnamedExpr(Expr::Function(Function {
        name: ObjectName::from(vec![Ident::new("array_agg")]),
        args: FunctionArguments::List(FunctionArgumentList {
            duplicate_treatment: None,
            args: vec![FunctionArg::Unnamed(FunctionArgExpr::Expr(item.clone()))],
            clauses: Vec::new(),
        }),
        ..function.clone()
    }))];
    let body = Box::new(SetExpr::Select(select));
    Some(Expr::Subquery(Box::new(Query { body, order_by: None, ..query.as_ref().clone() })))
}

#[cfg(test)]
mod tests {
    use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
    use datafusion::sql::sqlparser::parser::Parser;

    use super::*;

    fn check(sql: &str, expected: &str) {
        let mut statements = Parser::parse_sql(&PostgreSqlDialect {}, sql).expect(sql);
        let adapted = rewrite(statements.pop().expect("a statement")).to_string();
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
        check("SELECT x <> 0, ARRAY[1] FROM t", "SELECT x <> 0, ARRAY[1] FROM t");
    }
}
