//! Addresses of files that carry their own right to be read: signed for one client, with an end. Clients of Delta Sharing
//! read files without a token. The door has the secret and checks signatures; an engine signs with its client's key, which
//! comes with each request.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use ring::hmac;

use crate::Error;
use crate::client_identity::ClientIdentity;

/// The path of signed files, and the routes below it.
pub(crate) const SIGNED_FILES: &str = "/delta-sharing/files/";
pub(crate) const SIGNED_ROUTE: &str = "/delta-sharing/files/{client}/{expires}/{signature}/{table}/{file}";
/// Time for which an address is valid.
pub(crate) const VALID: Duration = Duration::from_secs(3600);

/// Header of a request from the door to an engine: the key of its client.
const KEY_HEADER: HeaderName = HeaderName::from_static("echolake-signing-key");
const KEY_BYTES: usize = 32;

/// The door's secret, which lives as long as the server.
pub(crate) struct SigningSecret(hmac::Key);

/// The key of one client.
pub(crate) struct SigningKey([u8; KEY_BYTES]);

/// A signed address.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SignedAddress {
    /// Name of the client that may read the file.
    pub(crate) client: String,
    /// Seconds since 1970.
    expires: u64,
    /// Table and file.
    pub(crate) file: String,
    signature: Vec<u8>,
}

impl SigningSecret {
    /// A new one.
    ///
    /// # Errors
    /// [`Error::Random`].
    pub(crate) fn new() -> Result<Self, Error> {
        let mut secret = [0; KEY_BYTES];
        getrandom::fill(&mut secret).map_err(|failed| Error::Random(failed.into()))?;
        Ok(Self(hmac::Key::new(hmac::HMAC_SHA256, &secret)))
    }

    /// The key of a client; another token of the same name has another.
    pub(crate) fn key_of(&self, client: &ClientIdentity) -> SigningKey {
        let token = client.token.unwrap_or_default();
        let signed = hmac::sign(&self.0, format!("{token} {}", client.name).as_bytes());
        let mut key = [0; KEY_BYTES];
        key.copy_from_slice(signed.as_ref());
        SigningKey(key)
    }
}

impl SigningKey {
    /// Sends it to an engine with a request, in the stead of one that came with it.
    pub(crate) fn send(&self, headers: &mut HeaderMap) {
        if let Ok(value) = HeaderValue::from_str(&hex::encode(self.0)) {
            headers.insert(KEY_HEADER, value);
        }
    }

    /// The key that the door sent.
    pub(crate) fn of_request(headers: &HeaderMap) -> Option<Self> {
        let mut key = [0; KEY_BYTES];
        hex::decode_to_slice(headers.get(KEY_HEADER)?.as_bytes(), &mut key).ok()?;
        Some(Self(key))
    }

    /// The path of a file, `TABLE/FILE`, that `client` may read until `end`.
    pub(crate) fn sign(&self, client: &str, file: &str, end: SystemTime) -> String {
        let expires = end.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        let client = hex::encode(client);
        let signature = hmac::sign(&self.key(), message(&client, expires, file).as_bytes());
        format!("{SIGNED_FILES}{client}/{expires}/{}/{file}", hex::encode(signature))
    }

    /// Returns whether an address was signed with this key.
    pub(crate) fn verify(&self, address: &SignedAddress) -> bool {
        let message = message(&hex::encode(&address.client), address.expires, &address.file);
        hmac::verify(&self.key(), message.as_bytes(), &address.signature).is_ok()
    }

    fn key(&self) -> hmac::Key {
        hmac::Key::new(hmac::HMAC_SHA256, &self.0)
    }
}

impl SignedAddress {
    /// Reads a path.
    pub(crate) fn parse(path: &str) -> Option<Self> {
        let mut parts = path.strip_prefix(SIGNED_FILES)?.splitn(4, '/');
        let client = String::from_utf8(hex::decode(parts.next()?).ok()?).ok()?;
        let expires = parts.next()?.parse().ok()?;
        let signature = hex::decode(parts.next()?).ok()?;
        Some(Self { client, expires, signature, file: parts.next()?.to_owned() })
    }

    /// Returns whether it is no longer valid.
    pub(crate) fn has_expired(&self) -> bool {
        SystemTime::now() >= UNIX_EPOCH + Duration::from_secs(self.expires)
    }
}

// The same for no other parts: none of them has a line break.
fn message(client: &str, expires: u64, file: &str) -> String {
    format!("{client}\n{expires}\n{file}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_its_clients_and_as_it_was_signed() {
        let secret = SigningSecret::new().expect("random bytes");
        let (ann, bob) = (ClientIdentity::local("ann / \u{e4}"), ClientIdentity::local("bob"));
        let path = secret.key_of(&ann).sign(&ann.name, "tnce/a.parquet", SystemTime::now() + VALID);
        let address = SignedAddress::parse(&path).expect("an address");
        assert_eq!((address.client.as_str(), address.file.as_str()), (ann.name.as_str(), "tnce/a.parquet"));
        assert!(secret.key_of(&ann).verify(&address) && !address.has_expired());
        assert!(!secret.key_of(&bob).verify(&address));
        assert!(!SigningSecret::new().expect("random bytes").key_of(&ann).verify(&address), "another server's");
        let other_token = ClientIdentity { token: Some(7), ..ann.clone() };
        assert!(!secret.key_of(&other_token).verify(&address));
        for changed in [
            SignedAddress { file: "tnce/b.parquet".to_owned(), ..address.clone() },
            SignedAddress { expires: address.expires + 1, ..address.clone() },
            SignedAddress { client: bob.name.clone(), ..address.clone() },
            SignedAddress { signature: Vec::new(), ..address.clone() },
        ] {
            assert!(!secret.key_of(&ann).verify(&changed), "{changed:?}");
        }
        let past = secret.key_of(&ann).sign(&ann.name, "tnce/a.parquet", SystemTime::now());
        assert!(SignedAddress::parse(&past).is_some_and(|address| address.has_expired()));
    }

    #[test]
    fn paths_that_are_no_addresses_are_refused() {
        for path in [
            "",
            "/delta-sharing/files/",
            "/delta-sharing/files/zz/1/00/a/b",
            "/delta-sharing/files/61/x/00/a/b",
            "/delta-sharing/files/61/1/0g/a/b",
            "/delta-sharing/files/61/1/00",
            "/api/v1/files",
        ] {
            assert_eq!(SignedAddress::parse(path), None, "{path}");
        }
    }
}
