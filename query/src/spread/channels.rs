//! Connections to workers, kept open between queries, with limits on how long a silent machine is waited for.

use std::collections::HashMap;
use std::fmt;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use async_trait::async_trait;
use datafusion::error::{DataFusionError, Result};
use datafusion_distributed::grpc::{BoxCloneSyncChannel, create_worker_client};
use datafusion_distributed::{ChannelResolver, WorkerChannel};
use tonic::body::Body;
use tonic::codegen::http::header::AUTHORIZATION;
use tonic::codegen::http::{HeaderValue, Request, Response};
use tonic::codegen::{Body as _, Service};
use tonic::transport::{Channel, Endpoint, Error as TransportError};
use url::Url;

use super::connector::WorkerConnector;
use super::{WORKER_FIGURES_PATH, WorkerFigures, WorkerLink, WorkerLoss, WorkerToken};

/// Time for a connection to a worker to be made.
pub(super) const CONNECT_LIMIT: Duration = Duration::from_secs(2);
/// Time without a word from a worker after which it is asked if it is there, and time for it to say so.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
const KEEP_ALIVE_LIMIT: Duration = Duration::from_secs(5);
/// Bytes of figures, at most.
const LARGEST_FIGURES: usize = 4096;
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
}

impl WorkerChannels {
    /// # Errors
    /// If the token fits into no header.
    pub(super) fn new(link: &WorkerLink) -> Result<Self> {
        let header = |token: &WorkerToken| HeaderValue::from_str(&format!("Bearer {}", token.secret()));
        let mut authorization =
            link.token.as_ref().map(header).transpose().map_err(|e| DataFusionError::External(Box::new(e)))?;
        if let Some(value) = &mut authorization {
            value.set_sensitive(true);
        }
        Ok(Self(Arc::new(OpenChannels { link: link.clone(), authorization, open: Mutex::default() })))
    }

    // Connects when it is used first, and again after the connection was lost.
    pub(super) fn channel(&self, url: &Url) -> Result<AuthorizedChannel> {
        // A plan names the workers that others read from, and may have come from any user of this machine.
        if let Some(reason) = self.0.link.refusal(url) {
            return Err(WorkerLoss::new(reason).into());
        }
        let mut open = self.0.open.lock().unwrap_or_else(PoisonError::into_inner);
        let channel = match open.get(url) {
            Some(channel) => channel.clone(),
            None => {
                let channel = self.connect(url)?;
                open.insert(url.clone(), channel.clone());
                channel
            }
        };
        Ok(AuthorizedChannel { channel, authorization: self.0.authorization.clone() })
    }

    /// Asks a worker for its figures; None if it does not answer them.
    pub(super) async fn figures(&self, url: &Url) -> Option<WorkerFigures> {
        let mut channel = self.channel(url).ok()?;
        poll_fn(|context| channel.poll_ready(context)).await.ok()?;
        let request = Request::get(WORKER_FIGURES_PATH).body(Body::empty()).ok()?;
        let mut body = channel.call(request).await.ok()?.into_body();
        let mut text = Vec::new();
        while let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
            text.extend_from_slice(&frame.ok()?.into_data().ok()?);
            if text.len() > LARGEST_FIGURES {
                return None;
            }
        }
        serde_json::from_slice(&text).ok()
    }

    fn connect(&self, url: &Url) -> Result<Channel> {
        let endpoint = Endpoint::from_shared(url.to_string())
            .map_err(|e| WorkerLoss::new(format!("`{url}` is no address of a worker: {e}")))?;
        let connector = WorkerConnector::new(url, self.0.link.trust.as_ref())
            .ok_or_else(|| WorkerLoss::new(format!("`{url}` is no address of a worker: it has no host")))?;
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
    async fn get_worker_client_for_url(&self, url: &Url) -> Result<Box<dyn WorkerChannel>> {
        Ok(create_worker_client(BoxCloneSyncChannel::new(self.channel(url)?)))
    }
}

/// A connection whose requests have the token.
#[derive(Clone)]
pub(super) struct AuthorizedChannel {
    channel: Channel,
    authorization: Option<HeaderValue>,
}

impl Service<Request<Body>> for AuthorizedChannel {
    type Response = Response<Body>;
    type Error = TransportError;
    type Future = <Channel as Service<Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<std::result::Result<(), TransportError>> {
        self.channel.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        if let Some(authorization) = &self.authorization {
            request.headers_mut().insert(AUTHORIZATION, authorization.clone());
        }
        self.channel.call(request)
    }
}
