//! An optimizer rule: rows of measurements are aggregated by the keys of a join, and then the groups are joined. There
//! are a million rows, but 2951 pairs, eight symmetries, and as many surfaces as runs.
//!
//! ```text
//! by expressions of both                      by expressions of both: totals of partial results
//! └ rows JOIN others ON key          becomes  └ groups JOIN others ON key
//!                                               └ rows by key and the columns above: partial results
//! ```
//!
//! A join finds for each row of a group the same other rows, since it sees the group's columns alone. So each partial
//! result stands for the same rows in the total as before, once for each match; the other side need not be unique. A
//! value of the other side counts once for each row of the group.
//!
//! The same without a join, if lookups by pair have taken its place ([`super::PairJoin`]).
//!
//! Rows of `tnce_d4` are those of `tnce` joined with the symmetries ([`symmetry_rows`]).
//!
//! Only functions that split are moved: `count`, `sum`, `min`, `max` and `avg`. Types and nulls stay as they are; sums
//! of floats differ in their last digits, as they do between runs of a query.

mod flat_aggregate;
mod split_aggregate;
mod symmetry_rows;

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::datatypes::DataType;
use datafusion::common::Column;
use datafusion::common::tree_node::Transformed;
use datafusion::error::Result;
use datafusion::logical_expr::expr::{AggregateFunction, InList};
use datafusion::logical_expr::logical_plan::Aggregate;
use datafusion::logical_expr::utils::split_conjunction;
use datafusion::logical_expr::{AggregateUDF, BinaryExpr, Expr, LogicalPlan, Operator};
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use echolake_functions::exact_aggregates;
use echolake_schema::Symmetry;

use super::LookupFunctions;
use flat_aggregate::{FlatAggregate, count_rows};
use split_aggregate::SplitAggregate;

/// Rows of a group from which on it is faster to make groups first: they are aggregated twice.
const ROWS_A_GROUP: u64 = 8;
/// Versions of a reference that a lake has, about: a rig's Flat and Foam are measured again when it has changed.
const KNOWN_REFERENCES: u64 = 16;
/// Values that a column has whose values are few: verdicts, attempts, flags.
const FEW_VALUES: u64 = 4;

/// The rule.
#[derive(Debug)]
pub(crate) struct EagerAggregation {
    lookups: LookupFunctions,
    /// The sum that statements have, as which another process understands its name.
    sum: Arc<AggregateUDF>,
    rows_a_group: u64,
}

impl EagerAggregation {
    /// Creates the rule with a lake's lookups.
    pub fn new(lookups: &LookupFunctions) -> Self {
        let [sum, ..] = exact_aggregates();
        Self { lookups: lookups.clone(), sum: Arc::new(sum), rows_a_group: ROWS_A_GROUP }
    }

    /// Creates the rule for tables of any size.
    #[cfg(test)]
    pub fn of_any_size(lookups: &LookupFunctions) -> Self {
        Self { rows_a_group: 0, ..Self::new(lookups) }
    }

    // Returns the same groups by other nodes; None if that is not possible, or not faster.
    fn aggregate_first(&self, aggregate: &Aggregate) -> Option<LogicalPlan> {
        if count_rows(&aggregate.input) == 0 {
            return None;
        }
        let flat = FlatAggregate::from_aggregate(aggregate, &self.lookups)?;
        // Rows are counted by the log.
        if flat.group.is_empty() && flat.predicates.is_empty() && flat.calls.iter().all(counts_rows) {
            return None;
        }
        let split = SplitAggregate::from_flat(self, &flat)?;
        let groups = self.estimate_groups(&flat, split.keys())?;
        if groups.saturating_mul(self.rows_a_group) > estimate_rows(&flat, self.lookups.count_pairs()) {
            return None;
        }
        split.build_plan(flat, &aggregate.schema)
    }

