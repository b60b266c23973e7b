//! Connections to workers, kept open between queries, with limits on how long a silent machine is waited for.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use async_trait::async_trait;
use datafusion::error::{DataFusionError, Result};
use datafusion_distributed::grpc::{BoxCloneSyncChannel, create_worker_client};
use datafusion_distributed::{ChannelResolver, WorkerChannel};
use tonic::body::Body;
use tonic::codegen::Service;
use tonic::codegen::http::header::AUTHORIZATION;
use tonic::codegen::http::{HeaderValue, Request, Response};
use tonic::transport::{Channel, Endpoint, Error as TransportError};
use url::{Host, Url};

use super::{WorkerLoss, WorkerToken};

/// Time for a connection to a worker to be made.
pub(super) const CONNECT_LIMIT: Duration = Duration::from_secs(2);
/// Time without a word from a worker after which it is asked if it is there, and time for it to say so.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
const KEEP_ALIVE_LIMIT: Duration = Duration::from_secs(5);
/// Bytes in flight of one stream, and of one connection.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 16 << 20;

/// The connections of one process. Clones share them.
#[derive(Clone)]
pub(super) struct WorkerChannels(Arc<OpenChannels>);

struct OpenChannels {
    /// The header with the token; None on one machine.
    authorization: Option<HeaderValue>,
    open: Mutex<HashMap<Url, Channel>>,
}

impl WorkerChannels {
    /// # Errors
    /// If the token fits into no header.
    pub(super) fn new(token: Option<&WorkerToken>) -> Result<Self> {
        let header = |token: &WorkerToken| HeaderValue::from_str(&format!("Bearer {}", token.secret()));
        let mut authorization = token.map(header).transpose().map_err(|e| DataFusionError::External(Box::new(e)))?;
        if let Some(value) = &mut authorization {
            value.set_sensitive(true);
        }
        Ok(Self(Arc::new(OpenChannels { authorization, open: Mutex::default() })))
    }

    // Connects when it is used first, and again after the connection was lost.
    fn channel(&self, url: &Url) -> Result<AuthorizedChannel> {
        // A plan names the workers that others read from: without a token, it may have come from any user of this machine.
        if self.0.authorization.is_none() && !is_loopback(url) {
            return Err(WorkerLoss::new(format!("`{url}` is not of this machine, and there is no token")).into());
        }
        let mut open = self.0.open.lock().unwrap_or_else(PoisonError::into_inner);
        let channel = match open.get(url) {
            Some(channel) => channel.clone(),
            None => {
                let endpoint = Endpoint::from_shared(url.to_string())
                    .map_err(|e| WorkerLoss::new(format!("`{url}` is no address of a worker: {e}")))?;
                let channel = endpoint
                    .connect_timeout(CONNECT_LIMIT)
                    .tcp_nodelay(true)
                    .http2_keep_alive_interval(KEEP_ALIVE)
                    .keep_alive_timeout(KEEP_ALIVE_LIMIT)
                    .initial_stream_window_size(STREAM_WINDOW)
                    .initial_connection_window_size(CONNECTION_WINDOW)
                    .connect_lazy();
                open.insert(url.clone(), channel.clone());
                channel
            }
        };
        Ok(AuthorizedChannel { channel, authorization: self.0.authorization.clone() })
    }
}

/// Returns whether a URL is of this machine, whatever a resolver says.
pub(super) fn is_loopback(url: &Url) -> bool {
    match url.host() {
        Some(Host::Ipv4(address)) => address.is_loopback(),
        Some(Host::Ipv6(address)) => address.is_loopback(),
        Some(Host::Domain(name)) => name == "localhost",
        None => false,
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
struct AuthorizedChannel {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_token_nothing_leaves_this_machine() {
        for (url, is_own) in [
            ("http://127.0.0.1:7070", true),
            ("http://[::1]:7070", true),
            ("http://localhost:7070", true),
            ("http://localhost.example.org:7070", false),
            ("http://10.0.0.7:7070", false),
            ("http://[2001:db8::1]:7070", false),
        ] {
            assert_eq!(is_loopback(&Url::parse(url).expect("a URL")), is_own, "{url}");
        }
    }
}
