//! TLS of all three protocols: the server's certificate and key, from files that are read again when they change.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use echolake_service::Error;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::sign::{CertifiedKey, SingleCertAndKey};
use tokio_rustls::rustls::{self, ServerConfig};
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;

#[cfg(feature = "postgres")]
use super::certificate_hash::certificate_hash;
use super::connection_places::PlacedStream;

/// Time limit for a handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Time between two looks at the files.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// A connection, encrypted or not.
pub(crate) type DoorStream = Either<PlacedStream, Box<TlsStream<PlacedStream>>>;

/// A server's certificate and key, as PEM files.
#[derive(Debug, Clone)]
pub struct CertificateFiles {
    /// The certificate, then those of its issuers.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// Times of change and lengths of the files.
type FileStates = Vec<Option<(SystemTime, u64)>>;

impl CertificateFiles {
    /// Returns the folders that a confined process reads to take renewed files: those of the files, and of what they
    /// link to.
    pub fn folders(&self) -> Vec<PathBuf> {
        let files = [&self.certificate, &self.key];
        let targets = files.into_iter().filter_map(|path| path.canonicalize().ok());
        let folder = |path: PathBuf| match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        files.into_iter().cloned().chain(targets).map(folder).collect()
    }

    fn file_states(&self) -> FileStates {
        let state = |path: &PathBuf| {
            let about = std::fs::metadata(path).ok()?;
            Some((about.modified().ok()?, about.len()))
        };
        [&self.certificate, &self.key].into_iter().map(state).collect()
    }

    fn load_certificate(&self) -> Result<Arc<CertifiedKey>, Error> {
        let wrong = |source| Error::Certificate { path: self.key.clone(), source };
        let chain = read_certificates(&self.certificate)?;
        let key = PrivateKeyDer::from_pem_file(&self.key).map_err(|e| wrong(e.into()))?;
        let key = ring::sign::any_supported_type(&key).map_err(|e| wrong(e.into()))?;
        let certified = CertifiedKey::new(chain, key);
        match certified.keys_match() {
            // Some kinds of keys cannot be compared.
            Ok(()) | Err(rustls::Error::InconsistentKeys(rustls::InconsistentKeys::Unknown)) => Ok(certified.into()),
            Err(e) => Err(wrong(e.into())),
        }
    }
}

// Returns the certificates of a PEM file, at least one.
fn read_certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, Error> {
    let wrong = |source: Box<dyn std::error::Error + Send + Sync>| Error::Certificate { path: path.to_owned(), source };
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let certificates = read.map_err(|e| wrong(e.into()))?;
    match certificates.is_empty() {
        true => Err(wrong("it has no `BEGIN CERTIFICATE`".into())),
        false => Ok(certificates),
    }
}

/// Encryption of a server.
pub(crate) struct ServerEncryption {
    files: CertificateFiles,
    loaded: Arc<CertifiedKey>,
    protocols: Vec<Arc<RwLock<ProtocolTls>>>,
}

impl ServerEncryption {
    /// Reads the files.
    ///
    /// # Errors
    /// [`Error::Certificate`].
    pub fn new(files: CertificateFiles) -> Result<Self, Error> {
        Ok(Self { loaded: files.load_certificate()?, files, protocols: Vec::new() })
    }

    /// Returns the encryption of a protocol, which clients may name in the handshake by one of these names.
    ///
    /// # Errors
    /// [`Error::System`].
    pub fn of_protocol(&mut self, names: &'static [&'static [u8]]) -> Result<ProtocolEncryption, Error> {
        let tls = ProtocolTls::new(names, &self.loaded).map_err(|e| Error::System(io::Error::other(e)))?;
        let tls = Arc::new(RwLock::new(tls));
        self.protocols.push(tls.clone());
        Ok(ProtocolEncryption(Some(tls)))
    }

    /// Takes changed files for new connections; open ones keep what they began with. Never ends.
    pub async fn keep_up(self) {
        let mut known = self.files.file_states();
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let states = self.files.file_states();
            if states == known {
                continue;
            }
            match self.files.load_certificate() {
                Ok(loaded) => self.renew_protocols(&loaded),
                // One of them may be still to come.
                Err(e) => tracing::warn!(error = &e as &dyn std::error::Error, "the old certificates stay in use"),
            }
            known = states;
        }
    }

    fn renew_protocols(&self, loaded: &Arc<CertifiedKey>) {
        for protocol in &self.protocols {
            let names = protocol.read().unwrap_or_else(PoisonError::into_inner).names;
            match ProtocolTls::new(names, loaded) {
                Ok(tls) => *protocol.write().unwrap_or_else(PoisonError::into_inner) = tls,
                Err(e) => tracing::error!(error = &e as &dyn std::error::Error, "a certificate cannot be used"),
            }
        }
        tracing::info!("the certificates were read again");
    }
}

/// The settings of one protocol.
struct ProtocolTls {
    names: &'static [&'static [u8]],
    acceptor: TlsAcceptor,
    #[cfg(feature = "postgres")]
    certificate: Arc<CertifiedKey>,
}

impl ProtocolTls {
    fn new(names: &'static [&'static [u8]], loaded: &Arc<CertifiedKey>) -> Result<Self, rustls::Error> {
        let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&rustls::version::TLS13, &rustls::version::TLS12])?
            .with_no_client_auth()
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(loaded.clone())));
        config.alpn_protocols = names.iter().map(|name| name.to_vec()).collect();
        Ok(Self {
            names,
            acceptor: TlsAcceptor::from(Arc::new(config)),
            #[cfg(feature = "postgres")]
            certificate: loaded.clone(),
        })
    }
}

/// Encryption of one protocol's connections, or none.
#[derive(Clone, Default)]
pub(crate) struct ProtocolEncryption(Option<Arc<RwLock<ProtocolTls>>>);

impl ProtocolEncryption {
    /// Returns whether connections are encrypted.
    pub fn is_on(&self) -> bool {
        self.0.is_some()
    }

    // What shakes hands with the next client; None if connections are not encrypted.
    fn acceptor(&self) -> Option<TlsAcceptor> {
        let tls = self.0.as_ref()?.read().unwrap_or_else(PoisonError::into_inner);
        Some(tls.acceptor.clone())
    }

    /// Returns the hash of the certificate by which logins are bound to it.
    #[cfg(feature = "postgres")]
    pub fn certificate_hash(&self) -> Option<Vec<u8>> {
        let tls = self.0.as_ref()?.read().unwrap_or_else(PoisonError::into_inner);
        certificate_hash(tls.certificate.cert.first()?)
    }

    /// Shakes hands with a client, if connections are encrypted; None if that fails, or takes too long.
    pub async fn shake_hands(&self, stream: PlacedStream) -> Option<DoorStream> {
        let Some(acceptor) = self.acceptor() else { return Some(Either::Left(stream)) };
        let evicted = stream.wait_for_eviction();
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

/// Returns the protocol that was agreed on in the handshake, if there was one.
pub(super) fn agreed_protocol(stream: &DoorStream) -> Option<&[u8]> {
    match stream {
        Either::Left(_) => None,
        Either::Right(encrypted) => encrypted.get_ref().1.alpn_protocol(),
    }
}
