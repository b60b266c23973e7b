//! Types of placeholders that DataFusion leaves open: those of casts, of LIMIT and OFFSET, of lists that are searched,
//! of NOT, and of values that stand beside others.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field};
use datafusion::common::DFSchema;
use datafusion::common::tree_node::{Transformed, TreeNode as _};
use datafusion::error::Result;
use datafusion::logical_expr::expr::{Cast, Placeholder, ScalarFunction};
use datafusion::logical_expr::utils::merge_schema;
use datafusion::logical_expr::{Expr, ExprSchemable as _, LogicalPlan};
use echolake_functions::ANY_EQUAL;

/// Functions whose arguments are a list and one of its values.
const SEARCHES: [&str; 2] = ["array_has", ANY_EQUAL];

/// Functions whose arguments have one type.
const ALIKE: [&str; 4] = ["coalesce", "greatest", "least", "nullif"];

/// Gives a plan's placeholders the types that the query determines.
pub(crate) fn infer_types(plan: LogicalPlan) -> Result<LogicalPlan> {
    let settle = |node: LogicalPlan| {
        let schema = merge_schema(&node.inputs());
        let counts_rows = matches!(node, LogicalPlan::Limit(_));
        node.map_expressions(|expr| expr.transform_up(|expr| infer_of_expression(expr, counts_rows, &schema)))
    };
    Ok(plan.transform_up_with_subqueries(settle)?.data)
}

fn infer_of_expression(mut expr: Expr, counts_rows: bool, schema: &DFSchema) -> Result<Transformed<Expr>> {
    let found = match &mut expr {
        Expr::Cast(Cast { expr, field }) => {
            let kind = field.data_type().clone();
            settle_type(expr, || Some(kind))
        }
        Expr::ScalarFunction(ScalarFunction { func, args }) if SEARCHES.contains(&func.name()) => match &mut args[..] {
            [list @ Expr::Placeholder(_), element] => settle_type(list, || {
                let kind = element.get_type(schema).ok().filter(|kind| *kind != DataType::Null)?;
                Some(DataType::new_list(kind, true))
            }),
            [list, element] => settle_type(element, || match list.get_type(schema).ok()? {
                DataType::List(item) | DataType::LargeList(item) => Some(item.data_type().clone()),
                _ => None,
            }),
            _ => false,
        },
        Expr::ScalarFunction(ScalarFunction { func, args }) if ALIKE.contains(&func.name()) => {
            let known = |arg: &Expr| arg.get_type(schema).ok().filter(|kind| *kind != DataType::Null);
            let kind = args.iter().find_map(known);
            let mut found = false;
            for arg in args {
                found |= settle_type(arg, || kind.clone());
            }
            found
        }
        Expr::Not(truth) => settle_type(truth, || Some(DataType::Boolean)),
        placeholder @ Expr::Placeholder(_) if counts_rows => settle_type(placeholder, || Some(DataType::Int64)),
        _ => false,
    };
    Ok(if found { Transformed::yes(expr) } else { Transformed::no(expr) })
}

// Sets the type of a placeholder without one.
fn settle_type(expr: &mut Expr, kind: impl FnOnce() -> Option<DataType>) -> bool {
    let Expr::Placeholder(Placeholder { field: field @ None, .. }) = expr else { return false };
    *field = kind().map(|kind| Arc::new(Field::new("", kind, true)));
    field.is_some()
}
