//! The engine: the lake, cached file footers, memory and limits that all sessions of a process share.

use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use datafusion::catalog::{CatalogProvider as _, CatalogProviderList as _, TableProvider};
use datafusion::catalog::{MemoryCatalogProvider, MemoryCatalogProviderList, MemorySchemaProvider};
use datafusion::error::DataFusionError;
use datafusion::execution::FunctionRegistry as _;
use datafusion::execution::disk_manager::DiskManagerBuilder;
use datafusion::execution::memory_pool::GreedyMemoryPool;
use datafusion::execution::object_store::{DefaultObjectStoreRegistry, ObjectStoreRegistry as _, ObjectStoreUrl};
use datafusion::execution::runtime_env::{RuntimeEnv, RuntimeEnvBuilder};
use datafusion::execution::session_state::{SessionState, SessionStateBuilder};
use datafusion::functions_nested::min_max::array_min_udf;
use datafusion::logical_expr::Documentation;
use datafusion::optimizer::{Optimizer, OptimizerRule};
use datafusion::prelude::{SessionConfig, SessionContext};
use echolake_functions::{
    FunctionSet, exact_aggregates, list_membership, octet_length_of_bytes, pattern_functions, whole_number_ranges,
    zone_time,
};
use echolake_lake::Lake;
use echolake_lake_tables::{FileReaders, LakeReaderFactory, SmallTables};
use futures::FutureExt as _;

use crate::catalog::LakeCatalog;
use crate::client::QueryQuota;
use crate::control::threads::{QueryThreadGroups, QueryThreads};
use crate::control::{QueryTicket, RunningQueries, StopReason};
use crate::statement::{FloatForms, IntegerArithmetic, SubqueryConditions};
use crate::system::{self, SystemSource};
use crate::{Error, OpaqueValue};

/// URL of the lake's store. No other store is registered, so no query can reach a file outside of the lake.
const STORE: &str = "echolake://lake/";
/// URL of the store that DataFusion registers by default: the whole machine.
const MACHINE: &str = "file:///";
/// Rows per batch: at 384 samples each, 3 MB of responses.
const BATCH_ROWS: usize = 2048;
/// Cache size for the files' footers and page indexes, bytes. Queries read the same files again and again, and a
/// thousand runs need more than DataFusion's default of 50 MiB.
const METADATA_BYTES: usize = 256 << 20;
/// Bytes that are fetched of a file's end on an object store: footer and page index of nearly all files in one request.
const REMOTE_FOOTER_BYTES: usize = 128 << 10;

/// Disk space that sorts and aggregations of all queries may use, bytes.
const SPILL_BYTES: u64 = 16 << 30;

/// Answers the queries of many sessions on one lake.
///
/// ```
/// use std::sync::Arc;
///
/// use echolake_lake::{Lake, ReferenceSurfaces};
/// use echolake_query::{EngineClient, Error, QueryEngine, QueryQuota};
/// use echolake_schema::Rig;
///
/// # tokio::runtime::Runtime::new()?.block_on(async {
/// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
/// let engine = QueryEngine::new(&lake, None)?;
/// let client = EngineClient::new("guest", QueryQuota { rows: Some(1), ..QueryQuota::default() });
/// let mut answer = engine.open_session(&Arc::new(client)).query("select * from points").await?;
/// assert!(matches!(answer.next().await, Err(Error::RowLimit { limit: 1 })));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// # })?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct QueryEngine(OpaqueValue<EngineState>);

struct EngineState {
    template: SessionState,
    catalog: LakeCatalog,
    threads: QueryThreadGroups,
    running: RunningQueries,
    /// Bytes that queries may hold; None for no limit.
    memory: Option<usize>,
    /// Names of echolake's own functions.
    own: BTreeSet<String>,
    // A thread for timeouts, which busy query threads cannot delay.
    watch: QueryThreads,
    system: OnceLock<Arc<dyn SystemSource>>,
}

/// A function that queries may call.
#[derive(Debug, Clone)]
pub struct SqlFunction {
    /// Its name.
    pub name: String,
    /// Its call syntax.
    pub syntax: String,
    /// Its description.
    pub description: String,
    /// A query with it, if there is one.
    pub example: Option<String>,
    /// True for echolake's own functions, false for those of DataFusion.
    pub is_own: bool,
}

