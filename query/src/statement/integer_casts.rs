//! Casts of fractions to integers: they round, as in PostgreSQL and DuckDB. DataFusion's cut the digits off.

use arrow::datatypes::DataType;
use datafusion::common::DFSchema;
use datafusion::common::tree_node::{Transformed, TreeNode as _};
use datafusion::error::Result;
use datafusion::functions::math::expr_fn::round;
use datafusion::logical_expr::expr::{Cast, TryCast};
use datafusion::logical_expr::expr_rewriter::NamePreserver;
use datafusion::logical_expr::utils::merge_schema;
use datafusion::logical_expr::{Expr, ExprSchemable as _, LogicalPlan};

use super::declared_types::allow_null;
use super::literals::read_literals;

/// Has the casts that a statement writes round to the nearest integer, ties away from zero, and treats its literals and
/// subqueries as [`read_literals`] and [`allow_null`] say. It is called before DataFusion adds casts of its own.
pub(crate) fn round_casts(plan: LogicalPlan) -> Result<LogicalPlan> {
    let round_node = |node: LogicalPlan| {
        let schema = merge_schema(&node.inputs());
        let names = NamePreserver::new(&node);
        node.map_expressions(|expr| {
            let name = names.save(&expr);
            let rounded = expr.transform_up(|expr| {
                let null = allow_null(expr)?;
                let read = read_literals(null.data, &schema);
                let rounded = round_cast(read.data, &schema);
                let transformed = null.transformed || read.transformed || rounded.transformed;
                Ok(Transformed { transformed, ..rounded })
            })?;
            Ok(rounded.update_data(|expr| name.restore(expr)))
        })
    };
    Ok(plan.transform_up_with_subqueries(round_node)?.data)
}

fn round_cast(mut cast: Expr, schema: &DFSchema) -> Transformed<Expr> {
    let (Expr::Cast(Cast { expr, field }) | Expr::TryCast(TryCast { expr, field })) = &mut cast else {
        return Transformed::no(cast);
    };
    let has_fraction = |kind: DataType| kind.is_floating() || kind.is_decimal();
    if !field.data_type().is_integer() || !expr.get_type(schema).is_ok_and(has_fraction) {
        return Transformed::no(cast);
    }
    **expr = round(vec![std::mem::take(expr.as_mut())]);
    Transformed::yes(cast)
}

#[cfg(test)]
mod tests {
    use arrow::util::display::array_value_to_string;

    use echolake_lake::{Lake, ReferenceSurfaces};
    use echolake_schema::Rig;

    use crate::Session;

    #[tokio::test]
    async fn fractions_are_rounded_and_columns_keep_their_names() {
        let lake =
            Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let session = Session::new(&lake).expect("a session");
        for (sql, expected) in [
            ("select 2.7::int", "3"),
            ("select cast(-2.5 as bigint)", "-3"),
            ("select try_cast(1.49::real as smallint)", "1"),
            ("select cast(cast(2.5 as decimal(4, 1)) as int)", "3"),
            ("select cast(0.5 + x as int) from (values (2.2)) as t(x)", "3"),
            (
                "select cast(x as int) from (values (1.6), (2.4)) as t(x) \
                 group by cast(x as int) order by cast(x as int)",
                "2",
            ),
            ("select (select max(cast(x as int)) from (values (1.6)) as t(x))", "2"),
            ("select 7 / 2", "3"),
        ] {
            let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
            let batch = answer.next().await.expect(sql).expect(sql);
            assert_eq!(array_value_to_string(batch.column(0), 0).expect(sql), expected, "{sql}");
        }
    }
}
