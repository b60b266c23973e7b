//! The service of one client, as the three protocols share it: the shared engine with the client's rights, its quota,
//! encoder threads, and metrics.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use datafusion::common::ParamValues;
use echolake_lake::Lake;
use echolake_query::{
    EngineClient, PreparedQuery, QueryEngine, QueryThreads, RequestMemory, Session, SqlFunction, SystemSource,
    continue_request,
};
use futures::future::BoxFuture;
use futures::{FutureExt as _, TryFutureExt as _};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tracing::Instrument as _;

use crate::client_identity::ClientIdentity;
use crate::door_rows::{ClientRows, DoorRows};
use crate::engine_report::EngineReport;
use crate::fault::{FaultCode, RequestFault};
use crate::query_watch::{QueryTimer, QueryWatch, RunningWatches};
use crate::request_number::current_request;
use crate::running::{
    AnswerEncoder, RunningQuery, SessionTimeLimit, WAITING, finish_task, split_batch, wait_for_fault,
};
use crate::server_protocol::ServerProtocol;
use crate::stop_signal::StopSignal;
use crate::token_scope::TokenScope;

/// The catalogue of the lake's tables, as DataFusion calls it.
pub const CATALOG: &str = "datafusion";
/// Their schema, as DataFusion calls it.
pub const SCHEMA: &str = "public";

/// The service of one client. Clones are the same.
#[derive(Clone)]
pub struct QueryService(Arc<ServiceState>);

struct ServiceState {
    shared: Arc<SharedService>,
    /// The lake as the client sees it.
    lake: Lake,
    /// The shared engine with the client's rights.
    engine: QueryEngine,
    identity: ClientIdentity,
    client: Arc<EngineClient>,
}

/// What all clients of an engine share.
pub(crate) struct SharedService {
    /// The lake, all of it.
    pub lake: Lake,
    /// The engine with the rights of a reader of all projects.
    pub engine: QueryEngine,
    pub watches: Arc<RunningWatches>,
    pub door_rows: Arc<DoorRows>,
    // Answers are encoded on threads of their own: connections are answered, and queries cancelled, while all are busy.
    pub encoders: QueryThreads,
}

/// The query text or plan to run.
pub enum QueryWork {
    /// A text.
    Sql(String),
    /// A prepared plan, with values for its placeholders.
    Prepared(Arc<PreparedQuery>, ParamValues),
}

impl QueryWork {
    fn statement_text(&self) -> &str {
        match self {
            Self::Sql(sql) => sql,
            Self::Prepared(prepared, _) => prepared.sql(),
        }
    }
}

/// A query to run.
pub struct QueryJob {
    /// Its protocol.
    pub protocol: ServerProtocol,
    /// Its session.
    pub session: Arc<Session>,
    /// The text or plan.
    pub work: QueryWork,
    /// The session's own limit of time, beside its client's quota.
    pub limit: Option<SessionTimeLimit>,
    /// Stops it from another task.
    pub stop: StopSignal,
}

impl QueryService {
    /// The service of one client, whose queries count against the quota of `client`.
    ///
    /// # Errors
    /// [`RequestFault`] if the lake's tables cannot be laid out for its rights.
    pub(crate) fn new(
        shared: &Arc<SharedService>,
        identity: ClientIdentity,
        client: Arc<EngineClient>,
    ) -> Result<Self, RequestFault> {
        let lake = identity.visible_lake(&shared.lake);
        let engine = shared.engine.of_lake(&lake)?;
        Ok(Self(Arc::new(ServiceState { shared: shared.clone(), lake, engine, identity, client })))
    }

    /// The lake, as the client sees it.
    pub fn lake(&self) -> &Lake {
        &self.0.lake
    }

    /// The query engine.
    pub fn engine(&self) -> &QueryEngine {
        &self.0.engine
    }

    /// Returns whether the server has no tokens.
    pub fn is_open(&self) -> bool {
        self.0.identity.is_open
    }

    /// The client whose requests these are, if they may do this.
    ///
    /// # Errors
    /// [`RequestFault::Forbidden`].
    pub fn authorised_client(&self, scope: TokenScope) -> Result<Arc<EngineClient>, RequestFault> {
        self.0.identity.require_scope(scope).inspect_err(EngineReport::record_failure)?;
        Ok(self.0.client.clone())
    }