impl SqlFunction {
    /// Returns the arguments in the call syntax, without the parentheses.
    pub fn argument_list(&self) -> &str {
        let inner = self.syntax.split_once('(').map_or("", |(_, rest)| rest);
        inner.rsplit_once(')').map_or(inner, |(inner, _)| inner)
    }
}

impl QueryEngine {
    /// Creates an engine on a lake, all of whose queries together may hold `memory` bytes; None for no limit.
    ///
    /// # Errors
    /// [`Error::Execution`] if DataFusion cannot be set up.
    pub fn new(lake: &Lake, memory: Option<usize>) -> Result<Self, Error> {
        let failed = |e: DataFusionError| Error::from_execution("", &e);
        let url = ObjectStoreUrl::parse(STORE).map_err(failed)?;
        let runtime = build_runtime(lake, &url, memory).map_err(failed)?;
        let metadata = runtime.cache_manager.get_file_metadata_cache();
        let reader = Arc::new(LakeReaderFactory::new(lake, metadata));
        let functions = FunctionSet::all(lake.rig()).map_err(|e| Error::failed_query(&e.to_string()))?;
        let threads = |e: std::io::Error| Error::failed_query(&format!("no threads for queries: {e}"));
        let footer_bytes = lake.is_remote().then_some(REMOTE_FOOTER_BYTES);
        let small = Arc::new(SmallTables::new(lake));
        let restricted = lake.is_restricted().then(|| lake.clone());
        let catalog = LakeCatalog::new(lake, &functions, FileReaders { url, reader, footer_bytes, small, restricted })?;
        let inner = EngineState {
            template: build_template(runtime, &functions, catalog.optimizer_rules()),
            catalog,
            threads: QueryThreadGroups::per_core("query").map_err(threads)?,
            running: RunningQueries::default(),
            memory,
            own: functions.names().map(str::to_owned).collect(),
            watch: QueryThreads::new("query-watch", 1).map_err(threads)?,
            system: OnceLock::new(),
        };
        Ok(Self(OpaqueValue::new(inner)))
    }

    /// Adds tables to the schema `system`; to be called once.
    pub fn add_system_tables(&self, source: Arc<dyn SystemSource>) {
        let _ = self.0.system.set(source);
    }

    /// Returns the tables of the schema `system` that are not the lake's; none without a program around that has some.
    pub(crate) fn system_tables(&self) -> Vec<(&'static str, Arc<dyn TableProvider>)> {
        self.0.system.get().map_or_else(Vec::new, system::engine_tables)
    }

    /// Returns the number of queries that run or wait now.
    pub fn count_running(&self) -> usize {
        self.0.running.count_running()
    }

    /// Returns the longest time for which work has continued after its query was ended; None if there is none.
    pub fn longest_overdue(&self) -> Option<Duration> {
        self.0.running.longest_overdue()
    }

    /// Returns the functions, sorted by name.
    pub(crate) fn sql_functions(&self) -> Vec<SqlFunction> {
        let state = &self.0.template;
        let scalar = state.scalar_functions().iter().map(|(name, f)| (name, f.documentation()));
        let aggregate = state.aggregate_functions().iter().map(|(name, f)| (name, f.documentation()));
        let window = state.window_functions().iter().map(|(name, f)| (name, f.documentation()));
        let mut functions: Vec<_> =
            scalar.chain(aggregate).chain(window).map(|(name, doc)| self.describe_function(name, doc)).collect();
        functions.sort_by(|a, b| a.name.cmp(&b.name));
        functions.dedup_by(|a, b| a.name == b.name);
        functions
    }

    fn describe_function(&self, name: &str, doc: Option<&Documentation>) -> SqlFunction {
        SqlFunction {
            name: name.to_owned(),
            syntax: doc.map_or_else(|| format!("{name}(...)"), |d| d.syntax_example.clone()),
            description: doc.map_or_else(String::new, |d| d.description.clone()),
            example: doc.and_then(|d| d.sql_example.clone()),
            is_own: self.0.own.contains(name),
        }
    }

