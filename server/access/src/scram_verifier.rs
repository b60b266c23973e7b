//! Verifiers of tokens for SCRAM-SHA-256 (RFC 5802, RFC 7677), by which clients of Postgres' protocol prove that they
//! have a token without sending it. They are written as PostgreSQL writes them, and nobody can log in by having one.

use std::fmt;
use std::num::NonZeroU32;
use std::str::FromStr;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use ring::{digest, hmac, pbkdf2};
use subtle::ConstantTimeEq as _;

/// The method's name, which begins a verifier.
pub const METHOD: &str = "SCRAM-SHA-256";
/// Iterations of the hash, as in PostgreSQL. A token is random, so that more of them would protect nothing.
const ITERATIONS: NonZeroU32 = match NonZeroU32::new(4096) {
    Some(iterations) => iterations,
    None => NonZeroU32::MIN,
};
const SALT_BYTES: usize = 16;
/// Iterations of a verifier at most: its client has to compute them.
const MOST_ITERATIONS: u32 = 1_000_000;

/// Verifier of a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScramVerifier {
    iterations: NonZeroU32,
    salt: Vec<u8>,
    stored_key: [u8; 32],
    server_key: [u8; 32],
}

impl ScramVerifier {
    /// Makes the verifier of a token, which has ASCII alone, with a new salt.
    ///
    /// # Errors
    /// If the system gives no random bytes.
    pub fn new(token: &str) -> Result<Self, getrandom::Error> {
        let mut salt = vec![0; SALT_BYTES];
        getrandom::fill(&mut salt)?;
        Ok(Self::with_salt(token, salt, ITERATIONS))
    }

    /// Makes a verifier that no token passes, for a name without one. Its salt is always the same for a name, as that
    /// of a verifier is, and nobody computes it without the secret.
    pub(crate) fn unpassable(name: &str, secret: &[u8]) -> Self {
        let of = |purpose: &[u8]| hmac_sign(&hmac_sign(secret, purpose), name.as_bytes());
        let salt = of(b"salt")[..SALT_BYTES].to_vec();
        let stored_key = of(b"stored key");
        Self { iterations: ITERATIONS, salt, stored_key, server_key: of(b"server key") }
    }

    fn with_salt(token: &str, salt: Vec<u8>, iterations: NonZeroU32) -> Self {
        let mut salted = [0; 32];
        pbkdf2::derive(pbkdf2::PBKDF2_HMAC_SHA256, iterations, &salt, token.as_bytes(), &mut salted);
        let stored_key = sha256(&hmac_sign(&salted, b"Client Key"));
        let server_key = hmac_sign(&salted, b"Server Key");
        Self { iterations, salt, stored_key, server_key }
    }

    /// Returns the salt in base 64, which the client needs.
    pub fn salt(&self) -> String {
        BASE64.encode(&self.salt)
    }

    /// Returns the number of iterations, which the client needs.
    pub fn iterations(&self) -> NonZeroU32 {
        self.iterations
    }

    /// Checks a client's proof of the messages of a login; returns the server's, if it is right.
    pub fn check_proof(&self, messages: &str, proof: &[u8]) -> Option<[u8; 32]> {
        let signature = hmac_sign(&self.stored_key, messages.as_bytes());
        let proof: &[u8; 32] = proof.try_into().ok()?;
        let mut client_key = [0; 32];
        for ((key, proof), signature) in client_key.iter_mut().zip(proof).zip(signature) {
            *key = proof ^ signature;
        }
        let is_right: bool = sha256(&client_key).ct_eq(&self.stored_key).into();
        is_right.then(|| hmac_sign(&self.server_key, messages.as_bytes()))
    }
}

fn hmac_sign(key: &[u8], message: &[u8]) -> [u8; 32] {
    let signed = hmac::sign(&hmac::Key::new(hmac::HMAC_SHA256, key), message);
    let mut bytes = [0; 32];
    bytes.copy_from_slice(signed.as_ref());
    bytes
}