    /// Returns whether the client's token is for something.
    pub fn has_scope(&self, scope: TokenScope) -> bool {
        self.0.identity.require_scope(scope).is_ok()
    }

    /// Reports a failed request to the door, which counts them.
    pub fn report_failure(&self, code: FaultCode) {
        EngineReport::Failure(code).queue_line();
    }

    /// Watches a query, or other work that is listed among queries, until the timer is dropped.
    pub fn watch_query(&self, protocol: ServerProtocol, statement: &str, stop: &StopSignal) -> QueryTimer {
        self.0.shared.watches.begin_watch(protocol, &self.0.identity.name, statement, stop)
    }

    /// The client's name.
    pub fn client_name(&self) -> &str {
        &self.0.identity.name
    }

    /// Begins a session: one per connection, or one per request if the protocol has no connections.
    pub fn begin_session(&self, client: &Arc<EngineClient>) -> Session {
        let rows: Arc<dyn SystemSource> = Arc::new(ClientRows {
            door: self.0.shared.door_rows.clone(),
            client: self.0.identity.name.clone(),
            sees_all: self.has_scope(TokenScope::Metrics),
        });
        self.0.engine.open_session(client).with_system(rows).of_request(current_request())
    }

    /// The tables and their schemas.
    pub fn lake_tables(&self) -> Vec<(&'static str, SchemaRef)> {
        self.begin_session(&self.0.client).table_schemas().collect()
    }

    /// The tables of the schema `system`, and their schemas.
    pub fn system_tables(&self) -> Vec<(&'static str, SchemaRef)> {
        self.begin_session(&self.0.client).system_tables()
    }

    /// All tables by the names that SQL has for them, and their schemas: those of the lake, then those of the schema
    /// `system`.
    pub fn all_tables(&self) -> Vec<(String, SchemaRef)> {
        self.begin_session(&self.0.client).all_tables()
    }

