//! The end of a worker's tasks. A task is over when the call by which it was sent is: its engine holds that call open
//! for as long as the query runs. The library then forgets the task's plan, at a time that is its cache's to choose;
//! until that, operators that compute on threads of their own would go on. So the leaves and the head of each plan are
//! guarded.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::common::tree_node::TreeNodeRecursion;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::{RecordBatchStream, SendableRecordBatchStream, TaskContext};
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_plan::metrics::MetricsSet;
use datafusion::physical_plan::{
    ChildrenPropertiesMode, DisplayAs, DisplayFormatType, ExecutionPlan, PlanProperties, ReplaceChildrenOptions,
};
use datafusion_distributed::{WorkerPlanRewriteEvent, WorkerPlanRewriteEventResponse, WorkerPlanRewriteHandler};
use futures::{FutureExt as _, Stream, StreamExt as _};
use serde::{Deserialize, Serialize};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::codegen::http::{HeaderMap, HeaderValue};

/// The header by which a worker tells its tasks apart.
pub(super) const TASK_HEADER: &str = "x-echolake-task";

/// The error of rows that come after the end of their task.
pub(super) const OVER: &str = "the task's query is over";

/// Metrics of scans: bytes that they read of table files, and of run files.
const READ_BYTES: [&str; 2] = ["bytes_scanned", "bytes_read"];

/// Figures of a worker since its start. What a task read is counted when it is over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerFigures {
    /// Tasks that run now.
    pub running: u64,
    /// Tasks that are over.
    pub tasks: u64,
    /// Bytes of files that they read.
    pub read_bytes: u64,
    /// Requests to the object store of the whole process, for what its cache did not have.
    pub store_requests: u64,
}

impl WorkerFigures {
    // Counts a task that is over, by the leaves of its plan.
    fn add_task(&mut self, leaves: &[Arc<dyn ExecutionPlan>]) {
        self.tasks += 1;
        self.read_bytes += leaves.iter().map(count_read_bytes).sum::<u64>();
    }
}

fn count_read_bytes(leaf: &Arc<dyn ExecutionPlan>) -> u64 {
    let metrics = leaf.metrics().unwrap_or_default();
    READ_BYTES.iter().filter_map(|name| metrics.sum_by_name(name)).map(|value| value.as_usize() as u64).sum()
}

/// The tasks of a worker that are not over.
#[derive(Debug, Clone, Default)]
pub(super) struct SpreadTasks(Arc<OpenTasks>);

#[derive(Debug, Default)]
struct OpenTasks {
    last: AtomicU64,
    open: Mutex<HashMap<u64, Arc<OpenTask>>>,
    /// Figures of those that are over.
    figures: Mutex<WorkerFigures>,
    /// Those that are over, too, as long as they compute.
    computing: Mutex<Vec<Weak<TaskEnd>>>,
}

/// The end of a task, and the steps of its operators.
#[derive(Debug, Default)]
struct TaskEnd {
    over: CancellationToken,
    since: OnceLock<Instant>,
    /// Steps that run now.
    steps: AtomicUsize,
}

/// A step of an operator.
struct TaskStep<'a>(&'a TaskEnd);

impl TaskEnd {
    fn stop(&self) {
        let _ = self.since.set(Instant::now());
        self.over.cancel();
    }

    fn begin_step(&self) -> TaskStep<'_> {
        self.steps.fetch_add(1, Ordering::Relaxed);
        TaskStep(self)
    }

    // Time for which a step has gone on after the end.
    fn overdue_time(&self) -> Option<Duration> {
        let since = self.since.get()?;
        (self.steps.load(Ordering::Relaxed) > 0).then(|| since.elapsed())
    }
}

impl Drop for TaskStep<'_> {
    fn drop(&mut self) {
        self.0.steps.fetch_sub(1, Ordering::Relaxed);
    }
}

#[derive(Debug)]
struct OpenTask {
    end: Arc<TaskEnd>,
    /// The leaves of its plan, once that has come.
    leaves: Mutex<Vec<Arc<dyn ExecutionPlan>>>,
}

/// A task that is not over. Dropping it ends its work.
#[derive(Debug)]
pub(super) struct TaskLease {
    number: u64,
    task: Arc<OpenTask>,
    tasks: SpreadTasks,
}