    // About how many groups of rows there are; None if a column may have any number of values.
    fn estimate_groups(&self, flat: &FlatAggregate, keys: &BTreeSet<Column>) -> Option<u64> {
        let mut dimensions = BTreeSet::new();
        for key in keys {
            let (_, field) = flat.rows.schema().qualified_field_from_column(key).ok()?;
            if !matches!(field.data_type(), DataType::Int32 | DataType::Utf8 | DataType::Boolean) {
                return None;
            }
            dimensions.insert(KeyDimension::from_column(&key.name)?);
        }
        // The moved pair follows from both.
        if dimensions.contains(&KeyDimension::Pair) && dimensions.contains(&KeyDimension::Symmetry) {
            dimensions.remove(&KeyDimension::MovedPair);
        }
        // Many runs have the same references.
        if dimensions.contains(&KeyDimension::Run) {
            dimensions.remove(&KeyDimension::References);
        }
        let values = |dimension: &KeyDimension| match dimension {
            KeyDimension::Run => flat.size.runs,
            KeyDimension::References => flat.size.runs.min(KNOWN_REFERENCES),
            KeyDimension::Pair | KeyDimension::MovedPair => self.lookups.count_pairs(),
            KeyDimension::Symmetry => Symmetry::ALL.len() as u64,
            KeyDimension::Few(_) => FEW_VALUES,
        };
        Some(dimensions.iter().map(values).fold(1, u64::saturating_mul))
    }
}

impl OptimizerRule for EagerAggregation {
    fn name(&self) -> &str {
        "eager_aggregation"
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        Some(ApplyOrder::BottomUp)
    }

    fn rewrite(&self, plan: LogicalPlan, _config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        let LogicalPlan::Aggregate(aggregate) = &plan else { return Ok(Transformed::no(plan)) };
        Ok(match self.aggregate_first(aggregate) {
            Some(first) => Transformed::yes(first),
            None => Transformed::no(plan),
        })
    }
}

/// Something of which columns of a table are names: columns of one dimension together have no more values than one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum KeyDimension {
    Run,
    References,
    Pair,
    MovedPair,
    Symmetry,
    Few(&'static str),
}

impl KeyDimension {
    fn from_column(name: &str) -> Option<Self> {
        const FEW: [&str; 5] = ["attempt", "level", "source", "swapped", "verdict"];
        match name {
            "surface_id" | "run_id" => Some(Self::Run),
            "flat_version" | "foam_version" => Some(Self::References),
            "pair_id" | "microphone" | "speaker" => Some(Self::Pair),
            "d4_pair_id" | "d4_microphone" | "d4_speaker" => Some(Self::MovedPair),
            "symmetry" => Some(Self::Symmetry),
            name => FEW.into_iter().find(|few| *few == name).map(Self::Few),
        }
    }
}

fn counts_rows(call: &AggregateFunction) -> bool {
    call.func.name() == "count" && call.params.args.iter().all(|arg| matches!(arg, Expr::Literal(..)))
}

// Rows of few runs, or of few pairs, are not many.
fn estimate_rows(flat: &FlatAggregate, pairs: u64) -> u64 {
    let mut rows = flat.size.rows;
    let fixed: BTreeSet<_> = flat.predicates.iter().flat_map(split_conjunction).filter_map(fixed_dimension).collect();
    for dimension in fixed {
        rows /= match dimension {
            KeyDimension::Run => flat.size.runs.max(1),
            KeyDimension::Pair => pairs.max(1),
            _ => 1,
        };
    }
    rows
}

// The dimension of which a predicate leaves single values.
fn fixed_dimension(predicate: &Expr) -> Option<KeyDimension> {
    let column = match predicate {
        Expr::BinaryExpr(BinaryExpr { left, op: Operator::Eq, right }) => left.try_as_col().or(right.try_as_col()),
        Expr::InList(InList { expr, negated: false, .. }) => expr.try_as_col(),
        _ => None,
    };
    KeyDimension::from_column(&column?.name)
}
