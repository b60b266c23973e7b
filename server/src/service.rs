//! State shared by the three protocols: the query engine, its client, encoder threads, and metrics.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use arrow::datatypes::SchemaRef;
use datafusion::common::ParamValues;
use echolake_lake::Lake;
use echolake_query::{EngineClient, PreparedQuery, QueryEngine, QueryQuota, QueryThreads, Session, SqlFunction};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tracing::Instrument as _;

use crate::Error;
use crate::client_identity::ClientIdentity;
use crate::fault::RequestFault;
use crate::metrics::{ServerMetrics, ServerProtocol};
use crate::running::{AnswerEncoder, RunningQuery, SessionTimeLimit, StopSignal, WAITING, ended, finish, parts};
use crate::tokens::TokenScope;

/// Maximal age of a plan, which sees the lake as of its planning.
pub(crate) const FRESH: Duration = Duration::from_secs(2);
/// The catalogue and schema of the lake's tables, as DataFusion calls them.
pub(crate) const CATALOG: &str = "datafusion";
pub(crate) const SCHEMA: &str = "public";

/// State shared by the three protocols.
#[derive(Clone)]
pub(crate) struct QueryService(Arc<ServiceState>);

struct ServiceState {
    lake: Lake,
    engine: QueryEngine,
    identity: ClientIdentity,
    client: Arc<EngineClient>,
    activity: ActivityCounter,
    metrics: ServerMetrics,
    // Answers are encoded on threads of their own: connections are answered, and queries cancelled, while all are busy.
    encoders: QueryThreads,
}

/// The query text or plan to run.
pub(crate) enum QueryWork {
    /// A text.
    Sql(String),
    /// A prepared plan, with values for its placeholders.
    Prepared(Arc<PreparedQuery>, ParamValues),
}

/// A query to run.
pub(crate) struct QueryJob {
    pub(crate) protocol: ServerProtocol,
    pub(crate) session: Arc<Session>,
    pub(crate) work: QueryWork,
    /// The session's own limit of time, beside its client's quota.
    pub(crate) limit: Option<SessionTimeLimit>,
    /// Stops it from another task.
    pub(crate) stop: StopSignal,
}

/// Counts requests, and work for them.
#[derive(Clone, Default)]
pub(crate) struct ActivityCounter(Arc<AtomicUsize>);

/// One that is counted, until this is dropped.
pub(crate) struct ActivityGuard(ActivityCounter);

impl Drop for ActivityGuard {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl ActivityCounter {
    pub(crate) fn enter(&self) -> ActivityGuard {
        self.0.fetch_add(1, Ordering::Relaxed);
        ActivityGuard(self.clone())
    }

    pub(crate) fn count(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

impl QueryService {
    pub(crate) fn new(lake: &Lake, engine: QueryEngine, identity: ClientIdentity) -> Result<Self, Error> {
        Ok(Self(Arc::new(ServiceState {
            lake: lake.clone(),
            engine,
            client: Arc::new(EngineClient::new(identity.name.clone(), identity.quota())),
            identity,
            activity: ActivityCounter::default(),
            metrics: ServerMetrics::default(),
            encoders: QueryThreads::per_core("encode").map_err(Error::System)?,
        })))
    }

    pub(crate) fn lake(&self) -> &Lake {
        &self.0.lake
    }

    pub(crate) fn engine(&self) -> &QueryEngine {
        &self.0.engine
    }

    /// Returns whether the server has no tokens.
    pub(crate) fn is_open(&self) -> bool {
        self.0.identity.is_open
    }

    /// The client whose requests these are, if they may do this.
    ///
    /// # Errors
    /// [`RequestFault::Forbidden`].
    pub(crate) fn client(&self, scope: TokenScope) -> Result<Arc<EngineClient>, RequestFault> {
        self.0.identity.require(scope).inspect_err(|fault| self.0.metrics.record_failure(fault))?;
        Ok(self.0.client.clone())
    }

    /// Requests that are being answered.
    pub(crate) fn activity(&self) -> &ActivityCounter {
        &self.0.activity
    }

    pub(crate) fn metrics(&self) -> &ServerMetrics {
        &self.0.metrics
    }

    /// Begins a session: one per connection, or one per request if the protocol has no connections.
    pub(crate) fn session(&self, client: &Arc<EngineClient>) -> Session {
        self.0.engine.session(client)
    }

    /// The tables and their schemas.
    pub(crate) fn tables(&self) -> Vec<(&'static str, SchemaRef)> {
        let nobody = Arc::new(EngineClient::new("tables", QueryQuota::default()));
        self.session(&nobody).tables().collect()
    }

    /// The field's functions.
    pub(crate) fn functions(&self) -> Vec<SqlFunction> {
        let nobody = Arc::new(EngineClient::new("functions", QueryQuota::default()));
        self.session(&nobody).functions().into_iter().filter(|f| f.is_own).collect()
    }

    /// Spawns work on the encoder threads; dropping the returned task aborts it.
    pub(crate) fn spawn<T: Send + 'static>(&self, work: impl Future<Output = T> + Send + 'static) -> JoinSet<T> {
        let mut task = JoinSet::new();
        let guard = self.0.activity.enter();
        if let Some(threads) = self.0.encoders.handle() {
            let work = async move {
                let _guard = guard;
                work.await
            };
            task.spawn_on(work, threads);
        }
        task
    }

    /// Parses and plans for a client, away from the threads that answer connections.
    pub(crate) async fn plan<T: Send + 'static>(
        &self,
        client: &EngineClient,
        work: impl Future<Output = Result<T, RequestFault>> + Send + 'static,
    ) -> Result<T, RequestFault> {
        let guard = self.0.activity.enter();
        let work = async move {
            let _guard = guard;
            work.await
        };
        let planned = self.0.engine.supervise(client.quota().time, work.in_current_span()).await;
        planned.inspect_err(|fault| self.0.metrics.record_failure(fault))
    }

