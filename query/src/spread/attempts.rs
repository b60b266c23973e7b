//! The order in which a query is tried: on the workers, once more on those that remain, and in the engine itself. Once
//! rows have been sent, a query is not retried.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use datafusion::common::display::PlanType;
use datafusion::common::format::ExplainFormat;
use datafusion::common::tree_node::TreeNode as _;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::session_state::{SessionState, SessionStateBuilder};
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
use datafusion::logical_expr::LogicalPlan;
use datafusion::physical_plan::explain::ExplainExec;
use datafusion::physical_plan::stream::RecordBatchStreamAdapter;
use datafusion::physical_plan::{ExecutionPlan, execute_stream};
use datafusion_distributed::{DistributedExec, DistributedExt as _, SessionStateBuilderExt as _, display_plan_ascii};
use futures::{Stream, StreamExt as _, stream};
use url::Url;

use super::affinity::QueryWorkers;
use super::cluster::WorkerCluster;
use super::decision::{SpreadDecision, mebibytes};
use super::loss::WorkerLoss;
use super::options::TaskOptions;
use crate::QueryEngine;
use crate::plan_transport::{McapCodec, check_transport};

/// Attempts on workers before the engine runs the query itself.
const SPREAD_ATTEMPTS: usize = 2;

/// Makes the context of a plan of this state: with the query's own memory.
pub(crate) type ContextMaker = Box<dyn Fn(&SessionState) -> Arc<TaskContext> + Send + Sync>;

/// The ways to run a query that are left.
pub(crate) struct QueryAttempts {
    schema: SchemaRef,
    local: Option<QueryAttempt>,
    spread: Option<SpreadQuery>,
    /// Attempts on workers so far.
    spread_count: usize,
}

/// One way to run a query.
struct QueryAttempt {
    plan: Arc<dyn ExecutionPlan>,
    context: Arc<TaskContext>,
    is_spread: bool,
}

/// All that a query is planned and decided from.
pub(crate) struct SpreadQuery {
    /// The workers.
    pub cluster: Arc<WorkerCluster>,
    /// The engine that runs it if workers do not, with the same functions and options as theirs.
    pub engine: QueryEngine,
    /// The state of this one.
    pub state: SessionState,
    /// The query.
    pub logical: LogicalPlan,
    /// True if the optimizer's rules were applied to it.
    pub is_optimized: bool,
    /// Bytes that each task may hold; None for no limit.
    pub memory: Option<usize>,
    /// Makes the context of a plan.
    pub contexts: ContextMaker,
}

/// A plan whose stages run on workers, with the state that it runs under.
struct SpreadPlan {
    plan: Arc<dyn ExecutionPlan>,
    state: SessionState,
}

impl QueryAttempts {
    /// Returns the attempts at a query: `local` runs it in the engine, and before that `spread`, if there are workers,
    /// is tried. An EXPLAIN gets the decision added to its text.
    ///
    /// # Errors
    /// If the query cannot be planned.
    pub async fn plan_query(
        local: Arc<dyn ExecutionPlan>,
        context: Arc<TaskContext>,
        spread: Option<SpreadQuery>,
    ) -> Result<Self> {
        let mut plan = local;
        let mut attempt = None;
        if let Some(query) = spread {
            if matches!(query.logical, LogicalPlan::Explain(_)) {
                plan = query.add_decision(plan).await?;
            } else if let SpreadDecision::Spread(_) = query.decide(&plan)? {
                attempt = Some(query);
            }
        }
        let schema = plan.schema();
        Ok(Self {
            schema,
            local: Some(QueryAttempt { plan, context, is_spread: false }),
            spread: attempt,
            spread_count: 0,
        })
    }

