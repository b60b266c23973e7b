//! Plans of statements on one snapshot, kept for clients that send a statement again: to plan one that reads few rows
//! takes longer than to run it.

use std::sync::Arc;

use datafusion::common::TableReference;
use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::error::DataFusionError;
use datafusion::logical_expr::{Expr, LogicalPlan, Volatility};
use quick_cache::sync::Cache;

use super::PreparedQuery;
use crate::Error;
use crate::overlay_schema::NamedTables;

/// Plans that are kept of each snapshot.
const KEPT_PLANS: usize = 32;
/// Longest text, in bytes, whose plan is kept, and most parts of such a plan: they bound the memory.
const LONGEST_TEXT: usize = 4096;
const MOST_PARTS: usize = 2000;
/// Most bytes of constants in a plan that is kept.
const MOST_CONSTANT_BYTES: usize = 256 << 10;

/// Plans by the texts of their statements.
pub(crate) struct KnownPlans(Cache<String, Arc<PreparedQuery>>);

impl Default for KnownPlans {
    fn default() -> Self {
        Self(Cache::new(KEPT_PLANS))
    }
}

impl KnownPlans {
    /// Returns the plan of a statement, if it is kept.
    pub fn find_plan(&self, sql: &str) -> Option<Arc<PreparedQuery>> {
        self.0.get(sql)
    }

    /// Keeps the plan of a statement if each later run on the snapshot would plan the same: if it reads nothing but
    /// these tables, and calls no function such as `now()`. It is optimized first, unless there are workers.
    ///
    /// # Errors
    /// As [`PreparedQuery::optimize`].
    pub fn keep_plan(
        &self,
        query: PreparedQuery,
        tables: &NamedTables,
        has_workers: bool,
    ) -> Result<Arc<PreparedQuery>, Error> {
        if query.sql.len() > LONGEST_TEXT || !is_repeatable(&query.plan, tables) {
            return Ok(Arc::new(query));
        }
        let query = Arc::new(if has_workers { query } else { query.optimize()? });
        if constant_bytes(&query.plan).is_ok_and(|bytes| bytes <= MOST_CONSTANT_BYTES) {
            self.0.insert(query.sql.clone(), query.clone());
        }
        Ok(query)
    }
}

fn is_repeatable(plan: &LogicalPlan, tables: &NamedTables) -> bool {
    let mut parts = 0;
    let mut is_repeatable = true;
    let mut look_on = |is_same: bool| {
        parts += 1;
        is_repeatable &= is_same && parts < MOST_PARTS;
        if is_repeatable { TreeNodeRecursion::Continue } else { TreeNodeRecursion::Stop }
    };
    let looked: Result<_, DataFusionError> = plan.apply_with_subqueries(|node| {
        let going_on = look_on(node_is_same(node, tables));
        match going_on {
            TreeNodeRecursion::Stop => Ok(going_on),
            _ => node.apply_expressions(|all| all.apply(|part| Ok(look_on(expression_is_same(part))))),
        }
    });
    looked.is_ok() && is_repeatable
}

// What constant calls have returned is in the plan.
fn constant_bytes(plan: &LogicalPlan) -> Result<usize, DataFusionError> {
    let mut bytes = 0;
    plan.apply_with_subqueries(|node| {
        node.apply_expressions(|all| {
            all.apply(|part| {
                if let Expr::Literal(value, _) = part {
                    bytes += value.size();
                }
                Ok(TreeNodeRecursion::Continue)
            })
        })
    })?;
    Ok(bytes)
}

fn node_is_same(node: &LogicalPlan, tables: &NamedTables) -> bool {
    match node {
        LogicalPlan::TableScan(scan) => {
            matches!(&scan.table_name, TableReference::Bare { table } if tables.contains_key(&**table))
        }
        LogicalPlan::Explain(_)
        | LogicalPlan::Analyze(_)
        | LogicalPlan::DescribeTable(_)
        | LogicalPlan::Statement(_)
        | LogicalPlan::Ddl(_)
        | LogicalPlan::Dml(_)
        | LogicalPlan::Copy(_) => false,
        _ => true,
    }
}

fn expression_is_same(part: &Expr) -> bool {
    let volatility = match part {
        Expr::ScalarFunction(call) => call.func.signature().volatility,
        Expr::AggregateFunction(call) => call.func.signature().volatility,
        Expr::WindowFunction(call) => call.fun.signature().volatility,
        Expr::Placeholder(_) => return false,
        _ => Volatility::Immutable,
    };
    volatility == Volatility::Immutable
}
