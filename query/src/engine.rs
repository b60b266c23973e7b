//! The engine: what all sessions of a process share, a lake, its files' footers, memory and limits.

use std::sync::Arc;
use std::time::Duration;

use datafusion::datasource::physical_plan::parquet::CachedParquetFileReaderFactory;
use datafusion::error::DataFusionError;
use datafusion::execution::object_store::{DefaultObjectStoreRegistry, ObjectStoreRegistry as _, ObjectStoreUrl};
use datafusion::execution::runtime_env::{RuntimeEnv, RuntimeEnvBuilder};
use datafusion::prelude::{SessionConfig, SessionContext};
use echolake_lake::Lake;

use crate::catalog::Catalog;
use crate::table::Source;
use crate::{Error, Functions, Session};

/// Where the lake's store is registered; no other store is, so no query reaches a file outside of the lake.
const STORE: &str = "echolake://lake/";
/// The store that DataFusion registers by itself: the whole machine.
const MACHINE: &str = "file:///";
/// Rows a batch: 384 samples each make 3 MB of responses.
const BATCH_ROWS: usize = 2048;
/// Memory for the files' footers and page indexes. A session asks the same files again and again, and those of a
/// thousand runs are more than DataFusion's 50 MiB.
const METADATA_BYTES: usize = 256 << 20;

/// Answers the queries of many sessions on one lake.
#[derive(Clone)]
pub struct Engine(Arc<Inner>);

struct Inner {
    config: SessionConfig,
    runtime: Arc<RuntimeEnv>,
    catalog: Catalog,
    functions: Functions,
}

/// Who asks, and how much they may have. One for all sessions of a token.
#[derive(Debug)]
pub struct Client {
    /// Name for logs and refusals.
    pub name: String,
    /// What their queries may use.
    pub quota: Quota,
}

/// What the queries of one client may use; None is as much as there is.
#[derive(Debug, Clone, Default)]
pub struct Quota {
    /// Time from a query's start to its last row.
    pub time: Option<Duration>,
    /// Bytes of memory of one query.
    pub memory: Option<usize>,
    /// Rows of one answer; a longer one ends with an error, it is not cut in silence.
    pub rows: Option<u64>,
    /// Queries that run at once; more wait.
    pub concurrent: Option<usize>,
}

impl Engine {
    /// An engine on a lake.
    ///
    /// # Errors
    /// [`Error::Execution`] where DataFusion cannot be set up.
    pub fn new(lake: &Lake) -> Result<Self, Error> {
        let failed = |e: DataFusionError| Error::execution(&e);
        let url = ObjectStoreUrl::parse(STORE).map_err(failed)?;
        let runtime = runtime(lake, &url).map_err(failed)?;
        let metadata = runtime.cache_manager.get_file_metadata_cache();
        let reader = Arc::new(CachedParquetFileReaderFactory::new(lake.store(), metadata));
        let catalog = Catalog::new(lake, Source { url, reader });
        let functions = Functions::all(lake.rig()).map_err(|e| Error::Execution { message: e.to_string() })?;
        Ok(Self(Arc::new(Inner { config: config(), runtime, catalog, functions })))
    }

    /// A session of a client: one a connection.
    pub fn session(&self, client: &Arc<Client>) -> Session {
        Session::of(self.clone(), client.clone())
    }

    /// What can be asked.
    pub(crate) fn catalog(&self) -> &Catalog {
        &self.0.catalog
    }

    // A new one a query: the tables are those of one snapshot, and nothing a query does outlives it.
    pub(crate) fn context(&self) -> SessionContext {
        let context = SessionContext::new_with_config_rt(self.0.config.clone(), self.0.runtime.clone());
        self.0.functions.register(&context);
        context
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
