//! Authorities of workers' certificates: those of a file, or the system's.

use std::path::{Path, PathBuf};

use echolake_query::WorkerTrust;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;

use crate::Error;

/// Places of the system's authorities.
const SYSTEM: [&str; 5] =
    ["/etc/ssl", "/etc/pki", "/etc/ca-certificates", "/usr/share/ca-certificates", "/usr/local/share/ca-certificates"];
/// Variables that name others.
const VARIABLES: [&str; 2] = ["SSL_CERT_FILE", "SSL_CERT_DIR"];

/// Reads the certificates of a file that workers have, or their issuers have; the system's authorities without a file.
///
/// # Errors
/// [`Error::Certificate`], [`Error::NoAuthorities`].
pub fn read_worker_trust(file: Option<&Path>) -> Result<WorkerTrust, Error> {
    let Some(path) = file else { return system_trust() };
    let wrong = |source| Error::Certificate { path: path.to_owned(), source };
    let certificates = CertificateDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(|e| wrong(e.into()))?;
    if certificates.is_empty() {
        return Err(wrong("it has no `BEGIN CERTIFICATE`".into()));
    }
    WorkerTrust::new(certificates).map_err(|e| wrong(e.into()))
}

// One that cannot be used is left out, as other programs do: there are hundreds.
fn system_trust() -> Result<WorkerTrust, Error> {
    let found = rustls_native_certs::load_native_certs();
    for error in &found.errors {
        tracing::warn!(error = error as &dyn std::error::Error, "some of the system's authorities are not trusted");
    }
    let usable = found.certs.into_iter().filter(|certificate| WorkerTrust::new([certificate.clone()]).is_ok());
    let usable: Vec<_> = usable.collect();
    match WorkerTrust::new(usable.clone()) {
        Ok(trust) if !usable.is_empty() => Ok(trust),
        _ => Err(Error::NoAuthorities),
    }
}

/// Returns the files and folders that [`read_worker_trust`] reads.
pub fn worker_trust_files(file: Option<&Path>) -> Vec<PathBuf> {
    match file {
        Some(path) => vec![path.to_owned()],
        None => SYSTEM.map(PathBuf::from).into_iter().chain(VARIABLES.iter().filter_map(variable)).collect(),
    }
}

fn variable(name: &&str) -> Option<PathBuf> {
    std::env::var_os(name).map(PathBuf::from)
}
