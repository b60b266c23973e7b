//! Sums, differences and products of whole numbers: one that its type cannot hold is an error, as in PostgreSQL and
//! DuckDB. DataFusion's own wrap round.
//!
//! A function takes the operator's place once all types are known, before any constant is folded. It has the operator's
//! name in results, so that columns are called as before.

use std::sync::Arc;

use arrow::compute::kernels::numeric::{add, mul, sub};
use arrow::datatypes::{DataType, Field, FieldRef};
use datafusion::common::DFSchema;
use datafusion::common::config::ConfigOptions;
use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::common::utils::take_function_args;
use datafusion::error::Result;
use datafusion::logical_expr::expr::ScalarFunction;
use datafusion::logical_expr::expr_rewriter::NamePreserver;
use datafusion::logical_expr::utils::merge_schema;
use datafusion::logical_expr::{
    BinaryExpr, ColumnarValue, Expr, ExprSchemable as _, LogicalPlan, Operator, ReturnFieldArgs, ScalarFunctionArgs,
    ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};
use datafusion::optimizer::AnalyzerRule;
use datafusion::physical_expr_common::datum::apply;
use datafusion::scalar::ScalarValue;
use echolake_functions::check_stop;

/// The rule; it follows the coercion of types.
#[derive(Debug)]
pub(crate) struct IntegerArithmetic;

impl AnalyzerRule for IntegerArithmetic {
    fn name(&self) -> &str {
        "integer_arithmetic"
    }

    fn analyze(&self, plan: LogicalPlan, _: &ConfigOptions) -> Result<LogicalPlan> {
        let mut is_there = false;
        plan.apply_with_subqueries(|node| {
            is_there |= has_arithmetic(node)?;
            Ok(if is_there { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
        })?;
        match is_there {
            true => Ok(plan.transform_up_with_subqueries(check_node)?.data),
            false => Ok(plan),
        }
    }
}

fn is_arithmetic(expr: &Expr) -> bool {
    matches!(
        expr,
        Expr::Negative(_)
            | Expr::BinaryExpr(BinaryExpr { op: Operator::Plus | Operator::Minus | Operator::Multiply, .. })
    )
}

fn has_arithmetic(node: &LogicalPlan) -> Result<bool> {
    let mut is_there = false;
    node.apply_expressions(|expr| {
        is_there = is_there || expr.exists(|part| Ok(is_arithmetic(part)))?;
        Ok(if is_there { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
    })?;
    Ok(is_there)
}

fn check_node(node: LogicalPlan) -> Result<Transformed<LogicalPlan>> {
    if !has_arithmetic(&node)? {
        return Ok(Transformed::no(node));
    }
    let schema = merge_schema(&node.inputs());
    let names = NamePreserver::new(&node);
    node.map_expressions(|expr| {
        let name = names.save(&expr);
        let checked = expr.transform_up(|expr| check_operator(expr, &schema))?;
        Ok(checked.update_data(|expr| name.restore(expr)))
    })
}

fn check_operator(expr: Expr, schema: &DFSchema) -> Result<Transformed<Expr>> {
    if let Expr::Negative(operand) = expr {
        return check_negation(operand, schema);
    }
    let Expr::BinaryExpr(BinaryExpr { left, op, right }) = expr else { return Ok(Transformed::no(expr)) };
    let restored = |left, right| Ok(Transformed::no(Expr::BinaryExpr(BinaryExpr { left, op, right })));
    if !matches!(op, Operator::Plus | Operator::Minus | Operator::Multiply) {
        return restored(left, right);
    }
    let kind = operand_type(&left, schema)?;
    if !kind.is_integer() || operand_type(&right, schema)? != kind {
        return restored(left, right);
    }
    Ok(Transformed::yes(checked_call(op, kind, [*left, *right])))
}

// `-x` is 0 - x.
fn check_negation(operand: Box<Expr>, schema: &DFSchema) -> Result<Transformed<Expr>> {
    let kind = operand_type(&operand, schema)?;
    if !kind.is_signed_integer() {
        return Ok(Transformed::no(Expr::Negative(operand)));
    }
    let zero = Expr::Literal(ScalarValue::new_zero(&kind)?, None);
    Ok(Transformed::yes(checked_call(Operator::Minus, kind, [zero, *operand])))
}

fn checked_call(operator: Operator, kind: DataType, operands: [Expr; 2]) -> Expr {
    let function = CheckedOperator::new_function(operator, Some(kind));
    Expr::ScalarFunction(ScalarFunction::new_udf(function.into(), operands.into()))
}

/// Returns the functions for integers of any type, by whose names a plan of another process is understood.
pub(crate) fn checked_operators() -> [ScalarUDF; 3] {
    [Operator::Plus, Operator::Minus, Operator::Multiply].map(|operator| CheckedOperator::new_function(operator, None))
}

// The type of a long sum is not asked for from its beginning at each of its parts.
fn operand_type(expr: &Expr, schema: &DFSchema) -> Result<DataType> {
    if let Expr::ScalarFunction(function) = expr
        && let Some(checked) = function.func.inner().downcast_ref::<CheckedOperator>()
        && let Some(kind) = &checked.kind
    {
        return Ok(kind.clone());
    }
    expr.get_type(schema)
}

/// `+`, `-` or `*` of two integers of one type.
#[derive(Debug, PartialEq, Eq, Hash)]
struct CheckedOperator {
    operator: Operator,
    /// Type of its operands and result, if it is known beforehand.
    kind: Option<DataType>,
    signature: Signature,
}

impl CheckedOperator {
    fn new_function(operator: Operator, kind: Option<DataType>) -> ScalarUDF {
        ScalarUDF::new_from_impl(Self { operator, kind, signature: Signature::any(2, Volatility::Immutable) })
    }
}

impl ScalarUDFImpl for CheckedOperator {
    fn name(&self) -> &str {
        match self.operator {
            Operator::Plus => "checked_add",
            Operator::Minus => "checked_subtract",
            _ => "checked_multiply",
        }
    }

    fn schema_name(&self, args: &[Expr]) -> Result<String> {
        let [left, right] = take_function_args(self.name(), args)?;
        Ok(format!("{} {} {}", left.schema_name(), self.operator, right.schema_name()))
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let [left, _] = take_function_args(self.name(), types)?;
        Ok(self.kind.as_ref().unwrap_or(left).clone())
    }

    // As the operator's: a union that has it declares no nulls that are not there.
    fn return_field_from_args(&self, args: ReturnFieldArgs) -> Result<FieldRef> {
        let [left, right] = take_function_args(self.name(), args.arg_fields)?;
        let kind = self.kind.as_ref().unwrap_or(left.data_type());
        Ok(Arc::new(Field::new(self.name(), kind.clone(), left.is_nullable() || right.is_nullable())))
    }

    fn is_strict(&self) -> bool {
        true
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        check_stop()?;
        let [left, right] = take_function_args(self.name(), args.args)?;
        match self.operator {
            Operator::Plus => apply(&left, &right, add),
            Operator::Minus => apply(&left, &right, sub),
            _ => apply(&left, &right, mul),
        }
    }
}
