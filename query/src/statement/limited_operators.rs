//! Operators and casts that make much of little, for processes whose memory is limited: `a || b` of texts becomes a
//! function with a limit, and so does `a ~ b`; functions that stand for operators on lists get theirs. A cast of lists to
//! text ends with its statement, and no cast makes a value of a huge fixed size. See [`limited_functions`].
//!
//! [`limited_functions`]: echolake_functions::limited_functions

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::DataType;
use datafusion::common::DFSchema;
use datafusion::common::config::ConfigOptions;
use datafusion::common::tree_node::{Transformed, TreeNode as _, TreeNodeRecursion};
use datafusion::error::Result;
use datafusion::logical_expr::expr::{Cast, ScalarFunction, TryCast};
use datafusion::logical_expr::expr_rewriter::NamePreserver;
use datafusion::logical_expr::utils::merge_schema;
use datafusion::logical_expr::{BinaryExpr, Expr, ExprSchemable as _, LogicalPlan, Operator, ScalarUDF};
use datafusion::optimizer::AnalyzerRule;
use echolake_functions::{check_fixed_type, list_text, text_concatenation};

/// The function of the operator `~`.
const REGEXP_LIKE: &str = "regexp_like";

/// The rule; it follows the coercion of types.
#[derive(Debug)]
pub(crate) struct LimitedOperators {
    texts: Arc<ScalarUDF>,
    list_text: Arc<ScalarUDF>,
    /// Functions with limits by their names.
    functions: HashMap<String, Arc<ScalarUDF>>,
}

impl LimitedOperators {
    /// Creates the rule with the functions that have limits.
    pub fn new(functions: &[Arc<ScalarUDF>]) -> Self {
        let functions = functions.iter().map(|function| (function.name().to_owned(), function.clone())).collect();
        Self { texts: text_concatenation(), list_text: list_text(), functions }
    }

    // The limited form of a function that the planner has taken without its limit.
    fn limited_form(&self, call: &ScalarFunction) -> Option<&Arc<ScalarUDF>> {
        self.functions.get(call.func.name()).filter(|limited| call.func != **limited)
    }

    fn is_unlimited(&self, expr: &Expr) -> bool {
        match expr {
            Expr::BinaryExpr(BinaryExpr { op, right, .. }) => {
                *op == Operator::StringConcat || (*op == Operator::RegexMatch && !matches!(**right, Expr::Literal(..)))
            }
            Expr::ScalarFunction(call) => self.limited_form(call).is_some(),
            Expr::Cast(Cast { field, .. }) | Expr::TryCast(TryCast { field, .. }) => field.data_type().is_string(),
            _ => false,
        }
    }
}

impl AnalyzerRule for LimitedOperators {
    fn name(&self) -> &str {
        "limited_operators"
    }

    fn analyze(&self, plan: LogicalPlan, _: &ConfigOptions) -> Result<LogicalPlan> {
        let mut is_unlimited = false;
        plan.apply_with_subqueries(|node| {
            node.apply_expressions(|expr| {
                expr.apply(|part| {
                    is_unlimited |= self.is_unlimited(part);
                    if let Expr::Cast(Cast { field, .. }) | Expr::TryCast(TryCast { field, .. }) = part {
                        check_fixed_type(field.data_type())?;
                    }
                    Ok(TreeNodeRecursion::Continue)
                })
            })
        })?;
        match is_unlimited {
            true => Ok(plan.transform_up_with_subqueries(|node| self.limit_node(node))?.data),
            false => Ok(plan),
        }
    }
}

impl LimitedOperators {
    fn limit_node(&self, node: LogicalPlan) -> Result<Transformed<LogicalPlan>> {
        let schema = merge_schema(&node.inputs());
        let names = NamePreserver::new(&node);
        node.map_expressions(|expr| {
            let name = names.save(&expr);
            let limited = expr.transform_up(|expr| self.limit_operator(expr, &schema))?;
            Ok(limited.update_data(|expr| name.restore(expr)))
        })
    }

    fn limit_operator(&self, expr: Expr, schema: &DFSchema) -> Result<Transformed<Expr>> {
        let (left, right) = match expr {
            Expr::BinaryExpr(BinaryExpr { left, op: Operator::StringConcat, right }) => (left, right),
            Expr::BinaryExpr(BinaryExpr { left, op: Operator::RegexMatch, right })
                if !matches!(*right, Expr::Literal(..)) && self.functions.contains_key(REGEXP_LIKE) =>
            {
                let function = self.functions[REGEXP_LIKE].clone();
                let call = ScalarFunction::new_udf(function, vec![*left, *right]);
                return Ok(Transformed::yes(Expr::ScalarFunction(call)));
            }
            Expr::ScalarFunction(call) => {
                return Ok(match self.limited_form(&call).cloned() {
                    Some(limited) => {
                        Transformed::yes(Expr::ScalarFunction(ScalarFunction::new_udf(limited, call.args)))
                    }
                    None => Transformed::no(Expr::ScalarFunction(call)),
                });
            }
            Expr::Cast(Cast { expr, field }) if field.data_type().is_string() => {
                let (expr, is_limited) = self.limit_text(*expr, schema)?;
                return Ok(Transformed::new_transformed(Expr::Cast(Cast { expr: Box::new(expr), field }), is_limited));
            }
            Expr::TryCast(TryCast { expr, field }) if field.data_type().is_string() => {
                let (expr, is_limited) = self.limit_text(*expr, schema)?;
                let cast = Expr::TryCast(TryCast { expr: Box::new(expr), field });
                return Ok(Transformed::new_transformed(cast, is_limited));
            }
            other => return Ok(Transformed::no(other)),
        };
        let kind = self.operand_type(&left, schema)?;
        let is_text = matches!(kind, DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View);
        if !is_text || self.operand_type(&right, schema)? != kind {
            return Ok(Transformed::no(Expr::BinaryExpr(BinaryExpr { left, op: Operator::StringConcat, right })));
        }
        let call = ScalarFunction::new_udf(self.texts.clone(), vec![*left, *right]);
        Ok(Transformed::yes(Expr::ScalarFunction(call)))
    }

    // Lists and structs are written by the function, so that the cast above it is one of texts.
    fn limit_text(&self, expr: Expr, schema: &DFSchema) -> Result<(Expr, bool)> {
        Ok(match self.operand_type(&expr, schema)?.is_nested() {
            true => (Expr::ScalarFunction(ScalarFunction::new_udf(self.list_text.clone(), vec![expr])), true),
            false => (expr, false),
        })
    }

    // The type of a long chain is not asked for from its beginning at each of its parts.
    fn operand_type(&self, expr: &Expr, schema: &DFSchema) -> Result<DataType> {
        match expr {
            Expr::ScalarFunction(call) if Arc::ptr_eq(&call.func, &self.texts) => match call.args.last() {
                Some(last) => last.get_type(schema),
                None => expr.get_type(schema),
            },
            _ => expr.get_type(schema),
        }
    }
}
