//! Two lanes: queries that answer at once, and those that need long or much, a few at a time.

use std::sync::Arc;
use std::time::Duration;

use arrow::datatypes::{DataType, Schema};
use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::physical_expr::ScalarFunctionExpr;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::joins::{
    CrossJoinExec, HashJoinExec, NestedLoopJoinExec, PiecewiseMergeJoinExec, SortMergeJoinExec,
};
use datafusion::physical_plan::recursive_query::RecursiveQueryExec;
use datafusion::physical_plan::sorts::sort::SortExec;
use datafusion::physical_plan::statistics::{StatisticsArgs, StatisticsContext};
use datafusion::physical_plan::unnest::UnnestExec;
use datafusion::physical_plan::windows::{BoundedWindowAggExec, WindowAggExec};
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Bytes of decoded columns up to which a scan is light: some numbers of each of a million measurements, or the
/// responses of some dozen surfaces.
const LIGHT_BYTES: usize = 256 << 20;
/// Rows up to which any operator is light.
const LIGHT_ROWS: usize = 5_000_000;
/// Rows up to which a sort of all of them is light.
const LIGHT_SORT: usize = 1_000_000;
/// Rows up to which work is light that may take long for each: windows, lists taken apart, texts compared.
const LIGHT_SLOW: usize = 100_000;
/// Pairs of rows up to which a join that compares each row with each is light.
const LIGHT_PAIRS: usize = 20_000_000;
/// The same of a join by keys, which compares only what falls together.
const LIGHT_KEYED: usize = 20_000_000_000;
/// Bytes of a text, where nothing is known of it.
const TEXT_BYTES: usize = 24;
/// Elements of a list, where nothing is known of it: a response's.
const LIST_LENGTH: usize = 384;
/// Functions that may take long for one row.
const SLOW: [&str; 5] = ["levenshtein", "regexp_replace", "regexp_match", "regexp_like", "regexp_count"];
/// Light queries that run at once.
const LIGHT_AT_ONCE: usize = 64;
/// Stack of a thread that plans and runs: queries may nest deeply.
const STACK: usize = 8 << 20;

/// Where a query runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lane {
    /// Beside all others.
    Light,
    /// A few at a time.
    Heavy,
}

/// Threads and places of both lanes.
pub(crate) struct Lanes {
    light: Threads,
    heavy: Threads,
    light_places: Arc<Semaphore>,
    heavy_places: Arc<Semaphore>,
}

/// A runtime that may be dropped anywhere.
pub struct Threads(Option<Runtime>);

impl Threads {
    /// `count` threads of a name.
    ///
    /// # Errors
    /// Where the system gives no threads.
    pub fn new(name: &str, count: usize) -> std::io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(count)
            .thread_name(name)
            .thread_stack_size(STACK)
            .max_blocking_threads(16)
            .thread_keep_alive(Duration::from_secs(60))
            .enable_all()
            .build()?;
        Ok(Self(Some(runtime)))
    }

    /// One thread a core.
    ///
    /// # Errors
    /// As [`Threads::new`].
    pub fn per_core(name: &str) -> std::io::Result<Self> {
        Self::new(name, std::thread::available_parallelism().map_or(1, usize::from))
    }

    /// Where work is given to them; None while they end.
    pub fn handle(&self) -> Option<&Handle> {
        self.0.as_ref().map(Runtime::handle)
    }
}

impl Drop for Threads {
    // A runtime's own drop waits for its threads, which asynchronous code must not.
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}

impl Lanes {
    /// Lanes for this machine's cores, with `heavy` heavy queries at once.
    ///
    /// # Errors
    /// Where the system gives no threads.
    pub(crate) fn new(heavy: usize) -> std::io::Result<Self> {
        Ok(Self {
            light: Threads::per_core("query")?,
            heavy: Threads::per_core("query-heavy")?,
            light_places: Arc::new(Semaphore::new(LIGHT_AT_ONCE)),
            heavy_places: Arc::new(Semaphore::new(heavy)),
        })
    }

