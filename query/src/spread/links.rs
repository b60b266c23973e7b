//! Common ground of a server and a worker: the build, the lake, a token, and certificates.

use std::fmt;
use std::sync::Arc;

use echolake_schema::ErrorCause;
use serde::{Deserialize, Serialize};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::{self, ClientConfig, RootCertStore, version};
use url::{Host, Url};

/// The protocol within encrypted connections, as handshakes name it.
const HTTP_2: &[u8] = b"h2";

/// A reason for which a worker cannot be used, or cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum WorkerFault {
    /// The address is none.
    #[error("`{given}` is no address of a worker; hint: as https://10.0.0.7:7070, which `serve --worker` prints")]
    Address {
        /// The given text.
        given: String,
    },
    /// Others could reach the worker, and it would run whatever they send.
    #[error(
        "{address} is beyond this machine, and workers have no token; hint: --worker-token FILE here and there, with a \
         line that `openssl rand -hex 32` makes"
    )]
    NoToken {
        /// The worker's address.
        address: String,
    },
    /// Rows and the token would go over the network as they are.
    #[error(
        "{address} is beyond this machine, and not encrypted; hint: --certificate and --key with --worker, and https:// \
         in --workers"
    )]
    PlainText {
        /// The worker's address.
        address: String,
    },
    /// Nothing vouches for the worker's certificate.
    #[error(
        "{address} is encrypted, and no certificate is trusted; hint: --worker-ca FILE with the workers' certificates"
    )]
    NoAuthority {
        /// The worker's address.
        address: String,
    },
    /// The token is too short, or has other characters.
    #[error(
        "the token of workers has {LEAST_TOKEN} letters and digits or more, and nothing else; hint: `openssl rand -hex 32` \
         makes one"
    )]
    Token,
    /// The system gives no thread for connections.
    #[error("no thread for connections to workers")]
    Thread(#[source] std::io::Error),
    /// The trusted certificates cannot be read.
    #[error("the certificates of --worker-ca cannot be used: {0}; hint: a PEM file, as `echolake certificate` makes")]
    Authorities(#[source] ErrorCause),
}

/// The build of a program and the lake that it reads. Workers and servers with different ones refuse each other: plans
/// of another build may not mean the same, and files of another lake are others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct WorkerIdentity {
    /// The program's version and checksum, without spaces.
    pub build: String,
    /// The lake's id.
    pub lake: String,
}

impl WorkerIdentity {
    /// Returns it as one line, which [`WorkerIdentity::parse_line`] reads.
    pub fn to_line(&self) -> String {
        format!("{} {}", self.build, self.lake)
    }

    /// Reads a line of [`WorkerIdentity::to_line`]; None if it is not one.
    pub fn parse_line(line: &str) -> Option<Self> {
        let (build, lake) = line.split_once(' ')?;
        Some(Self { build: build.to_owned(), lake: lake.to_owned() })
    }

    /// Returns in words how another one differs; None if it does not.
    pub fn find_difference(&self, other: &Self) -> Option<String> {
        let Self { build, lake } = self;
        if other.build != *build {
            let found = &other.build;
            return Some(format!(
                "it is of another build: {found}, expected {build}; hint: the same program everywhere"
            ));
        }
        (other.lake != *lake)
            .then(|| format!("it has another lake: {}, expected {lake}; hint: start it with this lake", other.lake))
    }
}

/// Least number of characters of a token: as many as `openssl rand -hex 16` writes.
const LEAST_TOKEN: usize = 32;

/// The secret that workers and servers share.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct WorkerToken(String);

impl WorkerToken {
    /// Takes the text of a token's file.
    ///
    /// # Errors
    /// [`WorkerFault::Token`].
    pub fn parse(text: &str) -> Result<Self, WorkerFault> {
        let text = text.trim();
        let is_plain = text.chars().all(|c| c.is_ascii_alphanumeric() || "-_+/=".contains(c));
        match is_plain && text.len() >= LEAST_TOKEN {
            true => Ok(Self(text.to_owned())),
            false => Err(WorkerFault::Token),
        }
    }