fn sha256(message: &[u8]) -> [u8; 32] {
    let hashed = digest::digest(&digest::SHA256, message);
    let mut bytes = [0; 32];
    bytes.copy_from_slice(hashed.as_ref());
    bytes
}

impl fmt::Display for ScramVerifier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let stored = BASE64.encode(self.stored_key);
        let server = BASE64.encode(self.server_key);
        write!(f, "{METHOD}${}:{}${stored}:{server}", self.iterations, self.salt())
    }
}

impl FromStr for ScramVerifier {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form = "`SCRAM-SHA-256$4096:salt$key:key`, salt and keys in base 64";
        parse_verifier(text).ok_or_else(|| format!("it is not {form}; hint: `echolake token` writes it"))
    }
}

fn parse_verifier(text: &str) -> Option<ScramVerifier> {
    let (numbers, keys) = text.strip_prefix(METHOD)?.strip_prefix('$')?.split_once('$')?;
    let (iterations, salt) = numbers.split_once(':')?;
    let (stored, server) = keys.split_once(':')?;
    let iterations: NonZeroU32 = iterations.parse().ok()?;
    let salt = BASE64.decode(salt).ok()?;
    let stored_key = BASE64.decode(stored).ok()?.try_into().ok()?;
    let server_key = BASE64.decode(server).ok()?.try_into().ok()?;
    (iterations.get() <= MOST_ITERATIONS).then_some(ScramVerifier { iterations, salt, stored_key, server_key })
}

#[cfg(test)]
mod tests {
    use super::*;

    // RFC 7677, section 3: the password is `pencil`.
    const MESSAGES: &str = "n=user,r=rOprNGfwEbeRWgbNEkqO,\
                            r=rOprNGfwEbeRWgbNEkqO%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0,s=W22ZaJ0SNY7soEsUEjb6gQ==,i=4096,\
                            c=biws,r=rOprNGfwEbeRWgbNEkqO%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0";
    const PROOF: &str = "dHzbZapWIk4jUhN+Ute9ytag9zjfMHgsqmmiz7AndVQ=";
    const ANSWER: &str = "6rriTRBi23WpRR/wtup+mMhUZUn/dB5nLTJRsjl95G4=";

    fn verifier(password: &str) -> ScramVerifier {
        let salt = BASE64.decode("W22ZaJ0SNY7soEsUEjb6gQ==").expect("base 64");
        ScramVerifier::with_salt(password, salt, ITERATIONS)
    }

    #[test]
    fn proofs_are_those_of_the_standard() {
        let proof = BASE64.decode(PROOF).expect("base 64");
        let answer = verifier("pencil").check_proof(MESSAGES, &proof).map(|answer| BASE64.encode(answer));
        assert_eq!(answer.as_deref(), Some(ANSWER));
        for (wrong, messages, proof) in [
            ("pen", MESSAGES, proof.clone()),
            ("pencil", &MESSAGES[1..], proof.clone()),
            ("pencil", MESSAGES, proof[1..].to_vec()),
            ("pencil", MESSAGES, Vec::new()),
            ("pencil", MESSAGES, vec![0; 32]),
        ] {
            assert_eq!(verifier(wrong).check_proof(messages, &proof), None, "{wrong} {messages}");
        }
    }

    #[test]
    fn verifiers_are_read_as_they_are_written() {
        let made = ScramVerifier::new("a token").expect("random bytes");
        assert_eq!(made.to_string().parse(), Ok(made.clone()));
        assert_ne!(ScramVerifier::new("a token").expect("random bytes"), made, "each has a salt of its own");
        let text = verifier("pencil").to_string();
        for wrong in
            ["", "md5abc", &text[1..], &text[..text.len() - 4], &text.replace("4096", "0"), &text.replace('$', "")]
        {
            assert!(wrong.parse::<ScramVerifier>().is_err(), "{wrong}");
        }
    }
}
