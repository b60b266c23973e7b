//! A session: every query sees one snapshot of the lake and may only read.

mod answer;
pub(crate) mod known_plans;

use std::borrow::Cow;
use std::collections::HashSet;
use std::sync::Arc;

use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use datafusion::catalog::TableProvider;
use datafusion::common::ParamValues;
use datafusion::error::DataFusionError;
use datafusion::execution::TaskContext;
use datafusion::execution::memory_pool::MemoryPool;
use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::LogicalPlan;
use datafusion::prelude::SessionContext;
use datafusion::sql::parser::Statement;
use echolake_functions::set_planning;
use echolake_lake::{Lake, LakeSnapshot, VisibleRun};
use echolake_lake_tables::RowReading;
use echolake_mcap_tables::Contents;
use echolake_schema::RunId;
use echolake_schema::annotations::Annotation;
use echolake_schema::tables::Table;
use futures::FutureExt as _;
use futures::future::BoxFuture;
use tokio::sync::mpsc;

use crate::client::{EngineClient, QueryPermit, QueryQuota};
use crate::control::QueryTicket;
use crate::control::pool::PartialPool;
use crate::engine::{QueryEngine, SqlFunction};
use crate::literal_batches::limit_batch_rows;
use crate::request_memory::RequestMemory;
use crate::spread::attempts::{QueryAttempts, SpreadQuery};
use crate::statement::{PredicateForm, append_predicate, parse_statement, prepare_statement};
use crate::system::{self, SYSTEM_SCHEMA, SystemSource};
use crate::{Error, OpaqueValue};
use answer::drive_query;
pub use answer::{CancelHandle, QueryAnswer};

/// Capacity of the queue of batches to a slow reader.
const AHEAD: usize = 2;

/// Runs SQL queries on a lake, one session per connection. Clones are the same session.
#[derive(Clone)]
pub struct Session {
    engine: QueryEngine,
    client: Arc<EngineClient>,
    request: Option<u64>,
    extend: Option<ContextExtension>,
    system: Option<Arc<dyn SystemSource>>,
}

/// Adds a protocol's own tables and functions to the context of every query.
pub type ContextExtension = Arc<dyn Fn(&SessionContext) -> Result<(), DataFusionError> + Send + Sync>;

/// A planned query that can be run repeatedly with other values. It keeps the snapshot of the lake on which it was
/// planned; [`Session::is_current`] finds out whether the lake has changed since.
pub struct PreparedQuery {
    state: OpaqueValue<SessionState>,
    plan: OpaqueValue<LogicalPlan>,
    snapshot: Arc<LakeSnapshot>,
    sql: String,
    is_optimized: bool,
}

impl PreparedQuery {
    /// Optimizes its logical plan once for all runs, which then need values of the very types of its placeholders. For
    /// all of them `now()` is the time of this call.
    ///
    /// # Errors
    /// [`Error::Query`] if it cannot be planned.
    pub fn optimize(self) -> Result<Self, Error> {
        set_planning(true);
        let plan = self.state.optimize(&self.plan);
        set_planning(false);
        let plan = plan.map_err(|e| Error::from_optimizing(&self.sql, &e))?;
        Ok(Self { plan: OpaqueValue::new(plan), is_optimized: true, ..self })
    }

    /// Returns its text.
    pub fn sql(&self) -> &str {
        &self.sql
    }

    /// Returns whether it was planned on this snapshot.
    pub(crate) fn is_of_snapshot(&self, snapshot: &Arc<LakeSnapshot>) -> bool {
        Arc::ptr_eq(&self.snapshot, snapshot)
    }

    /// Returns the schema of its answers.
    pub fn schema(&self) -> SchemaRef {
        Arc::new(self.plan.schema().as_arrow().clone())
    }

    /// Returns the types of its placeholders `$1`, `$2`, ... in this order; None if the query does not determine one.
    ///
    /// # Errors
    /// [`Error::Query`] if a placeholder is not a number.
    pub fn parameter_types(&self) -> Result<Vec<Option<DataType>>, Error> {
        let types = self.plan.get_parameter_types().map_err(|e| Error::from_planning(&self.sql, &e))?;
        let number = |name: &str| name.strip_prefix('$').and_then(|n| n.parse::<usize>().ok()).filter(|n| *n > 0);
        let mut found = Vec::new();
        for (name, kind) in types {
            let Some(number) = number(&name) else {
                let message = format!("`{name}` is no placeholder");
                return Err(Error::Query { message, place: None, hint: Some("they are $1, $2, ...".to_owned()) });
            };
            if found.len() < number {
                found.resize(number, None);
            }
            found[number - 1] = kind;
        }
        Ok(found)
    }
}

