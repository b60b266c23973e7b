//! A worker: runs stages of heavy queries for the engines of other servers of the same lake, over gRPC.
//!
//! Any plan that comes over its port is run, so the port is for those who know the token, or for this machine alone. A plan
//! finds a store that reads, and no other file; the system keeps the process to the lake's files as it does with engines.

mod access;
mod engine_workers;
mod identity;
mod incoming;
mod task_end;
mod trust;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use axum::Json;
use axum::middleware::from_fn_with_state;
use axum::routing::get;
use echolake_lake::Lake;
use echolake_query::{
    EngineLimits, QueryEngine, QueryThreads, SpreadTasks, SpreadWorker, WORKER_FIGURES_PATH, WorkerFigures, WorkerLink,
    WorkerToken,
};
use tokio::net::TcpListener;
use tonic::Request;
use tonic::service::{InterceptorLayer, Routes};
use tonic::transport::Server;

use crate::Error;
use crate::door::{CertificateFiles, ServerEncryption};
pub use access::read_worker_token;
use access::{WorkerAccess, check_address};
pub use engine_workers::EngineWorkers;
pub use identity::program_build;
use identity::worker_identity;
use incoming::incoming;
use task_end::{WorkerCalls, run_call};
pub use trust::{read_worker_trust, worker_trust_files};

/// The variable by which an engine gets the token of workers: arguments are for everybody on a machine to see.
pub const WORKER_TOKEN_VARIABLE: &str = "ECHOLAKE_WORKER_TOKEN";
/// The protocol within encrypted connections, as handshakes name it.
const HTTP_2: &[u8] = b"h2";
/// Bytes in flight of one stream, and of one connection.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 16 << 20;
/// Streams of one connection: an engine has one for each task and stage of all its queries.
const CONNECTION_STREAMS: u32 = 4096;

/// Time between two looks at tasks that are over, and time for which a step of one may go on.
const WATCH_INTERVAL: Duration = Duration::from_millis(100);
const STEP_GRACE: Duration = Duration::from_secs(2);

/// Address and limits of a worker.
#[derive(Debug, Clone)]
pub struct WorkerSettings {
    /// Its address; port 0 for any that is free.
    pub address: SocketAddr,
    /// Access to it, and its connection to other workers.
    pub link: WorkerLink,
    /// The certificate with which connections are encrypted; None for plain text.
    pub certificate: Option<CertificateFiles>,
    /// Bytes that all its tasks may hold together.
    pub memory: usize,
    /// The folder for sorts that do not fit into memory.
    pub temp: PathBuf,
}

/// A worker that listens and does not answer yet.
pub struct LakeWorker {
    lake: Lake,
    listener: TcpListener,
    service: SpreadWorker,
    token: Option<WorkerToken>,
    encryption: Option<ServerEncryption>,
    threads: QueryThreads,
    // The tasks' tables and functions.
    _engine: QueryEngine,
}

impl LakeWorker {
    /// Reads the lake and listens.
    ///
    /// # Errors
    /// [`Error::OpenWorker`], [`Error::PlainTextWorker`], [`Error::Certificate`], [`Error::Bind`], [`Error::Query`],
    /// [`Error::Lake`], [`Error::System`].
    pub async fn bind(lake: &Lake, settings: WorkerSettings) -> Result<Self, Error> {
        let WorkerSettings { address, link, certificate, memory, temp } = settings;
        check_address(&link, &address.ip().to_string(), address.ip().is_loopback(), certificate.is_some())?;
        let encryption = certificate.map(ServerEncryption::new).transpose()?;
        let limits = EngineLimits { memory: Some(memory), temp: Some(temp) };
        let engine = QueryEngine::new(lake, limits)?;
        let identity = worker_identity(lake, program_build().map_err(Error::System)?).await?;
        let service = SpreadWorker::new(&engine, &identity, &link)?;
        let listener = TcpListener::bind(address).await.map_err(|source| Error::Bind { address, source })?;
        let threads = QueryThreads::per_core("worker").map_err(Error::System)?;
        let lake = lake.clone();
        Ok(Self { lake, listener, service, token: link.token, encryption, threads, _engine: engine })
    }

    /// Returns its address as a URL.
    ///
    /// # Errors
    /// [`Error::System`].
    pub fn address(&self) -> Result<String, Error> {
        let scheme = if self.encryption.is_some() { "https" } else { "http" };
        Ok(format!("{scheme}://{}", self.listener.local_addr().map_err(Error::System)?))
    }

    /// Answers until `stop`. Stages that run then are broken off: their engines run them elsewhere.
    ///
    /// # Errors
    /// [`Error::Transport`], [`Error::System`].
    pub async fn run(self, stop: impl Future<Output = ()>) -> Result<(), Error> {
        let access = WorkerAccess::new(self.token);
        // Plans are decoded by recursion, for which these threads have the stack.
        let Some(threads) = self.threads.handle().cloned() else { return Ok(()) };
        let tasks = self.service.tasks().clone();
        watch(tasks.clone()).map_err(Error::System)?;
        let calls = WorkerCalls { tasks: tasks.clone(), threads };
        let routes = self.service.into_routes().into_axum_router().layer(from_fn_with_state(calls, run_call));
        // Answered while all threads compute.
        let lake = self.lake;
        let figures = get(move || std::future::ready(Json(worker_figures(&tasks, &lake))));
        let routes = Routes::from(routes.route(WORKER_FIGURES_PATH, figures));
        let mut own = self.encryption;
        let encryption = own.as_mut().map(|own| own.of_protocol(&[HTTP_2])).transpose()?.unwrap_or_default();
        let serving = Server::builder()
            .initial_stream_window_size(STREAM_WINDOW)
            .initial_connection_window_size(CONNECTION_WINDOW)
            .max_concurrent_streams(CONNECTION_STREAMS)
            .layer(InterceptorLayer::new(move |request: Request<()>| access.check(request)))
            .add_routes(routes)
            .serve_with_incoming(incoming(self.listener, encryption));
        let renewal = async {
            match own {
                Some(own) => own.keep_up().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = stop => {}
            () = renewal => {}
            ended = serving => ended.map_err(|e| Error::Transport(e.into()))?,
        }
        Ok(())
    }
}

fn worker_figures(tasks: &SpreadTasks, lake: &Lake) -> WorkerFigures {
    let store_requests = lake.cache_counts().map_or(0, |counts| counts.requests);
    WorkerFigures { store_requests, ..tasks.figures() }
}

// Ends the process if a step of a task goes on after the task is over: the library cannot be interrupted there. Engines run
// the queries of others elsewhere.
fn watch(tasks: SpreadTasks) -> std::io::Result<()> {
    let watch = move || {
        loop {
            std::thread::sleep(WATCH_INTERVAL);
            if let Some(time) = tasks.overdue().filter(|time| *time > STEP_GRACE) {
                tracing::error!(?time, "a task that is over did not stop: the worker ends itself");
                std::process::abort();
            }
        }
    };
    std::thread::Builder::new().name("watchdog".to_owned()).spawn(watch)?;
    Ok(())
}
