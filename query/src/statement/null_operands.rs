//! Operators and aggregates of NULL alone, of which the planner finds no type: they are NULL, as in DuckDB.

use datafusion::sql::sqlparser::ast::{
    BinaryOperator, CastKind, DataType, Expr, FunctionArg, FunctionArgExpr, FunctionArguments, Value, ValueWithSpan,
};

use super::tree;

/// Aggregates that have no answer of a NULL without a type.
const AGGREGATES: [&str; 4] = ["sum", "bit_and", "bit_or", "bit_xor"];

/// Gives a NULL a type where the planner needs one. The operands of the expression are done.
pub(super) fn settle_null(expr: &mut Expr) {
    match expr {
        Expr::BinaryOp { left, op, right } if is_null(left) && is_null(right) && is_typeless(op) => {
            *expr = Expr::value(Value::Null);
        }
        Expr::Function(function)
            if tree::plain_name(&function.name).is_some_and(|n| AGGREGATES.contains(&n.as_str())) =>
        {
            let FunctionArguments::List(list) = &mut function.args else { return };
            if let [FunctionArg::Unnamed(FunctionArgExpr::Expr(value))] = list.args.as_mut_slice()
                && is_null(value)
            {
                let expr = Box::new(value.clone());
                *value = Expr::Cast {
                    kind: CastKind::Cast,
                    expr,
                    data_type: DataType::BigInt(None),
                    array: false,
                    format: None,
                };
            }
        }
        _ => {}
    }
}

fn is_null(expr: &Expr) -> bool {
    matches!(expr, Expr::Value(ValueWithSpan { value: Value::Null, .. }))
}

fn is_typeless(operator: &BinaryOperator) -> bool {
    use BinaryOperator::{BitwiseAnd, BitwiseOr, PGBitwiseShiftLeft, PGBitwiseShiftRight, PGBitwiseXor, StringConcat};
    let typeless = [BitwiseAnd, BitwiseOr, PGBitwiseXor, PGBitwiseShiftLeft, PGBitwiseShiftRight, StringConcat];
    typeless.contains(operator)
}
