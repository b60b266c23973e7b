//! The catalogue of one query: tables and views of one snapshot of the lake, and the past tables and run files that the
//! query names.
//!
//! Taking a snapshot reads fourteen logs, so the last one is cached until `runs` has a newer version: a run's rows
//! become visible together with its row in `runs`. That check does not detect commits of `optimize`. They are not
//! urgent, because `vacuum` keeps replaced files for a while; so all logs are checked periodically.

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use arrow::datatypes::SchemaRef;
use bytes::Bytes;
use datafusion::common::TableReference;
use datafusion::datasource::TableProvider;
use datafusion::error::DataFusionError;
use datafusion::logical_expr::ScalarUDF;
use datafusion::optimizer::OptimizerRule;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::prelude::SessionContext;
use datafusion::sql::parser::Statement;
use echolake_functions::unified_floats;
use echolake_lake::{DataFile, Error as LakeError, Lake, LakeMoment, LakeSnapshot, VisibleRun};
use echolake_lake_tables::{FileReaders, LakeTable, RunRows, rewrite_local_scans};
use echolake_mcap_tables::{self as mcap_tables, Contents, McapCalls, McapFiles};
use echolake_schema::RunId;
use echolake_schema::annotations::Annotation;
use echolake_schema::tables::{Source, Table};
use futures::future::try_join_all;
use quick_cache::sync::Cache;

use crate::contributions::{AnnotationCache, KnownVerdicts, with_pending_rows, without_rejected};
use crate::listed_verdicts::listed_rejection;
use crate::overlay_schema::{NamedTables, OverlaySchema};
use crate::session::PreparedQuery;
use crate::session::known_plans::KnownPlans;
use crate::sorted_join::AsOfFilter;
use crate::statement::{PastTableName, checked_operators, end_joins, find_past_tables, walk_statement};
use crate::system;
use crate::views::{
    EagerAggregation, LakeView, LazyView, LookupFunctions, PairJoin, PercentileCalls, SortedNulls, UnusedJoin,
};
use crate::{Error, error};

/// Time for which a new layout of the same rows may go undetected; vacuum keeps replaced files for an hour at least.
const LAYOUT_SEEN: Duration = Duration::from_secs(30);
/// Time for which a look at the log of `runs` is good for all queries, if the lake is on an object store: there it is a
/// request, which takes long and costs money.
const REMOTE_CHECK_LASTS: Duration = Duration::from_secs(1);
/// Maximum number of cached past tables.
const PAST_TABLES: usize = 32;

/// Returns the optimizer rules for plans over tables and views: the same for every snapshot and every reader.
pub(crate) fn optimizer_rules(lookups: &LookupFunctions) -> [Arc<dyn OptimizerRule + Send + Sync>; 6] {
    [
        Arc::new(UnusedJoin),
        Arc::new(PairJoin::new(lookups)),
        Arc::new(EagerAggregation::new(lookups)),
        Arc::new(PercentileCalls::new()),
        Arc::new(SortedNulls),
        Arc::new(AsOfFilter),
    ]
}

/// Registers the tables of a lake in a query's context. It is what a right has: the lake as readers with this right see
/// it, and all that is cached for them.
pub(crate) struct LakeCatalog {
    lake: Lake,
    source: FileReaders,
    lookups: LookupFunctions,
    /// Tables and views, once somebody asks for their list.
    names: OnceLock<Vec<(&'static str, SchemaRef)>>,
    current: Mutex<Option<Arc<CatalogSnapshot>>>,
    /// Held while one query takes a new snapshot; the others wait for it.
    taking: tokio::sync::Mutex<()>,
    /// Cache of tables as of versions of the lake, which do not change.
    past: Cache<(String, u64, Table), Arc<LakeTable>>,
    runs: Arc<McapFiles>,
    annotations: AnnotationCache,
}

/// One snapshot of the lake with its tables and views.
struct CatalogSnapshot {
    snapshot: Arc<LakeSnapshot>,
    /// The tag of its version of `runs`.
    tag: Option<String>,
    tables: HashMap<Table, Arc<LakeTable>>,
    /// Tables and views, and the lake's tables of the schema `system`, as all queries see them.
    public_tables: Arc<NamedTables>,
    system_tables: Arc<NamedTables>,
    rejection: ScalarUDF,
    verdicts: KnownVerdicts,
    plans: KnownPlans,
    looked: Mutex<Instant>,
    /// The last look at the log of `runs`; None if the next query must look.
    checked: Mutex<Option<Instant>>,
}

impl LakeCatalog {
    /// Creates the catalogue of a lake as its reader sees it. `source` caches nothing for another reader but what all
    /// may see.
    pub fn new(lake: &Lake, lookups: LookupFunctions, source: FileReaders) -> Self {
        let columns = source.columns.clone();
        Self {
            lake: lake.clone(),
            source,
            lookups,
            names: OnceLock::new(),
            current: Mutex::default(),
            taking: tokio::sync::Mutex::default(),
            past: Cache::new(PAST_TABLES),
            runs: Arc::new(McapFiles::new(lake, &columns)),
            annotations: AnnotationCache::default(),
        }
    }