    /// Returns the header `Authorization` of those who have it.
    pub fn authorization(&self) -> String {
        format!("Bearer {}", self.0)
    }
}

impl fmt::Debug for WorkerToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WorkerToken(..)")
    }
}

/// Proof of one side of a connection, and trust in the other.
#[derive(Clone, Default)]
pub struct WorkerLink {
    /// The secret that they share; None on one machine.
    pub token: Option<WorkerToken>,
    /// The workers' certificates or their issuers'; None if no worker has one.
    pub(super) trust: Option<Arc<ClientConfig>>,
}

impl WorkerLink {
    /// Takes a token, and the PEM of the certificates that workers have, or that their issuers have.
    ///
    /// # Errors
    /// [`WorkerFault::Authorities`].
    pub fn new(token: Option<WorkerToken>, authorities: Option<&str>) -> Result<Self, WorkerFault> {
        Ok(Self { token, trust: authorities.map(trust_certificates).transpose()? })
    }

    /// Checks that a worker may listen there.
    ///
    /// # Errors
    /// [`WorkerFault::NoToken`], [`WorkerFault::PlainText`].
    pub fn check_listener(&self, address: std::net::SocketAddr, is_encrypted: bool) -> Result<(), WorkerFault> {
        self.check_reach(&address.to_string(), address.ip().is_loopback(), is_encrypted)
    }

    /// Checks that a worker's address may be connected to. Plans name addresses, too.
    ///
    /// # Errors
    /// [`WorkerFault::NoToken`], [`WorkerFault::PlainText`], [`WorkerFault::NoAuthority`].
    pub(super) fn check_url(&self, url: &Url) -> Result<(), WorkerFault> {
        let is_encrypted = url.scheme() == "https";
        self.check_reach(url.as_str(), is_loopback_url(url), is_encrypted)?;
        match is_encrypted && self.trust.is_none() {
            true => Err(WorkerFault::NoAuthority { address: url.to_string() }),
            false => Ok(()),
        }
    }

    fn check_reach(&self, address: &str, is_loopback: bool, is_encrypted: bool) -> Result<(), WorkerFault> {
        let address = || address.to_owned();
        match (is_loopback, &self.token, is_encrypted) {
            (true, ..) | (false, Some(_), true) => Ok(()),
            (false, None, _) => Err(WorkerFault::NoToken { address: address() }),
            (false, Some(_), false) => Err(WorkerFault::PlainText { address: address() }),
        }
    }
}

impl fmt::Debug for WorkerLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WorkerLink").field("token", &self.token).finish_non_exhaustive()
    }
}

fn trust_certificates(pem: &str) -> Result<Arc<ClientConfig>, WorkerFault> {
    let wrong = |text: String| WorkerFault::Authorities(text.into());
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_slice_iter(pem.as_bytes()) {
        let certificate = certificate.map_err(|e| wrong(e.to_string()))?;
        roots.add(certificate).map_err(|e| wrong(e.to_string()))?;
    }
    if roots.is_empty() {
        return Err(wrong("there is no `BEGIN CERTIFICATE`".to_owned()));
    }
    let config = || -> Result<ClientConfig, rustls::Error> {
        Ok(ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&version::TLS13, &version::TLS12])?
            .with_root_certificates(roots)
            .with_no_client_auth())
    };
    let mut config = config().map_err(|e| wrong(e.to_string()))?;
    config.alpn_protocols = vec![HTTP_2.to_vec()];
    Ok(Arc::new(config))
}

