//! A predicate of somebody else's in a query of ours: it fills the parentheses that it was put into, and nothing more.

use std::ops::ControlFlow;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    BinaryOperator, Expr, Query, SetExpr, Statement as Sql, Value, Visit as _, Visitor,
};

use crate::{Error, Session};

/// Whether a predicate may ask other tables, or the same again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subqueries {
    /// It may.
    Allowed,
    /// It sees the row that it is asked of, and nothing more.
    Refused,
}

impl Session {
    /// The query `select` with a predicate: `select` ends in `where`, or in `and` behind it. The query is not run, and
    /// what it may read is for the gate to say; here it is only made sure that `predicate` is one expression.
    ///
    /// # Errors
    /// [`Error::Query`] where the predicate is none, or has queries where it may not.
    pub fn selecting(&self, select: &str, predicate: &str, subqueries: Subqueries) -> Result<String, Error> {
        // The line breaks keep a comment in the predicate from reaching further.
        let query = |predicate: &str| format!("{select} (\n{predicate}\n)");
        let given = query(predicate);
        let (mut asked, mut ours) = (self.parse(&given)?, self.parse(&query("true"))?);
        let wrong = |message: &str, hint: &str| {
            Err(Error::Query { message: message.to_owned(), place: None, hint: Some(hint.to_owned()) })
        };
        match (emptied(&mut asked), emptied(&mut ours)) {
            (Some(inner), Some(_)) if asked == ours => match subqueries == Subqueries::Refused && asks(&inner) {
                true => wrong("the predicate may have no queries of its own here", "name columns of the table alone"),
                false => Ok(given),
            },
            _ => wrong(
                "the predicate is not one expression",
                "what may stand behind WHERE, as `snr_db < 35 and pair_id < 100`",
            ),
        }
    }
}

// Whether there are queries in an expression.
fn asks(expression: &Expr) -> bool {
    struct Found;
    impl Visitor for Found {
        type Break = ();

        fn pre_visit_query(&mut self, _: &Query) -> ControlFlow<()> {
            ControlFlow::Break(())
        }
    }
    expression.visit(&mut Found).is_break()
}

// Takes what stands in the parentheses of the last condition out of a query.
fn emptied(statement: &mut Statement) -> Option<Expr> {
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
