//! A connection: its session, settings and cursors, and what runs on it.

use std::collections::HashMap;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use bytes::Bytes;
use datafusion::common::ParamValues;
use datafusion_pg_catalog::sql::PostgresCompatibilityParser;
use echolake_query::{EngineClient, Session};
use echolake_service::running::{AnswerEncoder, RunningQuery, SessionTimeLimit, wait_for_fault};
use echolake_service::{Error, QueryJob, QueryService, QueryWork, RequestFault, ServerProtocol, StopSignal};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use pgwire::messages::startup::SecretKey;
use tokio::sync::SetOnce;

use super::catalog::PgCatalog;
use super::cursor::{CommandRun, QueryCursor};
use super::settings::SessionSettings;
use super::statement::{self, ClientStatement, PlannedQuery};

/// Cursors of a connection at once.
const CURSORS: usize = 16;
/// Bytes of a query, as over HTTP.
const LARGEST: usize = 2 << 20;

/// The key by which a client cancels: the process's number and the secret that it was given.
pub(super) type BackendKey = (i32, Bytes);

/// The connections of all clients, by their keys, with what runs on them.
pub(super) type RunningCommands = Arc<Mutex<HashMap<BackendKey, Arc<Mutex<StopSignal>>>>>;

/// State shared by all connections of a client.
pub(super) struct PostgresState {
    pub service: QueryService,
    pub parser: PostgresCompatibilityParser,
    pub catalog: PgCatalog,
    next_pid: AtomicI32,
    running: RunningCommands,
}

impl PostgresState {
    pub fn new(service: QueryService, running: RunningCommands) -> Result<Self, Error> {
        let catalog = PgCatalog::new(&service)?;
        let parser = PostgresCompatibilityParser::new();
        Ok(Self { service, parser, catalog, next_pid: AtomicI32::new(1), running })
    }

    /// Cancels the query on the connection of this key.
    pub fn cancel_query(&self, pid: i32, key: &SecretKey) {
        let found = lock_mutex(&self.running).get(&(pid, key.to_bytes())).cloned();
        if let Some(current) = found {
            lock_mutex(&current).stop();
        }
    }
}

/// A connection.
pub(super) struct PostgresConnection {
    shared: Arc<PostgresState>,
    session: SetOnce<Arc<Session>>,
    key: OnceLock<BackendKey>,
    current: Arc<Mutex<StopSignal>>,
    cursors: Mutex<HashMap<String, Arc<QueryCursor>>>,
    pub settings: Arc<SessionSettings>,
}

impl Drop for PostgresConnection {
    fn drop(&mut self) {
        if let Some(key) = self.key.get() {
            lock_mutex(&self.shared.running).remove(key);
        }
    }
}

impl PostgresConnection {
    /// A connection without a login.
    pub fn new(shared: Arc<PostgresState>) -> Self {
        Self {
            shared,
            session: SetOnce::new(),
            key: OnceLock::new(),
            current: Arc::new(Mutex::new(StopSignal::new())),
            cursors: Mutex::default(),
            settings: Arc::default(),
        }
    }

    pub fn shared(&self) -> &PostgresState {
        &self.shared
    }