/// Reads a worker's address, a URL without a path.
///
/// # Errors
/// [`WorkerFault::Address`].
pub(super) fn parse_worker_url(given: &str) -> Result<Url, WorkerFault> {
    let wrong = || WorkerFault::Address { given: given.to_owned() };
    let url = Url::parse(given).map_err(|_| wrong())?;
    let is_plain = matches!(url.scheme(), "http" | "https")
        && url.path() == "/"
        && url.query().is_none()
        && url.username().is_empty();
    (is_plain && url.host().is_some()).then_some(url).ok_or_else(wrong)
}

// Whether it is of this machine, whatever a resolver says.
fn is_loopback_url(url: &Url) -> bool {
    match url.host() {
        Some(Host::Ipv4(address)) => address.is_loopback(),
        Some(Host::Ipv6(address)) => address.is_loopback(),
        Some(Host::Domain(name)) => name == "localhost",
        None => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "0123456789abcdef0123456789abcdef";

    #[test]
    fn differences_are_put_in_words() {
        let identity = |build: &str, lake: &str| WorkerIdentity { build: build.to_owned(), lake: lake.to_owned() };
        let own = identity("0.1.0-1a", "lake-1");
        assert_eq!(WorkerIdentity::parse_line(&own.to_line()), Some(own.clone()));
        assert_eq!(WorkerIdentity::parse_line(""), None);
        assert_eq!(own.find_difference(&own), None);
        let build = own.find_difference(&identity("0.1.0-2b", "lake-1")).expect("another build");
        assert!(build.contains("0.1.0-2b, expected 0.1.0-1a"), "{build}");
        let lake = own.find_difference(&identity("0.1.0-1a", "lake-2")).expect("another lake");
        assert!(lake.contains("lake-2, expected lake-1"), "{lake}");
    }

    #[test]
    fn tokens_are_long_and_never_printed() {
        let token = WorkerToken::parse(&format!("{TOKEN}\n")).expect("a token");
        assert_eq!(token.authorization(), format!("Bearer {TOKEN}"));
        assert!(!format!("{token:?}").contains(TOKEN));
        for wrong in ["short".to_owned(), format!("{TOKEN} {TOKEN}")] {
            assert!(matches!(WorkerToken::parse(&wrong), Err(WorkerFault::Token)), "{wrong}");
        }
    }

    #[test]
    fn beyond_this_machine_there_is_a_token_and_encryption() {
        let url = |text: &str| parse_worker_url(text).expect("an address");
        for wrong in ["", "127.0.0.1:7070", "grpc://127.0.0.1:7070", "http://127.0.0.1/x", "http://me@127.0.0.1"] {
            assert!(matches!(parse_worker_url(wrong), Err(WorkerFault::Address { .. })), "{wrong}");
        }
        let own = WorkerLink::default();
        for near in ["http://127.0.0.1:7070", "http://[::1]:7070", "http://localhost:7070"] {
            own.check_url(&url(near)).expect(near);
        }
        for far in ["http://localhost.example.org:7070", "http://10.0.0.7:7070", "http://[2001:db8::1]:7070"] {
            assert!(matches!(own.check_url(&url(far)), Err(WorkerFault::NoToken { .. })), "{far}");
        }
        let token = Some(WorkerToken::parse(TOKEN).expect("a token"));
        let link = WorkerLink::new(token, None).expect("a link");
        assert!(matches!(link.check_url(&url("http://10.0.0.7:7070")), Err(WorkerFault::PlainText { .. })));
        assert!(matches!(link.check_url(&url("https://10.0.0.7:7070")), Err(WorkerFault::NoAuthority { .. })));
        let everywhere = "0.0.0.0:7070".parse().expect("an address");
        assert!(link.check_listener(everywhere, true).is_ok());
        assert!(matches!(link.check_listener(everywhere, false), Err(WorkerFault::PlainText { .. })));
        assert!(matches!(own.check_listener(everywhere, true), Err(WorkerFault::NoToken { .. })));
        for wrong in ["", "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"] {
            assert!(matches!(WorkerLink::new(None, Some(wrong)), Err(WorkerFault::Authorities(_))), "{wrong}");
        }
    }
}
