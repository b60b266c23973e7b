//! The plan of a query for workers.

use std::sync::Arc;

use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::session_state::{SessionState, SessionStateBuilder};
use datafusion::logical_expr::LogicalPlan;
use datafusion::physical_plan::ExecutionPlan;
use datafusion_distributed::{DistributedExec, DistributedExt as _, SessionStateBuilderExt as _};
use tonic::codegen::http::{HeaderMap, HeaderValue};
use url::Url;

use super::MEMORY_HEADER;
use super::affinity::QueryWorkers;
use super::cluster::WorkerCluster;
use crate::mcap::McapCodec;

/// A plan whose stages run on workers, with the state that it runs under.
pub(super) struct SpreadPlan {
    pub(super) plan: Arc<dyn ExecutionPlan>,
    pub(super) state: SessionState,
}

impl SpreadPlan {
    /// Plans a query for these workers, whose tasks may hold `memory` bytes each; None if nothing of it runs apart.
    ///
    /// # Errors
    /// If it cannot be planned so.
    pub(super) async fn new(
        cluster: &WorkerCluster,
        workers: Vec<Url>,
        state: &SessionState,
        query: &LogicalPlan,
        memory: usize,
    ) -> Result<Option<Self>> {
        let workers = QueryWorkers::new(workers, cluster.least_bytes() == 0);
        let state = SessionStateBuilder::new_from_existing(state.clone())
            .with_distributed_worker_resolver(workers.clone())
            .with_distributed_user_codec(McapCodec::encoder())
            .with_distributed_channel_resolver(cluster.channels().clone())
            .with_distributed_desired_task_count_handler(workers.clone())
            .with_distributed_scale_up_leaf_node_handler(workers.clone())
            .with_distributed_route_tasks_handler(workers)
            .with_distributed_passthrough_headers(headers(memory)?)?
            .with_distributed_planner()
            .build();
        let plan = state.create_physical_plan(query).await?;
        Ok(has_stages(&plan)?.then_some(Self { plan, state }))
    }
}

fn headers(memory: usize) -> Result<HeaderMap> {
    let mut headers = HeaderMap::new();
    if memory < usize::MAX {
        let value = HeaderValue::from_str(&memory.to_string()).map_err(|e| DataFusionError::External(Box::new(e)))?;
        headers.insert(MEMORY_HEADER, value);
    }
    Ok(headers)
}

fn has_stages(plan: &Arc<dyn ExecutionPlan>) -> Result<bool> {
    let mut found = false;
    plan.apply(|node| {
        found = node.downcast_ref::<DistributedExec>().is_some();
        Ok(if found { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
    })?;
    Ok(found)
}