    /// Computes something long, which waits for nothing.
    pub(crate) async fn crunch<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, RequestFault> {
        let guard = self.0.activity.enter();
        let work = move || {
            let _guard = guard;
            work()
        };
        let handle = self.0.encoders.handle().map(|threads| threads.spawn_blocking(work));
        let Some(handle) = handle else { return Err(RequestFault::Internal) };
        handle.await.map_err(RequestFault::defect("computing ended its task"))
    }

    /// Begins a query; its columns are known when this returns.
    ///
    /// # Errors
    /// What is wrong with the query, or ended it.
    pub(crate) async fn begin<E: AnswerEncoder>(
        &self,
        job: QueryJob,
        encode: impl FnOnce(&SchemaRef) -> Result<E, RequestFault> + Send + 'static,
    ) -> Result<RunningQuery<E::Item>, RequestFault> {
        let (columns, known) = oneshot::channel();
        let (to, items) = mpsc::channel(WAITING);
        let (stop, limit) = (job.stop.clone(), job.limit);
        let inner = self.0.clone();
        let span = tracing::error_span!("query", protocol = job.protocol.name(), client = self.0.identity.name);
        let work = async move {
            let _timed = inner.metrics.begin(job.protocol);
            let done = run(&inner.metrics, job, encode, columns, to).await;
            done.inspect_err(|fault| inner.metrics.record_failure(fault))
        };
        let mut task = self.spawn(work.instrument(span.clone()));
        tokio::select! {
            biased;
            fault = ended(&stop, limit) => {
                span.in_scope(|| self.0.metrics.record_failure(&fault));
                Err(fault)
            }
            schema = known => match schema {
                Ok(schema) => Ok(RunningQuery { schema, items, task, stop, limit, service: self.clone(), span }),
                // It ended without having any: it says why.
                Err(_) => finish(&mut task).await.and(Err(RequestFault::Internal)),
            }
        }
    }
}

async fn run<E: AnswerEncoder>(
    metrics: &ServerMetrics,
    job: QueryJob,
    encode: impl FnOnce(&SchemaRef) -> Result<E, RequestFault>,
    columns: oneshot::Sender<SchemaRef>,
    to: mpsc::Sender<E::Item>,
) -> Result<(), RequestFault> {
    let mut answer = match job.work {
        QueryWork::Sql(sql) => job.session.query(&sql).await?,
        QueryWork::Prepared(prepared, values) => job.session.execute(&prepared, values).await?,
    };
    let mut encoder = encode(&answer.schema)?;
    // If sending fails, here and below, the receiver is gone: the query ends by being dropped.
    if columns.send(answer.schema.clone()).is_err() {
        return Ok(());
    }
    while let Some(batch) = answer.next().await? {
        metrics.rows(batch.num_rows());
        for part in parts(&batch) {
            for item in encoder.batch(part)? {
                if to.send(item).await.is_err() {
                    return Ok(());
                }
            }
        }
    }
    for item in encoder.end()? {
        if to.send(item).await.is_err() {
            return Ok(());
        }
    }
    Ok(())
}
