//! The last rewrite of a plan, on the process that runs it: scans of what the process holds read that.
//!
//! A plan is optimised, explained and sent to other machines with DataFusion's own scans of Parquet files. Just before it
//! runs,
//!
//! - a scan without lists reads the columns that this process has decoded of its files, and decodes and keeps the others
//!   ([`HeldScan`]), unless they are more than a share of what the process keeps; a scan of lists of few pairs does so,
//!   and then reads the pages of the lists that have these rows;
//! - such a scan of small files reads all their rows. For each file that it opens, DataFusion's Parquet source
//!   adapts the query's filters to the file, and plans by them which row groups and pages to read: for a file of a few
//!   thousand rows that takes longer than reading them. The filters stand above the scan, too;
//! - another scan for the first rows of an order reads the order's first column alone of most rows ([`LeadingFilter`]). It
//!   skips row groups by their statistics, too, but few: each has rows of many surfaces, and so nearly all values;
//! - other scans read through this process' cache and its footers, also those of a plan that came over the wire;
//! - values of lists that are aggregated are taken from the lists by all partitions: one of them reads the lists of a
//!   run, and their values are some hundred times as many rows.
//!
//! The plan's nodes keep their partitions, orders, statistics and rows, so that nodes above need not be planned again.

use std::sync::Arc;

use datafusion::datasource::physical_plan::{FileScanConfig, FileScanConfigBuilder, FileSource, ParquetSource};
use datafusion::datasource::source::{DataSource, DataSourceExec};
use datafusion::error::Result;
use datafusion::physical_expr::aggregate::AggregateFunctionExpr;
use datafusion::physical_expr::{Partitioning, PhysicalExpr};
use datafusion::physical_plan::aggregates::AggregateExec;
use datafusion::physical_plan::execution_plan::{ChildrenPropertiesMode, ReplaceChildrenOptions};
use datafusion::physical_plan::filter::FilterExec;
use datafusion::physical_plan::projection::ProjectionExec;
use datafusion::physical_plan::repartition::RepartitionExec;
use datafusion::physical_plan::sorts::sort::SortExec;
use datafusion::physical_plan::union::UnionExec;
use datafusion::physical_plan::unnest::UnnestExec;
use datafusion::physical_plan::{ExecutionPlan, ExecutionPlanProperties as _, InputOrderMode};

use crate::held_scan::HeldScan;
use crate::lake_table::FileReaders;
use crate::leading_filter::LeadingFilter;

/// Rows below which a file without wanted lists is read as a whole, whatever filters there are.
const SMALL_FILE_ROWS: usize = 65_536;

/// Aggregate functions that give the same whatever the order of their rows, the last digits of sums apart.
const UNORDERED: [&str; 5] = ["avg", "count", "max", "min", "sum"];

/// Replaces scans of the lake's files by what this process holds of them. No plan crosses the wire after it.
///
/// # Errors
/// If a scan's expressions do not fit its columns.
pub fn rewrite_local_scans(plan: Arc<dyn ExecutionPlan>, readers: &FileReaders) -> Result<Arc<dyn ExecutionPlan>> {
    rewrite_node(plan, readers, WantedRows::All, &mut Vec::new())
}

/// The rows of a node that the nodes above it want.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum WantedRows {
    All,
    /// All, in any order.
    Unordered,
    /// The first ones of an order.
    First,
}

impl WantedRows {
    fn of_children(self, plan: &dyn ExecutionPlan) -> Self {
        if let Some(sort) = plan.downcast_ref::<SortExec>() {
            return if sort.fetch().is_some() { Self::First } else { Self::All };
        }
        if let Some(aggregate) = plan.downcast_ref::<AggregateExec>() {
            let is_insensitive = |call: &Arc<AggregateFunctionExpr>| UNORDERED.contains(&call.fun().name());
            let is_unordered = *aggregate.input_order_mode() == InputOrderMode::Linear;
            let keeps_all = is_unordered && aggregate.aggr_expr().iter().all(is_insensitive);
            return if keeps_all { Self::Unordered } else { Self::All };
        }
        let keeps_rows = plan.is::<FilterExec>()
            || plan.is::<ProjectionExec>()
            || plan.is::<RepartitionExec>()
            || plan.is::<UnionExec>();
        if keeps_rows { self } else { Self::All }
    }
}

// `bounds` are the ids of filters that nodes above give their scans while they run, see [`produced_bounds`].
fn rewrite_node(
    plan: Arc<dyn ExecutionPlan>,
    readers: &FileReaders,
    wanted: WantedRows,
    bounds: &mut Vec<u64>,
) -> Result<Arc<dyn ExecutionPlan>> {
    if plan.children().is_empty() {
        let scan = plan.downcast_ref::<DataSourceExec>();
        let local = scan.map_or(Ok(None), |scan| local_scan(scan.data_source(), readers, wanted, bounds));
        return Ok(local?.unwrap_or(plan));
    }
    let is_shared = wanted == WantedRows::Unordered && plan.is::<UnnestExec>();
    let wanted = wanted.of_children(plan.as_ref());
    bounds.extend(produced_bounds(plan.as_ref()));
    rewrite_children(plan, &mut |child| {
        let local = rewrite_node(child, readers, wanted, bounds)?;
        if is_shared { share_batches(local) } else { Ok(local) }
    })
}

