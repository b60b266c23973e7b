//! The decision whether a query is spread over workers: it reads enough, and workers can read all of it.

use std::sync::Arc;

use arrow::datatypes::Schema;
use datafusion::common::stats::Precision;
use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::datasource::memory::MemorySourceConfig;
use datafusion::datasource::physical_plan::{FileScanConfig, ParquetSource};
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_expr::expressions::Column;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::empty::EmptyExec;
use datafusion::physical_plan::placeholder_row::PlaceholderRowExec;
use datafusion::physical_plan::sorts::sort::SortExec;
use echolake_mcap_tables::McapExec;

/// Size of a list against that of a number: the samples of a response, half as many bytes each.
const LIST_WEIGHT: u64 = 192;
/// Reason for which the first rows of an order are found on one machine.
const NARROWING: &str = "it asks for the first rows of an order, and skips files by those that it has found; on workers, \
                         each would read more";

/// The decision about one query.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum SpreadDecision {
    /// Workers run it, and read about so many bytes, as far as its plan tells.
    Spread(u64),
    /// The engine runs it, for this reason, a clause.
    Local(String),
}

impl SpreadDecision {
    /// Decides about a query by its plan for one machine. Workers get what reads `least_bytes` or more.
    ///
    /// # Errors
    /// If the plan is not consistent.
    pub fn from_plan(plan: &Arc<dyn ExecutionPlan>, least_bytes: u64) -> Result<Self> {
        let mut files = None;
        let mut refused = None;
        plan.apply(|node| {
            if node.children().is_empty() {
                match PlanLeaf::from_node(node.as_ref()) {
                    PlanLeaf::Files(bytes) => files = Some(files.unwrap_or(0) + bytes),
                    PlanLeaf::Rows => {}
                    PlanLeaf::Refused(reason) => {
                        refused = Some(reason);
                        return Ok(TreeNodeRecursion::Stop);
                    }
                }
            }
            Ok(TreeNodeRecursion::Continue)
        })?;
        Ok(match (refused, files) {
            (Some(reason), _) => Self::Local(reason),
            (None, None) => Self::Local("it reads no table file and no run file".to_owned()),
            (None, Some(bytes)) if bytes < least_bytes => {
                let [bytes, least] = [bytes, least_bytes].map(mebibytes);
                Self::Local(format!("it reads about {bytes} MiB, less than {least} MiB"))
            }
            (None, Some(_)) if narrows_scans(plan)? => Self::Local(NARROWING.to_owned()),
            (None, Some(bytes)) => Self::Spread(bytes),
        })
    }
}

pub(super) fn mebibytes(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}

enum PlanLeaf {
    /// Table files or run files, and about how many bytes of them are read.
    Files(u64),
    /// Rows that the plan has in itself.
    Rows,
    /// A node that is not sent to workers, with the reason.
    Refused(String),
}

impl PlanLeaf {
    fn from_node(node: &dyn ExecutionPlan) -> Self {
        if let Some(scan) = find_file_scan(node) {
            return match scan.file_groups.iter().flat_map(|group| group.iter()).all(|file| file.extensions.is_empty()) {
                true => Self::Files(read_bytes(scan)),
                // The wire would drop them, and with them what they leave out.
                false => Self::Refused("it reads some of the rows of a file by their places".to_owned()),
            };
        }
        if let Some(scan) = find_mcap_scan(node) {
            return Self::Files(scan.fetched_bytes());
        }
        if has_own_rows(node)
            || node.downcast_ref::<EmptyExec>().is_some()
            || node.downcast_ref::<PlaceholderRowExec>().is_some()
        {
            return Self::Rows;
        }
        Self::Refused(format!("`{}` is not sent to workers", node.name()))
    }
}

/// Returns whether a node is a scan of rows that the plan has in itself.
pub(super) fn has_own_rows(node: &dyn ExecutionPlan) -> bool {
    let source = node.downcast_ref::<DataSourceExec>();
    source.is_some_and(|source| source.data_source().downcast_ref::<MemorySourceConfig>().is_some())
}