    /// Runs other work of a client's request, such as parsing, in the same way as queries: on the same threads and with
    /// a timeout of `time`. If the caller drops it, the work is ended or reported by [`QueryEngine::longest_overdue`].
    ///
    /// # Errors
    /// Those of `work`; [`Error::TimeLimit`].
    pub async fn supervise_work<T: Send + 'static, E: From<Error> + Send + 'static>(
        &self,
        time: Option<Duration>,
        work: impl Future<Output = Result<T, E>> + Send + 'static,
    ) -> Result<T, E> {
        self.on_threads(&self.create_ticket(time), work).await
    }

    /// Creates a ticket with a timeout of `time`.
    pub(crate) fn create_ticket(&self, time: Option<Duration>) -> Arc<QueryTicket> {
        let ticket = Arc::new(QueryTicket::new());
        self.0.running.add_ticket(&ticket);
        if let (Some(time), Some(threads)) = (time, self.0.watch.handle()) {
            let watched = Arc::downgrade(&ticket);
            let timer = threads.spawn(async move {
                tokio::time::sleep(time).await;
                if let Some(ticket) = watched.upgrade() {
                    ticket.stop(StopReason::Time(time));
                }
            });
            ticket.set_timer(timer.abort_handle());
        }
        ticket
    }

    // Constants are computed while a query is planned, so planning must not block the caller's threads.
    pub(crate) async fn on_threads<T: Send + 'static, E: From<Error> + Send + 'static>(
        &self,
        ticket: &Arc<QueryTicket>,
        work: impl Future<Output = Result<T, E>> + Send + 'static,
    ) -> Result<T, E> {
        let mut stop = StopOnDrop { ticket: ticket.clone(), is_done: false };
        let begun = ticket.clone();
        let guarded = async move {
            let _guard = begun.begin_work();
            tokio::select! {
                biased;
                why = begun.wait_for_stop() => Err(Error::from_stop(&why).into()),
                done = work => done,
            }
        };
        let guarded = guarded.boxed();
        let work = async {
            let Some(task) = self.0.threads.begin_work(guarded).await else { return Err(ended_error().into()) };
            let done = task.await.unwrap_or_else(|_| Some(Err(defect_error().into())));
            done.unwrap_or_else(|| Err(ended_error().into()))
        };
        let done = tokio::select! {
            done = work => done,
            why = ticket.wait_for_stop() => Err(Error::from_stop(&why).into()),
        };
        stop.is_done = true;
        done
    }

    /// Returns the catalogue of tables and views.
    pub(crate) fn catalog(&self) -> &LakeCatalog {
        &self.0.catalog
    }

    /// Returns the threads that plan and run queries.
    pub(crate) fn threads(&self) -> &QueryThreadGroups {
        &self.0.threads
    }

    /// Returns the memory limit of one query, bytes; `usize::MAX` if there is none.
    pub(crate) fn memory_limit(&self, quota: &QueryQuota) -> usize {
        self.0.memory.into_iter().chain(quota.memory).min().unwrap_or(usize::MAX)
    }

    /// Returns the state from which all contexts are built: without tables, with the same parser options.
    pub(crate) fn template_state(&self) -> &SessionState {
        &self.0.template
    }

    // One new context per query: its tables are of one snapshot, and nothing a query does outlives it. Functions and
    // optimizer rules are those of the template.
    pub(crate) fn create_context(&self) -> SessionContext {
        let names = &self.0.template.config_options().catalog;
        let catalog = MemoryCatalogProvider::new();
        // A new catalogue accepts any name.
        for schema in [&names.default_schema, system::SYSTEM_SCHEMA] {
            let _ = catalog.register_schema(schema, Arc::new(MemorySchemaProvider::new()));
        }
        let catalogs = MemoryCatalogProviderList::new();
        catalogs.register_catalog(names.default_catalog.clone(), Arc::new(catalog));
        let state = SessionStateBuilder::new_from_existing(self.0.template.clone())
            .with_catalog_list(Arc::new(catalogs))
            .build();
        SessionContext::new_with_state(state)
    }
}

