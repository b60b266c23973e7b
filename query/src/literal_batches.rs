//! Batches of fewer rows for queries with large constants.
//!
//! An operator that needs a constant as a column repeats it for each row of a batch. A text of 1 MB, written out or
//! made by `repeat` while the query was planned, is 8 GB in a batch of 8192 rows, which no memory pool counts before it
//! is there.

use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::error::Result;
use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::{Expr, LogicalPlan};

use crate::OpaqueValue;

/// Constants that are smaller do not count, bytes.
const SMALL_CONSTANT: usize = 4 << 10;
/// Bytes that a batch may have of the constants of one operator.
const MOST_BATCH_BYTES: usize = 32 << 20;

/// Returns a state in which a batch of a plan has so few rows that the constants of each of its operators, repeated for
/// each row, are no more than 32 MiB, or one row.
///
/// # Errors
/// If the plan is not consistent.
pub(crate) fn limit_batch_rows(
    state: OpaqueValue<SessionState>,
    plan: &LogicalPlan,
) -> Result<OpaqueValue<SessionState>> {
    let mut largest = 0;
    plan.apply_with_subqueries(|node| {
        // Its rows are written out, each with constants of its own.
        if !matches!(node, LogicalPlan::Values(_)) {
            let mut bytes = 0;
            node.apply_expressions(|expr| {
                bytes += constant_bytes(expr)?;
                Ok(TreeNodeRecursion::Continue)
            })?;
            largest = largest.max(bytes);
        }
        Ok(TreeNodeRecursion::Continue)
    })?;
    let rows = MOST_BATCH_BYTES.checked_div(largest).unwrap_or(usize::MAX).max(1);
    if rows >= state.config().batch_size() {
        return Ok(state);
    }
    let mut limited = SessionState::clone(&state);
    limited.config_mut().options_mut().set("datafusion.execution.batch_size", &rows.to_string())?;
    Ok(OpaqueValue::new(limited))
}

fn constant_bytes(expr: &Expr) -> Result<usize> {
    let mut bytes = 0;
    expr.apply(|part| {
        if let Expr::Literal(value, _) = part {
            bytes += Some(value.size()).filter(|size| *size >= SMALL_CONSTANT).unwrap_or(0);
        }
        Ok(TreeNodeRecursion::Continue)
    })?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use datafusion::prelude::SessionContext;

    use super::*;

    #[tokio::test]
    async fn large_constants_make_small_batches() {
        let long = "x".repeat(1 << 20);
        let usual = SessionContext::new().state().config().batch_size();
        for (sql, rows) in [
            ("select v, 'x' as x from (values (1), (2)) t(v)".to_owned(), usual..=usual),
            (format!("select v, '{long}' as x from (values (1), (2)) t(v)"), 30..=32),
            (format!("select v from (values (1), (2)) t(v) where concat(v, '{long}') <> '{long}'"), 15..=16),
            (format!("select v from (values ('{long}'), ('b')) t(v)"), usual..=usual),
            (format!("select v, '{}' as x from (values (1), (2)) t(v)", long.repeat(40)), 1..=1),
        ] {
            let state = SessionContext::new().state();
            let plan = state.create_logical_plan(&sql).await.expect("planned");
            let plan = state.optimize(&plan).expect("optimised");
            let limited = limit_batch_rows(OpaqueValue::new(state), &plan).expect("a state");
            let given = limited.config().batch_size();
            assert!(rows.contains(&given), "{given}, expected {rows:?}: {}", &sql[..60]);
        }
    }
}
