//! An optimizer rule: replaces a join with table `pairs` by `pair_id` with lookups. `pairs` has every pair of the rig
//! once and measurements have no other pairs, so the join neither drops nor duplicates a row, and an array access is
//! cheaper than a hash table.

use datafusion::common::metadata::FieldMetadata;
use datafusion::common::tree_node::Transformed;
use datafusion::common::{Column, JoinType};
use datafusion::datasource::source_as_provider;
use datafusion::error::Result;
use datafusion::logical_expr::logical_plan::{Join, Projection};
use datafusion::logical_expr::{Expr, LogicalPlan};
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use echolake_lake_tables::LakeTable;
use echolake_schema::tables::Table;

use super::LookupFunctions;

const KEY: &str = "pair_id";

/// The rule.
#[derive(Debug)]
pub(crate) struct PairJoin(LookupFunctions);

impl PairJoin {
    /// Creates the rule with a lake's lookups.
    pub fn new(lookups: &LookupFunctions) -> Self {
        Self(lookups.clone())
    }

    // Returns the same rows without the join; None if the join is needed.
    fn without_join(&self, join: &Join) -> Option<Result<LogicalPlan>> {
        let [(left, right)] = join.on.as_slice() else { return None };
        let left = left.try_as_col()?;
        let right = right.try_as_col()?;
        if join.filter.is_some() {
            return None;
        }
        let (rows, key, pairs) = match join.join_type {
            JoinType::Inner | JoinType::Left if is_pairs(&join.right, right) => (&join.left, left, &join.right),
            JoinType::Inner | JoinType::Right if is_pairs(&join.left, left) => (&join.right, right, &join.left),
            _ => return None,
        };
        if !is_measured(rows, key) {
            return None;
        }
        let columns = join.schema.columns().into_iter();
        let columns = columns.map(|column| match pairs.schema().has_column(&column) {
            true => self.lookup_column(&column, key, pairs),
            false => Some(Expr::Column(column)),
        });
        let columns: Vec<_> = columns.collect::<Option<_>>()?;
        Some(Projection::try_new(columns, rows.clone()).map(LogicalPlan::Projection))
    }

    // Returns a column of `pairs` as a lookup by `key`.
    fn lookup_column(&self, column: &Column, key: &Column, pairs: &LogicalPlan) -> Option<Expr> {
        let value = match column.name.as_str() {
            KEY => Expr::Column(key.clone()),
            name => self.0.of_pair(name)?.call(vec![Expr::Column(key.clone())]),
        };
        let (_, field) = pairs.schema().qualified_field_from_column(column).ok()?;
        let metadata = Some(FieldMetadata::from(field.metadata()));
        Some(value.alias_qualified_with_metadata(column.relation.clone(), &column.name, metadata))
    }
}

impl OptimizerRule for PairJoin {
    fn name(&self) -> &str {
        "pair_join"
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        Some(ApplyOrder::BottomUp)
    }

    fn rewrite(&self, plan: LogicalPlan, _config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        match &plan {
            LogicalPlan::Join(join) => match self.without_join(join) {
                Some(without) => Ok(Transformed::yes(without?)),
                None => Ok(Transformed::no(plan)),
            },
            _ => Ok(Transformed::no(plan)),
        }
    }
}

// Returns whether the plan has all rows of `pairs`, with the key under its own name.
fn is_pairs(plan: &LogicalPlan, key: &Column) -> bool {
    key.name == KEY && scanned_table(plan, true) == Some(Table::Pairs)
}

// Returns whether the column is `pair_id` of a table of measurements, so that it has only pairs of the rig.
fn is_measured(plan: &LogicalPlan, key: &Column) -> bool {
    let measured = [Table::Measurements, Table::Nce, Table::Tnce, Table::TnceD4];
    key.name == KEY && scanned_table(plan, false).is_some_and(|table| measured.contains(&table))
}

/// Returns the table whose rows the plan has, with columns under their own names: `all` of its rows, or some.
pub(crate) fn scanned_table(plan: &LogicalPlan, all: bool) -> Option<Table> {
    match plan {
        LogicalPlan::TableScan(scan) => {
            let provider = source_as_provider(&scan.source).ok()?;
            let provider: &dyn std::any::Any = provider.as_ref();
            let whole = scan.filters.is_empty() && scan.fetch.is_none();
            provider.downcast_ref::<LakeTable>().map(LakeTable::table).filter(|_| whole || !all)
        }
        LogicalPlan::Filter(filter) if !all => scanned_table(&filter.input, all),
        LogicalPlan::SubqueryAlias(alias) => scanned_table(&alias.input, all),
        LogicalPlan::Projection(projection) => {
            let plain = projection.expr.iter().all(|e| matches!(e, Expr::Column(_)));
            scanned_table(&projection.input, all).filter(|_| plain)
        }
        _ => None,
    }
}