fn build_template(
    runtime: Arc<RuntimeEnv>,
    functions: &FunctionSet,
    rules: impl IntoIterator<Item = Arc<dyn OptimizerRule + Send + Sync>>,
) -> SessionState {
    let conditions: Arc<dyn OptimizerRule + Send + Sync> = Arc::new(SubqueryConditions);
    let builder = SessionStateBuilder::new()
        .with_config(session_config())
        .with_runtime_env(runtime)
        .with_default_features()
        .with_analyzer_rule(Arc::new(IntegerArithmetic))
        .with_analyzer_rule(Arc::new(FloatForms))
        .with_optimizer_rules(std::iter::once(conditions).chain(Optimizer::new().rules).collect());
    let mut state = rules.into_iter().fold(builder, SessionStateBuilder::with_optimizer_rule).build();
    let _ = state.register_udf(Arc::new(octet_length_of_bytes()));
    for function in whole_number_ranges() {
        let _ = state.register_udf(Arc::new(function));
    }
    let _ = state.register_udf(Arc::new(zone_time()));
    for function in list_membership() {
        let _ = state.register_udf(Arc::new(function));
    }
    for function in exact_aggregates() {
        let _ = state.register_udaf(Arc::new(function));
    }
    // DuckDB's name, as `list_max`, which DataFusion has.
    let _ = state.register_udf(Arc::new(array_min_udf().as_ref().clone().with_aliases(["list_min"])));
    for function in pattern_functions(state.config_options()) {
        let _ = state.register_udf(Arc::new(function));
    }
    // They replace functions with the same names and aliases; only a closed registry would refuse.
    for function in functions.scalar() {
        let _ = state.register_udf(function.clone());
    }
    for function in functions.aggregate() {
        let _ = state.register_udaf(function.clone());
    }
    state
}

// DataFusion's defaults already use all cores and prune by row group and page.
fn session_config() -> SessionConfig {
    let mut config = SessionConfig::new().with_information_schema(true).with_batch_size(BATCH_ROWS);
    let options = config.options_mut();
    options.sql_parser.collect_spans = true;
    // As in Postgres' protocol, a TIMESTAMPTZ is of UTC.
    options.execution.time_zone = Some("UTC".to_owned());
    // DataFusion compares the comments on columns, too, of which a union of unions takes the first or the last.
    options.execution.skip_physical_aggregate_schema_check = true;
    // Files contain plain strings, and so do the output formats of answers.
    options.execution.parquet.schema_force_view_types = false;
    config
}

fn build_runtime(lake: &Lake, url: &ObjectStoreUrl, memory: Option<usize>) -> Result<Arc<RuntimeEnv>, DataFusionError> {
    let stores = DefaultObjectStoreRegistry::new();
    stores.deregister_store(ObjectStoreUrl::parse(MACHINE)?.as_ref())?;
    stores.register_store(url.as_ref(), lake.store());
    let mut builder = RuntimeEnvBuilder::new();
    if let Some(memory) = memory {
        builder = builder.with_memory_pool(Arc::new(GreedyMemoryPool::new(memory)));
    }
    builder
        .with_disk_manager_builder(DiskManagerBuilder::default().with_max_temp_directory_size(SPILL_BYTES))
        .with_object_store_registry(Arc::new(stores))
        .with_metadata_cache_limit(METADATA_BYTES)
        .build_arc()
}

/// Stops the work of a caller that is dropped while it waits; it ends at its next await.
struct StopOnDrop {
    ticket: Arc<QueryTicket>,
    is_done: bool,
}

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        if !self.is_done {
            self.ticket.stop(StopReason::Cancelled);
        }
    }
}

/// Returns the error for an engine that has ended.
pub(crate) fn ended_error() -> Error {
    Error::failed_query("the query service has ended")
}

/// Returns the error for a panic.
pub(crate) fn defect_error() -> Error {
    Error::failed_query("a defect ended it")
}

#[cfg(test)]
mod tests {
    use echolake_lake::ReferenceSurfaces;
    use echolake_schema::Rig;

    use super::*;

    #[tokio::test]
    async fn a_timer_ends_with_its_query() {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let engine = QueryEngine::new(&lake, None).expect("an engine");
        let tasks = engine.0.watch.handle().expect("threads").metrics();
        let before = tasks.num_alive_tasks();
        let tickets: Vec<_> = (0..100).map(|_| engine.create_ticket(Some(Duration::from_secs(3600)))).collect();
        assert_eq!(tasks.num_alive_tasks(), before + 100);
        drop(tickets);
        let ended = async {
            while tasks.num_alive_tasks() > before {
                tokio::task::yield_now().await;
            }
        };
        tokio::time::timeout(Duration::from_secs(60), ended).await.expect("no task sleeps for an hour");
    }
}
