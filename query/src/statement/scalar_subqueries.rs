//! A subquery that is a value is null if it has no row. DataFusion (55.2) takes it to be null only if its column may be:
//! `(SELECT pair_id FROM pairs WHERE false) IS NULL` is false, and the null itself an error.
//!
//! A function that hands on its argument says that the value may be null. Subqueries that depend on the row around them
//! become joins, which know it.

use std::sync::Arc;

use arrow::datatypes::{DataType, FieldRef};
use datafusion::common::Column;
use datafusion::common::tree_node::{Transformed, TreeNode as _};
use datafusion::common::utils::take_function_args;
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, Expr, LogicalPlan, LogicalPlanBuilder, ReturnFieldArgs, ScalarFunctionArgs, ScalarUDF,
    ScalarUDFImpl, Signature, Subquery, Volatility,
};

/// Has the subqueries that are values be null without a row.
pub(super) fn allow_missing_rows(plan: LogicalPlan) -> Result<LogicalPlan> {
    let allow_node = |node: LogicalPlan| node.map_expressions(|expr| expr.transform_up(allow_missing_row));
    Ok(plan.transform_up_with_subqueries(allow_node)?.data)
}

fn allow_missing_row(expr: Expr) -> Result<Transformed<Expr>> {
    let Expr::ScalarSubquery(subquery) = &expr else { return Ok(Transformed::no(expr)) };
    let schema = subquery.subquery.schema();
    let is_null_known = schema.fields().len() != 1 || schema.field(0).is_nullable();
    if is_null_known || !subquery.outer_ref_columns.is_empty() {
        return Ok(Transformed::no(expr));
    }
    let name = schema.field(0).name().clone();
    let value = Expr::Column(Column::from(schema.qualified_field(0)));
    let function = NullableValue { signature: Signature::any(1, Volatility::Volatile) };
    let value = ScalarUDF::new_from_impl(function).call(vec![value]).alias(name);
    let plan = LogicalPlanBuilder::from(subquery.subquery.clone()).project([value])?.build()?;
    let spans = subquery.spans.clone();
    let subquery = Subquery { subquery: Arc::new(plan), outer_ref_columns: Vec::new(), spans };
    Ok(Transformed::yes(Expr::ScalarSubquery(subquery)))
}

/// Its argument, which may be null. It is volatile, so that it is not folded if the argument is a constant.
#[derive(Debug, PartialEq, Eq, Hash)]
struct NullableValue {
    signature: Signature,
}

impl ScalarUDFImpl for NullableValue {
    fn name(&self) -> &str {
        "nullable_value"
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let [kind] = take_function_args(self.name(), types)?;
        Ok(kind.clone())
    }

    fn return_field_from_args(&self, args: ReturnFieldArgs<'_>) -> Result<FieldRef> {
        let [field] = take_function_args(self.name(), args.arg_fields)?;
        Ok(Arc::new(field.as_ref().clone().with_nullable(true)))
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let [value] = take_function_args(self.name(), args.args)?;
        Ok(value)
    }
}

#[cfg(test)]
mod tests {
    use arrow::util::display::array_value_to_string;

    use echolake_lake::{Lake, ReferenceSurfaces};
    use echolake_schema::Rig;

    use crate::Session;

    /// N10: A subquery without a row is null, also if its column is not.
    #[tokio::test]
    async fn a_subquery_without_a_row_is_null() {
        let lake =
            Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let session = Session::new(&lake).expect("a session");
        for (sql, expected) in [
            ("select (select pair_id from pairs where pair_id < 0) is null", "true"),
            ("select count(*) from points where (select pair_id from pairs where pair_id < 0) is null", "78"),
            ("select count(*) from points where (select 1 where false) is not null", "0"),
            ("select coalesce((select pair_id from pairs where pair_id < 0), -1)", "-1"),
            ("select coalesce((select y from (values (1)) u(y) where y > 5), x) from (values (7)) t(x)", "7"),
            ("select (select pair_id from pairs where pair_id = 3) + 1", "4"),
            ("select x from (values (7)) t(x) where x > (select 5)", "7"),
            ("select (select pair_id from pairs where pair_id = 3)", "3"),
            ("select (select pair_id from pairs where pair_id < 0)", ""),
        ] {
            let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
            let batch = answer.next().await.unwrap_or_else(|e| panic!("{sql}: {e}")).expect(sql);
            assert_eq!(array_value_to_string(batch.column(0), 0).expect(sql), expected, "{sql}");
        }
    }
}
