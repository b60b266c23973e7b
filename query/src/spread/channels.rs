//! Connections to workers, kept open between queries, with timeouts for a silent machine.

use std::collections::HashMap;
use std::fmt;
use std::future::poll_fn;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use async_trait::async_trait;
use datafusion::error::{DataFusionError, Result};
use datafusion_distributed::grpc::{BoxCloneSyncChannel, create_worker_client};
use datafusion_distributed::{ChannelResolver, WorkerChannel};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::ClientConfig;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_util::either::Either;
use tonic::body::Body;
use tonic::codegen::http::header::AUTHORIZATION;
use tonic::codegen::http::{HeaderValue, Request, Response, Uri};
use tonic::codegen::{Body as _, Service};
use tonic::transport::{Channel, Endpoint, Error as TransportError};
use url::{Host, Url};

use super::calls::FIGURES_PATH;
use super::{WorkerFault, WorkerFigures, WorkerLink, WorkerLoss};
use crate::control::threads::QueryThreads;

/// Timeout of a new connection to a worker.
pub(super) const CONNECT_LIMIT: Duration = Duration::from_secs(2);
/// Silence after which a worker is asked for a sign of life, and the timeout of its answer.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
const KEEP_ALIVE_LIMIT: Duration = Duration::from_secs(5);
/// Limit of a worker's figures, bytes.
const FIGURES_BYTES: usize = 4096;
/// Bytes in flight of one stream, and of one connection.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 16 << 20;

/// The connections of one process. Clones share them.
#[derive(Clone)]
pub(super) struct WorkerChannels(Arc<OpenChannels>);

struct OpenChannels {
    link: WorkerLink,
    /// The header with the token; None on one machine.
    authorization: Option<HeaderValue>,
    open: Mutex<HashMap<Url, Channel>>,
    /// The thread of connections, which outlive the queries that open them.
    threads: QueryThreads,
}

impl WorkerChannels {
    /// # Errors
    /// [`WorkerFault::Thread`].
    pub fn new(link: &WorkerLink) -> Result<Self, WorkerFault> {
        // A token has characters of headers alone.
        let mut authorization =
            link.token.as_ref().and_then(|token| HeaderValue::from_str(&token.authorization()).ok());
        if let Some(value) = &mut authorization {
            value.set_sensitive(true);
        }
        let threads = QueryThreads::new("workers", 1).map_err(WorkerFault::Thread)?;
        Ok(Self(Arc::new(OpenChannels { link: link.clone(), authorization, open: Mutex::default(), threads })))
    }

    // Connects when it is first used, and again after the connection was lost.
    fn open_channel(&self, url: &Url) -> Result<AuthorizedChannel> {
        // A plan names the workers that others read from, and may have come from any user of this machine.
        self.0.link.check_url(url).map_err(|fault| WorkerLoss::new(fault.to_string()))?;
        let mut open = self.0.open.lock().unwrap_or_else(PoisonError::into_inner);
        let channel = match open.get(url) {
            Some(channel) => channel.clone(),
            None => {
                let channel = self.connect_lazily(url)?;
                open.insert(url.clone(), channel.clone());
                channel
            }
        };
        Ok(AuthorizedChannel { channel, authorization: self.0.authorization.clone() })
    }

    /// Requests a worker's figures; None if it does not send them.
    pub async fn fetch_figures(&self, url: &Url) -> Option<WorkerFigures> {
        let mut channel = self.open_channel(url).ok()?;
        poll_fn(|context| channel.poll_ready(context)).await.ok()?;
        let request = Request::get(FIGURES_PATH).body(Body::empty()).ok()?;
        let mut body = channel.call(request).await.ok()?.into_body();
        let mut text = Vec::new();
        while let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
            text.extend_from_slice(&frame.ok()?.into_data().ok()?);
            if text.len() > FIGURES_BYTES {
                return None;
            }
        }
        serde_json::from_slice(&text).ok()
    }

    fn connect_lazily(&self, url: &Url) -> Result<Channel> {
        let wrong = |reason: String| WorkerLoss::new(format!("`{url}` is no address of a worker: {reason}"));
        let _context = self.0.threads.handle().map(Handle::enter);
        let endpoint = Endpoint::from_shared(url.to_string()).map_err(|e| wrong(e.to_string()))?;
        let trust = self.0.link.trust.clone().filter(|_| url.scheme() == "https");
        let connector = WorkerConnector::new(url, trust).ok_or_else(|| wrong("it has no host".to_owned()))?;
        Ok(endpoint
            .connect_timeout(CONNECT_LIMIT)
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_timeout(KEEP_ALIVE_LIMIT)
            .initial_stream_window_size(STREAM_WINDOW)
            .initial_connection_window_size(CONNECTION_WINDOW)
            .connect_with_connector_lazy(connector))
    }
}

impl fmt::Debug for WorkerChannels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WorkerChannels").finish_non_exhaustive()
    }
}

#[async_trait]
impl ChannelResolver for WorkerChannels {
    async fn get_worker_client_for_url(&self, url: &Url) -> Result<Box<dyn WorkerChannel>, DataFusionError> {
        Ok(create_worker_client(BoxCloneSyncChannel::new(self.open_channel(url)?)))
    }
}

/// A connection whose requests have the token.
#[derive(Clone)]
struct AuthorizedChannel {
    channel: Channel,
    authorization: Option<HeaderValue>,
}

impl Service<Request<Body>> for AuthorizedChannel {
    type Response = Response<Body>;
    type Error = TransportError;
    type Future = <Channel as Service<Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), TransportError>> {
        self.channel.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        if let Some(authorization) = &self.authorization {
            request.headers_mut().insert(AUTHORIZATION, authorization.clone());
        }
        self.channel.call(request)
    }
}

/// A TCP connection, encrypted or not.
type WorkerConnection = Either<TcpStream, Box<TlsStream<TcpStream>>>;

/// Connects to one worker, each time that the connection is needed and lost.
#[derive(Clone)]
struct WorkerConnector {
    host: String,
    port: u16,
    /// None for plain text.
    trust: Option<Arc<ClientConfig>>,
}

impl WorkerConnector {
    fn new(url: &Url, trust: Option<Arc<ClientConfig>>) -> Option<Self> {
        let host = match url.host()? {
            Host::Domain(name) => name.to_owned(),
            Host::Ipv4(address) => address.to_string(),
            Host::Ipv6(address) => address.to_string(),
        };
        Some(Self { host, port: url.port_or_known_default()?, trust })
    }

    async fn connect(self) -> io::Result<WorkerConnection> {
        let stream = TcpStream::connect((self.host.as_str(), self.port)).await?;
        stream.set_nodelay(true)?;
        let Some(trust) = self.trust else { return Ok(Either::Left(stream)) };
        let name = ServerName::try_from(self.host.clone()).map_err(io::Error::other)?;
        let shaken = TlsConnector::from(trust).connect(name, stream).await;
        let encrypted = shaken.map_err(|e| {
            let hint = "--certificate there, and --worker-ca here with that certificate or its issuer's";
            io::Error::new(e.kind(), format!("no encryption with {}: {e}; hint: {hint}", self.host))
        })?;
        Ok(Either::Right(Box::new(encrypted)))
    }
}

impl Service<Uri> for WorkerConnector {
    type Response = TokioIo<WorkerConnection>;
    type Error = io::Error;
    type Future = BoxFuture<'static, io::Result<TokioIo<WorkerConnection>>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        self.clone().connect().map(|connected| connected.map(TokioIo::new)).boxed()
    }
}
