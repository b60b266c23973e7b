//! The engine: what a process has, and the lake as readers with one right see it.

mod process;

use std::sync::Arc;
use std::time::Duration;

use datafusion::catalog::{CatalogProvider as _, CatalogProviderList as _, TableProvider};
use datafusion::catalog::{MemoryCatalogProvider, MemoryCatalogProviderList, MemorySchemaProvider};
use datafusion::execution::session_state::{SessionState, SessionStateBuilder};
use datafusion::logical_expr::Documentation;
use datafusion::prelude::SessionContext;
use echolake_lake::Lake;
use futures::FutureExt as _;

use crate::catalog::LakeCatalog;
use crate::client::QueryQuota;
use crate::control::threads::QueryThreadGroups;
use crate::control::{QueryTicket, StopReason};
use crate::system::{self, SystemSource};
use crate::{Error, OpaqueValue};
use process::EngineProcess;

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
///
/// It is a handle: what its process has is shared by the engines of all rights, see [`QueryEngine::of_lake`].
#[derive(Clone)]
pub struct QueryEngine {
    process: OpaqueValue<EngineProcess>,
    catalog: OpaqueValue<LakeCatalog>,
}

/// Limits on all queries of a process together.
#[derive(Debug, Clone, Copy, Default)]
pub struct EngineLimits {
    /// Bytes that they may hold; None for no limit.
    pub memory: Option<usize>,
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
        Self::with_limits(lake, EngineLimits { memory })
    }

    /// Creates an engine on a lake with limits on all of its queries together.
    ///
    /// # Errors
    /// As [`QueryEngine::new`].
    pub fn with_limits(lake: &Lake, limits: EngineLimits) -> Result<Self, Error> {
        let process = EngineProcess::new(lake, &limits)?;
        let catalog = process.catalog_of(lake)?;
        Ok(Self { process: OpaqueValue::new(process), catalog })
    }

    /// Returns the engine for readers with the right of this view of its lake, in the same process: tables, snapshots
    /// and cached rows are those of the right, and nothing that a reader with another right caused is among them.
    ///
    /// # Errors
    /// [`Error::Execution`] if it is another lake.
    pub fn of_lake(&self, lake: &Lake) -> Result<Self, Error> {
        Ok(Self { process: self.process.clone(), catalog: self.process.catalog_of(lake)? })
    }

    /// Returns the lake as the engine's readers see it.
    pub fn lake(&self) -> &Lake {
        self.catalog.lake()
    }

    /// Adds tables to the schema `system`; to be called once.
    pub fn add_system_tables(&self, source: Arc<dyn SystemSource>) {
        let _ = self.process.system.set(source);
    }

    /// Returns the tables of the schema `system` that are not the lake's; none without a program around that has some.
    pub(crate) fn system_tables(&self) -> Vec<(&'static str, Arc<dyn TableProvider>)> {
        self.process.system.get().map_or_else(Vec::new, system::engine_tables)
    }

    /// Returns the number of queries that run or wait now.
    pub fn count_running(&self) -> usize {
        self.process.running.count_running()
    }

    /// Returns the longest time for which work has continued after its query was ended; None if there is none.
    pub fn longest_overdue(&self) -> Option<Duration> {
        self.process.running.longest_overdue()
    }

    /// Returns the functions, sorted by name.
    pub(crate) fn sql_functions(&self) -> Vec<SqlFunction> {
        let state = &self.process.template;
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
            is_own: self.process.own.contains(name),
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
        self.process.running.add_ticket(&ticket);
        if let (Some(time), Some(threads)) = (time, self.process.watch.handle()) {
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
            let Some(task) = self.process.threads.begin_work(guarded).await else { return Err(ended_error().into()) };
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
        &self.catalog
    }

    /// Returns the threads that plan and run queries.
    pub(crate) fn threads(&self) -> &QueryThreadGroups {
        &self.process.threads
    }

    /// Returns the memory limit of one query, bytes; `usize::MAX` if there is none.
    pub(crate) fn memory_limit(&self, quota: &QueryQuota) -> usize {
        self.process.memory.into_iter().chain(quota.memory).min().unwrap_or(usize::MAX)
    }

    /// Returns the state from which all contexts are built: without tables, with the same parser options.
    pub(crate) fn template_state(&self) -> &SessionState {
        &self.process.template
    }

    // One new context per query: its tables are of one snapshot, and nothing a query does outlives it. Functions and
    // optimizer rules are those of the template.
    pub(crate) fn create_context(&self) -> SessionContext {
        let names = &self.process.template.config_options().catalog;
        let catalog = MemoryCatalogProvider::new();
        // A new catalogue accepts any name.
        for schema in [&names.default_schema, system::SYSTEM_SCHEMA] {
            let _ = catalog.register_schema(schema, Arc::new(MemorySchemaProvider::new()));
        }
        let catalogs = MemoryCatalogProviderList::new();
        catalogs.register_catalog(names.default_catalog.clone(), Arc::new(catalog));
        let state = SessionStateBuilder::new_from_existing(self.process.template.clone())
            .with_catalog_list(Arc::new(catalogs))
            .build();
        SessionContext::new_with_state(state)
    }
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
mod tests;
