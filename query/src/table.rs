//! A table of the lake as DataFusion sees it: a plain Parquet scan over the files of one snapshot.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::datatypes::{DataType, SchemaRef};
use async_trait::async_trait;
use datafusion::catalog::{Session, TableProvider};
use datafusion::common::stats::Precision;
use datafusion::common::{ScalarValue, Statistics};
use datafusion::datasource::TableType;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{
    FileGroup, FileScanConfigBuilder, ParquetFileReaderFactory, ParquetSource,
};
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::execution::object_store::ObjectStoreUrl;
use datafusion::logical_expr::{Expr, TableProviderFilterPushDown};
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_expr::expressions::{Column, in_list, lit};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::filter::{FilterExec, FilterExecBuilder};
use datafusion::physical_plan::union::UnionExec;
use echolake_lake::DataFile;
use object_store::ObjectMeta;

/// Delta's writers cut texts in statistics to 32 characters; a shorter one is whole, whoever wrote it.
const WHOLE_TEXT: usize = 32;
/// The column that tells the runs of a merged file apart.
const RUN: &str = "run_id";

/// Files of one table in one snapshot.
#[derive(Debug)]
pub(crate) struct LakeTable {
    schema: SchemaRef,
    files: Vec<DataFile>,
    source: Source,
}

/// How files are read.
#[derive(Debug, Clone)]
pub(crate) struct Source {
    /// Where the lake's store is registered.
    pub(crate) url: ObjectStoreUrl,
    /// Reads footers once a session.
    pub(crate) reader: Arc<dyn ParquetFileReaderFactory>,
}

impl LakeTable {
    pub(crate) fn new(schema: SchemaRef, files: Vec<DataFile>, source: Source) -> Self {
        Self { schema, files, source }
    }

    // A plain scan of files, in groups of about the same size; a file is split further by DataFusion where that pays.
    fn files(
        &self,
        files: &[&DataFile],
        state: &dyn Session,
        projection: Option<Vec<usize>>,
        limit: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let count = state.config().target_partitions();
        let mut groups: Vec<(u64, Vec<PartitionedFile>)> = vec![(0, Vec::new()); count.clamp(1, files.len().max(1))];
        for file in files {
            if let Some((bytes, group)) = groups.iter_mut().min_by_key(|g| g.0) {
                *bytes += file.bytes;
                group.push(self.file(file));
            }
        }
        let mut statistics = Statistics::new_unknown(&self.schema);
        statistics.num_rows = Precision::Exact(files.iter().map(|f| f.rows as usize).sum());
        let source = ParquetSource::new(self.schema.clone())
            .with_table_parquet_options(state.table_options().parquet.clone())
            .with_parquet_file_reader_factory(self.source.reader.clone())
            .with_pushdown_filters(self.reads_lists(projection.as_ref()));
        let config = FileScanConfigBuilder::new(self.source.url.clone(), Arc::new(source))
            .with_file_groups(groups.into_iter().map(|(_, files)| FileGroup::new(files)).collect())
            .with_statistics(statistics)
            .with_projection_indices(projection)?
            .with_limit(limit)
            .build();
        Ok(DataSourceExec::from_data_source(config))
    }

    // Merged files with runs that are replaced since: the same scan without their rows. The limit counts rows that
    // stay, so it is not the scan's.
    fn partly_hidden(
        &self,
        files: &[&DataFile],
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let mut columns = projection.cloned().unwrap_or_else(|| (0..self.schema.fields().len()).collect());
        let wanted: Vec<_> = (0..columns.len()).collect();
        let run = self.schema.index_of(RUN)?;
        let at = columns.iter().position(|c| *c == run).unwrap_or_else(|| {
            columns.push(run);
            columns.len() - 1
        });
        let scan = self.files(files, state, Some(columns), None)?;
        let hidden: BTreeSet<_> = files.iter().flat_map(|f| f.hidden.iter().map(|r| r.as_str())).collect();
        let hidden: Vec<Arc<dyn PhysicalExpr>> = hidden.into_iter().map(lit).collect();
        let shown = in_list(Arc::new(Column::new(RUN, at)), hidden, &true, &scan.schema())?;
        let filter: FilterExec = FilterExecBuilder::new(shown, scan).apply_projection(Some(wanted))?.build()?;
        Ok(Arc::new(filter))
    }

