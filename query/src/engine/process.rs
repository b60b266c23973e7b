//! What a process has of an engine, whoever reads: memory, disk, footers of files, functions, threads, running queries.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use datafusion::error::DataFusionError;
use datafusion::execution::FunctionRegistry as _;
use datafusion::execution::disk_manager::DiskManagerBuilder;
use datafusion::execution::memory_pool::GreedyMemoryPool;
use datafusion::execution::object_store::{DefaultObjectStoreRegistry, ObjectStoreRegistry as _, ObjectStoreUrl};
use datafusion::execution::runtime_env::{RuntimeEnv, RuntimeEnvBuilder};
use datafusion::execution::session_state::{SessionState, SessionStateBuilder};
use datafusion::functions_nested::min_max::array_min_udf;
use datafusion::optimizer::{Optimizer, OptimizerRule};
use datafusion::physical_optimizer::PhysicalOptimizerRule;
use datafusion::physical_optimizer::optimizer::PhysicalOptimizer;
use datafusion::prelude::SessionConfig;
use echolake_functions::{
    FunctionSet, exact_aggregates, limited_aggregates, limited_functions, limited_windows, list_membership,
    octet_length_of_bytes, pattern_functions, whole_number_ranges, zone_time,
};
use echolake_lake::Lake;
use echolake_lake_tables::{ColumnStore, FileReaders, LakeReaderFactory};
use echolake_schema::ProjectName;

use super::EngineLimits;
use crate::catalog::{LakeCatalog, optimizer_rules};
use crate::control::RunningQueries;
use crate::control::seats::SeatPool;
use crate::control::threads::{QueryThreads, count_cores};
use crate::control::turns::TurnQueue;
use crate::sorted_join::SortedJoinPlanner;
use crate::spread::{ReadOnlyStore, WorkerCluster};
use crate::statement::{
    AsOfSidePlanner, EndingPhysicalRule, EndingRule, FloatForms, IntegerArithmetic, LimitedOperators,
    SubqueryConditions,
};
use crate::views::LookupFunctions;
use crate::{Error, OpaqueValue};

/// URL of the lake's store. No other store is registered, so no query can reach a file outside of the lake.
pub(crate) const STORE: &str = "echolake://lake/";
/// URL of the store that DataFusion registers by default: the whole machine.
const MACHINE: &str = "file:///";
/// Rows per batch: at 384 samples each, 3 MB of responses.
const BATCH_ROWS: usize = 2048;
/// Cache size for the files' footers and page indexes, bytes. Queries read the same files again and again, and a
/// thousand runs need more than DataFusion's default of 50 MiB.
const METADATA_BYTES: usize = 256 << 20;
/// Bytes of decoded columns that a process keeps by default.
const COLUMN_BYTES: usize = 256 << 20;
/// Bytes that are fetched of a file's end on an object store: footer and page index of nearly all files in one request.
const REMOTE_FOOTER_BYTES: usize = 128 << 10;
/// Disk space that sorts and aggregations of all queries may use, bytes.
const SPILL_BYTES: u64 = 16 << 30;
/// Statements that may compute at once on a machine with one core or two.
const LEAST_COMPUTING: usize = 4;
/// Rights whose catalogues are cached, besides those in use.
const CACHED_RIGHTS: usize = 16;

/// What a process has of an engine.
pub(crate) struct EngineProcess {
    /// The lake as the engine was created on it.
    lake: Lake,
    /// Functions and optimizer rules, without tables.
    pub template: SessionState,
    lookups: LookupFunctions,
    url: ObjectStoreUrl,
    reader: Arc<LakeReaderFactory>,
    /// Decoded columns. A scan names the files that it reads, and leaves out rows by its filters.
    columns: Arc<ColumnStore>,
    pub turns: Arc<TurnQueue>,
    pub seats: Arc<SeatPool>,
    /// Seats of the program's own statements: others if those from outside are nice.
    pub program_seats: Arc<SeatPool>,
    pub running: RunningQueries,
    /// Bytes that queries may hold; None for no limit.
    pub memory: Option<usize>,
    /// Names of echolake's own functions.
    pub own: BTreeSet<String>,
    /// A thread for timeouts, which busy query threads cannot delay.
    pub watch: QueryThreads,
    /// Workers for heavy queries; none without `--workers`.
    pub cluster: OnceLock<Arc<WorkerCluster>>,
    rights: CatalogCache,
}

impl EngineProcess {
    /// # Errors
    /// [`Error::Execution`] if DataFusion cannot be set up.
    pub fn new(lake: &Lake, limits: &EngineLimits) -> Result<Self, Error> {
        let failed = |e: DataFusionError| Error::from_execution("", &e);
        let url = ObjectStoreUrl::parse(STORE).map_err(failed)?;
        let runtime = build_runtime(lake, &url, limits.memory).map_err(failed)?;
        let metadata = runtime.cache_manager.get_file_metadata_cache();
        let reader = Arc::new(LakeReaderFactory::new(lake, metadata));
        let column_bytes = limits.column_bytes.unwrap_or(COLUMN_BYTES);
        let columns = Arc::new(ColumnStore::new(reader.clone(), footer_bytes(lake), column_bytes as u64));
        let functions = FunctionSet::all(lake.rig()).map_err(|e| Error::failed_query(&e.to_string()))?;
        let threads = |e: std::io::Error| Error::failed_query(&format!("no threads for queries: {e}"));
        let lookups = LookupFunctions::from_lake(lake, &functions)?;
        let seats = SeatPool::new(limits.niceness, limits.seats);
        let program_seats = match limits.niceness {
            Some(_) => SeatPool::new(None, limits.seats),
            None => seats.clone(),
        };
        Ok(Self {
            lake: lake.clone(),
            template: build_template(runtime, &functions, optimizer_rules(&lookups), limits),
            lookups,
            url,
            reader,
            columns,
            turns: TurnQueue::new(limits.computing.unwrap_or_else(default_computing)),
            seats,
            program_seats,
            running: RunningQueries::default(),
            memory: limits.memory,
            own: functions.names().map(str::to_owned).collect(),
            watch: QueryThreads::new("query-watch", 1).map_err(threads)?,
            cluster: OnceLock::new(),
            rights: CatalogCache::default(),
        })
    }