    /// Returns the lake as its reader sees it.
    pub fn lake(&self) -> &Lake {
        &self.lake
    }

    /// Returns the functions that plans have and statements do not name; what a plan of another process has is known by
    /// their names.
    pub fn plan_functions(&self) -> impl Iterator<Item = Arc<ScalarUDF>> {
        let own = unified_floats().into_iter().chain(checked_operators()).chain([listed_rejection()]);
        self.lookups.functions().iter().cloned().chain(own.map(Arc::new))
    }

    /// Returns the run files of the lake, for scans that other processes send.
    pub fn run_files(&self) -> &Arc<McapFiles> {
        &self.runs
    }

    /// Replaces the scans of a plan by what this process holds of the files, just before it runs here, and makes joins end
    /// with their statement.
    ///
    /// # Errors
    /// If a scan does not fit its table.
    pub fn rewrite_local_scans(&self, plan: Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>, DataFusionError> {
        rewrite_local_scans(end_joins(plan)?, &self.source)
    }

    /// Returns a table in a snapshot that this catalogue has given, to read rows of its runs without a plan.
    pub fn run_rows<'a>(&'a self, snapshot: &'a LakeSnapshot, table: Table) -> RunRows<'a> {
        let known = self.known_snapshot();
        let known = known.as_ref().and_then(|known| known.tables.get(&table)).map(|table| table.schema());
        let schema = known.unwrap_or_else(|| table.schema(self.lake.rig()));
        RunRows { table, schema, snapshot, readers: &self.source }
    }

    /// Registers everything that `statement` may name, all of one snapshot of the lake, and the program's own tables in
    /// `system`. It is called before planning,
    /// because the lookup of these names is asynchronous and planning is not. Returns the snapshot.
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read, or not as of the moment that the statement names;
    /// [`Error::Query`] if that is no moment.
    pub async fn register_tables(
        &self,
        context: &SessionContext,
        system: Vec<(&'static str, Arc<dyn TableProvider>)>,
        statement: &mut Statement,
    ) -> Result<Arc<LakeSnapshot>, Error> {
        let past = find_past_tables(statement)?;
        let current = self.fresh_snapshot().await?;
        let names = context.copied_config().options().catalog.clone();
        let catalog = context.catalog(&names.default_catalog).ok_or_else(|| Error::failed_query("no catalogue"))?;
        for (schema, tables) in
            [(names.default_schema.as_str(), &current.public_tables), (system::SYSTEM_SCHEMA, &current.system_tables)]
        {
            catalog.register_schema(schema, Arc::new(OverlaySchema::new(tables))).map_err(execution_error)?;
        }
        context.register_udf(current.rejection.clone());
        for (name, provider) in system {
            context
                .register_table(TableReference::partial(system::SYSTEM_SCHEMA, name), provider)
                .map_err(execution_error)?;
        }
        // A time stands for one version in all of a statement, even if a version with an earlier time comes meanwhile.
        let mut versions = HashMap::new();
        for past in past {
            // Without all of its log, a version may seem never to have been.
            current.snapshot.check_table(Table::Runs)?;
            let provider = self.past_provider(&past, current.snapshot.tables_id(), &mut versions).await?;
            context.register_table(TableReference::bare(past.name), provider).map_err(execution_error)?;
        }
        let mut calls = McapCalls::default();
        find_mcap_calls(statement, &mut calls);
        let read = mcap_tables::register(context, &current.snapshot, &self.runs, calls).await;
        read.map_err(mcap_failed)?;
        Ok(current.snapshot.clone())
    }

    /// Returns the plan of a statement on the current snapshot, if it is kept.
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read.
    pub async fn find_plan(&self, sql: &str) -> Result<Option<Arc<PreparedQuery>>, Error> {
        let Some(known) = self.known_snapshot().filter(|known| known.snapshot.is_whole()) else { return Ok(None) };
        let Some(plan) = known.plans.find_plan(sql) else { return Ok(None) };
        Ok(self.is_fresh(&known).await?.then_some(plan))
    }

    /// Optimizes the plan of a statement, and keeps it for later runs on its snapshot if these would plan the same.
    /// That of an engine with workers is not optimized: for them, other rules apply.
    ///
    /// # Errors
    /// As [`PreparedQuery::optimize`].
    pub fn keep_plan(&self, query: PreparedQuery, has_workers: bool) -> Result<Arc<PreparedQuery>, Error> {
        match self.known_snapshot().filter(|known| query.is_of_snapshot(&known.snapshot)) {
            Some(known) => known.plans.keep_plan(query, &known.public_tables, has_workers),
            None => Ok(Arc::new(query)),
        }
    }

    /// Returns the current snapshot of the lake, which a query started now would see; cached until something changes.
    /// Tables other than `runs` may have faults, see [`LakeSnapshot::check_table`].
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read, or `runs` is not whole.
    pub async fn current_snapshot(&self) -> Result<Arc<LakeSnapshot>, Error> {
        let snapshot = self.fresh_snapshot().await?.snapshot.clone();
        snapshot.check_table(Table::Runs)?;
        Ok(snapshot)
    }

    /// Makes the next query look at the log, however short ago the last look was.
    pub fn expire_check(&self) {
        if let Some(known) = self.known_snapshot() {
            *known.checked.lock().unwrap_or_else(PoisonError::into_inner) = None;
        }
    }

    /// Returns the annotations on some runs that a snapshot shows.
    ///
    /// # Errors
    /// [`Error::Lake`] if they cannot be read.
    pub async fn annotations_on(
        &self,
        snapshot: &LakeSnapshot,
        runs: &HashSet<RunId>,
    ) -> Result<Vec<Annotation>, Error> {
        Ok(self.annotations.read_annotations(&self.lake, snapshot, runs).await?)
    }

    /// Returns the last snapshot if it is still the current one. It reads no log, so that it waits for no threads.
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read.
    pub async fn known_current_snapshot(&self) -> Result<Option<Arc<LakeSnapshot>>, Error> {
        match self.known_snapshot() {
            Some(known) if known.snapshot.is_whole() && self.is_fresh(&known).await? => {
                Ok(Some(known.snapshot.clone()))
            }
            _ => Ok(None),
        }
    }

    /// Returns the contents of a run's file, from its summary and message indexes.
    ///
    /// # Errors
    /// [`Error::Execution`] if the file cannot be read.
    pub async fn read_contents(&self, run: &VisibleRun) -> Result<Contents, Error> {
        mcap_tables::read_contents(run, &self.fresh_snapshot().await?.snapshot, &self.runs).await.map_err(mcap_failed)
    }

    /// Returns the bytes of the first attachment of a run's file whose name has this ending; None if there is none.
    ///
    /// # Errors
    /// As [`LakeCatalog::read_contents`].
    pub async fn read_attachment(&self, run: &VisibleRun, ending: &str) -> Result<Option<Bytes>, Error> {
        let snapshot = &self.fresh_snapshot().await?.snapshot;
        mcap_tables::read_attachment(run, snapshot, ending, &self.runs).await.map_err(mcap_failed)
    }

    /// Returns the views with their definitions.
    pub fn view_definitions(&self) -> impl Iterator<Item = (&'static str, String)> {
        LakeView::ALL.into_iter().map(|view| (view.name(), view.definition_sql(&self.lake)))
    }

    /// Returns the system tables that every lake has, with their schemas.
    pub fn system_tables(&self) -> [(&'static str, SchemaRef); 4] {
        system::lake_columns(&Table::Runs.schema(self.lake.rig()))
    }

    /// Returns the tables and views with their schemas.
    pub fn table_schemas(&self) -> impl Iterator<Item = (&'static str, SchemaRef)> {
        let tables = || Table::ALL.into_iter().map(|table| (table.name(), table.schema(self.lake.rig())));
        let views = || LakeView::ALL.into_iter().map(|view| (view.name(), view.schema(&self.lake, &self.lookups)));
        self.names.get_or_init(|| tables().chain(views()).collect()).iter().cloned()
    }

    async fn fresh_snapshot(&self) -> Result<Arc<CatalogSnapshot>, Error> {
        let known = self.known_snapshot();
        if let Some(current) = &known
            && self.is_fresh(current).await?
        {
            return Ok(current.clone());
        }
        let _taking = self.taking.lock().await;
        // Another query may have taken a snapshot meanwhile; it is used only if it is still fresh.
        let newer = self.known_snapshot();
        if let Some(newer) = &newer
            && known.as_ref().is_none_or(|known| !Arc::ptr_eq(known, newer))
            && self.is_fresh(newer).await?
        {
            return Ok(newer.clone());
        }
        let taken = Arc::new(self.take_snapshot(newer.as_deref()).await?);
        *self.current.lock().unwrap_or_else(PoisonError::into_inner) = Some(taken.clone());
        Ok(taken)
    }

    fn known_snapshot(&self) -> Option<Arc<CatalogSnapshot>> {
        self.current.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    async fn is_fresh(&self, current: &CatalogSnapshot) -> Result<bool, Error> {
        let log = self.lake.commit_log();
        let Some(version) = current.snapshot.log_version(Table::Runs) else { return Ok(false) };
        // What mends another table changes no version of `runs`.
        if !current.snapshot.is_whole() || current.verdicts.is_faulty() {
            return Ok(false);
        }
        let checked = *current.checked.lock().unwrap_or_else(PoisonError::into_inner);
        if self.lake.is_remote() && checked.is_some_and(|checked| checked.elapsed() < REMOTE_CHECK_LASTS) {
            return Ok(true);
        }
        // In a folder, a look at whether all of it is still there costs nothing.
        let is_newest = match self.lake.is_remote() {
            true => !log.has_after(Table::Runs, version).await?,
            false => self.lake.newest_tag(version).await?.is_some_and(|tag| Some(tag) == current.tag),
        };
        if !is_newest {
            return Ok(false);
        }
        *current.checked.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        let due = {
            let mut looked = current.looked.lock().unwrap_or_else(PoisonError::into_inner);
            let due = looked.elapsed() > LAYOUT_SEEN;
            if due {
                *looked = Instant::now();
            }
            due
        };
        if due {
            // The next snapshot tells which log cannot be read.
            let versions = try_join_all(Table::ALL.into_iter().map(|table| log.newest_version(table))).await;
            let is_same = |versions: Vec<_>| {
                Table::ALL.into_iter().zip(versions).all(|(table, now)| now == current.snapshot.log_version(table))
            };
            if !versions.is_ok_and(is_same) || log.commit_tag(Table::Runs, version).await? != current.tag {
                return Ok(false);
            }
        }
        Ok(true)
    }

    async fn take_snapshot(&self, before: Option<&CatalogSnapshot>) -> Result<CatalogSnapshot, Error> {
        let taken = Instant::now();
        let snapshot = Arc::new(self.lake.snapshot().await?);
        let tag = match snapshot.log_version(Table::Runs) {
            Some(version) => self.lake.commit_log().commit_tag(Table::Runs, version).await?,
            None => None,
        };
        let mut tables: HashMap<Table, Arc<LakeTable>> = HashMap::new();
        for table in Table::ALL {
            let files = snapshot.files(table);
            let measured = tables.get(&Table::Tnce).filter(|_| table == Table::TnceD4);
            let is_same = |before: &&Arc<LakeTable>| {
                let has_measured = before.measured_rows().map(Arc::as_ptr) == measured.map(Arc::as_ptr);
                before.is_of(files) && !before.is_faulty() && has_measured
            };
            let known = before.and_then(|b| b.tables.get(&table));
            let kept = known.filter(is_same);
            let provider = match kept.filter(|_| snapshot.check_table(table).is_ok()) {
                Some(kept) => kept.clone(),
                None => {
                    let opened = self.open_table(table, files, known.map(AsRef::as_ref))?.of_snapshot(&snapshot);
                    Arc::new(match measured {
                        Some(measured) => opened.with_measured(measured),
                        None => opened,
                    })
                }
            };
            tables.insert(table, provider);
        }
        let mut public_tables = NamedTables::new();
        for (table, provider) in &tables {
            let provider = self.with_pending(*table, provider.clone(), &snapshot).await?;
            public_tables.insert(table.name().to_owned(), provider);
        }
        let verdicts = self.annotations.find_verdicts(&self.lake, &snapshot).await?;
        let rejection = verdicts.rejection_function();
        for view in LakeView::ALL {
            let mut beneath = HashMap::new();
            for (table, provider) in view.source_tables().iter().filter_map(|t| tables.get(t).map(|found| (*t, found)))
            {
                let kept = without_rejected(table, provider.clone(), &verdicts, &snapshot);
                beneath.insert(table, kept.map_err(execution_error)?);
            }
            let view_table = LazyView::new(view, &self.lake, &self.lookups, beneath);
            public_tables.insert(view.name().to_owned(), Arc::new(view_table));
        }
        let mut system_tables = NamedTables::new();
        if let Some(runs) = tables.get(&Table::Runs) {
            let of_lake = system::lake_tables(&self.lake, &snapshot, runs.clone(), &self.source);
            system_tables.extend(of_lake.into_iter().map(|(name, table)| (name.to_owned(), table)));
        }
        let public_tables = Arc::new(public_tables);
        let system_tables = Arc::new(system_tables);
        let looked = Mutex::new(taken);
        let checked = Mutex::new(Some(taken));
        Ok(CatalogSnapshot {
            snapshot,
            tag,
            tables,
            public_tables,
            system_tables,
            rejection,
            verdicts,
            plans: KnownPlans::default(),
            looked,
            checked,
        })
    }

    async fn with_pending(
        &self,
        table: Table,
        provider: Arc<dyn TableProvider>,
        snapshot: &LakeSnapshot,
    ) -> Result<Arc<dyn TableProvider>, Error> {
        match table.source() {
            Source::Users => with_pending_rows(&self.lake, snapshot, table, provider).await,
            _ => Ok(provider),
        }
    }

    fn open_table(
        &self,
        table: Table,
        files: &[Arc<DataFile>],
        before: Option<&LakeTable>,
    ) -> Result<LakeTable, Error> {
        let schema = table.schema(self.lake.rig());
        LakeTable::new(table, schema, files, self.source.clone(), before).map_err(execution_error)
    }

    async fn past_provider(
        &self,
        past: &PastTableName,
        tables_id: &str,
        versions: &mut HashMap<LakeMoment, u64>,
    ) -> Result<Arc<dyn TableProvider>, Error> {
        let moment = past.parse_moment()?;
        let table = Table::by_name(&past.table);
        let view = LakeView::by_name(&past.table);
        if table.is_none() && view.is_none() {
            return Err(error::unknown_table(&past.table));
        }
        let version = match versions.get(&moment) {
            Some(version) => *version,
            None => self.lake.version_at(&moment).await.map_err(moment_error)?,
        };
        versions.insert(moment, version);
        if let Some(table) = table {
            let provider = self.table_at(tables_id, version, table).await?;
            if table.source() == Source::Users {
                let snapshot = self.lake.snapshot_at(version, table).await?;
                return with_pending_rows(&self.lake, &snapshot, table, provider).await;
            }
            return Ok(provider);
        }
        let annotated = self.lake.snapshot_at(version, Table::Annotations).await?;
        let verdicts = self.annotations.find_verdicts(&self.lake, &annotated).await?;
        let Some(view) = view else { return Err(error::unknown_table(&past.table)) };
        let mut beneath = HashMap::new();
        for table in view.source_tables() {
            let provider = self.table_at(tables_id, version, *table).await? as Arc<dyn TableProvider>;
            let kept = without_rejected(*table, provider, &verdicts, &annotated).map_err(execution_error)?;
            beneath.insert(*table, kept);
        }
        Ok(Arc::new(view.plan_over(&self.lake, &self.lookups, &beneath).map_err(execution_error)?))
    }

    async fn table_at(&self, tables_id: &str, version: u64, table: Table) -> Result<Arc<LakeTable>, Error> {
        let read = async {
            let snapshot = self.lake.snapshot_at(version, table).await?;
            Ok(Arc::new(self.open_table(table, snapshot.files(table), None)?))
        };
        self.past.get_or_insert_async(&(tables_id.to_owned(), version, table), read).await
    }
}

// A moment that never was is the query's fault.
fn moment_error(error: LakeError) -> Error {
    match error {
        LakeError::NoMoment { .. } | LakeError::NoTag { .. } => {
            let text = error.to_string();
            let (message, hint) = text.split_once("; hint: ").unwrap_or((&text, ""));
            Error::Query { message: message.to_owned(), place: None, hint: Some(hint.to_owned()) }
        }
        error => error.into(),
    }
}

fn find_mcap_calls(statement: &mut Statement, calls: &mut McapCalls) {
    match statement {
        Statement::Statement(sql) => {
            let _ = walk_statement(sql.as_mut(), calls);
        }
        Statement::Explain(explain) => find_mcap_calls(&mut explain.statement, calls),
        _ => {}
    }
}

// A call that is not right is the query's fault. What is wrong with a file is said as it is, without the store's hints.
fn mcap_failed(error: DataFusionError) -> Error {
    match error {
        DataFusionError::Plan(_) => Error::from_planning("", &error),
        DataFusionError::Execution(message) => Error::failed_query(&message),
        other => execution_error(other),
    }
}

fn execution_error(error: DataFusionError) -> Error {
    Error::from_execution("", &error)
}
