//! The engine: what a process has, and the lake as readers with one right see it.

mod process;

use std::sync::Arc;
use std::time::Duration;

use datafusion::catalog::{CatalogProviderList as _, MemoryCatalogProvider, MemoryCatalogProviderList};
use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::Documentation;
use datafusion::prelude::SessionContext;
use echolake_lake::Lake;
use futures::FutureExt as _;
use tokio::runtime::Handle;

use crate::catalog::LakeCatalog;
use crate::client::QueryQuota;
use crate::control::blame::StatementBlame;
use crate::control::{QueryTicket, StopReason};
use crate::spread::WorkerCluster;
use crate::{Error, OpaqueValue};
use process::EngineProcess;
pub(crate) use process::STORE;

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
    /// Statements that compute at once, while others wait; None for twice the cores, four at least. Statements whose
    /// readers fetch nothing do not count.
    pub computing: Option<usize>,
    /// Niceness of the threads that plan and run statements other than the program's own, -20 to 19; None for that of
    /// the process. Without a system that lets threads differ, as Linux does, it is the whole process's.
    pub niceness: Option<i32>,
    /// Bytes of decoded columns that the process keeps beside what queries hold; None for 256 MiB.
    pub column_bytes: Option<usize>,
    /// Statements that have threads at a time, those whose readers fetch nothing among them; None for any number.
    pub seats: Option<usize>,
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
        Self::with_limits(lake, EngineLimits { memory, ..EngineLimits::default() })
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

    /// Spreads heavy queries of all rights over workers; to be called once.
    pub fn spread_over(&self, cluster: Arc<WorkerCluster>) {
        let _ = self.process.cluster.set(cluster);
    }

    /// Returns the workers over which heavy queries are spread.
    pub fn cluster(&self) -> Option<&Arc<WorkerCluster>> {
        self.process.cluster.get()
    }

    /// Returns the number of queries that run or wait now.
    pub fn count_running(&self) -> usize {
        self.process.running.count_running()
    }

    /// Returns a statement that was ended (cancelled, out of time, its reader gone) or has ended, and of whose threads
    /// one has computed for more than `grace` since. It is found by regular calls: the first one after its end notes
    /// what its threads had computed. Processor time counts, so that nothing is blamed for waiting on a busy machine.
    pub fn find_runaway(&self, grace: Duration) -> Option<StatementBlame> {
        let running = self.process.running.find_runaway(grace);
        let on_seats = || self.process.seats.find_runaway(grace);
        running.or_else(on_seats).or_else(|| self.process.program_seats.find_runaway(grace))
    }

    /// Stops the statement that holds the most memory, with an error that says so; returns whose it was, and None if no
    /// statement holds any.
    pub fn cancel_largest(&self) -> Option<StatementBlame> {
        self.process.running.cancel_largest()
    }

    /// Cancels all that the clients of this name run.
    pub fn cancel_client(&self, name: &str) {
        self.process.running.cancel_client(name);
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

    /// Registers a ticket, which is stopped after `time`.
    pub(crate) fn start_ticket(&self, ticket: QueryTicket, time: Option<Duration>) -> Arc<QueryTicket> {
        let ticket = Arc::new(ticket);
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

    /// Runs `work` on the ticket's seat, once it has a turn. Dropping this stops it.
    // Constants are computed while a query is planned, so planning must not block the caller's threads.
    pub(crate) async fn on_seat<T: Send + 'static, E: From<Error> + Send + 'static>(
        &self,
        ticket: &Arc<QueryTicket>,
        work: impl Future<Output = Result<T, E>> + Send + 'static,
    ) -> Result<T, E> {
        let mut stop = StopOnDrop { ticket: ticket.clone(), is_done: false };
        let begun = ticket.clone();
        let work = ticket.scope_work(work);
        let guarded = async move {
            tokio::select! {
                biased;
                why = begun.wait_for_stop() => Err(Error::from_stop(&why).into()),
                done = work => done,
            }
        };
        let guarded = guarded.boxed();
        let work = async {
            let threads = self.begin_computing(ticket).await?;
            threads.spawn(guarded).await.unwrap_or_else(|_| Err(defect_error().into()))
        };
        let done = tokio::select! {
            done = work => done,
            why = ticket.wait_for_stop() => Err(Error::from_stop(&why).into()),
        };
        stop.is_done = true;
        done
    }

    /// Waits for a turn of the ticket, and takes its seat; returns the seat's threads.
    pub(crate) async fn begin_computing(&self, ticket: &QueryTicket) -> Result<Handle, Error> {
        let seats = if ticket.is_program { &self.process.program_seats } else { &self.process.seats };
        let threads = ticket.begin_computing(&self.process.turns, seats).await;
        let failed = |e| Error::failed_query(&format!("the system gives no threads for the query: {e}"));
        threads.map_err(failed)?.ok_or_else(ended_error)
    }

    /// Waits for a turn of the ticket, which has a seat.
    pub(crate) async fn resume_computing(&self, ticket: &QueryTicket) {
        ticket.resume_computing(&self.process.turns).await;
    }

    /// Returns the catalogue of tables and views.
    pub(crate) fn catalog(&self) -> &LakeCatalog {
        &self.catalog
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
        let mut state = self.process.template.clone();
        let catalogs = MemoryCatalogProviderList::new();
        let name = state.config_options().catalog.default_catalog.clone();
        catalogs.register_catalog(name, Arc::new(MemoryCatalogProvider::new()));
        state.register_catalog_list(Arc::new(catalogs));
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

// The error for an engine that has ended.
fn ended_error() -> Error {
    Error::failed_query("the query service has ended")
}

/// Returns the error for a panic.
pub(crate) fn defect_error() -> Error {
    Error::failed_query("a defect ended it")
}

#[cfg(test)]
mod tests;
