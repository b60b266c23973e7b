//! Self-signed certificates, for a lab without a certificate authority.

use echolake_service::Error;
use rcgen::{CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, KeyPair, KeyUsagePurpose};

/// Days for which a certificate is valid.
const DAYS: i64 = 397;

/// A certificate and its private key, in PEM.
pub struct SelfSigned {
    /// The certificate, which clients trust by having this file.
    pub certificate: String,
    /// The private key.
    pub key: String,
}

/// Makes a server's certificate of these names and addresses, valid for 397 days.
///
/// # Errors
/// [`Error::SelfSigned`] if a name cannot be one.
pub fn self_signed(names: &[String]) -> Result<SelfSigned, Error> {
    let make = || {
        let key = KeyPair::generate()?;
        let mut params = CertificateParams::new(names)?;
        params.distinguished_name = DistinguishedName::new();
        let now = time::OffsetDateTime::now_utc();
        params.not_before = now - time::Duration::hours(1);
        params.not_after = now + time::Duration::days(DAYS);
        params.distinguished_name.push(DnType::CommonName, names.first().map_or("echolake", String::as_str));
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        let certificate = params.self_signed(&key)?.pem();
        Ok(SelfSigned { certificate, key: key.serialize_pem() })
    };
    make().map_err(|source: rcgen::Error| Error::SelfSigned { names: names.join(", "), source: source.into() })
}