    /// Replaces what the engine itself runs, once workers were decided about.
    ///
    /// # Errors
    /// Those of `rewrite`.
    pub fn rewrite_local(
        &mut self,
        rewrite: impl FnOnce(Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>>,
    ) -> Result<()> {
        if let Some(local) = &mut self.local {
            local.plan = rewrite(local.plan.clone())?;
        }
        Ok(())
    }

    /// Returns the columns of the answer.
    pub fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    /// Runs the query when its rows are asked for.
    pub fn into_batches(self) -> impl Stream<Item = Result<RecordBatch>> + Send {
        let run = QueryRun { attempts: self, current: None, has_sent: false, is_done: false };
        stream::unfold(run, |mut run| async move { Some((run.next_batch().await?, run)) })
    }

    async fn first_attempt(&mut self) -> Option<QueryAttempt> {
        let workers = match &self.spread {
            Some(spread) => spread.cluster.usable_workers().await,
            None => Vec::new(),
        };
        match self.plan_attempt(workers).await {
            Some(attempt) => Some(attempt),
            None => self.local.take(),
        }
    }

    // None if the error of the failed one is the query's.
    async fn attempt_after(&mut self, failed: &QueryAttempt, error: &DataFusionError) -> Option<QueryAttempt> {
        let cluster = self.spread.as_ref().filter(|_| failed.is_spread)?.cluster.clone();
        let Some(loss) = WorkerLoss::find_in(error) else {
            // The engine finds out if the query is to blame: then its own error is what the client gets.
            tracing::debug!(%error, "a query failed on workers, and is run here");
            cluster.count(|counts| counts.returned += 1);
            return self.local.take();
        };
        tracing::warn!(lost = loss.message(), "a query lost a worker before its first row, and is run again");
        let workers = match self.spread_count < SPREAD_ATTEMPTS {
            true => cluster.remaining_workers().await,
            false => Vec::new(),
        };
        let repeated = self.plan_attempt(workers).await;
        cluster.count(|counts| match repeated {
            Some(_) => counts.repeated += 1,
            None => counts.returned += 1,
        });
        repeated.or_else(|| self.local.take())
    }

    async fn plan_attempt(&mut self, workers: Vec<Url>) -> Option<QueryAttempt> {
        let spread = self.spread.as_ref().filter(|_| !workers.is_empty())?;
        match spread.plan_stages(workers, &spread.logical).await {
            Ok(Some(SpreadPlan { plan, state })) => {
                if self.spread_count == 0 {
                    spread.cluster.count(|counts| counts.spread += 1);
                }
                self.spread_count += 1;
                Some(QueryAttempt { plan, context: (spread.contexts)(&state), is_spread: true })
            }
            Ok(None) => None,
            Err(error) => {
                tracing::debug!(%error, "a query cannot be planned for workers, and is run here");
                None
            }
        }
    }
}

impl SpreadQuery {
    fn decide(&self, local: &Arc<dyn ExecutionPlan>) -> Result<SpreadDecision> {
        let decision = SpreadDecision::from_plan(local, self.cluster.least_bytes())?;
        if let SpreadDecision::Spread(_) = decision
            && let Err(reason) = self.task_options()
        {
            return Ok(SpreadDecision::Local(reason));
        }
        if let SpreadDecision::Spread(_) = decision
            && let Err(error) = check_transport(local, &self.engine.worker_state())
        {
            return Ok(SpreadDecision::Local(format!("it cannot be sent: {}", error.strip_backtrace())));
        }
        Ok(decision)
    }

    // The error is the reason for which workers cannot run it.
    fn task_options(&self) -> std::result::Result<TaskOptions, String> {
        TaskOptions::from_session(
            self.engine.template_state().config_options(),
            self.state.config_options(),
            self.memory,
        )
    }

    // None if no part of it can run apart.
    async fn plan_stages(&self, workers: Vec<Url>, logical: &LogicalPlan) -> Result<Option<SpreadPlan>> {
        let options = self.task_options().map_err(DataFusionError::Plan)?;
        let workers = QueryWorkers::new(workers, self.cluster.least_bytes() == 0);
        let state = SessionStateBuilder::new_from_existing(self.state.clone())
            .with_distributed_option_extension(options)
            .with_distributed_worker_resolver(workers.clone())
            .with_distributed_channel_resolver(self.cluster.channels().clone())
            .with_distributed_user_codec(McapCodec::default())
            .with_distributed_desired_task_count_handler(workers.clone())
            .with_distributed_scale_up_leaf_node_handler(workers.clone())
            .with_distributed_route_tasks_handler(workers)
            .with_distributed_planner()
            .build();
        let plan = self.plan_physical(&state, logical).await?;
        let has_stages = plan.exists(|node| Ok(node.downcast_ref::<DistributedExec>().is_some()))?;
        Ok(has_stages.then_some(SpreadPlan { plan, state }))
    }

    // The planner for workers has other rules of the optimizer than that of one machine.
    async fn plan_physical(&self, state: &SessionState, logical: &LogicalPlan) -> Result<Arc<dyn ExecutionPlan>> {
        match self.is_optimized {
            true => state.query_planner().create_physical_plan(logical, state).await,
            false => state.create_physical_plan(logical).await,
        }
    }