impl SpreadTasks {
    /// Begins a task, whose request is then passed on with [`TaskLease::header_value`] as [`TASK_HEADER`].
    pub fn begin_task(&self) -> TaskLease {
        let number = self.0.last.fetch_add(1, Ordering::Relaxed) + 1;
        let task = Arc::new(OpenTask { end: Arc::default(), leaves: Mutex::default() });
        self.open_tasks().insert(number, task.clone());
        let mut computing = self.0.computing.lock().unwrap_or_else(PoisonError::into_inner);
        computing.retain(|end| end.strong_count() > 0);
        computing.push(Arc::downgrade(&task.end));
        drop(computing);
        TaskLease { number, task, tasks: self.clone() }
    }

    /// Returns the number of tasks that are not over.
    pub fn count_open(&self) -> usize {
        self.open_tasks().len()
    }

    /// Returns the figures of all tasks so far.
    pub fn figures(&self) -> WorkerFigures {
        let running = self.count_open() as u64;
        let counted = *self.0.figures.lock().unwrap_or_else(PoisonError::into_inner);
        WorkerFigures { running, ..counted }
    }

    /// Returns the longest time for which one step of a task has gone on after the task was over; None if none does.
    pub fn longest_overdue(&self) -> Option<Duration> {
        let computing = self.0.computing.lock().unwrap_or_else(PoisonError::into_inner);
        computing.iter().filter_map(|end| end.upgrade()?.overdue_time()).max()
    }

    /// Returns the guard of the task that a request belongs to.
    pub fn find_guard(&self, headers: &HeaderMap) -> Option<TaskGuard> {
        let number: u64 = headers.get(TASK_HEADER)?.to_str().ok()?.parse().ok()?;
        self.open_tasks().get(&number).cloned().map(TaskGuard)
    }

    fn open_tasks(&self) -> MutexGuard<'_, HashMap<u64, Arc<OpenTask>>> {
        self.0.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl TaskLease {
    /// Returns the value of [`TASK_HEADER`].
    pub fn header_value(&self) -> HeaderValue {
        HeaderValue::from(self.number)
    }
}

impl Drop for TaskLease {
    fn drop(&mut self) {
        self.task.end.stop();
        self.tasks.open_tasks().remove(&self.number);
        let leaves = std::mem::take(&mut *self.task.leaves.lock().unwrap_or_else(PoisonError::into_inner));
        self.tasks.0.figures.lock().unwrap_or_else(PoisonError::into_inner).add_task(&leaves);
    }
}

/// Guards a task's plan.
pub(super) struct TaskGuard(Arc<OpenTask>);

impl WorkerPlanRewriteHandler for TaskGuard {
    fn rewrite_worker_plan(&self, event: WorkerPlanRewriteEvent<'_>) -> Result<WorkerPlanRewriteEventResponse> {
        Ok(WorkerPlanRewriteEventResponse::new(self.guard_plan(event.plan, 0)?))
    }
}

impl TaskGuard {
    // The library replaces some heads by others, so that what is below is guarded as well.
    fn guard_plan(&self, plan: Arc<dyn ExecutionPlan>, depth: usize) -> Result<Arc<dyn ExecutionPlan>> {
        let children: Vec<_> = plan.children().into_iter().cloned().collect();
        let is_leaf = children.is_empty();
        let mut guarded = plan;
        if is_leaf {
            self.0.leaves.lock().unwrap_or_else(PoisonError::into_inner).push(guarded.clone());
        } else {
            let children =
                children.into_iter().map(|child| self.guard_plan(child, depth + 1)).collect::<Result<_>>()?;
            let options = ReplaceChildrenOptions::new(ChildrenPropertiesMode::Recompute);
            guarded = guarded.replace_children(children, options)?;
        }
        if is_leaf || depth < 2 {
            guarded = Arc::new(GuardedExec { inner: guarded, end: self.0.end.clone() });
        }
        Ok(guarded)
    }
}

/// An operator whose rows end in an error when its task is over. It passes for the operator itself.
#[derive(Debug)]
struct GuardedExec {
    inner: Arc<dyn ExecutionPlan>,
    end: Arc<TaskEnd>,
}

impl DisplayAs for GuardedExec {
    fn fmt_as(&self, format: DisplayFormatType, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.inner.fmt_as(format, f)
    }
}

impl ExecutionPlan for GuardedExec {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn downcast_delegate(&self) -> Option<&dyn ExecutionPlan> {
        Some(self.inner.as_ref())
    }

    fn properties(&self) -> &Arc<PlanProperties> {
        self.inner.properties()
    }

