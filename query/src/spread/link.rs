//! Connections between workers and engines: the token, the authorities of certificates, and if plain text may be sent.

use std::fmt;
use std::sync::Arc;

use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::{ClientConfig, Error as TlsError, RootCertStore, version};
use url::{Host, Url};

use super::WorkerToken;

/// The protocol within encrypted connections, as handshakes name it.
const HTTP_2: &[u8] = b"h2";

/// Connection between workers and engines.
#[derive(Debug, Clone, Default)]
pub struct WorkerLink {
    /// The secret that they share; None on one machine.
    pub token: Option<WorkerToken>,
    /// The authorities of workers' certificates; None if no worker has one.
    pub trust: Option<WorkerTrust>,
    /// True if plain text may leave this machine, because the network between them is private.
    pub is_private: bool,
}

/// Authorities whose certificates a worker may have.
#[derive(Clone)]
pub struct WorkerTrust(pub(super) Arc<ClientConfig>);

impl WorkerTrust {
    /// Trusts these certificates, and those that they have signed.
    ///
    /// # Errors
    /// One of them is no certificate.
    pub fn new(certificates: impl IntoIterator<Item = CertificateDer<'static>>) -> Result<Self, TlsError> {
        let mut roots = RootCertStore::empty();
        for certificate in certificates {
            roots.add(certificate)?;
        }
        let mut config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&version::TLS13, &version::TLS12])?
            .with_root_certificates(roots)
            .with_no_client_auth();
        config.alpn_protocols = vec![HTTP_2.to_vec()];
        Ok(Self(Arc::new(config)))
    }
}

impl fmt::Debug for WorkerTrust {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WorkerTrust(..)")
    }
}

impl WorkerLink {
    /// Returns why a worker's address is not connected to; None if it is. Plans name addresses, too.
    pub(super) fn refusal(&self, url: &Url) -> Option<String> {
        if self.token.is_none() && !is_loopback_url(url) {
            return Some(format!("`{url}` is not of this machine, and there is no token"));
        }
        match url.scheme() {
            "https" if self.trust.is_none() => {
                Some(format!("`{url}` is encrypted, and no certificate is trusted here"))
            }
            "https" => None,
            _ if is_loopback_url(url) || self.is_private => None,
            _ => Some(format!("`{url}` is not of this machine, and not encrypted")),
        }
    }
}

/// Returns whether a URL is of this machine, whatever a resolver says.
pub fn is_loopback_url(url: &Url) -> bool {
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

    fn url(text: &str) -> Url {
        Url::parse(text).expect("a URL")
    }

    #[test]
    fn this_machine_is_known_by_its_address() {
        for (text, is_own) in [
            ("http://127.0.0.1:7070", true),
            ("http://[::1]:7070", true),
            ("http://localhost:7070", true),
            ("http://localhost.example.org:7070", false),
            ("http://10.0.0.7:7070", false),
            ("http://[2001:db8::1]:7070", false),
        ] {
            assert_eq!(is_loopback_url(&url(text)), is_own, "{text}");
        }
    }

    #[test]
    fn beyond_this_machine_there_is_a_token_and_encryption_or_a_private_network() {
        let token = WorkerToken::parse("0123456789abcdef0123456789abcdef");
        let trust = WorkerTrust::new([]).ok();
        let refused = |link: &WorkerLink, text: &str| link.refusal(&url(text)).is_some();
        let own = WorkerLink::default();
        assert!(!refused(&own, "http://127.0.0.1:7070") && refused(&own, "http://10.0.0.7:7070"));
        assert!(refused(&own, "https://127.0.0.1:7070"), "no certificate is trusted");
        let encrypted = WorkerLink { token: token.clone(), trust: trust.clone(), is_private: false };
        assert!(!refused(&encrypted, "https://10.0.0.7:7070") && refused(&encrypted, "http://10.0.0.7:7070"));
        let without_token = WorkerLink { token: None, trust, is_private: true };
        assert!(refused(&without_token, "https://10.0.0.7:7070"));
        let private = WorkerLink { token, trust: None, is_private: true };
        assert!(!refused(&private, "http://10.0.0.7:7070") && refused(&private, "https://10.0.0.7:7070"));
    }
}