/// Returns the scan of table files that a node is, if it is one.
pub(super) fn find_file_scan(node: &dyn ExecutionPlan) -> Option<&FileScanConfig> {
    let scan: &FileScanConfig = node.downcast_ref::<DataSourceExec>()?.data_source().downcast_ref()?;
    scan.file_source().downcast_ref::<ParquetSource>().map(|_| scan)
}

/// Returns the scan of run files that a node is, if it is one.
pub(super) fn find_mcap_scan(node: &dyn ExecutionPlan) -> Option<&McapExec> {
    node.downcast_ref()
}

/// Returns about how many bytes a scan reads: of its files, the part that its columns are by the weight of their types,
/// and no more rows than it needs.
pub(super) fn read_bytes(scan: &FileScanConfig) -> u64 {
    let files = scan.file_groups.iter().flat_map(|group| group.iter());
    let bytes: u64 = files.map(|file| file.effective_size()).sum();
    let all = column_weight(scan.file_schema());
    let read = scan.projected_schema().map_or(all, |schema| column_weight(&schema));
    let columns = (read as f64 / all.max(1) as f64).min(1.0);
    let rows = match (scan.limit, scan.statistics().num_rows) {
        (Some(limit), Precision::Exact(rows) | Precision::Inexact(rows)) => {
            (limit as f64 / rows.max(1) as f64).min(1.0)
        }
        _ => 1.0,
    };
    (bytes as f64 * columns * rows) as u64
}

// Whether the first rows of an order are looked for in files that the rows found so far exclude by their statistics.
// What one task has found, others do not know.
fn narrows_scans(plan: &Arc<dyn ExecutionPlan>) -> Result<bool> {
    let mut narrows = false;
    plan.apply(|node| {
        if node.downcast_ref::<SortExec>().is_some_and(|sort| sort.fetch().is_some()) {
            let ids: Vec<_> = node.dynamic_expressions_produced().iter().filter_map(|e| e.expression_id()).collect();
            narrows |=
                node.exists(|below| Ok(find_file_scan(below.as_ref()).is_some_and(|scan| is_narrowed(scan, &ids))))?;
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

fn column_weight(schema: &Schema) -> u64 {
    schema.fields().iter().map(|field| if field.data_type().is_nested() { LIST_WEIGHT } else { 1 }).sum()
}

#[cfg(test)]
mod tests {
    use arrow::datatypes::{DataType, Field};
    use datafusion::datasource::listing::PartitionedFile;
    use datafusion::datasource::physical_plan::{FileGroup, FileScanConfigBuilder};
    use datafusion::execution::object_store::ObjectStoreUrl;

    use super::*;

    fn plan_scan(file: PartitionedFile) -> Arc<dyn ExecutionPlan> {
        let schema = Arc::new(Schema::new(vec![Field::new("n", DataType::Int64, true)]));
        let url = ObjectStoreUrl::parse("echolake://lake/").expect("a URL");
        let config = FileScanConfigBuilder::new(url, Arc::new(ParquetSource::new(schema)))
            .with_file_groups(vec![FileGroup::new(vec![file])])
            .build();
        DataSourceExec::from_data_source(config)
    }

    #[test]
    fn selected_rows_stay_here_and_ranges_go() {
        let decide = |file| SpreadDecision::from_plan(&plan_scan(file), 1 << 20).expect("a decision");
        let file = PartitionedFile::new("tables/nce/a.parquet", 3 << 20);
        assert_eq!(decide(file.clone()), SpreadDecision::Spread(3 << 20));
        assert_eq!(decide(file.clone().with_range(0, 2 << 20)), SpreadDecision::Spread(2 << 20));
        assert!(
            matches!(decide(file.clone().with_range(0, 1)), SpreadDecision::Local(why) if why.contains("less than"))
        );
        let selected = file.with_extension("rows 3 to 7");
        assert!(matches!(decide(selected), SpreadDecision::Local(why) if why.contains("by their places")));
    }
}
