//! Encryption for clients that have none: ports of this process from which connections go on to a server by TLS.

use std::io;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, copy_bidirectional};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Runtime};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

/// Name in the server's certificate.
pub(crate) const CERTIFIED_NAME: &str = "localhost";
/// Protocol of Flight SQL, as TLS names it.
const HTTP_2: &[u8] = b"h2";
/// Request of Postgres' protocol for TLS, and the answer that grants it.
const SSL_REQUEST: [u8; 8] = [0, 0, 0, 8, 4, 210, 22, 47];
const GRANTED: u8 = b'S';

/// Returns the encryption of a client that trusts this certificate alone.
///
/// # Errors
/// The file is no certificate.
pub(crate) fn trusting_config(certificate: &Path) -> Result<ClientConfig> {
    let read = || format!("`{}` is no certificate as PEM", certificate.display());
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(certificate).with_context(read)?).with_context(read)?;
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    Ok(config.with_safe_default_protocol_versions()?.with_root_certificates(roots).with_no_client_auth())
}

/// Beginning of an encrypted connection, which each protocol has its own of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TunnelOpening {
    Http,
    FlightSql,
    Postgres,
}

/// Tunnels to one server; dropping them closes their connections.
pub(crate) struct ServerTunnels {
    runtime: Option<Runtime>,
    config: ClientConfig,
}

impl ServerTunnels {
    /// Tunnels to a server that shows this certificate.
    ///
    /// # Errors
    /// The file is no certificate, or there are no threads.
    pub fn new(certificate: &Path) -> Result<Self> {
        let runtime = Builder::new_multi_thread().worker_threads(1).enable_io().build()?;
        Ok(Self { runtime: Some(runtime), config: trusting_config(certificate)? })
    }

    /// Opens a port that leads to `host:port`; returns its address.
    ///
    /// # Errors
    /// No port is free.
    pub fn open(&self, target: String, opening: TunnelOpening) -> Result<String> {
        let mut config = self.config.clone();
        if opening == TunnelOpening::FlightSql {
            config.alpn_protocols = vec![HTTP_2.to_vec()];
        }
        let connector = TlsConnector::from(Arc::new(config));
        let runtime = self.runtime.as_ref().context("the tunnels are closed")?;
        let listener = std::net::TcpListener::bind("127.0.0.1:0")?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?.to_string();
        runtime.spawn(async move {
            let listener = TcpListener::from_std(listener)?;
            while let Ok((client, _)) = listener.accept().await {
                let (connector, target) = (connector.clone(), target.clone());
                // A connection that fails is one that ends, for its client.
                tokio::spawn(async move { forward(client, &target, opening, &connector).await });
            }
            io::Result::Ok(())
        });
        Ok(address)
    }
}

impl Drop for ServerTunnels {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn forward(
    mut client: TcpStream,
    target: &str,
    opening: TunnelOpening,
    connector: &TlsConnector,
) -> io::Result<()> {
    let mut server = TcpStream::connect(target).await?;
    client.set_nodelay(true)?;
    server.set_nodelay(true)?;
    if opening == TunnelOpening::Postgres {
        server.write_all(&SSL_REQUEST).await?;
        if server.read_u8().await? != GRANTED {
            return Err(io::Error::other("the server does not encrypt"));
        }
    }
    let name = ServerName::try_from(CERTIFIED_NAME).map_err(io::Error::other)?;
    let mut server = connector.connect(name, server).await?;
    copy_bidirectional(&mut client, &mut server).await?;
    Ok(())
}
