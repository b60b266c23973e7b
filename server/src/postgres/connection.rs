//! A connection: its session, settings and cursors, and what runs on it.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use bytes::Bytes;
use datafusion::common::ParamValues;
use datafusion_pg_catalog::sql::PostgresCompatibilityParser;
use echolake_query::{EngineClient, Session};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use pgwire::api::Type;
use pgwire::messages::startup::SecretKey;
use tokio::sync::SetOnce;

use super::catalog::PgCatalog;
use super::cursor::Cursor;
use super::settings::Settings;
use super::statement::{self, Planned, Statement};
use crate::Error;
use crate::fault::Fault;
use crate::metrics::Protocol;
use crate::running::{Encode, Limit, Running, Stop, ended};
use crate::service::{FRESH, Job, Service, Work};

/// Cursors of a connection at once.
const CURSORS: usize = 16;
/// Bytes of a query, as over HTTP.
const LARGEST: usize = 2 << 20;
/// Prepared statements of a connection at once, and portals.
const NAMED: usize = 500;

/// What a client cancels by: the process's number and the secret that it was given.
type BackendKey = (i32, Bytes);

/// What all connections share.
pub(super) struct Shared {
    pub(super) service: Service,
    pub(super) parser: PostgresCompatibilityParser,
    pub(super) catalog: PgCatalog,
    next_pid: AtomicI32,
    running: Mutex<HashMap<BackendKey, Arc<Mutex<Stop>>>>,
}

impl Shared {
    pub(super) fn new(service: Service) -> Result<Self, Error> {
        let catalog = PgCatalog::new(service.tables(), service.functions())?;
        let parser = PostgresCompatibilityParser::new();
        Ok(Self { service, parser, catalog, next_pid: AtomicI32::new(1), running: Mutex::default() })
    }

    /// Ends what runs on the connection of this key.
    pub(super) fn cancel(&self, pid: i32, key: &SecretKey) {
        let found = lock(&self.running).get(&(pid, key.to_bytes())).cloned();
        if let Some(current) = found {
            lock(&current).stop();
        }
    }
}

/// A connection.
pub(super) struct Connection {
    shared: Arc<Shared>,
    session: SetOnce<Arc<Session>>,
    key: OnceLock<BackendKey>,
    current: Arc<Mutex<Stop>>,
    cursors: Mutex<HashMap<String, Arc<Cursor>>>,
    kept: Mutex<HashSet<(Kept, String)>>,
    pub(super) settings: Arc<Settings>,
}

impl Drop for Connection {
    fn drop(&mut self) {
        if let Some(key) = self.key.get() {
            lock(&self.shared.running).remove(key);
        }
    }
}

/// What clients keep by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Kept {
    Statement,
    Portal,
}

impl Kept {
    fn name(self) -> &'static str {
        match self {
            Self::Statement => "prepared statements",
            Self::Portal => "portals",
        }
    }
}

/// What a command runs under.
#[derive(Clone)]
pub(super) struct Run {
    pub(super) stop: Stop,
    pub(super) limit: Option<Limit>,
}

impl Connection {
    /// A connection that nobody has logged in on.
    pub(super) fn new(shared: Arc<Shared>) -> Self {
        Self {
            shared,
            session: SetOnce::new(),
            key: OnceLock::new(),
            current: Arc::new(Mutex::new(Stop::new())),
            cursors: Mutex::default(),
            kept: Mutex::default(),
            settings: Arc::default(),
        }
    }

    pub(super) fn shared(&self) -> &Shared {
        &self.shared
    }

