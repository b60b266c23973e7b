//! From a logical join by order to the node that runs it.

use std::sync::Arc;

use async_trait::async_trait;
use datafusion::arrow::datatypes::DataType;
use datafusion::catalog::Session;
use datafusion::common::DFSchema;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::context::QueryPlanner;
use datafusion::logical_expr::physical_planning_context::PhysicalPlanningContext;
use datafusion::logical_expr::{Expr, LogicalPlan, Operator, UserDefinedLogicalNode};
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_expr::expressions::{BinaryExpr, lit};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_planner::{DefaultPhysicalPlanner, ExtensionPlanner, PhysicalPlanner};

use super::exec::{MergedJoin, SortedJoinExec};
use super::recognition::sort_range_joins;
use super::{JoinBound, SortedJoin, WindowSide};

/// DataFusion's planner, for plans in which some joins are by order.
#[derive(Debug)]
pub(crate) struct SortedJoinPlanner;

#[async_trait]
impl QueryPlanner for SortedJoinPlanner {
    async fn create_physical_plan(
        &self,
        logical_plan: &LogicalPlan,
        session: &dyn Session,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let plan = sort_range_joins(logical_plan.clone())?;
        let planner = DefaultPhysicalPlanner::with_extension_planners(vec![Arc::new(SortedJoinExtension)]);
        planner.create_physical_plan(&plan, session).await
    }
}

struct SortedJoinExtension;

#[async_trait]
impl ExtensionPlanner for SortedJoinExtension {
    async fn plan_extension(
        &self,
        planner: &dyn PhysicalPlanner,
        node: &dyn UserDefinedLogicalNode,
        _logical_inputs: &[&LogicalPlan],
        physical_inputs: &[Arc<dyn ExecutionPlan>],
        session: &dyn Session,
        context: &PhysicalPlanningContext,
    ) -> Result<Option<Arc<dyn ExecutionPlan>>> {
        let (Some(join), [left, right]) = (node.as_any().downcast_ref::<SortedJoin>(), physical_inputs) else {
            return Ok(None);
        };
        let plan_expr = |expr: &Expr, schema: &DFSchema| planner.create_physical_expr(expr, schema, session, context);
        let plan_key = |expr: &Expr, schema: &DFSchema| unify_zeros(plan_expr(expr, schema)?, schema);
        let [left_schema, right_schema] = [join.left.schema(), join.right.schema()];
        let (window_schema, probe_schema) = match join.window {
            WindowSide::Left => (left_schema, right_schema),
            WindowSide::Right => (right_schema, left_schema),
        };
        let plan_bound = |bound: &JoinBound<Expr>| {
            let expr = plan_key(&bound.expr, probe_schema)?;
            Ok::<_, DataFusionError>(JoinBound { expr, is_strict: bound.is_strict })
        };
        let keys = join.keys.iter().map(|(l, r)| Ok((plan_key(l, left_schema)?, plan_key(r, right_schema)?)));
        let merged = MergedJoin {
            keys: keys.collect::<Result<_>>()?,
            window: join.window,
            position: plan_key(&join.position, window_schema)?,
            order: join.order,
            first: plan_bound(&join.first)?,
            last: join.last.as_ref().map(plan_bound).transpose()?,
            matched: join.matched,
            join_type: join.join_type,
            filter: join.filter.as_ref().map(|filter| plan_expr(filter, &join.schema)).transpose()?,
        };
        Ok(Some(Arc::new(SortedJoinExec::try_new(left.clone(), right.clone(), Arc::new(merged), None)?)))
    }
}

// Comparisons take -0.0 for 0.0, and sorting does not: x + 0.0 is never -0.0, and every other x.
fn unify_zeros(expr: Arc<dyn PhysicalExpr>, schema: &DFSchema) -> Result<Arc<dyn PhysicalExpr>> {
    let zero = match expr.data_type(schema.as_arrow())? {
        DataType::Float32 => lit(0.0_f32),
        DataType::Float64 => lit(0.0_f64),
        _ => return Ok(expr),
    };
    Ok(Arc::new(BinaryExpr::new(expr, Operator::Plus, zero)))
}