impl QueryEngine {
    /// Creates a session of a client, one per connection.
    pub fn open_session(&self, client: &Arc<EngineClient>) -> Session {
        Session { engine: self.clone(), client: client.clone(), request: None, extend: None, system: None }
    }
}

impl Session {
    /// Creates a session with an engine of its own, without limits.
    ///
    /// # Errors
    /// [`Error::Execution`] if DataFusion cannot be set up.
    pub fn new(lake: &Lake) -> Result<Self, Error> {
        let client = EngineClient::new("local", QueryQuota::default());
        Ok(QueryEngine::new(lake, None)?.open_session(&Arc::new(client)))
    }

    /// Adds a protocol's own tables and functions to the session.
    #[must_use]
    pub fn with_extension(mut self, extend: ContextExtension) -> Self {
        self.extend = Some(extend);
        self
    }

    /// Adds tables to the schema `system`, as this session's client sees them.
    #[must_use]
    pub fn with_system(mut self, source: Arc<dyn SystemSource>) -> Self {
        self.system = Some(source);
        self
    }

    // The tables of the schema `system` that are not the lake's; none without workers and a program around that has
    // some.
    fn source_tables(&self) -> Vec<(&'static str, Arc<dyn TableProvider>)> {
        system::engine_tables(self.system.as_ref(), self.engine.cluster())
    }

    /// Sets the number of the request that the session's queries are for, see [`StatementBlame::request`].
    ///
    /// [`StatementBlame::request`]: crate::StatementBlame::request
    #[must_use]
    pub fn of_request(mut self, request: Option<u64>) -> Self {
        self.request = request;
        self
    }

    /// Returns the client.
    pub fn client(&self) -> &Arc<EngineClient> {
        &self.client
    }

    /// Plans and runs a query.
    ///
    /// ```
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    /// use echolake_query::{Error, Session};
    /// use echolake_schema::Rig;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let session = Session::new(&lake)?;
    /// let mut answer = session.query("select point_id from points where z_mm = 474").await?;
    /// assert_eq!(answer.next().await?.map(|batch| batch.num_rows()), Some(1));
    /// assert!(matches!(session.query("drop table runs").await, Err(Error::NotReading { .. })));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Query`] if it is invalid, [`Error::NotReading`] if it would change something, [`Error::Lake`] if the
    /// lake cannot be read, [`Error::Busy`] if the client has no permit left, and those of [`QueryAnswer::next`].
    pub fn query<'a>(&'a self, sql: &'a str) -> BoxFuture<'a, Result<QueryAnswer, Error>> {
        let query = async move {
            let started = self.start_query()?;
            let prepared = match self.find_plan(sql, &started.ticket).await? {
                Some(known) => known,
                None => {
                    let (session, statement, sql) = (self.clone(), self.parse_sql(sql)?, sql.to_owned());
                    started.ticket.set_statement(&sql);
                    let plan = async move { session.keep_plan(session.plan_statement(sql, statement).await?) };
                    self.engine.on_seat(&started.ticket, plan).await?
                }
            };
            self.run_plan(&prepared, prepared.state.clone(), LogicalPlan::clone(&prepared.plan), started).await
        };
        query.boxed()
    }

    /// Plans a query.
    ///
    /// ```
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    /// use echolake_schema::Rig;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let session = echolake_query::Session::new(&lake)?;
    /// let prepared = session.prepare("select pair_id from pairs where direct_mm > $1").await?;
    /// assert_eq!(prepared.parameter_types()?, [Some(arrow::datatypes::DataType::Float64)]);
    /// assert_eq!(prepared.schema().field(0).name(), "pair_id");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// As [`Session::query`].
    pub fn prepare<'a>(&'a self, sql: &'a str) -> BoxFuture<'a, Result<PreparedQuery, Error>> {
        async move { self.prepare_statement(sql, self.parse_sql(sql)?).await }.boxed()
    }