    /// Threads of a lane; those of the light one plan, too.
    pub(crate) fn threads(&self, lane: Lane) -> Option<&Handle> {
        match lane {
            Lane::Light => self.light.handle(),
            Lane::Heavy => self.heavy.handle(),
        }
    }

    /// A place in a lane, when there is one.
    pub(crate) async fn place(&self, lane: Lane) -> Option<OwnedSemaphorePermit> {
        let places = match lane {
            Lane::Light => &self.light_places,
            Lane::Heavy => &self.heavy_places,
        };
        places.clone().acquire_owned().await.ok()
    }
}

impl Lane {
    /// Where a plan belongs: light is what surely ends soon, by what its operators are given. What nothing is known of
    /// is heavy.
    pub(crate) fn of(plan: &Arc<dyn ExecutionPlan>) -> Self {
        if is_light(plan).unwrap_or(false) { Self::Light } else { Self::Heavy }
    }
}

// The walk keeps its own stack: plans may be deeper than a thread's. None where something is not known.
fn is_light(plan: &Arc<dyn ExecutionPlan>) -> Option<bool> {
    let statistics = StatisticsContext::new();
    let rows = |node: &Arc<dyn ExecutionPlan>| {
        statistics.compute(node.as_ref(), &StatisticsArgs::new()).ok()?.num_rows.get_value().copied()
    };
    let mut bytes = 0_usize;
    let mut next = vec![plan];
    while let Some(node) = next.pop() {
        if node.children().is_empty() {
            let own = rows(node)?;
            bytes = bytes.saturating_add(own.saturating_mul(row_bytes(&node.schema())));
            if own > LIGHT_ROWS || bytes > LIGHT_BYTES {
                return Some(false);
            }
        }
        if node.is::<RecursiveQueryExec>() {
            return Some(false);
        }
        let most = most_rows(node);
        let given: Option<Vec<_>> = node.children().into_iter().map(rows).collect();
        if let Some(most) = most
            && given?.into_iter().fold(1_usize, usize::saturating_mul) > most
        {
            return Some(false);
        }
        next.extend(node.children());
    }
    Some(true)
}

// Rows, or pairs of rows, that an operator may be given; None where its leaves' limits are enough.
fn most_rows(node: &Arc<dyn ExecutionPlan>) -> Option<usize> {
    if node.is::<NestedLoopJoinExec>() || node.is::<CrossJoinExec>() || node.is::<PiecewiseMergeJoinExec>() {
        return Some(LIGHT_PAIRS);
    }
    if node.is::<HashJoinExec>() || node.is::<SortMergeJoinExec>() {
        return Some(LIGHT_KEYED);
    }
    if node.is::<WindowAggExec>() || node.is::<BoundedWindowAggExec>() || node.is::<UnnestExec>() || is_slow(node) {
        return Some(LIGHT_SLOW);
    }
    node.downcast_ref::<SortExec>().filter(|sort| sort.fetch().is_none()).map(|_| LIGHT_SORT)
}

fn is_slow(node: &Arc<dyn ExecutionPlan>) -> bool {
    let mut is_slow = false;
    let found = node.apply_expressions(&mut |expression| {
        expression.apply(|part| {
            is_slow |= part.downcast_ref::<ScalarFunctionExpr>().is_some_and(|f| SLOW.contains(&f.fun().name()));
            Ok(TreeNodeRecursion::Continue)
        })
    });
    is_slow || found.is_err()
}

fn row_bytes(schema: &Schema) -> usize {
    schema.fields().iter().map(|field| value_bytes(field.data_type())).sum()
}

fn value_bytes(kind: &DataType) -> usize {
    match kind {
        DataType::List(child) | DataType::LargeList(child) => LIST_LENGTH * value_bytes(child.data_type()),
        DataType::FixedSizeList(child, length) => *length as usize * value_bytes(child.data_type()),
        DataType::Struct(fields) => fields.iter().map(|field| value_bytes(field.data_type())).sum(),
        other => other.primitive_width().unwrap_or(TEXT_BYTES),
    }
}