    /// Logs a client in, whose connection has a number if the door gave one; returns what a CancelRequest must show.
    /// `wide` keys are of protocol 3.2.
    pub fn log_in(
        &self,
        client: &Arc<EngineClient>,
        pid: Option<i32>,
        wide: bool,
    ) -> Result<(i32, SecretKey), RequestFault> {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).map_err(RequestFault::defect("no random bytes"))?;
        let pid = pid.unwrap_or_else(|| self.shared.next_pid.fetch_add(1, Ordering::Relaxed));
        let key = match wide {
            true => SecretKey::Bytes(Bytes::copy_from_slice(&secret)),
            false => SecretKey::I32(i32::from_be_bytes([secret[0], secret[1], secret[2], secret[3]])),
        };
        let session = self
            .shared
            .service
            .begin_session(client)
            .with_extension(self.shared.catalog.session_extension(pid, &self.settings));
        let known = (pid, key.to_bytes());
        if self.session.set(Arc::new(session)).is_err() || self.key.set(known.clone()).is_err() {
            return Err(RequestFault::bad_request("this connection is logged in already"));
        }
        lock_mutex(&self.shared.running).insert(known, self.current.clone());
        Ok((pid, key))
    }

    /// Its session.
    pub fn session(&self) -> Result<&Arc<Session>, RequestFault> {
        self.session.get().ok_or(RequestFault::Unauthenticated)
    }

    /// Waits for the login.
    pub async fn logged_in(&self) {
        self.session.wait().await;
    }

    /// Begins a command: a CancelRequest ends this one from now on.
    pub fn begin_command(&self) -> CommandRun {
        let stop = StopSignal::new();
        *lock_mutex(&self.current) = stop.clone();
        CommandRun { stop, limit: self.settings.statement_timeout().map(SessionTimeLimit::from_now) }
    }

    /// Parses and plans. Boxed for the same reason as [`echolake_query::OpaqueValue`].
    pub fn plan_statements<'a>(
        &'a self,
        sql: &'a str,
        run: &'a CommandRun,
    ) -> BoxFuture<'a, Result<Vec<ClientStatement>, RequestFault>> {
        let statements = async move {
            if sql.len() > LARGEST {
                return Err(RequestFault::TooLarge { limit: LARGEST });
            }
            let shared = self.shared.clone();
            let session = self.session()?.clone();
            let sql: Arc<str> = sql.into();
            let work = async move {
                let mut statements = Vec::new();
                for parsed in
                    statement::parse_statements(&shared.parser, shared.catalog.empty_relations(), &session, &sql)?
                {
                    statements.push(statement::plan_statement(&session, &sql, parsed).await?);
                }
                Ok(statements)
            };
            self.plan_within(run, work).await
        };
        statements.boxed()
    }

    async fn plan_within<T: Send + 'static>(
        &self,
        run: &CommandRun,
        work: impl Future<Output = Result<T, RequestFault>> + Send + 'static,
    ) -> Result<T, RequestFault> {
        tokio::select! {
            fault = wait_for_fault(&run.stop, run.limit) => Err(fault),
            planned = self.shared.service.plan_query(self.session()?.client(), work) => planned,
        }
    }

    /// Runs a planned statement; plans it again if the lake has changed since.
    pub async fn run_planned<E: AnswerEncoder>(
        &self,
        run: &CommandRun,
        planned: &Arc<PlannedQuery>,
        values: ParamValues,
        encode: impl FnOnce(&arrow::datatypes::SchemaRef) -> Result<E, RequestFault> + Send + 'static,
    ) -> Result<RunningQuery<E::Item>, RequestFault> {
        let session = self.session()?.clone();
        let planner = session.clone();
        let known = planned.clone();
        let prepared = self.plan_within(run, async move { Ok(known.current_plan(&planner).await?) }).await?;
        if prepared.schema() != planned.prepared.schema() {
            return Err(RequestFault::unsupported("a prepared statement whose columns have changed since"));
        }
        let job = QueryJob {
            protocol: ServerProtocol::Postgres,
            session,
            work: QueryWork::Prepared(prepared, values),
            limit: run.limit,
            stop: run.stop.clone(),
        };
        self.shared.service.begin_query(job, encode).await
    }

    /// Keeps a cursor.
    pub fn declare_cursor(&self, name: &str, cursor: QueryCursor) -> Result<(), RequestFault> {
        let mut cursors = lock_mutex(&self.cursors);
        if cursors.contains_key(name) {
            return Err(RequestFault::bad_request(format!("cursor \"{name}\" already exists")));
        }
        if cursors.len() >= CURSORS {
            return Err(RequestFault::TooMany { what: "cursors", limit: CURSORS });
        }
        cursors.insert(name.to_owned(), Arc::new(cursor));
        Ok(())
    }

    /// A cursor.
    pub fn find_cursor(&self, name: &str) -> Result<Arc<QueryCursor>, RequestFault> {
        let missing = || RequestFault::NotFound { what: format!("cursor \"{name}\""), hint: "DECLARE it first" };
        lock_mutex(&self.cursors).get(name).cloned().ok_or_else(missing)
    }

    /// Closes a cursor, or all of them.
    pub fn close_cursors(&self, name: Option<&str>) -> Result<(), RequestFault> {
        match name {
            Some(name) => {
                self.find_cursor(name)?;
                lock_mutex(&self.cursors).remove(name);
            }
            None => lock_mutex(&self.cursors).clear(),
        }
        Ok(())
    }

    /// Ends a transaction: the cursors go that are not held.
    pub fn end_transaction(&self) {
        lock_mutex(&self.cursors).retain(|_, cursor| cursor.held);
    }
}

fn lock_mutex<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
