//! Parts of syntax trees that the rewrite builds and reads.

use datafusion::sql::sqlparser::ast::{
    BinaryOperator, Expr, Function, FunctionArg, FunctionArgExpr, FunctionArgumentList, FunctionArguments, Ident,
    ObjectName, Query, SelectItem, Value,
};
use datafusion::sql::sqlparser::parser::Parser;

use super::dialect::LakeDialect;
use crate::Error;

/// Parses a query that the rewrite has written.
///
/// # Errors
/// [`Error::Query`] if it is none.
pub(super) fn parse_query(sql: &str) -> Result<Box<Query>, Error> {
    let parsed = Parser::new(&LakeDialect).try_with_sql(sql).and_then(|mut parser| parser.parse_query());
    parsed.map_err(|error| Error::from_tokenizer(sql, error))
}

/// Parses an expression that the rewrite has written.
///
/// # Errors
/// [`Error::Query`] if it is none.
pub(super) fn parse_expr(sql: &str) -> Result<Expr, Error> {
    let parsed = Parser::new(&LakeDialect).try_with_sql(sql).and_then(|mut parser| parser.parse_expr());
    parsed.map_err(|error| Error::from_tokenizer(sql, error))
}

/// Returns a number.
pub(super) fn number_literal(number: i64) -> Expr {
    Expr::value(Value::Number(number.to_string(), false))
}

/// Returns a call of a function with copies of the arguments.
pub(super) fn function_call(name: &str, args: [&Expr; 2]) -> Expr {
    let args = args.map(|arg| FunctionArg::Unnamed(FunctionArgExpr::Expr(arg.clone()))).into();
    Expr::Function(Function {
        name: ObjectName::from(vec![Ident::new(name)]),
        uses_odbc_syntax: false,
        parameters: FunctionArguments::None,
        args: FunctionArguments::List(FunctionArgumentList { duplicate_treatment: None, args, clauses: Vec::new() }),
        filter: None,
        null_treatment: None,
        over: None,
        within_group: Vec::new(),
    })
}

/// Returns a name as it is, whatever its letters.
pub(super) fn quoted_ident(name: &str) -> Ident {
    Ident::with_quote('"', name)
}

/// Returns the name by which the planner knows an identifier.
pub(super) fn normalized_name(ident: &Ident) -> String {
    if ident.quote_style.is_some() { ident.value.clone() } else { ident.value.to_lowercase() }
}

/// Returns the name of a function without a schema, in lower case.
pub(super) fn plain_name(name: &ObjectName) -> Option<String> {
    match name.0.as_slice() {
        [part] => part.as_ident().filter(|ident| ident.quote_style.is_none()).map(|ident| ident.value.to_lowercase()),
        _ => None,
    }
}

/// Returns the conjunction of two conditions.
pub(super) fn and_conditions(left: Expr, right: Expr) -> Expr {
    let nested = |expr| Box::new(Expr::Nested(Box::new(expr)));
    Expr::BinaryOp { left: nested(left), op: BinaryOperator::And, right: nested(right) }
}

/// Returns a select item, under an alias if there is one.
pub(super) fn select_item(expr: Expr, alias: Option<Ident>) -> SelectItem {
    match alias {
        Some(alias) => SelectItem::ExprWithAlias { expr, alias },
        None => SelectItem::UnnamedExpr(expr),
    }
}
