//! Tables that the program around the engine has of itself, as a server has of its queries and connections.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::{DataFusionError, Result};

use super::SystemRows;

/// Tables that the program around the engine adds to the schema `system`.
#[async_trait]
pub trait SystemSource: std::fmt::Debug + Send + Sync {
    /// Returns the names and schemas of its tables.
    fn table_schemas(&self) -> Vec<(&'static str, SchemaRef)>;

    /// Returns the rows of a table, as they are now.
    ///
    /// # Errors
    /// Reason that there are none.
    async fn read_rows(&self, table: &'static str) -> std::result::Result<RecordBatch, String>;
}

#[derive(Debug)]
pub(super) struct SourceRows {
    pub source: Arc<dyn SystemSource>,
    pub name: &'static str,
    pub schema: SchemaRef,
}

#[async_trait]
impl SystemRows for SourceRows {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    async fn read_rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        self.source.read_rows(self.name).await.map_err(DataFusionError::Execution)
    }
}
