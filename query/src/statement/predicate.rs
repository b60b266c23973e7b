//! Predicates of a client inside a query of the server: the predicate must be one expression within its parentheses.

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{BinaryOperator, Expr, Ident, SetExpr, Statement as Sql, UnaryOperator, Value};

use super::columns::hinted_error;
use crate::Error;

/// Maximum length of a predicate of comparisons, bytes.
const MOST_COMPARISON_BYTES: usize = 2048;

/// Forms of predicates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PredicateForm {
    /// Any expression, with queries of other tables in it.
    AnyExpression,
    /// Comparisons of columns and literals, joined by AND, OR and NOT: bounded work per row, even in hostile ones.
    Comparisons,
}

/// Appends a predicate to the query `select` for [`Session::append_predicate`](crate::Session::append_predicate).
/// `parse` parses a query.
///
/// # Errors
/// [`Error::Query`] if the predicate is none, or is not of the form.
pub(crate) fn append_predicate(
    select: &str,
    predicate: &str,
    form: PredicateForm,
    parse: impl Fn(&str) -> Result<Statement, Error>,
) -> Result<String, Error> {
    if form == PredicateForm::Comparisons && predicate.len() > MOST_COMPARISON_BYTES {
        let message = format!("the predicate has {} bytes, {MOST_COMPARISON_BYTES} may be here", predicate.len());
        return Err(hinted_error(message, "BETWEEN and IN are shorter than many comparisons"));
    }
    // The line breaks keep a comment in the predicate from reaching further.
    let query = |predicate: &str| format!("{select} (\n{predicate}\n)");
    let given = query(predicate);
    let mut asked = parse(&given)?;
    let mut ours = parse(&query("true"))?;
    match (take_predicate(&mut asked), take_predicate(&mut ours)) {
        (Some(inner), Some(_)) if asked == ours => {
            if form == PredicateForm::Comparisons {
                check_comparisons(&inner)?;
            }
            Ok(given)
        }
        _ => Err(hinted_error(
            "the predicate is not one expression".to_owned(),
            "what may stand behind WHERE, as `snr_db < 35 and pair_id < 100`",
        )),
    }
}

// An allow list, so that no expression of a newer parser passes.
fn check_comparisons(predicate: &Expr) -> Result<(), Error> {
    use BinaryOperator::{And, Eq, Gt, GtEq, Lt, LtEq, NotEq, Or};
    let mut pending = vec![predicate];
    while let Some(expression) = pending.pop() {
        match expression {
            Expr::Identifier(name) if is_plain(name) => {}
            literal if is_literal(literal) => {}
            Expr::Nested(inner)
            | Expr::UnaryOp { op: UnaryOperator::Not, expr: inner }
            | Expr::IsNull(inner)
            | Expr::IsNotNull(inner) => pending.push(inner),
            Expr::BinaryOp { left, op: Eq | NotEq | Lt | LtEq | Gt | GtEq | And | Or, right } => {
                pending.extend([&**left, &**right]);
            }
            Expr::Between { expr, low, high, .. } => pending.extend([&**expr, &**low, &**high]),
            Expr::InList { expr, list, .. } if list.iter().all(is_literal) => pending.push(expr),
            _ => {
                return Err(hinted_error(
                    "the predicate has more than comparisons of columns and literals, which is all it may have here"
                        .to_owned(),
                    "=, <>, <, <=, >, >=, BETWEEN, IN, IS NULL, AND, OR and NOT, as `snr_db < 35 and pair_id < 100`",
                ));
            }
        }
    }
    Ok(())
}

// No `@variable`, and no name that could refer to a table.
fn is_plain(name: &Ident) -> bool {
    name.value.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
}

fn is_literal(expression: &Expr) -> bool {
    match expression {
        Expr::UnaryOp { op: UnaryOperator::Minus, expr } => {
            matches!(&**expr, Expr::Value(number) if matches!(number.value, Value::Number(..)))
        }
        Expr::Value(literal) => {
            matches!(literal.value, Value::Number(..) | Value::SingleQuotedString(_) | Value::Boolean(_) | Value::Null)
        }
        _ => false,
    }
}

// Takes the expression in the parentheses of the last condition out of a query.
fn take_predicate(statement: &mut Statement) -> Option<Expr> {
    let Statement::Statement(sql) = statement else { return None };
    let Sql::Query(query) = sql.as_mut() else { return None };
    let SetExpr::Select(select) = query.body.as_mut() else { return None };
    let mut condition = select.selection.as_mut()?;
    while let Expr::BinaryOp { op: BinaryOperator::And, right, .. } = condition {
        condition = right;
    }
    let Expr::Nested(inner) = condition else { return None };
    Some(std::mem::replace(&mut **inner, Expr::Value(Value::Null.into())))
}
