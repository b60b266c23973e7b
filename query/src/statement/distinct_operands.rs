//! `a IS DISTINCT FROM b AND c`: the parser (0.62) reads all that follows FROM as its right side, AND and OR, too. Here
//! NOT, AND and OR beside it get their operands back.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{BinaryOperator, Expr, Statement, UnaryOperator, Value, VisitorMut};

use super::syntax_walk::walk_mut;

/// Puts NOT, AND and OR beside `IS [NOT] DISTINCT FROM` in their order. The statement is as it was parsed: parentheses
/// are nodes.
pub(super) fn order_distinct_operands(statement: &mut Statement) {
    let _ = walk_mut(statement, &mut DistinctOperands);
}

struct DistinctOperands;

impl VisitorMut for DistinctOperands {
    type Break = ();

    // From the inside out, so that an operand is in order before the operator that has it.
    fn post_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        release_operand(expr);
        ControlFlow::Continue(())
    }
}

// Makes `op (l AND r)` of the parser `(op l) AND r`, if `op` binds more strongly.
fn release_operand(expr: &mut Expr) {
    let strength = binding_strength(expr);
    let is_distinct = is_distinct_test(expr);
    let Some(operand) = last_operand(expr) else { return };
    if binary_strength(operand) >= strength || !is_distinct && !is_distinct_test(first_leaf(operand)) {
        return;
    }
    let whole = std::mem::replace(operand, Expr::value(Value::Null));
    let operator = std::mem::replace(expr, whole);
    let mut place = expr;
    while binary_strength(place) < strength {
        // Only AND and OR are so weak.
        let Expr::BinaryOp { left, .. } = place else { return };
        place = left.as_mut();
    }
    let operand = std::mem::replace(place, operator);
    if let Some(empty) = last_operand(place) {
        *empty = operand;
    }
}

fn is_distinct_test(expr: &Expr) -> bool {
    matches!(expr, Expr::IsDistinctFrom(..) | Expr::IsNotDistinctFrom(..))
}

fn binding_strength(expr: &Expr) -> u8 {
    match expr {
        Expr::IsDistinctFrom(..) | Expr::IsNotDistinctFrom(..) => 4,
        Expr::UnaryOp { op: UnaryOperator::Not, .. } => 3,
        _ => binary_strength(expr),
    }
}

fn binary_strength(expr: &Expr) -> u8 {
    match expr {
        Expr::BinaryOp { op: BinaryOperator::And, .. } => 2,
        Expr::BinaryOp { op: BinaryOperator::Or, .. } => 1,
        _ => u8::MAX,
    }
}

fn last_operand(expr: &mut Expr) -> Option<&mut Expr> {
    match expr {
        Expr::IsDistinctFrom(_, right) | Expr::IsNotDistinctFrom(_, right) => Some(right.as_mut()),
        Expr::UnaryOp { op: UnaryOperator::Not, expr } => Some(expr.as_mut()),
        Expr::BinaryOp { op: BinaryOperator::And, right, .. } => Some(right.as_mut()),
        _ => None,
    }
}

fn first_leaf(mut expr: &Expr) -> &Expr {
    loop {
        expr = match expr {
            Expr::BinaryOp { op: BinaryOperator::And | BinaryOperator::Or, left, .. } => left.as_ref(),
            Expr::UnaryOp { op: UnaryOperator::Not, expr } => expr.as_ref(),
            leaf => return leaf,
        };
    }
}

#[cfg(test)]
mod tests {
    use arrow::util::display::array_value_to_string;

    use echolake_lake::{Lake, ReferenceSurfaces};
    use echolake_schema::Rig;

    use crate::Session;

    /// N5: IS DISTINCT FROM binds more strongly than NOT, AND and OR.
    #[tokio::test]
    async fn is_distinct_from_ends_before_and_and_or() {
        let lake =
            Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let session = Session::new(&lake).expect("a session");
        for (sql, expected) in [
            ("select true is distinct from false and false", "false"),
            ("select true is not distinct from true and false", "false"),
            ("select 1 is not distinct from 1 and false", "false"),
            ("select false and true is distinct from false or true", "true"),
            ("select not false is distinct from true or true", "true"),
            ("select false and not true is distinct from true or true", "true"),
            ("select 1 is distinct from 2 or 1 is distinct from 1 and false", "true"),
            ("select 1 is distinct from 1 and 1 is distinct from 2 or true", "true"),
            ("select true is distinct from (false and false)", "true"),
            ("select case when 1 is distinct from 1 or true then 'a' else 'b' end", "a"),
            ("select count(*) from (values (1, 2), (3, 3)) t(x, y) where x is distinct from y and x < 9", "1"),
        ] {
            let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
            let batch = answer.next().await.expect(sql).expect(sql);
            assert_eq!(array_value_to_string(batch.column(0), 0).expect(sql), expected, "{sql}");
        }
    }
}
