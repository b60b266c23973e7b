//! `x op ANY (list)`, which is null if no value fits and one is null. DataFusion takes it for false then. `=` becomes a
//! function, and the other operators `NOT (x op ALL (list))`, which DataFusion plans with nulls.

use datafusion::sql::sqlparser::ast::{BinaryOperator, Expr, UnaryOperator};
use echolake_functions::ANY_EQUAL;

use super::tree;

/// Rewrites a comparison with any value of a list.
pub(super) fn rewrite_list_comparison(expr: &mut Expr) {
    let Expr::AnyOp { left, compare_op, right, .. } = expr else { return };
    if matches!(**right, Expr::Subquery(_)) {
        return;
    }
    let negated = match compare_op {
        BinaryOperator::Eq => return *expr = tree::function_call(ANY_EQUAL, [right, left]),
        BinaryOperator::NotEq => BinaryOperator::Eq,
        BinaryOperator::Lt => BinaryOperator::GtEq,
        BinaryOperator::LtEq => BinaryOperator::Gt,
        BinaryOperator::Gt => BinaryOperator::LtEq,
        BinaryOperator::GtEq => BinaryOperator::Lt,
        _ => return,
    };
    let all = Expr::AllOp { left: left.clone(), compare_op: negated, right: right.clone() };
    *expr = Expr::UnaryOp { op: UnaryOperator::Not, expr: Box::new(Expr::Nested(Box::new(all))) };
}
