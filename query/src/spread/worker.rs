//! A worker: it runs the stages that engines send it, with the functions of its own engine and a store that only reads.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use axum::Router;
use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::datasource::sink::DataSinkExec;
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::FunctionRegistry as _;
use datafusion::execution::session_state::{SessionState, SessionStateBuilder};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::prelude::SessionConfig;
use datafusion_distributed::{
    DistributedExt as _, Worker, WorkerPlanRewriteEvent, WorkerPlanRewriteEventResponse, WorkerPlanRewriteHandler,
    WorkerQueryContext, WorkerSessionBuilder,
};
use echolake_lake::Lake;
use tonic::service::Routes;

use super::calls::WorkerCalls;
use super::channels::WorkerChannels;
use super::decision::{find_file_scan, has_own_rows};
use super::options::TaskOptions;
use super::tasks::SpreadTasks;
use super::{WorkerFigures, WorkerIdentity, WorkerLink};
use crate::control::pool::PartialPool;
use crate::control::threads::QueryThreads;
use crate::engine::STORE;
use crate::plan_transport::McapCodec;
use crate::{Error, QueryEngine};

/// A worker of the engines of other servers of the same lake.
///
/// Any plan that comes with the token is run, so the token is for those servers. A plan finds a store that only reads,
/// and nothing else.
pub struct WorkerService {
    worker: Worker,
    calls: WorkerCalls,
    tasks: SpreadTasks,
    lake: Lake,
}

impl WorkerService {
    /// Makes a worker of this build, all of whose tasks together may hold `memory` bytes; `link` is its own, and to the
    /// other workers that a stage reads from.
    ///
    /// # Errors
    /// [`Error::Execution`] if the engine cannot be set up, [`Error::Lake`] if the lake cannot be read.
    pub async fn start(lake: &Lake, memory: Option<usize>, build: &str, link: &WorkerLink) -> Result<Self, Error> {
        let engine = QueryEngine::new(lake, memory)?;
        let failed = |e: std::io::Error| Error::failed_query(&format!("no threads for tasks of queries: {e}"));
        let threads = QueryThreads::per_core("worker").map_err(failed)?;
        let channels = WorkerChannels::new(link).map_err(|e| Error::failed_query(&e.to_string()))?;
        let identity = WorkerIdentity { build: build.to_owned(), lake: lake.snapshot().await?.tables_id().to_owned() };
        let tasks = SpreadTasks::default();
        let runtime = engine.template_state().runtime_env().clone();
        let sessions = TaskSessions { engine, channels, tasks: tasks.clone() };
        let worker = Worker::from_session_builder(sessions).with_runtime_env(runtime).with_version(identity.to_line());
        let calls = WorkerCalls::new(link.token.as_ref(), tasks.clone(), threads);
        Ok(Self { worker, calls, tasks, lake: lake.clone() })
    }

    /// Returns what finds out for how long one step of a task has gone on after the task was over; None if none does.
    pub fn overdue_watch(&self) -> impl Fn() -> Option<Duration> + Send + 'static {
        let tasks = self.tasks.clone();
        move || tasks.longest_overdue()
    }

    /// Returns the routes for a server of HTTP/2.
    pub fn into_router(self) -> Router {
        let Self { worker, calls, tasks, lake } = self;
        let routes = Routes::new(worker.into_worker_server()).into_axum_router();
        calls.complete_routes(routes, move || {
            let store_requests = lake.cache_counts().map_or(0, |counts| counts.requests);
            WorkerFigures { store_requests, ..tasks.figures() }
        })
    }
}

/// Makes the state of each task.
struct TaskSessions {
    engine: QueryEngine,
    channels: WorkerChannels,
    tasks: SpreadTasks,
}

