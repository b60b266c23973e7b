//! An optimizer rule: `percentile_cont` and `median` of the same values become one call of `shared_percentiles`.
//! DataFusion collects the values again for each of them, and sorts all rows for `WITHIN GROUP (ORDER BY x)`.

use std::sync::Arc;

use arrow::datatypes::DataType;
use datafusion::common::tree_node::Transformed;
use datafusion::common::{Column, DFSchema};
use datafusion::error::Result;
use datafusion::functions_nested::expr_fn::array_element;
use datafusion::logical_expr::expr::AggregateFunction;
use datafusion::logical_expr::logical_plan::{Aggregate, Projection};
use datafusion::logical_expr::{AggregateUDF, Expr, ExprSchemable as _, LogicalPlan, lit};
use datafusion::optimizer::optimizer::ApplyOrder;
use datafusion::optimizer::{OptimizerConfig, OptimizerRule};
use datafusion::scalar::ScalarValue;
use echolake_functions::shared_percentiles;

/// The rule.
#[derive(Debug)]
pub(crate) struct PercentileCalls(Arc<AggregateUDF>);

impl PercentileCalls {
    /// Creates the rule.
    pub fn new() -> Self {
        Self(Arc::new(shared_percentiles()))
    }

    // None if nothing is shared.
    fn share_values(&self, aggregate: &Aggregate) -> Option<Result<LogicalPlan>> {
        let schema = aggregate.input.schema();
        let calls: Vec<_> = aggregate.aggr_expr.iter().map(|expr| PercentileCall::from_expr(expr, schema)).collect();
        let mut shared: Vec<SharedValues> = Vec::new();
        for call in calls.iter().flatten() {
            match shared.iter_mut().find(|shared| shared.values == call.values && shared.filter == call.filter) {
                Some(known) => known.add_call(call),
                None => shared.push(SharedValues::from_call(call)),
            }
        }
        shared.retain(SharedValues::is_faster);
        (!shared.is_empty()).then(|| self.plan_shared(aggregate, &calls, &shared))
    }

    fn plan_shared(
        &self,
        aggregate: &Aggregate,
        calls: &[Option<PercentileCall>],
        shared: &[SharedValues],
    ) -> Result<LogicalPlan> {
        let groups = aggregate.schema.fields().len() - calls.len();
        let mut columns: Vec<_> = aggregate.schema.columns().into_iter().map(Expr::Column).collect();
        let mut others = Vec::new();
        for (place, (expr, call)) in aggregate.aggr_expr.iter().zip(calls).enumerate() {
            match call.as_ref().and_then(|call| find_result(shared, call)) {
                Some(result) => {
                    let (relation, field) = aggregate.schema.qualified_field(groups + place);
                    columns[groups + place] = result.alias_qualified(relation.cloned(), field.name());
                }
                None => others.push(expr.clone()),
            }
        }
        others.extend(shared.iter().enumerate().map(|(nth, shared)| shared.new_call(&self.0).alias(list_name(nth))));
        let lists = Aggregate::try_new(aggregate.input.clone(), aggregate.group_expr.clone(), others)?;
        Projection::try_new(columns, Arc::new(LogicalPlan::Aggregate(lists))).map(LogicalPlan::Projection)
    }
}

impl OptimizerRule for PercentileCalls {
    fn name(&self) -> &str {
        "percentile_calls"
    }

    fn apply_order(&self) -> Option<ApplyOrder> {
        Some(ApplyOrder::BottomUp)
    }

    fn rewrite(&self, plan: LogicalPlan, _config: &dyn OptimizerConfig) -> Result<Transformed<LogicalPlan>> {
        let LogicalPlan::Aggregate(aggregate) = &plan else { return Ok(Transformed::no(plan)) };
        match self.share_values(aggregate) {
            Some(shared) => shared.map(Transformed::yes),
            None => Ok(Transformed::no(plan)),
        }
    }
}

/// A call of `percentile_cont` or `median`.
struct PercentileCall {
    values: Expr,
    filter: Option<Box<Expr>>,
    /// The share of values below it; null for the median.
    share: ScalarValue,
    /// Whether DataFusion would sort the rows.
    is_ordered: bool,
}

impl PercentileCall {
    fn from_expr(expr: &Expr, schema: &DFSchema) -> Option<Self> {
        let mut expr = expr;
        while let Expr::Alias(alias) = expr {
            expr = &alias.expr;
        }
        let Expr::AggregateFunction(AggregateFunction { func, params }) = expr else { return None };
        if params.distinct || params.null_treatment.is_some() {
            return None;
        }
        let (values, share) = match (func.name(), params.args.as_slice(), params.order_by.as_slice()) {
            ("median", [values], []) => (values, None),
            ("percentile_cont", [values, share], []) => (values, Some(read_share(share)?)),
            // The order is that of the values; from above, the share is as DataFusion computes it.
            ("percentile_cont", [values, share], [order]) => {
                let share = read_share(share)?;
                (values, Some(if order.asc { share } else { 1.0 - share }))
            }
            _ => return None,
        };
        let kind = values.get_type(schema).ok()?;
        matches!(kind, DataType::Float32 | DataType::Float64).then(|| Self {
            values: values.clone(),
            filter: params.filter.clone(),
            share: ScalarValue::Float64(share),
            is_ordered: !params.order_by.is_empty(),
        })
    }
}

// DataFusion refuses other ones, with a message.
fn read_share(expr: &Expr) -> Option<f64> {
    match expr {
        Expr::Literal(ScalarValue::Float64(Some(share)), _) => Some(*share).filter(|share| (0.0..=1.0).contains(share)),
        _ => None,
    }
}

/// Values of which percentiles are wanted.
struct SharedValues {
    values: Expr,
    filter: Option<Box<Expr>>,
    shares: Vec<ScalarValue>,
    is_ordered: bool,
}

impl SharedValues {
    fn from_call(call: &PercentileCall) -> Self {
        Self {
            values: call.values.clone(),
            filter: call.filter.clone(),
            shares: vec![call.share.clone()],
            is_ordered: call.is_ordered,
        }
    }

    fn add_call(&mut self, call: &PercentileCall) {
        self.is_ordered |= call.is_ordered;
        if !self.shares.contains(&call.share) {
            self.shares.push(call.share.clone());
        }
    }

    fn is_faster(&self) -> bool {
        self.is_ordered || self.shares.len() > 1
    }

    fn new_call(&self, function: &Arc<AggregateUDF>) -> Expr {
        let shares = self.shares.iter().map(|share| Expr::Literal(share.clone(), None));
        let args = std::iter::once(self.values.clone()).chain(shares).collect();
        let call = AggregateFunction::new_udf(function.clone(), args, false, self.filter.clone(), Vec::new(), None);
        Expr::AggregateFunction(call)
    }
}

// The element of the list that has the result of a call; None if it is not shared.
fn find_result(shared: &[SharedValues], call: &PercentileCall) -> Option<Expr> {
    let nth = shared.iter().position(|shared| shared.values == call.values && shared.filter == call.filter)?;
    let place = shared[nth].shares.iter().position(|share| *share == call.share)? as i64;
    Some(array_element(Expr::Column(Column::from_name(list_name(nth))), lit(place + 1)))
}

fn list_name(nth: usize) -> String {
    format!("__percentiles_{nth}")
}
