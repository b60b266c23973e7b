//! A worker: the stages of heavy queries that the engines of other servers send it, over gRPC. It is an engine of its
//! own with a port, which the system confines to the lake's files as it does with engines.

use std::convert::Infallible;
use std::fs::File;
use std::io::{self, BufReader, Read as _};
use std::net::SocketAddr;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::Request;
use echolake_lake::Lake;
use echolake_query::{WorkerLink, WorkerService};
use echolake_service::Error;
use http_body_util::BodyExt as _;
use hyper::body::Incoming;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::TokioIo;
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;

use crate::CertificateFiles;
use crate::door::connection_places::{ConnectionPlaces, PlacedStream};
use crate::door::encryption::{ProtocolEncryption, ServerEncryption};
use crate::door::http_connection::{HTTP_2, http2_builder};

/// The running program, even if its file was replaced.
const PROGRAM: &str = "/proc/self/exe";
/// Connections at once: each engine has one.
const CONNECTIONS: usize = 512;
/// Streams of one connection: an engine has one for each task and stage of all its queries.
const STREAMS: u32 = 4096;
/// Bytes in flight of one stream, and of one connection.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 16 << 20;
/// Time between two looks at tasks that are over, and time for which a step of one may go on.
const WATCH_INTERVAL: Duration = Duration::from_millis(100);
const STEP_GRACE: Duration = Duration::from_secs(2);

/// Address and limits of a worker.
#[derive(Debug)]
pub struct WorkerSettings {
    /// Its address; port 0 for any that is free.
    pub address: SocketAddr,
    /// Access to it, and its connection to other workers.
    pub link: WorkerLink,
    /// The certificate with which connections are encrypted; None for plain text.
    pub certificate: Option<CertificateFiles>,
    /// Bytes that all its tasks may hold together.
    pub memory: usize,
}

/// A worker that listens and does not answer yet.
pub struct LakeWorker {
    listener: TcpListener,
    service: WorkerService,
    encryption: Option<ServerEncryption>,
}

impl LakeWorker {
    /// Reads the lake and listens.
    ///
    /// # Errors
    /// [`Error::Worker`], [`Error::Certificate`], [`Error::Bind`], [`Error::Query`], [`Error::System`].
    pub async fn bind(lake: &Lake, settings: WorkerSettings) -> Result<Self, Error> {
        let WorkerSettings { address, link, certificate, memory } = settings;
        link.check_listener(address, certificate.is_some())?;
        let encryption = certificate.map(ServerEncryption::new).transpose()?;
        let build = program_build().map_err(Error::System)?;
        let service = WorkerService::start(lake, Some(memory), &build, &link).await?;
        let listener = TcpListener::bind(address).await.map_err(|source| Error::Bind { address, source })?;
        Ok(Self { listener, service, encryption })
    }

    /// Returns its address as a URL.
    ///
    /// # Errors
    /// [`Error::System`].
    pub fn listening_url(&self) -> Result<String, Error> {
        let scheme = if self.encryption.is_some() { "https" } else { "http" };
        Ok(format!("{scheme}://{}", self.listener.local_addr().map_err(Error::System)?))
    }

    /// Answers until `stop`. Stages that run then are ended: their engines run them elsewhere.
    ///
    /// # Errors
    /// [`Error::System`].
    pub async fn serve_until(self, stop: impl Future<Output = ()>) -> Result<(), Error> {
        start_watchdog(self.service.overdue_watch()).map_err(Error::System)?;
        let router = self.service.into_router();
        let mut own = self.encryption;
        let encryption = own.as_mut().map(|own| own.of_protocol(&[HTTP_2])).transpose()?.unwrap_or_default();
        let places = ConnectionPlaces::new(self.listener, CONNECTIONS);
        let serving = places.attend_connections(|stream| answer_connection(stream, encryption.clone(), router.clone()));
        let renewal = async {
            match own {
                Some(own) => own.keep_up().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = stop => {}
            () = renewal => {}
            () = serving => {}
        }
        Ok(())
    }
}

async fn answer_connection(stream: PlacedStream, encryption: ProtocolEncryption, router: Router) {
    let evicted = stream.wait_for_eviction();
    let work = stream.work_handle();
    let Some(stream) = encryption.shake_hands(stream).await else { return };
    let router = TowerToHyperService::new(router);
    let service = service_fn(move |request: Request<Incoming>| {
        work.hear_request();
        let working = work.begin_work();
        let answer = router.call(request);
        async move {
            let Ok(response) = answer.await;
            // Until the last row is sent.
            let held = move |frame| {
                let _ = &working;
                frame
            };
            Ok::<_, Infallible>(response.map(|body| Body::new(body.map_frame(held))))
        }
    });
    let mut builder = http2_builder();
    builder
        .max_concurrent_streams(STREAMS)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW);
    // A connection that breaks off is its engine's matter.
    tokio::select! {
        _ = builder.serve_connection(TokioIo::new(stream), service) => {}
        () = evicted => {}
    }
}

// Ends the process if a step of a task goes on after the task is over: the library cannot be interrupted there. Engines
// run the queries of others elsewhere.
fn start_watchdog(longest_overdue: impl Fn() -> Option<Duration> + Send + 'static) -> io::Result<()> {
    let watch = move || {
        loop {
            std::thread::sleep(WATCH_INTERVAL);
            if let Some(time) = longest_overdue().filter(|time| *time > STEP_GRACE) {
                tracing::error!(?time, "a task that is over did not stop: the worker ends itself");
                std::process::abort();
            }
        }
    };
    std::thread::Builder::new().name("watchdog".to_owned()).spawn(watch)?;
    Ok(())
}

/// Returns the version of this program with a checksum of its file: two builds of one version may plan differently.
///
/// # Errors
/// The program's file cannot be read.
pub fn program_build() -> io::Result<String> {
    let mut file = BufReader::with_capacity(1 << 20, File::open(PROGRAM)?);
    let mut checksum = crc32fast::Hasher::new();
    let mut block = vec![0; 1 << 20];
    loop {
        match file.read(&mut block)? {
            0 => break,
            read => checksum.update(&block[..read]),
        }
    }
    Ok(format!("{}-{:08x}", env!("CARGO_PKG_VERSION"), checksum.finalize()))
}