#[async_trait]
impl WorkerSessionBuilder for TaskSessions {
    async fn build_session_state(&self, context: WorkerQueryContext) -> Result<SessionState, DataFusionError> {
        // A task that no call holds open would have no end.
        let guard = self.tasks.find_guard(&context.headers);
        let guard = guard.ok_or_else(|| DataFusionError::Execution("the task belongs to no call".to_owned()))?;
        let builder =
            context.builder.with_distributed_option_extension_from_headers::<TaskOptions>(&context.headers)?;
        let mut config = builder
            .with_distributed_channel_resolver(self.channels.clone())
            .with_distributed_user_codec(McapCodec { files: Some(self.engine.catalog().run_files().clone()) })
            .with_distributed_worker_plan_rewrite_handler(check_task_plan)
            .with_distributed_worker_plan_rewrite_handler(LocalScans(self.engine.clone()))
            .with_distributed_worker_plan_rewrite_handler(guard)
            .config()
            .take()
            .unwrap_or_default();
        let options = config.options().extensions.get::<TaskOptions>().cloned().unwrap_or_default();
        config.options_mut().execution = self.engine.template_state().config_options().execution.clone();
        options.apply_to(config.options_mut())?;
        build_task_state(&self.engine, config, options.memory_limit())
    }
}

/// Puts what the worker holds of the lake's files into a plan.
struct LocalScans(QueryEngine);

impl WorkerPlanRewriteHandler for LocalScans {
    fn rewrite_worker_plan(&self, event: WorkerPlanRewriteEvent<'_>) -> Result<WorkerPlanRewriteEventResponse> {
        Ok(WorkerPlanRewriteEventResponse::new(self.0.rewrite_local_scans(event.plan)?))
    }
}

// The state of a task: functions and store of the engine's queries, with the task's configuration; its operators may
// hold `memory` bytes.
fn build_task_state(engine: &QueryEngine, config: SessionConfig, memory: Option<usize>) -> Result<SessionState> {
    let known = engine.worker_state();
    let mut runtime = known.runtime_env().as_ref().clone();
    if let Some(limit) = memory {
        let pool = PartialPool::new(runtime.memory_pool, "the task holds", limit, Arc::default());
        runtime.memory_pool = Arc::new(pool);
    }
    let mut state = SessionStateBuilder::new_from_existing(known.clone())
        .with_config(config)
        .with_runtime_env(Arc::new(runtime))
        .build();
    // The builder registers functions in any order, so that one may have replaced another by an alias. Twice, because
    // this does, too.
    for _ in 0..2 {
        for (name, function) in known.scalar_functions() {
            if name == function.name()
                && !state.scalar_functions().get(name).is_some_and(|own| Arc::ptr_eq(own, function))
            {
                state.register_udf(function.clone())?;
            }
        }
        for (name, function) in known.aggregate_functions() {
            if name == function.name()
                && !state.aggregate_functions().get(name).is_some_and(|own| Arc::ptr_eq(own, function))
            {
                state.register_udaf(function.clone())?;
            }
        }
    }
    Ok(state)
}

// The store refuses to write and no other store is there; what would try is refused before it runs.
fn check_task_plan(event: WorkerPlanRewriteEvent<'_>) -> Result<WorkerPlanRewriteEventResponse> {
    event.plan.apply(|node| match find_foreign_part(node.as_ref()) {
        Some(part) => Err(DataFusionError::Execution(format!("a worker does not run {part}"))),
        None => Ok(TreeNodeRecursion::Continue),
    })?;
    Ok(WorkerPlanRewriteEventResponse::new(event.plan))
}

// Writing, and reading of anything but Parquet files of the lake and rows that are in the plan.
fn find_foreign_part(node: &dyn ExecutionPlan) -> Option<String> {
    if node.downcast_ref::<DataSinkExec>().is_some() {
        return Some("a plan that writes".to_owned());
    }
    node.downcast_ref::<DataSourceExec>()?;
    match find_file_scan(node) {
        Some(scan) if scan.object_store_url.as_str() != STORE => Some(format!("a scan of `{}`", scan.object_store_url)),
        None if !has_own_rows(node) => Some("a scan of other files".to_owned()),
        _ => None,
    }
}
