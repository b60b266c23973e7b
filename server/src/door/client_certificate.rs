//! Certificates of clients: who issues them, and the name that stands for a token's.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use tokio_rustls::rustls::RootCertStore;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, CertificateRevocationListDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::server::danger::ClientCertVerifier;
use webpki::EndEntityCert;

use super::der_element::DerElement;
use crate::Error;

/// Kinds of elements of DER: an identifier, and texts in UTF-8 or ASCII.
const IDENTIFIER: u8 = 0x06;
const TEXTS: [u8; 3] = [0x0c, 0x13, 0x16];
/// The identifier of a common name (2.5.4.3).
const COMMON_NAME: [u8; 3] = [0x55, 0x04, 0x03];

type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// Reads the certificates of a PEM file; there is at least one.
///
/// # Errors
/// [`Error::Certificate`].
pub(super) fn read_certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, Error> {
    let wrong = |source: AnyError| Error::Certificate { path: PathBuf::from(path), source };
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let certificates = read.map_err(|e| wrong(e.into()))?;
    match certificates.is_empty() {
        true => Err(wrong("it has no `BEGIN CERTIFICATE`".into())),
        false => Ok(certificates),
    }
}

/// Makes what checks clients' certificates, by a PEM file of their issuers. If it has lists of revoked certificates too, each
/// client's issuer must have one. A client may have no certificate.
///
/// # Errors
/// [`Error::Certificate`].
pub(super) fn client_verifier(path: &Path) -> Result<Arc<dyn ClientCertVerifier>, Error> {
    let wrong = |source: AnyError| Error::Certificate { path: path.to_owned(), source };
    let mut issuers = RootCertStore::empty();
    for certificate in read_certificates(path)? {
        issuers.add(certificate).map_err(|e| wrong(e.into()))?;
    }
    let lists = CertificateRevocationListDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    WebPkiClientVerifier::builder_with_provider(issuers.into(), Arc::new(ring::default_provider()))
        .with_crls(lists.map_err(|e| wrong(e.into()))?)
        .only_check_end_entity_revocation()
        .allow_unauthenticated()
        .build()
        .map_err(|e| wrong(e.into()))
}

/// Returns the name in a client's certificate: the common name of its subject, or, if it has none, its one DNS name or
/// URI. None if several could be meant.
pub(super) fn client_name(certificate: &CertificateDer<'_>) -> Option<String> {
    let certificate = EndEntityCert::try_from(certificate).ok()?;
    let mut names = common_names(certificate.subject())?;
    if names.is_empty() {
        names = certificate.valid_dns_names().chain(certificate.valid_uri_names()).map(str::to_owned).collect();
    }
    let name = names.pop().filter(|name| names.is_empty() && !name.is_empty());
    name.filter(|name| !name.chars().any(char::is_control))
}

// A subject is a sequence of sets of attributes; each has an identifier and a value.
fn common_names(subject: &[u8]) -> Option<Vec<String>> {
    let mut names = Vec::new();
    for set in DerElement::all(subject)? {
        for attribute in DerElement::all(set.content)? {
            let identifier = DerElement::first(attribute.content)?;
            if identifier.kind != IDENTIFIER || identifier.content != COMMON_NAME {
                continue;
            }
            let value = DerElement::first(identifier.rest).filter(|value| TEXTS.contains(&value.kind))?;
            names.push(String::from_utf8(value.content.to_vec()).ok()?);
        }
    }
    Some(names)
}

#[cfg(test)]
mod tests {
    use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, SanType};

    use super::*;

    fn named(common: &[&str], dns: &[&str], uris: &[&str]) -> Option<String> {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new(dns.iter().map(|name| name.to_string()).collect::<Vec<_>>())
            .expect("names of machines");
        let uri = |uri: &&str| SanType::URI((*uri).try_into().expect("a URI"));
        params.subject_alt_names.extend(uris.iter().map(uri));
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(DnType::OrganizationName, "lab");
        common.iter().for_each(|name| params.distinguished_name.push(DnType::CommonName, *name));
        client_name(params.self_signed(&key).expect("a certificate").der())
    }

    #[test]
    fn the_name_is_the_common_one_or_the_only_other() {
        assert_eq!(named(&["ann \u{e4}"], &["lab.example.org"], &[]).as_deref(), Some("ann \u{e4}"));
        assert_eq!(named(&[], &["lab.example.org"], &[]).as_deref(), Some("lab.example.org"));
        assert_eq!(named(&[], &[], &["spiffe://lab/ann"]).as_deref(), Some("spiffe://lab/ann"));
        assert_eq!(named(&[], &["lab.example.org"], &["spiffe://lab/ann"]), None, "either could be meant");
        assert_eq!(named(&[""], &["lab.example.org"], &[]), None);
        assert_eq!(named(&["a\nb"], &[], &[]), None);
        assert_eq!(named(&[], &[], &[]), None);
    }

    #[test]
    fn files_are_of_issuers() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ca.pem");
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let issuer = params.self_signed(&key).expect("a certificate");
        let list = rcgen::CertificateRevocationListParams {
            this_update: rcgen::date_time_ymd(2026, 1, 1),
            next_update: rcgen::date_time_ymd(2036, 1, 1),
            crl_number: 1_u64.into(),
            issuing_distribution_point: None,
            revoked_certs: Vec::new(),
            key_identifier_method: rcgen::KeyIdMethod::Sha256,
        };
        let list = list.signed_by(&Issuer::new(params, key)).expect("a list").pem().expect("PEM");
        for (text, is_right) in [
            (issuer.pem(), true),
            (issuer.pem() + &list, true),
            (list.clone(), false),
            (String::new(), false),
            (issuer.pem() + "-----BEGIN X509 CRL-----\nAAAA\n-----END X509 CRL-----\n", false),
        ] {
            std::fs::write(&path, &text).expect("written");
            assert_eq!(client_verifier(&path).is_ok(), is_right, "{text}");
        }
    }
}
