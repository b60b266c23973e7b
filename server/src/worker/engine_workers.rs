//! The workers that a server's engines use.

use echolake_lake::Lake;
use echolake_query::{ClusterSettings, WorkerCluster};
use url::{Host, Url};

use super::access::WorkerLink;
use super::identity::worker_identity;
use crate::Error;

/// The port of a URL without one.
const HTTP_PORT: u16 = 80;

/// Workers over which a server's engines spread heavy queries.
#[derive(Debug, Clone)]
pub struct EngineWorkers {
    urls: Vec<Url>,
    link: WorkerLink,
    least_bytes: u64,
    build: String,
}

impl EngineWorkers {
    /// Takes addresses as `http://10.0.0.7:7070`, bytes from which a query is spread, and the build that workers must have.
    ///
    /// # Errors
    /// [`Error::WorkerAddress`], [`Error::OpenWorker`], [`Error::PlainTextWorker`].
    pub fn new(addresses: &[String], link: WorkerLink, least_bytes: u64, build: String) -> Result<Self, Error> {
        let urls: Vec<_> = addresses.iter().map(|given| parse_address(given)).collect::<Result<_, _>>()?;
        for url in &urls {
            link.check(url.as_str(), is_loopback(url))?;
        }
        Ok(Self { urls, link, least_bytes, build })
    }

    /// Returns the ports of the workers.
    pub fn ports(&self) -> impl Iterator<Item = u16> {
        self.urls.iter().map(|url| url.port().unwrap_or(HTTP_PORT))
    }

    /// Returns the arguments by which an engine is told of them; the token is none of them.
    pub(crate) fn engine_arguments(&self) -> [String; 6] {
        let urls: Vec<_> = self.urls.iter().map(Url::as_str).collect();
        let (bytes, build) = (self.least_bytes.to_string(), self.build.clone());
        ["--workers".to_owned(), urls.join(","), "--spread-bytes".to_owned(), bytes, "--build".to_owned(), build]
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
        Ok(WorkerCluster::new(ClusterSettings { workers, token: link.token, identity, least_bytes })?)
    }
}

fn parse_address(given: &str) -> Result<Url, Error> {
    let wrong = || Error::WorkerAddress { given: given.to_owned() };
    let url = Url::parse(given).map_err(|_| wrong())?;
    let is_plain = url.scheme() == "http" && url.path() == "/" && url.query().is_none() && url.username().is_empty();
    (is_plain && url.host().is_some()).then_some(url).ok_or_else(wrong)
}

fn is_loopback(url: &Url) -> bool {
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

    #[test]
    fn addresses_are_checked() {
        let new = |address: &str| EngineWorkers::new(&[address.to_owned()], WorkerLink::default(), 0, String::new());
        let own = new("http://127.0.0.1:7070").expect("a worker of this machine");
        assert_eq!(own.ports().collect::<Vec<_>>(), [7070]);
        for wrong in ["", "127.0.0.1:7070", "https://127.0.0.1:7070", "http://127.0.0.1/x", "http://me@127.0.0.1"] {
            assert!(matches!(new(wrong), Err(Error::WorkerAddress { .. })), "{wrong}");
        }
        assert!(matches!(new("http://10.0.0.7:7070"), Err(Error::OpenWorker { .. })));
    }
}