    /// Returns the catalogue of the lake as its reader sees it: the cached one of the same right, if there is one.
    ///
    /// # Errors
    /// [`Error::Execution`] if it is another lake than the engine's.
    pub fn catalog_of(&self, lake: &Lake) -> Result<OpaqueValue<LakeCatalog>, Error> {
        if !self.lake.is_same_lake(lake) {
            return Err(Error::failed_query("the engine is another lake's"));
        }
        Ok(self.rights.get_or_insert(lake.visible_projects(), || self.open_catalog(lake)))
    }

    // Footers and columns are cached by file: what a reader may not see of a file is not read by its footer, and is left
    // out of its columns by the scan's filter.
    fn open_catalog(&self, lake: &Lake) -> LakeCatalog {
        let source = FileReaders {
            url: self.url.clone(),
            reader: self.reader.clone(),
            footer_bytes: footer_bytes(lake),
            columns: self.columns.clone(),
            is_restricted: lake.is_restricted(),
        };
        LakeCatalog::new(lake, self.lookups.clone(), source)
    }
}

fn footer_bytes(lake: &Lake) -> Option<usize> {
    lake.is_remote().then_some(REMOTE_FOOTER_BYTES)
}

// Statements wait for the store now and then; more at once would hold memory, and not end sooner.
fn default_computing() -> usize {
    (2 * count_cores()).max(LEAST_COMPUTING)
}

/// The projects that a reader sees; None for all.
type VisibleProjects = Option<BTreeSet<ProjectName>>;

/// Catalogues by right, the one that was used last in front. A catalogue in use stays.
#[derive(Default)]
struct CatalogCache(Mutex<VecDeque<(VisibleProjects, OpaqueValue<LakeCatalog>)>>);

impl CatalogCache {
    fn get_or_insert(
        &self,
        right: Option<&BTreeSet<ProjectName>>,
        open: impl FnOnce() -> LakeCatalog,
    ) -> OpaqueValue<LakeCatalog> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let at = known.iter().position(|(of, _)| of.as_ref() == right);
        let (of, catalog) = match at.and_then(|at| known.remove(at)) {
            Some(known) => known,
            None => (right.cloned(), OpaqueValue::new(open())),
        };
        known.push_front((of, catalog.clone()));
        while known.len() > CACHED_RIGHTS {
            let Some(unused) = known.iter().rposition(|(_, catalog)| catalog.is_unshared()) else { break };
            known.remove(unused);
        }
        catalog
    }
}

fn build_template(
    runtime: Arc<RuntimeEnv>,
    functions: &FunctionSet,
    rules: impl IntoIterator<Item = Arc<dyn OptimizerRule + Send + Sync>>,
    limits: &EngineLimits,
) -> SessionState {
    let conditions: Arc<dyn OptimizerRule + Send + Sync> = Arc::new(SubqueryConditions);
    let rules = std::iter::once(conditions).chain(Optimizer::new().rules).chain(rules);
    let ending = |rule| -> Arc<dyn OptimizerRule + Send + Sync> { Arc::new(EndingRule(rule)) };
    let physical = PhysicalOptimizer::new().rules.into_iter();
    let ending_physical = |rule| -> Arc<dyn PhysicalOptimizerRule + Send + Sync> { Arc::new(EndingPhysicalRule(rule)) };
    let mut state = SessionStateBuilder::new()
        .with_config(session_config())
        .with_runtime_env(runtime)
        .with_default_features()
        .with_analyzer_rule(Arc::new(IntegerArithmetic))
        .with_analyzer_rule(Arc::new(FloatForms))
        .with_optimizer_rules(rules.map(ending).collect())
        .with_physical_optimizer_rules(physical.map(ending_physical).collect())
        .with_relation_planners(vec![Arc::new(AsOfSidePlanner)])
        .with_query_planner(Arc::new(SortedJoinPlanner))
        .build();
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
    match limits.memory {
        Some(_) => limit_calls(state),
        None => state,
    }
}

fn limit_calls(mut state: SessionState) -> SessionState {
    let limited: Vec<_> = limited_functions(|name| state.scalar_functions().get(name).cloned());
    let limited: Vec<_> = limited.into_iter().map(Arc::new).collect();
    for function in &limited {
        let _ = state.register_udf(function.clone());
    }
    for function in limited_aggregates() {
        let _ = state.register_udaf(Arc::new(function));
    }
    for function in limited_windows() {
        let _ = state.register_udwf(Arc::new(function));
    }
    let rule = LimitedOperators::new(&limited);
    SessionStateBuilder::new_from_existing(state).with_analyzer_rule(Arc::new(rule)).build()
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
    stores.register_store(url.as_ref(), Arc::new(ReadOnlyStore::new(lake.store())));
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
