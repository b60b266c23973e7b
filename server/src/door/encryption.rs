//! TLS of all three protocols: a certificate and its key from files, which are read again when they change.

use std::io;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::{ClientHello, ResolvesServerCert};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::rustls::{self, ServerConfig};
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;

use super::certificate_hash::certificate_hash;
use super::connection_places::PlacedStream;
use crate::Error;

/// Time limit for a handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Time between two looks at the files.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// A connection, encrypted or not.
pub(super) type DoorStream = Either<PlacedStream, Box<TlsStream<PlacedStream>>>;

/// A server's certificate and key, as PEM files.
#[derive(Debug, Clone)]
pub struct CertificateFiles {
    /// The certificate, then those of its issuers.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// Times of change and lengths of the two files.
type FileStates = [Option<(SystemTime, u64)>; 2];

impl CertificateFiles {
    /// Returns the folders that a process reads to take renewed files: those of the files, and of what they link to.
    pub fn folders(&self) -> Vec<PathBuf> {
        let files = [&self.certificate, &self.key];
        let targets = files.into_iter().filter_map(|path| path.canonicalize().ok());
        let all = files.into_iter().cloned().chain(targets);
        let folder = |path: PathBuf| match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        all.map(folder).collect()
    }

    fn states(&self) -> FileStates {
        [&self.certificate, &self.key].map(|path| {
            let about = std::fs::metadata(path).ok()?;
            Some((about.modified().ok()?, about.len()))
        })
    }

    fn load(&self) -> Result<CertifiedKey, Error> {
        type AnyError = Box<dyn std::error::Error + Send + Sync>;
        let wrong = |path: &PathBuf, source: AnyError| Error::Certificate { path: path.clone(), source };
        let of_certificate = |e: AnyError| wrong(&self.certificate, e);
        let chain = CertificateDer::pem_file_iter(&self.certificate)
            .and_then(Iterator::collect::<Result<Vec<_>, _>>)
            .map_err(|e| of_certificate(e.into()))?;
        if chain.is_empty() {
            return Err(of_certificate("it has no `BEGIN CERTIFICATE`".into()));
        }
        let key = PrivateKeyDer::from_pem_file(&self.key).map_err(|e| wrong(&self.key, e.into()))?;
        let key = ring::sign::any_supported_type(&key).map_err(|e| wrong(&self.key, e.into()))?;
        let certified = CertifiedKey::new(chain, key);
        match certified.keys_match() {
            // Some kinds of keys cannot be compared.
            Ok(()) | Err(rustls::Error::InconsistentKeys(rustls::InconsistentKeys::Unknown)) => Ok(certified),
            Err(e) => Err(wrong(&self.key, e.into())),
        }
    }
}

/// The certificate in use.
#[derive(Debug)]
struct CurrentCertificate(RwLock<Arc<CertifiedKey>>);

impl CurrentCertificate {
    fn get(&self) -> Arc<CertifiedKey> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl ResolvesServerCert for CurrentCertificate {
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.get())
    }
}

/// Encryption of a server.
pub(crate) struct ServerEncryption {
    files: CertificateFiles,
    current: Arc<CurrentCertificate>,
}

impl ServerEncryption {
    /// Reads the files.
    ///
    /// # Errors
    /// [`Error::Certificate`].
    pub(crate) fn new(files: CertificateFiles) -> Result<Self, Error> {
        let current = Arc::new(CurrentCertificate(RwLock::new(Arc::new(files.load()?))));
        Ok(Self { files, current })
    }

    /// Returns the encryption of a protocol, which clients may name in the handshake.
    ///
    /// # Errors
    /// [`Error::System`].
    pub(super) fn of_protocol(&self, name: &[u8]) -> Result<ProtocolEncryption, Error> {
        Ok(ProtocolEncryption(Some((self.acceptor(name)?, self.current.clone()))))
    }

    /// Returns what shakes hands with clients of a protocol.
    ///
    /// # Errors
    /// [`Error::System`].
    pub(crate) fn acceptor(&self, name: &[u8]) -> Result<TlsAcceptor, Error> {
        let failed = |e: rustls::Error| Error::System(io::Error::other(e));
        let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&rustls::version::TLS13, &rustls::version::TLS12])
            .map_err(failed)?
            .with_no_client_auth()
            .with_cert_resolver(self.current.clone());
        config.alpn_protocols = vec![name.to_vec()];
        Ok(TlsAcceptor::from(Arc::new(config)))
    }

    /// Takes changed files for new connections; open ones keep the certificate with which they began. Never ends.
    pub(crate) async fn keep_up(self) {
        let mut known = self.files.states();
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let states = self.files.states();
            if states == known {
                continue;
            }
            match self.files.load() {
                Ok(certified) => {
                    *self.current.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(certified);
                    tracing::info!("the certificate was renewed");
                }
                // One of the two may be still to come.
                Err(e) => tracing::warn!(error = &e as &dyn std::error::Error, "the old certificate stays in use"),
            }
            known = states;
        }
    }
}

/// Encryption of one protocol's connections, or none.
#[derive(Clone, Default)]
pub(super) struct ProtocolEncryption(Option<(TlsAcceptor, Arc<CurrentCertificate>)>);

impl ProtocolEncryption {
    /// Returns whether connections are encrypted.
    pub(super) fn is_on(&self) -> bool {
        self.0.is_some()
    }

    /// Returns the hash of the certificate by which logins are bound to it.
    pub(super) fn certificate_hash(&self) -> Option<Vec<u8>> {
        let (_, current) = self.0.as_ref()?;
        certificate_hash(current.get().cert.first()?)
    }

    /// Shakes hands with a client, if connections are encrypted; None if that fails, or takes too long.
    pub(super) async fn accept(&self, stream: PlacedStream) -> Option<DoorStream> {
        let Some((acceptor, _)) = &self.0 else { return Some(Either::Left(stream)) };
        let evicted = stream.evicted();
        tokio::select! {
            shaken = tokio::time::timeout(HANDSHAKE, acceptor.accept(stream)) => match shaken {
                Ok(Ok(encrypted)) => Some(Either::Right(Box::new(encrypted))),
                Ok(Err(e)) => {
                    tracing::debug!(error = &e as &dyn std::error::Error, "a handshake failed");
                    None
                }
                Err(_) => None,
            },
            () = evicted => None,
        }
    }
}
