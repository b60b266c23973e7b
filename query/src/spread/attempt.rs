//! The order in which a query is tried: on the workers, once more on those that are left, and in the engine itself. Only
//! what has sent no row is tried again.

use std::fmt;
use std::sync::Arc;

use datafusion::common::display::PlanType;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::TaskContext;
use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::{Explain, LogicalPlan};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::explain::ExplainExec;
use datafusion_distributed::display_plan_ascii;
use url::Url;

use super::WorkerLoss;
use super::cluster::SharedCluster;
use super::decision::{SpreadDecision, mebibytes};
use super::planner::SpreadPlan;

/// Makes the context of a plan of this state: with the query's own memory.
pub(crate) type ContextMaker = Box<dyn Fn(&SessionState) -> Arc<TaskContext> + Send + Sync>;

/// One way to run a query.
pub(crate) struct QueryAttempt {
    pub(crate) plan: Arc<dyn ExecutionPlan>,
    pub(crate) context: Arc<TaskContext>,
    is_spread: bool,
}

/// The ways to run a query that are left.
pub(crate) struct QueryAttempts {
    local: Option<QueryAttempt>,
    spread: Option<SpreadQuery>,
    /// Attempts on workers so far.
    spread_count: usize,
}

/// Everything that a plan for workers is made of.
pub(crate) struct SpreadQuery {
    pub(crate) cluster: SharedCluster,
    pub(crate) state: SessionState,
    pub(crate) query: LogicalPlan,
    /// Bytes that each task may hold.
    pub(crate) memory: usize,
    pub(crate) contexts: ContextMaker,
}

/// Attempts on workers before the engine runs the query itself.
const SPREAD_ATTEMPTS: usize = 2;

impl QueryAttempts {
    /// `local` runs the query in the engine; before that, `spread` is tried.
    pub(crate) fn new(local: Arc<dyn ExecutionPlan>, context: Arc<TaskContext>, spread: Option<SpreadQuery>) -> Self {
        Self { local: Some(QueryAttempt { plan: local, context, is_spread: false }), spread, spread_count: 0 }
    }

    /// Returns the first attempt; None if there was one.
    pub(crate) async fn first(&mut self) -> Option<QueryAttempt> {
        let workers = match &self.spread {
            Some(spread) => spread.cluster.usable_workers().await,
            None => Vec::new(),
        };
        match self.plan_spread(workers).await {
            Some(attempt) => Some(attempt),
            None => self.local.take(),
        }
    }

    /// Returns the attempt after one that failed; None if its error is the query's.
    pub(crate) async fn after(&mut self, failed: &QueryAttempt, error: &DataFusionError) -> Option<QueryAttempt> {
        if !failed.is_spread {
            return None;
        }
        let spread = self.spread.as_ref()?;
        let Some(loss) = WorkerLoss::find(error) else {
            // The engine finds out if the query is to blame: then its own error is what the client gets.
            tracing::debug!(%error, "a query failed on workers, and is run here");
            spread.cluster.count(|counts| counts.returned += 1);
            return self.local.take();
        };
        tracing::warn!(lost = loss.message(), "a query lost a worker before its first row, and is run again");
        let workers = match self.spread_count < SPREAD_ATTEMPTS {
            true => spread.cluster.remaining_workers().await,
            false => Vec::new(),
        };
        let cluster = spread.cluster.clone();
        match self.plan_spread(workers).await {
            Some(attempt) => {
                cluster.count(|counts| counts.repeated += 1);
                Some(attempt)
            }
            None => {
                cluster.count(|counts| counts.returned += 1);
                self.local.take()
            }
        }
    }

    async fn plan_spread(&mut self, workers: Vec<Url>) -> Option<QueryAttempt> {
        let spread = self.spread.as_ref().filter(|_| !workers.is_empty())?;
        match SpreadPlan::new(&spread.cluster, workers, &spread.state, &spread.query, spread.memory).await {
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

impl QueryAttempt {
    /// Returns the error of this attempt as it is passed on: that a worker was lost, if one was.
    pub(crate) fn final_error(&self, error: DataFusionError) -> DataFusionError {
        match WorkerLoss::find(&error).filter(|_| self.is_spread) {
            Some(loss) => loss.into(),
            None => error,
        }
    }

    /// Returns whether its batches may lack metadata of the plan's columns: what a function returns loses it on its way.
    pub(crate) fn is_spread(&self) -> bool {
        self.is_spread
    }
}

impl fmt::Debug for QueryAttempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("QueryAttempt").field("is_spread", &self.is_spread).finish_non_exhaustive()
    }
}

/// Adds to the physical plan of an EXPLAIN if the query is spread, and why not.
///
/// # Errors
/// If the query cannot be planned.
pub(crate) async fn explain_spread(
    cluster: &SharedCluster,
    state: &SessionState,
    explain: &Explain,
    plan: Arc<dyn ExecutionPlan>,
) -> Result<Arc<dyn ExecutionPlan>> {
    let Some(explained) = plan.downcast_ref::<ExplainExec>() else { return Ok(plan) };
    let local = state.create_physical_plan(&explain.plan).await?;
    let note = spread_note(cluster, state, &explain.plan, &local).await?;
    let mut texts = explained.stringified_plans().to_vec();
    if let Some(text) = texts.iter_mut().rfind(|text| text.plan_type == PlanType::FinalPhysicalPlan) {
        text.plan = Arc::new(format!("{}\n{note}\n", text.plan.trim_end()));
    }
    Ok(Arc::new(ExplainExec::new(plan.schema(), texts, explained.verbose())))
}

async fn spread_note(
    cluster: &SharedCluster,
    state: &SessionState,
    query: &LogicalPlan,
    local: &Arc<dyn ExecutionPlan>,
) -> Result<String> {
    let bytes = match SpreadDecision::of_plan(local, cluster.least_bytes())? {
        SpreadDecision::Local { reason } => return Ok(format!("not spread over workers: {reason}")),
        SpreadDecision::Spread { bytes } => bytes,
    };
    let workers = cluster.usable_workers().await;
    let (count, size) = (workers.len(), cluster.size());
    if count == 0 {
        return Ok(format!("not spread over workers: none of {size} answers"));
    }
    let plan = match SpreadPlan::new(cluster, workers, state, query, usize::MAX).await {
        Ok(Some(spread)) => display_plan_ascii(spread.plan.as_ref(), false),
        Ok(None) => return Ok("not spread over workers: no part of it can run apart".to_owned()),
        Err(error) => return Ok(format!("not spread over workers: {}", error.strip_backtrace())),
    };
    Ok(format!("spread over {count} of {size} workers: it reads about {} MiB\n{plan}", mebibytes(bytes)))
}