    fn maintains_input_order(&self) -> Vec<bool> {
        self.inner.maintains_input_order()
    }

    fn children(&self) -> Vec<&Arc<dyn ExecutionPlan>> {
        self.inner.children()
    }

    fn apply_expressions(
        &self,
        visit: &mut dyn FnMut(&Arc<dyn PhysicalExpr>) -> Result<TreeNodeRecursion>,
    ) -> Result<TreeNodeRecursion> {
        self.inner.apply_expressions(visit)
    }

    fn replace_children(
        self: Arc<Self>,
        children: Vec<Arc<dyn ExecutionPlan>>,
        options: ReplaceChildrenOptions,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let inner = self.inner.clone().replace_children(children, options)?;
        Ok(Arc::new(Self { inner, end: self.end.clone() }))
    }

    fn with_new_children(self: Arc<Self>, children: Vec<Arc<dyn ExecutionPlan>>) -> Result<Arc<dyn ExecutionPlan>> {
        self.replace_children(children, ReplaceChildrenOptions::new(ChildrenPropertiesMode::Recompute))
    }

    fn execute(&self, partition: usize, context: Arc<TaskContext>) -> Result<SendableRecordBatchStream> {
        let inner = self.inner.execute(partition, context)?;
        let over = Box::pin(self.end.over.clone().cancelled_owned());
        Ok(Box::pin(GuardedStream { schema: inner.schema(), inner: Some(inner), over, end: self.end.clone() }))
    }

    fn metrics(&self) -> Option<MetricsSet> {
        self.inner.metrics()
    }
}

struct GuardedStream {
    schema: SchemaRef,
    /// None after its task is over.
    inner: Option<SendableRecordBatchStream>,
    over: Pin<Box<WaitForCancellationFutureOwned>>,
    end: Arc<TaskEnd>,
}

impl Stream for GuardedStream {
    type Item = Result<RecordBatch>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let end = self.end.clone();
        let Some(inner) = &mut self.inner else { return Poll::Ready(None) };
        let step = end.begin_step();
        let next = inner.poll_next_unpin(context);
        drop(step);
        // An end that comes too early would look like an end of the rows.
        if !matches!(next, Poll::Ready(None)) && self.over.poll_unpin(context).is_ready() {
            self.inner = None;
            return Poll::Ready(Some(Err(DataFusionError::Execution(OVER.to_owned()))));
        }
        next
    }
}

impl RecordBatchStream for GuardedStream {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }
}

#[cfg(test)]
mod tests {
    use datafusion::prelude::SessionContext;

    use super::*;

    #[tokio::test]
    async fn a_plan_ends_with_its_task() {
        let tasks = SpreadTasks::default();
        let lease = tasks.begin_task();
        let headers =
            HeaderMap::from_iter([(tonic::codegen::http::HeaderName::from_static(TASK_HEADER), lease.header_value())]);
        let guard = tasks.find_guard(&headers).expect("a task");
        assert!(tasks.find_guard(&HeaderMap::new()).is_none());
        let context = SessionContext::new();
        let sql = "select value % 3, count(*) from generate_series(1, 100000000000) group by 1";
        let plan = context.sql(sql).await.expect("a query").create_physical_plan().await.expect("a plan");
        let guarded = guard.guard_plan(plan.clone(), 0).expect("guarded");
        assert_eq!(guarded.schema(), plan.schema());
        let mut rows = datafusion::physical_plan::execute_stream(guarded, context.task_ctx()).expect("rows");
        assert_eq!(tasks.count_open(), 1);
        let ending = tokio::spawn(async move { rows.next().await });
        drop(lease);
        let end = tokio::time::timeout(Duration::from_secs(60), ending).await.expect("in time");
        let error = end.expect("no panic").expect("an error, not an end").expect_err("it is over");
        assert!(error.to_string().contains(OVER), "{error}");
        assert_eq!((tasks.count_open(), tasks.find_guard(&headers).is_none()), (0, true));
        assert_eq!(tasks.figures(), WorkerFigures { tasks: 1, ..WorkerFigures::default() }, "it read no file");
        let begun = std::time::Instant::now();
        while tasks.longest_overdue().is_some() {
            assert!(begun.elapsed() < Duration::from_secs(60), "the operators' threads go on");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        // A step that goes on is found.
        let step = guard.0.end.begin_step();
        assert!(tasks.longest_overdue().is_some());
        drop(step);
        assert_eq!(tasks.longest_overdue(), None);
    }
}
