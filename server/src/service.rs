//! What the three protocols share: the query engine, whose it is, threads to compute on, and figures.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use arrow::datatypes::SchemaRef;
use datafusion::common::ParamValues;
use echolake_lake::Lake;
use echolake_query::{EngineClient, PreparedQuery, QueryEngine, QueryQuota, QueryThreads, Session, SqlFunction};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;

use crate::Error;
use crate::client_identity::ClientIdentity;
use crate::fault::Fault;
use crate::metrics::{Metrics, Protocol};
use crate::running::{Encode, Limit, Running, Stop, WAITING, ended, finish, parts};
use crate::tokens::Scope;

/// How long a plan is good for: it sees the lake as it was.
pub(crate) const FRESH: Duration = Duration::from_secs(2);
/// The catalogue and schema of the lake's tables, as DataFusion calls them.
pub(crate) const CATALOG: &str = "datafusion";
pub(crate) const SCHEMA: &str = "public";

/// What the three protocols share.
#[derive(Clone)]
pub(crate) struct Service(Arc<Inner>);

struct Inner {
    lake: Lake,
    engine: QueryEngine,
    identity: ClientIdentity,
    client: Arc<EngineClient>,
    activity: Activity,
    metrics: Metrics,
    // Answers are encoded on threads of their own: connections are answered, and queries cancelled, while all are busy.
    encoders: QueryThreads,
}

/// What to run.
pub(crate) enum Work {
    /// A text.
    Sql(String),
    /// What was planned before, with values for its placeholders.
    Prepared(Arc<PreparedQuery>, ParamValues),
}

/// A query to run.
pub(crate) struct Job {
    pub(crate) protocol: Protocol,
    pub(crate) session: Arc<Session>,
    pub(crate) work: Work,
    /// The session's own limit of time, beside its client's quota.
    pub(crate) limit: Option<Limit>,
    /// Ends it from elsewhere.
    pub(crate) stop: Stop,
}

/// Counts requests, and work for them.
#[derive(Clone, Default)]
pub(crate) struct Activity(Arc<AtomicUsize>);

/// One that is counted, until this is dropped.
pub(crate) struct ActivityGuard(Activity);

impl Drop for ActivityGuard {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Activity {
    pub(crate) fn enter(&self) -> ActivityGuard {
        self.0.fetch_add(1, Ordering::Relaxed);
        ActivityGuard(self.clone())
    }

    pub(crate) fn count(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

impl Service {
    pub(crate) fn new(lake: &Lake, engine: QueryEngine, identity: ClientIdentity) -> Result<Self, Error> {
        Ok(Self(Arc::new(Inner {
            lake: lake.clone(),
            engine,
            client: Arc::new(EngineClient::new(identity.name.clone(), identity.quota())),
            identity,
            activity: Activity::default(),
            metrics: Metrics::default(),
            encoders: QueryThreads::per_core("encode").map_err(Error::System)?,
        })))
    }

    pub(crate) fn lake(&self) -> &Lake {
        &self.0.lake
    }

    pub(crate) fn engine(&self) -> &QueryEngine {
        &self.0.engine
    }

    /// Whether the server has no tokens.
    pub(crate) fn is_open(&self) -> bool {
        self.0.identity.is_open
    }

    /// The client whose requests these are, if they may do this.
    ///
    /// # Errors
    /// [`Fault::Forbidden`].
    pub(crate) fn client(&self, scope: Scope) -> Result<Arc<EngineClient>, Fault> {
        self.0.identity.require(scope).inspect_err(|fault| self.0.metrics.failed(fault.code()))?;
        Ok(self.0.client.clone())
    }

    /// Requests that are being answered.
    pub(crate) fn activity(&self) -> &Activity {
        &self.0.activity
    }

    pub(crate) fn metrics(&self) -> &Metrics {
        &self.0.metrics
    }

    /// A session: one a connection, or a request where connections are not known.
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

    /// Begins work on the threads that encode answers; it ends where what this returns is dropped.
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
        work: impl Future<Output = Result<T, Fault>> + Send + 'static,
    ) -> Result<T, Fault> {
        let guard = self.0.activity.enter();
        let work = async move {
            let _guard = guard;
            work.await
        };
        let planned = self.0.engine.supervise(client.quota().time, work).await;
        planned.inspect_err(|fault| self.0.metrics.failed(fault.code()))
    }

    /// Computes something long, which waits for nothing.
    pub(crate) async fn crunch<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Fault> {
        let guard = self.0.activity.enter();
        let work = move || {
            let _guard = guard;
            work()
        };
        let handle = self.0.encoders.handle().map(|threads| threads.spawn_blocking(work));
        let Some(handle) = handle else { return Err(Fault::Internal) };
        handle.await.map_err(|failed| {
            eprintln!("computing ended its task: {failed}");
            Fault::Internal
        })
    }

    /// Begins a query; its columns are known when this returns.
    ///
    /// # Errors
    /// What is wrong with the query, or ended it.
    pub(crate) async fn begin<E: Encode>(
        &self,
        job: Job,
        encode: impl FnOnce(&SchemaRef) -> Result<E, Fault> + Send + 'static,
    ) -> Result<Running<E::Item>, Fault> {
        let (columns, known) = oneshot::channel();
        let (to, items) = mpsc::channel(WAITING);
        let (stop, limit) = (job.stop.clone(), job.limit);
        let inner = self.0.clone();
        let mut task = self.spawn(async move {
            let _timed = inner.metrics.begin(job.protocol);
            let done = run(&inner.metrics, job, encode, columns, to).await;
            done.inspect_err(|fault| inner.metrics.failed(fault.code()))
        });
        tokio::select! {
            biased;
            fault = ended(&stop, limit) => {
                self.0.metrics.failed(fault.code());
                Err(fault)
            }
            schema = known => match schema {
                Ok(schema) => Ok(Running { schema, items, task, stop, limit, service: self.clone() }),
                // It ended without having any: it says why.
                Err(_) => finish(&mut task).await.and(Err(Fault::Internal)),
            }
        }
    }
}

async fn run<E: Encode>(
    metrics: &Metrics,
    job: Job,
    encode: impl FnOnce(&SchemaRef) -> Result<E, Fault>,
    columns: oneshot::Sender<SchemaRef>,
    to: mpsc::Sender<E::Item>,
) -> Result<(), Fault> {
    let mut answer = match job.work {
        Work::Sql(sql) => job.session.query(&sql).await?,
        Work::Prepared(prepared, values) => job.session.execute(&prepared, values).await?,
    };
    let mut encoder = encode(&answer.schema)?;
    // Nobody listens any more where sending fails, here and below: the query ends by being dropped.
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
