//! A session: every query sees one frozen view of the lake and may only read.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use datafusion::datasource::physical_plan::parquet::CachedParquetFileReaderFactory;
use datafusion::error::DataFusionError;
use datafusion::execution::SendableRecordBatchStream;
use datafusion::execution::context::SQLOptions;
use datafusion::execution::object_store::{DefaultObjectStoreRegistry, ObjectStoreRegistry as _, ObjectStoreUrl};
use datafusion::execution::runtime_env::{RuntimeEnv, RuntimeEnvBuilder};
use datafusion::prelude::{SessionConfig, SessionContext};
use echolake_lake::Lake;
use echolake_schema::tables::Table;
use futures::StreamExt as _;

use crate::table::{LakeTable, Source};
use crate::{Error, gate};

/// Where the lake's store is registered; no other store is, so no query reaches a file outside of the lake.
const STORE: &str = "echolake://lake/";
/// The store that DataFusion registers by itself: the whole machine.
const MACHINE: &str = "file:///";
/// Rows a batch: 384 samples each make 3 MB of responses.
const BATCH_ROWS: usize = 2048;
/// Memory for the files' footers and page indexes. A session asks the same files again and again, and those of a
/// thousand runs are more than DataFusion's 50 MiB.
const METADATA_BYTES: usize = 256 << 20;

/// Asks a lake in SQL.
pub struct Session {
    lake: Lake,
    config: SessionConfig,
    runtime: Arc<RuntimeEnv>,
    source: Source,
}

/// An answer, as it comes.
pub struct Answer {
    /// Its columns.
    pub schema: SchemaRef,
    /// Its rows.
    pub batches: SendableRecordBatchStream,
}

impl Answer {
    /// The next rows; None after the last.
    ///
    /// # Errors
    /// [`Error::Execution`] where the query fails on its way.
    pub async fn next(&mut self) -> Result<Option<RecordBatch>, Error> {
        self.batches.next().await.transpose().map_err(|e| Error::execution(&e))
    }
}

impl Session {
    /// A session on a lake.
    ///
    /// # Errors
    /// [`Error::Execution`] where DataFusion cannot be set up.
    pub fn new(lake: &Lake) -> Result<Self, Error> {
        let failed = |e: DataFusionError| Error::execution(&e);
        let url = ObjectStoreUrl::parse(STORE).map_err(failed)?;
        let runtime = runtime(lake, &url).map_err(failed)?;
        let metadata = runtime.cache_manager.get_file_metadata_cache();
        let reader = Arc::new(CachedParquetFileReaderFactory::new(lake.store(), metadata));
        Ok(Self { lake: lake.clone(), config: config(), runtime, source: Source { url, reader } })
    }

    /// Answers a query.
    ///
    /// # Errors
    /// [`Error::Query`] where it is not right, [`Error::NotReading`] where it would change something,
    /// [`Error::Lake`] where the lake cannot be read.
    pub async fn query(&self, sql: &str) -> Result<Answer, Error> {
        let context = self.context().await?;
        let wrong = |e: DataFusionError| Error::plan(sql, &e);
        let state = context.state();
        let statement = state.sql_to_statement(sql, &state.config().options().sql_parser.dialect).map_err(wrong)?;
        gate::check(&statement)?;
        let plan = state.statement_to_plan(statement).await.map_err(wrong)?;
        // `SELECT INTO` reads by its first word and makes a table by its plan.
        let reading = SQLOptions::new().with_allow_ddl(false).with_allow_dml(false).with_allow_statements(false);
        reading.verify_plan(&plan).map_err(|_| Error::NotReading { statement: plan.display().to_string() })?;
        let frame = context.execute_logical_plan(plan).await.map_err(wrong)?;
        let batches = frame.execute_stream().await.map_err(wrong)?;
        Ok(Answer { schema: batches.schema(), batches })
    }

    /// The tables and their schemas.
    pub fn tables(&self) -> impl Iterator<Item = (&'static str, SchemaRef)> {
        Table::ALL.into_iter().map(|t| (t.name(), t.schema(self.lake.rig())))
    }

    // A new one a query: the tables are those of one snapshot, and nothing a query does outlives it.
    async fn context(&self) -> Result<SessionContext, Error> {
        let snapshot = self.lake.snapshot().await?;
        let context = SessionContext::new_with_config_rt(self.config.clone(), self.runtime.clone());
        for table in Table::ALL {
            let files = snapshot.files(table).to_vec();
            let provider = LakeTable::new(table.schema(self.lake.rig()), files, self.source.clone());
            context.register_table(table.name(), Arc::new(provider)).map_err(|e| Error::execution(&e))?;
        }
        Ok(context)
    }
}

// DataFusion's defaults already use all cores and prune by row group and page.
fn config() -> SessionConfig {
    let mut config = SessionConfig::new().with_information_schema(true).with_batch_size(BATCH_ROWS);
    let options = config.options_mut();
    options.sql_parser.collect_spans = true;
    // Files hold plain strings, and so do the formats that answers are written in.
    options.execution.parquet.schema_force_view_types = false;
    config
}

fn runtime(lake: &Lake, url: &ObjectStoreUrl) -> Result<Arc<RuntimeEnv>, DataFusionError> {
    let stores = DefaultObjectStoreRegistry::new();
    stores.deregister_store(ObjectStoreUrl::parse(MACHINE)?.as_ref())?;
    stores.register_store(url.as_ref(), lake.store());
    RuntimeEnvBuilder::new()
        .with_object_store_registry(Arc::new(stores))
        .with_metadata_cache_limit(METADATA_BYTES)
        .build_arc()
}

#[cfg(test)]
mod tests;
