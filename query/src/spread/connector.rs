//! The TCP connection to a worker, encrypted if its address says `https`.

use std::io;
use std::task::{Context, Poll};

use futures::FutureExt as _;
use futures::future::BoxFuture;
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_util::either::Either;
use tonic::codegen::Service;
use tonic::codegen::http::Uri;
use url::{Host, Url};

use super::WorkerTrust;

/// A connection, encrypted or not.
type WorkerConnection = Either<TcpStream, Box<TlsStream<TcpStream>>>;

/// Connects to one worker, as often as it is asked to.
#[derive(Clone)]
pub(super) struct WorkerConnector {
    host: String,
    port: u16,
    /// None for plain text.
    trust: Option<WorkerTrust>,
}

impl WorkerConnector {
    /// Returns a connector to an address; None if it has no host. `trust` is for those of `https`.
    pub(super) fn new(url: &Url, trust: Option<&WorkerTrust>) -> Option<Self> {
        let host = match url.host()? {
            Host::Domain(name) => name.to_owned(),
            Host::Ipv4(address) => address.to_string(),
            Host::Ipv6(address) => address.to_string(),
        };
        let trust = trust.filter(|_| url.scheme() == "https").cloned();
        Some(Self { host, port: url.port_or_known_default()?, trust })
    }

    async fn connect(self) -> io::Result<WorkerConnection> {
        let stream = TcpStream::connect((self.host.as_str(), self.port)).await?;
        stream.set_nodelay(true)?;
        let Some(trust) = self.trust else { return Ok(Either::Left(stream)) };
        let name = ServerName::try_from(self.host.clone()).map_err(io::Error::other)?;
        let shaken = TlsConnector::from(trust.0).connect(name, stream).await;
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