    /// Plans a statement that a protocol has parsed, and perhaps rewritten, from `sql`.
    ///
    /// # Errors
    /// As [`Session::query`].
    pub fn prepare_statement<'a>(
        &'a self,
        sql: &'a str,
        statement: Statement,
    ) -> BoxFuture<'a, Result<PreparedQuery, Error>> {
        let prepare = async move {
            let started = self.start_query()?;
            let (session, sql) = (self.clone(), sql.to_owned());
            started.ticket.set_statement(&sql);
            let plan = async move { session.plan_statement(sql, statement).await };
            self.engine.on_seat(&started.ticket, plan).await
        };
        prepare.boxed()
    }

    /// Runs a planned query with values for its placeholders.
    ///
    /// # Errors
    /// [`Error::Query`] if values are missing or of the wrong type; else as [`Session::query`].
    pub fn execute<'a>(
        &'a self,
        prepared: &'a PreparedQuery,
        values: ParamValues,
    ) -> BoxFuture<'a, Result<QueryAnswer, Error>> {
        let execute = async move {
            let plan = LogicalPlan::clone(&prepared.plan).with_param_values(values);
            let plan = plan.map_err(|e| Error::from_planning(&prepared.sql, &e))?;
            // now() is the time of this run, not that of planning.
            let mut state = SessionState::clone(&prepared.state);
            state.mark_start_execution();
            self.run_plan(prepared, OpaqueValue::new(state), plan, self.start_query()?).await
        };
        execute.boxed()
    }

    /// Returns whether a query that started now would see the snapshot on which this one was planned.
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read.
    pub async fn is_current(&self, prepared: &PreparedQuery) -> Result<bool, Error> {
        Ok(prepared.is_of_snapshot(&self.current_snapshot().await?))
    }

    /// Parses one statement.
    ///
    /// # Errors
    /// [`Error::Query`] if it is not a statement.
    pub fn parse_sql(&self, sql: &str) -> Result<Statement, Error> {
        parse_statement(sql, self.engine.template_state().config().options().sql_parser.recursion_limit.get())
    }

    /// Returns the query `select` with a predicate appended: `select` ends in `where`, or in `and` after it. The query
    /// is not run, and its permissions are left to the gate; this only checks that `predicate` is one expression.
    ///
    /// ```
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    /// use echolake_query::{PredicateForm, Session};
    /// use echolake_schema::Rig;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let session = Session::new(&lake)?;
    /// let select = "select 1 from pairs where";
    /// let selecting = |predicate| session.append_predicate(select, predicate, PredicateForm::Comparisons);
    /// assert_eq!(selecting("pair_id < 9")?, "select 1 from pairs where (\npair_id < 9\n)");
    /// assert!(selecting("true) or (true").is_err());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Query`] if the predicate is none, or is not of the form.
    pub fn append_predicate(&self, select: &str, predicate: &str, form: PredicateForm) -> Result<String, Error> {
        append_predicate(select, predicate, form, |sql| self.parse_sql(sql))
    }

    /// Runs other work of a client's request as a query runs: with one of the client's permits, within its time, on the
    /// threads of queries, and with a share of its memory. Dropping it ends the work at its next await.
    ///
    /// ```
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    /// use echolake_query::{EngineClient, Error, QueryEngine, QueryQuota};
    /// use echolake_schema::Rig;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let client = EngineClient::new("guest", QueryQuota { memory: Some(1000), ..QueryQuota::default() });
    /// let session = QueryEngine::new(&lake, None)?.open_session(&client.into());
    /// let sum = session.run_request(|memory| async move { memory.reserve(900).map(|()| 1 + 1) }).await?;
    /// assert_eq!(sum, 2);
    /// let more = session.run_request(|memory| async move { memory.reserve(1001) }).await;
    /// assert!(matches!(more, Err(Error::MemoryLimit { .. })));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// Those of `work`; [`Error::Busy`] if the client has no permit left, [`Error::TimeLimit`].
    pub fn run_request<'a, T, E, F>(
        &'a self,
        work: impl FnOnce(RequestMemory) -> F + Send + 'a,
    ) -> BoxFuture<'a, Result<T, E>>
    where
        T: Send + 'static,
        E: From<Error> + Send + 'static,
        F: Future<Output = Result<T, E>> + Send + 'static,
    {
        let run = async move {
            let Started { ticket, place } = self.start_query()?;
            let all = self.engine.template_state().runtime_env().memory_pool.clone();
            let work = work(RequestMemory::new(&self.query_pool(all, &ticket)));
            // The permit is released when the work has ended, even if the caller has left.
            let work = async move {
                let _place = place;
                work.await
            };
            self.engine.on_seat(&ticket, work).await
        };
        run.boxed()
    }

    /// Runs other work of a client's request, such as parsing, in the same way as queries: within the client's time, in
    /// one of its turns, on a seat. It needs no permit. Dropping it ends the work at its next await; then it is reported
    /// by [`QueryEngine::find_runaway`] if it goes on.
    ///
    /// # Errors
    /// Those of `work`; [`Error::TimeLimit`].
    pub async fn supervise_work<T: Send + 'static, E: From<Error> + Send + 'static>(
        &self,
        work: impl Future<Output = Result<T, E>> + Send + 'static,
    ) -> Result<T, E> {
        self.engine.on_seat(&self.start_ticket(), work).await
    }

    // The query's timeout starts here and includes waiting.
    fn start_query(&self) -> Result<Started, Error> {
        let place = self.client.acquire_place()?;
        Ok(Started { ticket: self.start_ticket(), place })
    }

    fn start_ticket(&self) -> Arc<QueryTicket> {
        let ticket = QueryTicket::new(self.client.shared_name(), self.request, self.client.is_program());
        self.engine.start_ticket(ticket, self.client.quota().time)
    }

    async fn plan_statement(&self, sql: String, mut statement: Statement) -> Result<PreparedQuery, Error> {
        let context = self.engine.create_context();
        let system = self.source_tables();
        let snapshot = self.engine.catalog().register_tables(&context, system, &mut statement).await?;
        if let Some(extend) = &self.extend {
            extend(&context).map_err(|e| Error::from_execution("", &e))?;
        }
        let state = context.state();
        let plan = OpaqueValue::new(prepare_statement(&sql, statement, &state).await?);
        Ok(PreparedQuery { state: OpaqueValue::new(state), plan, snapshot, sql, is_optimized: false })
    }

    // Looking may wait for the lake's store, so the ticket ends it.
    async fn find_plan(&self, sql: &str, ticket: &QueryTicket) -> Result<Option<Arc<PreparedQuery>>, Error> {
        if self.extend.is_some() {
            return Ok(None);
        }
        tokio::select! {
            found = self.engine.catalog().find_plan(sql) => found,
            why = ticket.wait_for_stop() => Err(Error::from_stop(&why)),
        }
    }

    // Those of a session with tables or settings of its own are not kept.
    fn keep_plan(&self, planned: PreparedQuery) -> Result<Arc<PreparedQuery>, Error> {
        match self.extend {
            Some(_) => Ok(Arc::new(planned)),
            None => self.engine.catalog().keep_plan(planned, self.engine.cluster().is_some()),
        }
    }

    async fn run_plan(
        &self,
        prepared: &PreparedQuery,
        state: OpaqueValue<SessionState>,
        plan: LogicalPlan,
        started: Started,
    ) -> Result<QueryAnswer, Error> {
        let Started { ticket, place } = started;
        ticket.set_statement(&prepared.sql);
        if let Some(cluster) = self.engine.cluster() {
            cluster.follow_lake(prepared.snapshot.tables_id());
        }
        let text = prepared.sql.clone();
        let is_optimized = prepared.is_optimized;
        let session = self.clone();
        let engine = self.engine.clone();
        let of_query = ticket.clone();
        let planned = async move {
            set_planning(true);
            let planned = async {
                let optimized = if is_optimized { Cow::Borrowed(&plan) } else { Cow::Owned(state.optimize(&plan)?) };
                let state = limit_batch_rows(state, &optimized)?;
                let physical = state.query_planner().create_physical_plan(&optimized, &*state).await?;
                let context = session.task_context(&state, &of_query);
                let spread = session.spread_query(&state, plan, is_optimized, of_query);
                let mut attempts = QueryAttempts::plan_query(physical, context, spread).await?;
                attempts.rewrite_local(|plan| engine.rewrite_local_scans(plan))?;
                Ok::<_, DataFusionError>(attempts)
            };
            let planned = planned.await;
            set_planning(false);
            planned.map_err(|error| Error::from_optimizing(&text, &error))
        };
        let attempts = self.engine.on_seat(&ticket, planned).await?;
        let schema = attempts.schema().clone();
        let (send, batches) = mpsc::channel(AHEAD);
        let query = drive_query(attempts, send, self.engine.clone(), ticket.clone(), place).boxed();
        // Dropped, it stops the query, which may have begun.
        let mut answer = QueryAnswer {
            schema,
            batches,
            query: None,
            ticket,
            sql: prepared.sql.clone(),
            rows: 0,
            limit: self.client.quota().rows,
            _engine: self.engine.clone(),
        };
        tokio::select! {
            threads = self.engine.begin_computing(&answer.ticket) => answer.query = Some(threads?.spawn(query)),
            why = answer.ticket.wait_for_stop() => return Err(Error::from_stop(&why)),
        }
        Ok(answer)
    }

    // All that a query is spread by, if there are workers.
    fn spread_query(
        self,
        state: &SessionState,
        logical: LogicalPlan,
        is_optimized: bool,
        ticket: Arc<QueryTicket>,
    ) -> Option<SpreadQuery> {
        let cluster = self.engine.cluster()?.clone();
        let engine = self.engine.clone();
        let memory = Some(self.engine.memory_limit(self.client.quota())).filter(|limit| *limit < usize::MAX);
        let state = state.clone();
        let contexts = Box::new(move |state: &SessionState| self.task_context(state, &ticket));
        Some(SpreadQuery { cluster, engine, state, logical, is_optimized, memory, contexts })
    }

    // As DataFusion builds it, except for the memory pool.
    fn task_context(&self, state: &SessionState, ticket: &Arc<QueryTicket>) -> Arc<TaskContext> {
        let mut runtime = state.runtime_env().as_ref().clone();
        runtime.memory_pool = self.query_pool(runtime.memory_pool, ticket);
        Arc::new(TaskContext::from(state).with_runtime(Arc::new(runtime)))
    }

    // The share of all memory that one query of the client may use.
    fn query_pool(&self, all: Arc<dyn MemoryPool>, ticket: &QueryTicket) -> Arc<dyn MemoryPool> {
        let limit = self.engine.memory_limit(self.client.quota());
        let pool = self.client.memory_pool(all);
        Arc::new(PartialPool::new(pool, "the query holds", limit, ticket.held_memory().clone()))
    }

    /// Returns the current snapshot of the lake, which a query started now would see; cached until something changes.
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read, or `runs` is not whole.
    pub async fn current_snapshot(&self) -> Result<Arc<LakeSnapshot>, Error> {
        self.engine.catalog().current_snapshot().await
    }

    /// Returns the last snapshot if it is still the current one. It reads no log, so that it waits for no threads.
    ///
    /// # Errors
    /// [`Error::Lake`] if the lake cannot be read.
    pub async fn known_snapshot(&self) -> Result<Option<Arc<LakeSnapshot>>, Error> {
        self.engine.catalog().known_current_snapshot().await
    }

    /// Returns the rows that `SELECT columns FROM table WHERE run_id IN (runs) AND pair_id IN (pairs)` has of a
    /// snapshot that the session has given, without a plan. The table's rows are those of runs, and each has a pair. To
    /// be called as a part of [`Session::run_request`].
    ///
    /// # Errors
    /// [`Error::Lake`] if the table has a fault or a file is damaged; [`Error::Execution`] if it cannot be read.
    pub fn read_pair_rows<'a>(
        &'a self,
        snapshot: &'a LakeSnapshot,
        table: Table,
        runs: &'a [RunId],
        pairs: &'a [i32],
        columns: &'a [&'a str],
        reading: RowReading,
    ) -> BoxFuture<'a, Result<RecordBatch, Error>> {
        let read = async move {
            let rows = self.engine.catalog().run_rows(snapshot, table).read_pairs(runs, pairs, columns, reading).await;
            rows.map_err(|e| Error::from_execution("", &e))
        };
        read.boxed()
    }

    /// Returns the rows that `SELECT columns FROM table WHERE run_id = run` has, in the same way, in batches. The
    /// columns are no lists.
    ///
    /// # Errors
    /// As [`Session::read_pair_rows`].
    pub fn read_run_rows<'a>(
        &'a self,
        snapshot: &'a LakeSnapshot,
        table: Table,
        run: &'a RunId,
        columns: &'a [&'a str],
    ) -> BoxFuture<'a, Result<Vec<RecordBatch>, Error>> {
        let read = async move {
            let rows = self.engine.catalog().run_rows(snapshot, table).read_run(run, columns).await;
            rows.map_err(|e| Error::from_execution("", &e))
        };
        read.boxed()
    }

    /// Makes the next query look for a newer version of the lake, however short ago the last look was.
    pub fn expire_snapshot(&self) {
        self.engine.catalog().expire_check();
    }

    /// Returns the annotations on some runs that a snapshot shows, in the order in which they were added.
    ///
    /// # Errors
    /// [`Error::Lake`] if they cannot be read.
    pub async fn annotations_on(
        &self,
        snapshot: &LakeSnapshot,
        runs: &HashSet<RunId>,
    ) -> Result<Vec<Annotation>, Error> {
        self.engine.catalog().annotations_on(snapshot, runs).await
    }

    /// Returns the contents of a run's file, from its summary and message indexes.
    ///
    /// # Errors
    /// [`Error::Execution`] if the file cannot be read.
    pub async fn read_contents(&self, run: &VisibleRun) -> Result<Contents, Error> {
        self.engine.catalog().read_contents(run).await
    }

    /// Returns the bytes of the first attachment of a run's file whose name has this ending; None if there is none.
    ///
    /// # Errors
    /// As [`Session::read_contents`].
    pub async fn read_attachment(&self, run: &VisibleRun, ending: &str) -> Result<Option<Bytes>, Error> {
        self.engine.catalog().read_attachment(run, ending).await
    }

    /// Returns the functions, sorted by name.
    pub fn sql_functions(&self) -> Vec<SqlFunction> {
        self.engine.sql_functions()
    }

    /// Returns the tables and views with their schemas.
    pub fn table_schemas(&self) -> impl Iterator<Item = (&'static str, SchemaRef)> {
        self.engine.catalog().table_schemas()
    }

    /// Returns the tables of the schema `system` with their schemas.
    pub fn system_tables(&self) -> Vec<(&'static str, SchemaRef)> {
        let of_engine = self.source_tables().into_iter().map(|(name, table)| (name, table.schema()));
        self.engine.catalog().system_tables().into_iter().chain(of_engine).collect()
    }

    /// Returns all tables and views by the names that SQL has for them, and their schemas: those of the lake, then
    /// those of the schema `system`.
    pub fn all_tables(&self) -> Vec<(String, SchemaRef)> {
        let own = self.table_schemas().map(|(name, schema)| (name.to_owned(), schema));
        let system = self.system_tables().into_iter();
        own.chain(system.map(|(name, schema)| (format!("{SYSTEM_SCHEMA}.{name}"), schema))).collect()
    }

    /// Returns the views with their definitions, SQL over the tables.
    pub fn view_definitions(&self) -> impl Iterator<Item = (&'static str, String)> {
        self.engine.catalog().view_definitions()
    }
}

#[cfg(test)]
impl Session {
    /// Plans a query for this process.
    pub(crate) async fn plan_locally(&self, sql: &str) -> Arc<dyn datafusion::physical_plan::ExecutionPlan> {
        let prepared = self.prepare(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        prepared.state.create_physical_plan(&prepared.plan).await.unwrap_or_else(|e| panic!("{sql}: {e}"))
    }
}

/// A started query with its permit, before it is planned.
struct Started {
    ticket: Arc<QueryTicket>,
    place: QueryPermit,
}

#[cfg(test)]
pub(crate) mod tests;

#[cfg(test)]
mod call_limits_tests;

#[cfg(test)]
mod known_plans_tests;

#[cfg(test)]
mod limits_tests;

#[cfg(test)]
mod turns_tests;

#[cfg(test)]
mod attempts;

#[cfg(test)]
mod eager_aggregation_tests;

#[cfg(test)]
mod escape_tests;

#[cfg(test)]
pub(crate) mod function_tests;

#[cfg(test)]
mod percentile_tests;

#[cfg(test)]
mod plan_tests;

#[cfg(test)]
mod request_tests;

#[cfg(test)]
mod right_answers_tests;