    fn file(&self, file: &DataFile) -> PartitionedFile {
        let meta = ObjectMeta {
            location: file.path.clone(),
            last_modified: file.modified,
            size: file.bytes,
            e_tag: None,
            version: None,
        };
        PartitionedFile::new_from_meta(meta).with_statistics(Arc::new(self.known(file)))
    }

    // What the log knows of a file, so that a query for one surface does not open the files of the others.
    fn known(&self, file: &DataFile) -> Statistics {
        let mut known = Statistics::new_unknown(&self.schema);
        known.num_rows = Precision::Exact(file.rows as usize);
        let Some(stats) = &file.stats else { return known };
        for (field, column) in self.schema.fields().iter().zip(&mut known.column_statistics) {
            let kind = field.data_type();
            let least = stats.min.get(field.name()).and_then(|v| scalar(kind, v.as_str(), v.as_i64()));
            let greatest = stats.max.get(field.name()).and_then(|v| scalar(kind, v.as_str(), v.as_i64()));
            if let (Some(least), Some(greatest)) = (least, greatest) {
                column.min_value = Precision::Exact(least);
                column.max_value = Precision::Exact(greatest);
            }
        }
        known
    }

    fn rows(&self) -> Statistics {
        let rows: u64 = self.files.iter().map(DataFile::visible_rows).sum();
        let mut statistics = Statistics::new_unknown(&self.schema);
        statistics.num_rows = Precision::Exact(rows as usize);
        statistics
    }

    // Lists are decoded for the rows that a filter leaves. Scans of narrow columns alone would only lose by it.
    fn reads_lists(&self, projection: Option<&Vec<usize>>) -> bool {
        let nested = |i: usize| self.schema.field(i).data_type().is_nested();
        match projection {
            Some(columns) => columns.iter().any(|i| nested(*i)),
            None => (0..self.schema.fields().len()).any(nested),
        }
    }
}

// Keys are integers and texts. JSON does not keep every float, so those are left to the file's own statistics.
fn scalar(kind: &DataType, text: Option<&str>, int: Option<i64>) -> Option<ScalarValue> {
    match kind {
        DataType::Utf8 => text.filter(|t| t.chars().count() < WHOLE_TEXT).map(ScalarValue::from),
        DataType::Int32 => int.and_then(|v| i32::try_from(v).ok()).map(ScalarValue::from),
        DataType::Int64 => int.map(ScalarValue::from),
        _ => None,
    }
}

#[async_trait]
impl TableProvider for LakeTable {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    fn table_type(&self) -> TableType {
        TableType::Base
    }

    // DataFusion keeps its filter, and its physical optimizer hands it to the Parquet reader, which leaves out files,
    // row groups and pages by statistics, and rows where lists are read.
    fn supports_filters_pushdown(&self, filters: &[&Expr]) -> Result<Vec<TableProviderFilterPushDown>> {
        Ok(vec![TableProviderFilterPushDown::Inexact; filters.len()])
    }

    fn statistics(&self) -> Option<Statistics> {
        Some(self.rows())
    }

    async fn scan(
        &self,
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
        _filters: &[Expr],
        limit: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let (whole, partial): (Vec<_>, Vec<_>) = self.files.iter().partition(|f| f.hidden.is_empty());
        if partial.is_empty() {
            return self.files(&whole, state, projection.cloned(), limit);
        }
        let partial = self.partly_hidden(&partial, state, projection)?;
        if whole.is_empty() {
            return Ok(partial);
        }
        UnionExec::try_new(vec![self.files(&whole, state, projection.cloned(), limit)?, partial])
    }
}