    /// The views' definitions by their names.
    pub fn view_definitions(&self) -> HashMap<&'static str, String> {
        self.begin_session(&self.0.client).view_definitions().collect()
    }

    /// The field's functions.
    pub fn own_functions(&self) -> Vec<SqlFunction> {
        self.all_functions().into_iter().filter(|f| f.is_own).collect()
    }

    /// All functions, the field's and DataFusion's.
    pub fn all_functions(&self) -> Vec<SqlFunction> {
        self.begin_session(&self.0.client).sql_functions()
    }

    /// Spawns work on the encoder threads; dropping the returned task aborts it.
    pub fn spawn_work<T: Send + 'static>(&self, work: impl Future<Output = T> + Send + 'static) -> JoinSet<T> {
        let mut task = JoinSet::new();
        if let Some(threads) = self.0.shared.encoders.handle() {
            task.spawn_on(continue_request(work), threads);
        }
        task
    }

    /// Parses and plans for a client, away from the threads that answer connections. Boxed for the same reason as
    /// [`echolake_query::OpaqueValue`].
    pub fn plan_query<T: Send + 'static>(
        &self,
        client: &Arc<EngineClient>,
        work: impl Future<Output = Result<T, RequestFault>> + Send + 'static,
    ) -> BoxFuture<'_, Result<T, RequestFault>> {
        let session = self.begin_session(client);
        let work = work.in_current_span();
        let planned = async move { session.supervise_work(work).await };
        planned.inspect_err(EngineReport::record_failure).boxed()
    }

    /// Does the work of a request that is no query as a query is run: with one of the client's permits, within its time
    /// and memory, listed in `system.queries` as `listed_as` and cancelled by its number there, or by dropping this.
    /// Boxed as [`QueryService::plan_query`].
    ///
    /// # Errors
    /// Those of `work`, and what ended it.
    pub fn run_request<T: Send + 'static, F>(
        &self,
        protocol: ServerProtocol,
        client: &Arc<EngineClient>,
        listed_as: &'static str,
        work: impl FnOnce(RequestMemory) -> F + Send + 'static,
    ) -> BoxFuture<'static, Result<T, RequestFault>>
    where
        F: Future<Output = Result<T, RequestFault>> + Send + 'static,
    {
        let service = self.clone();
        let session = self.begin_session(client);
        let span = tracing::error_span!("query", protocol = protocol.name(), client = self.0.identity.name);
        let run = async move {
            let stop = StopSignal::new();
            let timer = service.watch_query(protocol, listed_as, &stop);
            let done = tokio::select! {
                biased;
                () = stop.wait_for_stop() => Err(RequestFault::Cancelled),
                done = session.run_request(|memory| work(memory).in_current_span()) => done,
            };
            timer.watch().record_outcome(done.as_ref().err());
            done.inspect_err(EngineReport::record_failure)
        };
        run.instrument(span).boxed()
    }

    /// Computes something long, which waits for nothing.
    pub async fn compute_blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, RequestFault> {
        let handle = self.0.shared.encoders.handle().map(|threads| threads.spawn_blocking(work));
        let Some(handle) = handle else { return Err(RequestFault::Internal) };
        handle.await.map_err(RequestFault::defect("computing ended its task"))
    }

    /// Begins a query; its columns are known when this returns. Boxed as [`QueryService::plan_query`].
    ///
    /// # Errors
    /// What is wrong with the query, or ended it.
    pub fn begin_query<E: AnswerEncoder>(
        &self,
        job: QueryJob,
        encode: impl FnOnce(&SchemaRef) -> Result<E, RequestFault> + Send + 'static,
    ) -> BoxFuture<'_, Result<RunningQuery<E::Item>, RequestFault>> {
        let mut job = job;
        // A statement that an earlier request has planned runs for this one.
        if let Some(number) = current_request() {
            job.session = Arc::new(Session::clone(&job.session).of_request(Some(number)));
        }
        let begun = async move {
            let (columns, known) = oneshot::channel();
            let (to, items) = mpsc::channel(WAITING);
            let stop = job.stop.clone();
            let limit = job.limit;
            let span = tracing::error_span!("query", protocol = job.protocol.name(), client = self.0.identity.name);
            let timer = span.in_scope(|| self.watch_query(job.protocol, job.work.statement_text(), &job.stop));
            let watch = timer.watch().clone();
            let stopped = stop.clone();
            let work = async move {
                let done = tokio::select! {
                    done = run_query(timer.watch(), job, encode, columns, to) => done,
                    // Also if nobody fetches rows at present; who does says so.
                    () = stopped.wait_for_stop() => return Err(RequestFault::Cancelled),
                };
                timer.watch().record_outcome(done.as_ref().err());
                done.inspect_err(EngineReport::record_failure)
            };
            let mut task = self.spawn_work(work.instrument(span.clone()));
            tokio::select! {
                biased;
                fault = wait_for_fault(&stop, limit) => {
                    watch.record_outcome(Some(&fault));
                    span.in_scope(|| EngineReport::record_failure(&fault));
                    Err(fault)
                }
                schema = known => match schema {
                    Ok(schema) => Ok(RunningQuery { schema, items, task, stop, limit, watch, span }),
                    // It ended without having any: it says why.
                    Err(_) => finish_task(&mut task).await.and(Err(RequestFault::Internal)),
                }
            }
        };
        begun.boxed()
    }
}

async fn run_query<E: AnswerEncoder>(
    watch: &QueryWatch,
    job: QueryJob,
    encode: impl FnOnce(&SchemaRef) -> Result<E, RequestFault>,
    columns: oneshot::Sender<SchemaRef>,
    to: mpsc::Sender<E::Item>,
) -> Result<(), RequestFault> {
    let mut answer = match job.work {
        QueryWork::Sql(sql) => job.session.query(&sql).await?,
        QueryWork::Prepared(prepared, values) => job.session.execute(&prepared, values).await?,
    };
    watch.record_planned();
    let mut encoder = encode(&answer.schema)?;
    // If sending fails, here and below, the receiver is gone: the query ends by being dropped.
    if columns.send(answer.schema.clone()).is_err() {
        return Ok(());
    }
    while let Some(batch) = answer.next().await? {
        watch.count_rows(&batch);
        watch.record_memory(answer.peak_memory());
        for part in split_batch(&batch) {
            for item in encoder.encode_batch(part)? {
                if to.send(item).await.is_err() {
                    return Ok(());
                }
            }
        }
    }
    watch.record_memory(answer.peak_memory());
    for item in encoder.encode_end()? {
        if to.send(item).await.is_err() {
            return Ok(());
        }
    }
    Ok(())
}