    /// Logs a client in; returns what a CancelRequest must show. `wide` keys are of protocol 3.2.
    pub(super) fn log_in(&self, client: &Arc<EngineClient>, wide: bool) -> Result<(i32, SecretKey), Fault> {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).map_err(|failed| {
            eprintln!("no random bytes: {failed}");
            Fault::Internal
        })?;
        let pid = self.shared.next_pid.fetch_add(1, Ordering::Relaxed);
        let key = match wide {
            true => SecretKey::Bytes(Bytes::copy_from_slice(&secret)),
            false => SecretKey::I32(i32::from_be_bytes([secret[0], secret[1], secret[2], secret[3]])),
        };
        let session = self.shared.service.session(client).extended(self.shared.catalog.extend(&self.settings));
        let known = (pid, key.to_bytes());
        if self.session.set(Arc::new(session)).is_err() || self.key.set(known.clone()).is_err() {
            return Err(Fault::request("this connection is logged in already"));
        }
        lock(&self.shared.running).insert(known, self.current.clone());
        Ok((pid, key))
    }

    /// Its session.
    pub(super) fn session(&self) -> Result<&Arc<Session>, Fault> {
        self.session.get().ok_or(Fault::Unauthenticated)
    }

    /// Waits until somebody has logged in.
    pub(super) async fn logged_in(&self) {
        self.session.wait().await;
    }

    /// Begins a command: a CancelRequest ends this one from now on.
    pub(super) fn command(&self) -> Run {
        let stop = Stop::new();
        *lock(&self.current) = stop.clone();
        Run { stop, limit: self.settings.statement_timeout().map(Limit::of) }
    }

    /// Parses and plans. Boxed for the same reason as [`echolake_query::Opaque`].
    pub(super) fn statements<'a>(
        &'a self,
        sql: &'a str,
        types: &'a [Option<Type>],
        run: &'a Run,
    ) -> BoxFuture<'a, Result<Vec<Statement>, Fault>> {
        let statements = async move {
            if sql.len() > LARGEST {
                return Err(Fault::TooLarge { limit: LARGEST });
            }
            let (shared, session) = (self.shared.clone(), self.session()?.clone());
            let (sql, types): (Arc<str>, _) = (sql.into(), types.to_vec());
            let work = async move {
                let mut statements = Vec::new();
                for parsed in statement::parse(&shared.parser, &session, &sql, &types)? {
                    statements.push(statement::plan(&session, &sql, parsed).await?);
                }
                Ok(statements)
            };
            self.planned(run, work).await
        };
        statements.boxed()
    }

    async fn planned<T: Send + 'static>(
        &self,
        run: &Run,
        work: impl Future<Output = Result<T, Fault>> + Send + 'static,
    ) -> Result<T, Fault> {
        tokio::select! {
            fault = ended(&run.stop, run.limit) => Err(fault),
            planned = self.shared.service.plan(self.session()?.client(), work) => planned,
        }
    }

    /// Runs what was planned, anew where the plan is old.
    pub(super) async fn run<E: Encode>(
        &self,
        run: &Run,
        planned: &Arc<Planned>,
        values: ParamValues,
        encode: impl FnOnce(&arrow::datatypes::SchemaRef) -> Result<E, Fault> + Send + 'static,
    ) -> Result<Running<E::Item>, Fault> {
        let session = self.session()?.clone();
        let prepared = match planned.at.elapsed() < FRESH {
            true => planned.prepared.clone(),
            false => {
                let (planner, old) = (session.clone(), planned.clone());
                let new = self.planned(run, async move { Ok(old.again(&planner).await?) }).await?;
                if new.schema() != planned.prepared.schema() {
                    return Err(Fault::unsupported("a prepared statement whose columns have changed since"));
                }
                Arc::new(new)
            }
        };
        let job = Job {
            protocol: Protocol::Postgres,
            session,
            work: Work::Prepared(prepared, values),
            limit: run.limit,
            stop: run.stop.clone(),
        };
        self.shared.service.begin(job, encode).await
    }

    /// Counts what a client keeps by name.
    pub(super) fn remember(&self, kind: Kept, name: &str) -> Result<(), Fault> {
        let mut all = lock(&self.kept);
        let new = (kind, name.to_owned());
        if !all.contains(&new) && all.iter().filter(|(known, _)| *known == kind).count() >= NAMED {
            return Err(Fault::TooMany { what: kind.name(), limit: NAMED });
        }
        all.insert(new);
        Ok(())
    }

    /// Counts it no more.
    pub(super) fn forget(&self, kind: Kept, name: &str) {
        lock(&self.kept).remove(&(kind, name.to_owned()));
    }

    /// All portals are gone.
    pub(super) fn forget_portals(&self) {
        lock(&self.kept).retain(|(kind, _)| *kind != Kept::Portal);
    }

    /// Keeps a cursor.
    pub(super) fn declare(&self, name: &str, cursor: Cursor) -> Result<(), Fault> {
        let mut cursors = lock(&self.cursors);
        if cursors.contains_key(name) {
            return Err(Fault::request(format!("cursor \"{name}\" already exists")));
        }
        if cursors.len() >= CURSORS {
            return Err(Fault::TooMany { what: "cursors", limit: CURSORS });
        }
        cursors.insert(name.to_owned(), Arc::new(cursor));
        Ok(())
    }

    /// A cursor.
    pub(super) fn cursor(&self, name: &str) -> Result<Arc<Cursor>, Fault> {
        let missing = || Fault::NotFound { what: format!("cursor \"{name}\""), hint: "DECLARE it first" };
        lock(&self.cursors).get(name).cloned().ok_or_else(missing)
    }

    /// Closes a cursor, or all of them.
    pub(super) fn close(&self, name: Option<&str>) -> Result<(), Fault> {
        match name {
            Some(name) => {
                self.cursor(name)?;
                lock(&self.cursors).remove(name);
            }
            None => lock(&self.cursors).clear(),
        }
        Ok(())
    }

    /// Ends a transaction: the cursors go that are not held.
    pub(super) fn end_transaction(&self) {
        lock(&self.cursors).retain(|_, cursor| cursor.held);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
