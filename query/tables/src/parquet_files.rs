//! Parquet files of one schema that no table of the lake has, such as the contributions of users.

use std::sync::Arc;
use std::time::SystemTime;

use arrow::datatypes::SchemaRef;
use async_trait::async_trait;
use datafusion::catalog::{Session, TableProvider};
use datafusion::datasource::TableType;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{FileGroup, FileScanConfigBuilder, ParquetSource};
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::logical_expr::Expr;
use datafusion::physical_plan::ExecutionPlan;
use object_store::ObjectMeta;
use object_store::path::Path;

use crate::lake_table::FileReaders;

/// Parquet files that never change.
#[derive(Debug)]
pub struct ParquetFiles {
    schema: SchemaRef,
    files: Vec<PartitionedFile>,
    source: FileReaders,
}

impl ParquetFiles {
    /// Makes the table of files, by path and size.
    pub fn new(schema: SchemaRef, files: impl IntoIterator<Item = (Path, u64)>, source: FileReaders) -> Self {
        let file = |(location, size)| {
            let last_modified = SystemTime::UNIX_EPOCH.into();
            PartitionedFile::new_from_meta(ObjectMeta { location, last_modified, size, e_tag: None, version: None })
        };
        Self { schema, files: files.into_iter().map(file).collect(), source }
    }
}

#[async_trait]
impl TableProvider for ParquetFiles {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    fn table_type(&self) -> TableType {
        TableType::Base
    }

    async fn scan(
        &self,
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
        _: &[Expr],
        limit: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let source = ParquetSource::new(self.schema.clone())
            .with_table_parquet_options(state.table_options().parquet.clone())
            .with_parquet_file_reader_factory(self.source.reader.clone());
        let groups = FileGroup::new(self.files.clone()).split_files(state.config().target_partitions());
        let config = FileScanConfigBuilder::new(self.source.url.clone(), Arc::new(source))
            .with_file_groups(groups)
            .with_projection_indices(projection.cloned())?
            .with_limit(limit)
            .build();
        Ok(DataSourceExec::from_data_source(config))
    }
}
