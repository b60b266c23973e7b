//! The hash of a certificate by which a login is bound to it (`tls-server-end-point`, RFC 5929).

use ring::digest;

use super::der_element::DerElement;

/// Object identifiers of signature algorithms: RSA's with a hash (PKCS #1), and elliptic curves' with one.
const RSA: &[u8] = &[0x2a, 0x86, 0x48, 0x86, 0xf7, 0x0d, 0x01, 0x01];
const ECDSA_SHA1: &[u8] = &[0x2a, 0x86, 0x48, 0xce, 0x3d, 0x04, 0x01];
const ECDSA: &[u8] = &[0x2a, 0x86, 0x48, 0xce, 0x3d, 0x04, 0x03];

/// Returns the hash of a certificate (DER), by the hash of its own signature; None if that has none of its own.
pub(super) fn certificate_hash(certificate: &[u8]) -> Option<Vec<u8>> {
    let certified = DerElement::read_first(certificate)?.content;
    let algorithm = DerElement::read_first(DerElement::read_first(certified)?.rest)?;
    let identifier = DerElement::read_first(algorithm.content)?;
    let (last, family) = identifier.content.split_last()?;
    let hash = match (family, last) {
        // MD5 and SHA-1 are replaced.
        (RSA, 4 | 5 | 11) | (ECDSA_SHA1, 1) | (ECDSA, 2) => &digest::SHA256,
        (RSA, 12) | (ECDSA, 3) => &digest::SHA384,
        (RSA, 13) | (ECDSA, 4) => &digest::SHA512,
        _ => return None,
    };
    Some(digest::digest(hash, certificate).as_ref().to_vec())
}

#[cfg(test)]
mod tests {
    use tokio_rustls::rustls::pki_types::CertificateDer;
    use tokio_rustls::rustls::pki_types::pem::PemObject as _;

    use super::*;
    use crate::certificate::self_signed;

    #[test]
    fn the_hash_is_that_of_the_signature() {
        let made = self_signed(&["localhost".to_owned()]).expect("a certificate");
        let der = CertificateDer::from_pem_slice(made.certificate.as_bytes()).expect("PEM");
        let expected = digest::digest(&digest::SHA256, &der);
        assert_eq!(certificate_hash(&der).as_deref(), Some(expected.as_ref()));
        // ecdsa-with-SHA256 becomes ecdsa-with-SHA384, then Ed25519's, which has no hash of its own.
        let at = der.windows(8).rposition(|part| part == [ECDSA, &[2]].concat()).expect("the algorithm");
        let mut other = der.to_vec();
        other[at + 7] = 3;
        assert_eq!(certificate_hash(&other).map(|hash| hash.len()), Some(48));
        other[at] = 0x2b;
        assert_eq!(certificate_hash(&other), None);
        for length in 0..at {
            assert_eq!(certificate_hash(&der[..length]), None, "cut off after {length} bytes");
        }
    }
}
