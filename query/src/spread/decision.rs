//! The decision if a query is spread over workers: it reads enough, and workers can read all of it.

use std::sync::Arc;

use arrow::datatypes::Schema;
use datafusion::common::stats::Precision;
use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::datasource::memory::MemorySourceConfig;
use datafusion::datasource::physical_plan::FileScanConfig;
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_expr::expressions::Column;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::empty::EmptyExec;
use datafusion::physical_plan::placeholder_row::PlaceholderRowExec;
use datafusion::physical_plan::sorts::sort::SortExec;

use crate::mcap::McapExec;

/// Size of a list against that of a number: the samples of a response, half as many bytes each.
const LIST_WEIGHT: u64 = 192;
/// Reason for which the first rows of an order are found on one machine.
const NARROWING: &str = "it asks for the first rows of an order, and passes over files by those that it has; on workers, \
                         each would read more";

/// The decision about one query.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum SpreadDecision {
    /// Workers run it.
    Spread {
        /// Bytes that it reads, as far as its plan tells.
        bytes: u64,
    },
    /// The engine runs it.
    Local {
        /// The reason, as a clause.
        reason: String,
    },
}

impl SpreadDecision {
    /// Decides about a query by its plan for one machine. Workers get what reads `least` bytes or more.
    ///
    /// # Errors
    /// If the plan is not consistent.
    pub(crate) fn of_plan(plan: &Arc<dyn ExecutionPlan>, least: u64) -> Result<Self> {
        let mut files = None;
        let mut other = None;
        plan.apply(|node| {
            if node.children().is_empty() {
                match PlanLeaf::of_node(node) {
                    PlanLeaf::Files(bytes) => files = Some(files.unwrap_or(0) + bytes),
                    PlanLeaf::Rows => {}
                    PlanLeaf::Other(name) => {
                        other = Some(name);
                        return Ok(TreeNodeRecursion::Stop);
                    }
                }
            }
            Ok(TreeNodeRecursion::Continue)
        })?;
        let local = |reason: String| Ok(Self::Local { reason });
        match (other, files) {
            (Some(name), _) => local(format!("{name} is not sent to workers")),
            (None, None) => local("it reads no table file and no run file".to_owned()),
            (None, Some(bytes)) if bytes < least => {
                local(format!("it reads about {} MiB, less than {} MiB", mebibytes(bytes), mebibytes(least)))
            }
            (None, Some(_)) if narrows_scans(plan)? => local(NARROWING.to_owned()),
            (None, Some(bytes)) => Ok(Self::Spread { bytes }),
        }
    }
}

pub(crate) fn mebibytes(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}

enum PlanLeaf {
    /// Table files or run files, and about how many bytes of them are read.
    Files(u64),
    /// Rows that the plan has in itself.
    Rows,
    /// Anything else, by its name.
    Other(String),
}

impl PlanLeaf {
    fn of_node(node: &Arc<dyn ExecutionPlan>) -> Self {
        if let Some(scan) = file_scan(node) {
            return Self::Files(read_bytes(scan));
        }
        if let Some(scan) = run_scan(node) {
            // One with a limit ends early.
            return Self::Files(if scan.is_limited() { 0 } else { scan.fetched_bytes() });
        }
        let source = node.downcast_ref::<DataSourceExec>();
        if source.is_some_and(|source| source.data_source().downcast_ref::<MemorySourceConfig>().is_some())
            || node.downcast_ref::<EmptyExec>().is_some()
            || node.downcast_ref::<PlaceholderRowExec>().is_some()
        {
            return Self::Rows;
        }
        Self::Other(format!("`{}`", node.name()))
    }
}

/// Returns the scan of table files that a node is, if it is one.
pub(super) fn file_scan(node: &Arc<dyn ExecutionPlan>) -> Option<&FileScanConfig> {
    node.downcast_ref::<DataSourceExec>()?.data_source().downcast_ref()
}

/// Returns the scan of run files that a node is, if it is one.
pub(super) fn run_scan(node: &Arc<dyn ExecutionPlan>) -> Option<&McapExec> {
    node.downcast_ref()
}

/// Returns about how many bytes a scan reads: of its files, the part that its columns are by the weight of their types, and
/// no more rows than it needs.
pub(super) fn read_bytes(scan: &FileScanConfig) -> u64 {
    let files = scan.file_groups.iter().flat_map(|group| group.iter());
    let bytes: u64 = files.map(|file| file.effective_size()).sum();
    let all = weight(scan.file_schema());
    let read = scan.projected_schema().map_or(all, |schema| weight(&schema));
    let columns = (read as f64 / all.max(1) as f64).min(1.0);
    let rows = match (scan.limit, scan.statistics().num_rows) {
        (Some(limit), Precision::Exact(rows) | Precision::Inexact(rows)) => {
            (limit as f64 / rows.max(1) as f64).min(1.0)
        }
        _ => 1.0,
    };
    (bytes as f64 * columns * rows) as u64
}

// Whether the first rows of an order are looked for in files that the rows found so far exclude by their statistics. What
// one task has found, others do not know.
fn narrows_scans(plan: &Arc<dyn ExecutionPlan>) -> Result<bool> {
    let mut narrows = false;
    plan.apply(|node| {
        if node.downcast_ref::<SortExec>().is_some_and(|sort| sort.fetch().is_some()) {
            let ids: Vec<_> = node.dynamic_expressions_produced().iter().filter_map(|e| e.expression_id()).collect();
            narrows |= node.exists(|below| Ok(file_scan(below).is_some_and(|scan| is_narrowed(scan, &ids))))?;
        }
        Ok(if narrows { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
    })?;
    Ok(narrows)
}

// Lists and what is computed have no statistics.
fn is_narrowed(scan: &FileScanConfig, ids: &[u64]) -> bool {
    let is_column = |key: &&Arc<dyn PhysicalExpr>| {
        let column = key.downcast_ref::<Column>();
        let field = column.and_then(|column| scan.file_schema().field_with_name(column.name()).ok());
        field.is_some_and(|field| !field.data_type().is_nested())
    };
    let is_of_order = |part: &Arc<dyn PhysicalExpr>| {
        part.expression_id().is_some_and(|id| ids.contains(&id)) && part.children().first().is_some_and(is_column)
    };
    let filter = scan.file_source().filter();
    filter.is_some_and(|filter| filter.exists(|part| Ok(is_of_order(part))).unwrap_or(false))
}

fn weight(schema: &Schema) -> u64 {
    schema.fields().iter().map(|field| if field.data_type().is_nested() { LIST_WEIGHT } else { 1 }).sum()
}