// Hands batches to all partitions in turn, whichever of them read them.
fn share_batches(plan: Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>> {
    let partitions = plan.output_partitioning().partition_count();
    if partitions < 2 || plan.output_ordering().is_some() || !plan.is::<DataSourceExec>() {
        return Ok(plan);
    }
    Ok(Arc::new(RepartitionExec::try_new(plan, Partitioning::RoundRobinBatch(partitions))?))
}

/// Rewrites the inputs of a planned node. The node keeps its properties, and what it shares with nodes below, as the
/// filters of the rows that it has found.
///
/// # Errors
/// Those of `rewrite`, and of the node if its new inputs do not fit.
pub fn rewrite_children(
    plan: Arc<dyn ExecutionPlan>,
    rewrite: &mut dyn FnMut(Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>>,
) -> Result<Arc<dyn ExecutionPlan>> {
    let mut is_changed = false;
    let mut children = Vec::with_capacity(plan.children().len());
    for child in plan.children() {
        let rewritten = rewrite(child.clone())?;
        is_changed |= !Arc::ptr_eq(child, &rewritten);
        children.push(rewritten);
    }
    match is_changed {
        true => plan.replace_children(children, ReplaceChildrenOptions::new(ChildrenPropertiesMode::Keep)),
        false => Ok(plan),
    }
}

// The filters by which the first rows of an order, or an extreme, leave out rows that are beyond those found so far. Those
// of joins may leave few rows of many.
fn produced_bounds(plan: &dyn ExecutionPlan) -> Vec<u64> {
    let is_bounded = plan.downcast_ref::<SortExec>().is_some() || plan.downcast_ref::<AggregateExec>().is_some();
    let produced = if is_bounded { plan.dynamic_expressions_produced() } else { Vec::new() };
    produced.iter().filter_map(|filter| filter.expression_id()).collect()
}

// What this process reads for a scan; None if that is what the scan reads.
fn local_scan(
    data_source: &Arc<dyn DataSource>,
    readers: &FileReaders,
    wanted: WantedRows,
    bounds: &[u64],
) -> Result<Option<Arc<dyn ExecutionPlan>>> {
    let Some(scan) = data_source.downcast_ref::<FileScanConfig>() else { return Ok(None) };
    let Some(source) = scan.file_source().downcast_ref::<ParquetSource>() else { return Ok(None) };
    if scan.object_store_url != readers.url {
        return Ok(None);
    }
    if let Some(held) = HeldScan::try_from_scan(data_source, scan, source, readers, bounds)? {
        return Ok(Some(Arc::new(DataSourceExec::new(Arc::new(held)))));
    }
    let found_rows = Some(source).filter(|_| wanted == WantedRows::First).and_then(leading_predicate);
    let source: Arc<dyn FileSource> = if has_spare_filters(scan, source)? {
        let unfiltered = readers.parquet_source(scan.file_source().table_schema().clone());
        let unfiltered = unfiltered.with_table_parquet_options(source.table_parquet_options().clone());
        let projected = source.projection().map(|projection| unfiltered.try_pushdown_projection(projection));
        match projected.transpose()?.flatten() {
            Some(projected) => projected,
            None => return Ok(None),
        }
    } else if found_rows.is_none()
        && source.parquet_file_reader_factory().is_some_and(|own| Arc::ptr_eq(own, &readers.reader))
    {
        return Ok(None);
    } else {
        let source = source.clone().with_parquet_file_reader_factory(readers.reader.clone());
        let source = match found_rows {
            Some(predicate) => source.with_predicate(predicate).with_pushdown_filters(true),
            None => source,
        };
        match readers.footer_bytes {
            Some(bytes) => Arc::new(source.with_metadata_size_hint(bytes)),
            None => Arc::new(source),
        }
    };
    let local = FileScanConfigBuilder::from(scan.clone()).with_source(source).build();
    Ok(Some(DataSourceExec::from_data_source(local)))
}

// The predicate of a scan that becomes narrower while rows are found, so that it pays to test rows; None if it does not,
// or if the scan tests them anyway.
fn leading_predicate(source: &ParquetSource) -> Option<Arc<dyn PhysicalExpr>> {
    let is_tested = source.table_parquet_options().global.pushdown_filters;
    source.filter().filter(|_| !is_tested).and_then(|predicate| LeadingFilter::prepend_to(&predicate))
}

// Whether reading the whole files and filtering the rows above is faster.
fn has_spare_filters(scan: &FileScanConfig, source: &ParquetSource) -> Result<bool> {
    if source.filter().is_none() || source.table_parquet_options().global.pushdown_filters {
        return Ok(false);
    }
    if scan.projected_schema()?.fields().iter().any(|field| field.data_type().is_nested()) {
        return Ok(false);
    }
    Ok(ScanSize::from_scan(scan).is_some_and(|size| !size.has_large_files()))
}

/// What a scan reads.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ScanSize {
    files: usize,
    pub rows: usize,
}

impl ScanSize {
    /// Adds up the files of a scan, each of which is all of a file or a range of it; None if it does not know the rows
    /// of one.
    pub fn from_scan(scan: &FileScanConfig) -> Option<Self> {
        let mut size = Self { files: 0, rows: 0 };
        for file in scan.file_groups.iter().flat_map(|group| group.files()) {
            size.files += 1;
            size.rows += file.statistics.as_ref()?.num_rows.get_value()?;
        }
        Some(size)
    }

    /// Returns whether the files are so large that it pays to plan which of their rows to read.
    pub fn has_large_files(&self) -> bool {
        self.rows >= self.files * SMALL_FILE_ROWS
    }
}
