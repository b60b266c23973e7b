//! The workers that a server's engines use.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use echolake_lake::Lake;
use echolake_query::{ClusterSettings, WorkerCluster, WorkerLink, is_loopback_url};
use url::Url;

use super::access::check_address;
use super::identity::worker_identity;
use super::trust::{read_worker_trust, worker_trust_files};
use crate::Error;

/// Workers over which a server's engines spread heavy queries.
#[derive(Debug, Clone)]
pub struct EngineWorkers {
    urls: Vec<Url>,
    link: WorkerLink,
    /// The file of authorities; None for the system's.
    authorities: Option<PathBuf>,
    least_bytes: u64,
    build: String,
}

impl EngineWorkers {
    /// Takes addresses as `https://10.0.0.7:7070`, bytes from which a query is spread, and the build that workers must have.
    /// Certificates are verified by `authorities`, a file, or by the system's.
    ///
    /// # Errors
    /// [`Error::WorkerAddress`], [`Error::OpenWorker`], [`Error::PlainTextWorker`], [`Error::Certificate`],
    /// [`Error::NoAuthorities`].
    pub fn new(
        addresses: &[String],
        mut link: WorkerLink,
        authorities: Option<&Path>,
        least_bytes: u64,
        build: String,
    ) -> Result<Self, Error> {
        let urls: Vec<_> = addresses.iter().map(|given| parse_address(given)).collect::<Result<_, _>>()?;
        for url in &urls {
            check_address(&link, url.as_str(), is_loopback_url(url), is_encrypted(url))?;
        }
        if authorities.is_some() || urls.iter().any(is_encrypted) {
            link.trust = Some(read_worker_trust(authorities)?);
        }
        Ok(Self { urls, link, authorities: authorities.map(Path::to_owned), least_bytes, build })
    }

    /// Returns the ports of the workers.
    pub fn ports(&self) -> impl Iterator<Item = u16> {
        self.urls.iter().filter_map(Url::port_or_known_default)
    }

    /// Returns the files and folders that an engine reads to verify workers' certificates.
    pub fn files(&self) -> Vec<PathBuf> {
        match self.link.trust {
            Some(_) => worker_trust_files(self.authorities.as_deref()),
            None => Vec::new(),
        }
    }

    /// Returns the arguments by which an engine is told of them; the token is none of them.
    pub(crate) fn engine_arguments(&self) -> Vec<OsString> {
        let urls: Vec<_> = self.urls.iter().map(Url::as_str).collect();
        let arguments = [
            ("--workers", urls.join(",")),
            ("--spread-bytes", self.least_bytes.to_string()),
            ("--build", self.build.clone()),
        ];
        let arguments = arguments.into_iter().flat_map(|(name, value)| [name.into(), value.into()]);
        let authorities = self.authorities.iter().flat_map(|file| ["--worker-ca".into(), file.into()]);
        arguments.chain(authorities).collect()
    }

    /// Returns the token for an engine's environment.
    pub(crate) fn secret(&self) -> Option<&str> {
        self.link.token.as_ref().map(|token| token.secret())
    }

    /// Makes the cluster of an engine.
    ///
    /// # Errors
    /// [`Error::Lake`], [`Error::NoTables`], [`Error::Query`].
    pub(crate) async fn cluster(self, lake: &Lake) -> Result<WorkerCluster, Error> {
        let identity = worker_identity(lake, self.build).await?;
        let Self { urls: workers, link, least_bytes, .. } = self;
        Ok(WorkerCluster::new(ClusterSettings { workers, link, identity, least_bytes })?)
    }
}

fn parse_address(given: &str) -> Result<Url, Error> {
    let wrong = || Error::WorkerAddress { given: given.to_owned() };
    let url = Url::parse(given).map_err(|_| wrong())?;
    let is_plain = matches!(url.scheme(), "http" | "https")
        && url.path() == "/"
        && url.query().is_none()
        && url.username().is_empty();
    (is_plain && url.host().is_some()).then_some(url).ok_or_else(wrong)
}

fn is_encrypted(url: &Url) -> bool {
    url.scheme() == "https"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_checked() {
        let with_authorities = |address: &str, file: Option<&str>| {
            EngineWorkers::new(&[address.to_owned()], WorkerLink::default(), file.map(Path::new), 0, String::new())
        };
        let new = |address: &str| with_authorities(address, None);
        let own = new("http://127.0.0.1:7070").expect("a worker of this machine");
        assert_eq!(own.ports().collect::<Vec<_>>(), [7070]);
        for wrong in ["", "127.0.0.1:7070", "grpc://127.0.0.1:7070", "http://127.0.0.1/x", "http://me@127.0.0.1"] {
            assert!(matches!(new(wrong), Err(Error::WorkerAddress { .. })), "{wrong}");
        }
        assert!(matches!(new("http://10.0.0.7:7070"), Err(Error::OpenWorker { .. })));
        let missing = with_authorities("https://127.0.0.1:7070", Some("/none"));
        assert!(matches!(missing, Err(Error::Certificate { .. })));
    }
}