    // Adds to the physical plan of an EXPLAIN whether the query is spread, and why not.
    async fn add_decision(&self, plan: Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>> {
        let (Some(explained), LogicalPlan::Explain(explain)) = (plan.downcast_ref::<ExplainExec>(), &self.logical)
        else {
            return Ok(plan);
        };
        // The other formats are for programs.
        if !matches!(explain.explain_format, ExplainFormat::Indent | ExplainFormat::Tree) {
            return Ok(plan);
        }
        let note = self.describe_decision(&explain.plan).await?;
        let mut texts = explained.stringified_plans().to_vec();
        if let Some(text) = texts.iter_mut().rfind(|text| text.plan_type == PlanType::FinalPhysicalPlan) {
            text.plan = Arc::new(format!("{}\n{note}\n", text.plan.trim_end()));
        }
        Ok(Arc::new(ExplainExec::new(plan.schema(), texts, explained.verbose())))
    }

    async fn describe_decision(&self, logical: &LogicalPlan) -> Result<String> {
        let local = self.plan_physical(&self.state, logical).await?;
        let bytes = match self.decide(&local)? {
            SpreadDecision::Local(reason) => return Ok(format!("not spread over workers: {reason}")),
            SpreadDecision::Spread(bytes) => bytes,
        };
        let workers = self.cluster.usable_workers().await;
        let count = workers.len();
        let size = self.cluster.size();
        if count == 0 {
            return Ok(format!("not spread over workers: none of {size} answers"));
        }
        let plan = match self.plan_stages(workers, logical).await {
            Ok(Some(spread)) => display_plan_ascii(spread.plan.as_ref(), false),
            Ok(None) => return Ok("not spread over workers: no part of it can run apart".to_owned()),
            Err(error) => return Ok(format!("not spread over workers: {}", error.strip_backtrace())),
        };
        let read = mebibytes(bytes);
        Ok(format!("spread over {count} of {size} workers: it reads about {read} MiB\n{plan}"))
    }
}

/// A query that runs.
struct QueryRun {
    attempts: QueryAttempts,
    current: Option<(QueryAttempt, SendableRecordBatchStream)>,
    /// True if batches were passed on.
    has_sent: bool,
    is_done: bool,
}

impl QueryRun {
    async fn next_batch(&mut self) -> Option<Result<RecordBatch>> {
        if self.is_done {
            return None;
        }
        if self.current.is_none() {
            self.current = self.attempts.first_attempt().await.map(QueryAttempt::start);
        }
        while let Some((attempt, batches)) = &mut self.current {
            let batch = batches.next().await;
            match batch.map(|batch| batch.and_then(|batch| attempt.restore_schema(batch, &self.attempts.schema))) {
                Some(Err(error)) if !self.has_sent => {
                    let (failed, batches) = self.current.take()?;
                    // Its tasks end before the next attempt begins.
                    drop(batches);
                    self.current = self.attempts.attempt_after(&failed, &error).await.map(QueryAttempt::start);
                    if self.current.is_none() {
                        self.is_done = true;
                        return Some(Err(failed.final_error(error)));
                    }
                }
                Some(Err(error)) => {
                    self.is_done = true;
                    return Some(Err(attempt.final_error(error)));
                }
                Some(Ok(batch)) => {
                    self.has_sent = true;
                    return Some(Ok(batch));
                }
                None => {
                    self.is_done = true;
                    return None;
                }
            }
        }
        None
    }
}

impl QueryAttempt {
    fn start(self) -> (Self, SendableRecordBatchStream) {
        let batches = execute_stream(self.plan.clone(), self.context.clone()).unwrap_or_else(|error| {
            let failed = stream::iter([Err(error)]);
            Box::pin(RecordBatchStreamAdapter::new(self.plan.schema(), failed))
        });
        (self, batches)
    }

    // What a function returns loses its unit between machines.
    fn restore_schema(&self, batch: RecordBatch, schema: &SchemaRef) -> Result<RecordBatch> {
        if !self.is_spread {
            return Ok(batch);
        }
        let options = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
        Ok(RecordBatch::try_new_with_options(schema.clone(), batch.columns().to_vec(), &options)?)
    }

    // That a worker was lost, if one was.
    fn final_error(&self, error: DataFusionError) -> DataFusionError {
        match WorkerLoss::find_in(&error).filter(|_| self.is_spread) {
            Some(loss) => loss.into(),
            None => error,
        }
    }
}
