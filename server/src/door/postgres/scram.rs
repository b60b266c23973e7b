//! The server's side of a login by SCRAM-SHA-256 (RFC 5802): two messages of each side. Within TLS a client may bind
//! the login to the server's certificate, which nobody between the two has.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use bytes::{BufMut as _, BytesMut};
use echolake_access::{METHOD, ScramVerifier};
use echolake_service::RequestFault;

/// The method that binds a login to the certificate.
const METHOD_PLUS: &str = "SCRAM-SHA-256-PLUS";
/// The kind of that binding, RFC 5929: a hash of the certificate.
const BINDING: &str = "tls-server-end-point";
/// Random bytes of the server's part of the number that is used once.
const NONCE_BYTES: usize = 18;
/// Codes of the server's messages.
const SASL: i32 = 10;
const SASL_CONTINUE: i32 = 11;
const SASL_FINAL: i32 = 12;

/// Says by which methods a client may log in: with a certificate's hash, by both.
pub(super) fn methods_message(has_certificate: bool) -> BytesMut {
    let mut names = Vec::new();
    for method in has_certificate.then_some(METHOD_PLUS).into_iter().chain([METHOD]) {
        names.extend_from_slice(method.as_bytes());
        names.push(0);
    }
    names.push(0);
    sasl_message(SASL, &names)
}

fn sasl_message(code: i32, content: &[u8]) -> BytesMut {
    let mut bytes = BytesMut::new();
    bytes.put_u8(b'R');
    bytes.put_i32(8 + i32::try_from(content.len()).unwrap_or(0));
    bytes.put_i32(code);
    bytes.put_slice(content);
    bytes
}

/// A login after the client's first message.
pub(super) struct ScramExchange<'a> {
    verifier: &'a ScramVerifier,
    /// The client's last message must say this about the certificate.
    binding: Vec<u8>,
    nonce: String,
    /// The first messages of both.
    messages: String,
    server_first: String,
}

fn malformed_login(what: &str) -> RequestFault {
    RequestFault::bad_request(format!("the login by SCRAM is malformed: {what}"))
}

impl<'a> ScramExchange<'a> {
    /// Reads the client's first message, with the method and its length before it.
    ///
    /// # Errors
    /// [`RequestFault::Request`].
    pub fn read_first(
        message: &[u8],
        verifier: &'a ScramVerifier,
        certificate: Option<&[u8]>,
    ) -> Result<Self, RequestFault> {
        let mut random = [0; NONCE_BYTES];
        getrandom::fill(&mut random).map_err(RequestFault::defect("no random bytes"))?;
        Self::with_nonce(message, verifier, certificate, &BASE64.encode(random))
    }

    fn with_nonce(
        message: &[u8],
        verifier: &'a ScramVerifier,
        certificate: Option<&[u8]>,
        own_nonce: &str,
    ) -> Result<Self, RequestFault> {
        let (method, first) = initial_response(message)?;
        // The binding, whoever the client acts for, then the message proper.
        let mut parts = first.splitn(3, ',');
        let (Some(flag), Some(authorized), Some(bare)) = (parts.next(), parts.next(), parts.next()) else {
            return Err(malformed_login("its first message has not three parts"));
        };
        if !authorized.is_empty() {
            return Err(malformed_login("it acts for another user"));
        }
        let mut binding = format!("{flag},,").into_bytes();
        match (method, flag, certificate) {
            (METHOD_PLUS, flag, Some(hash)) if flag.strip_prefix("p=") == Some(BINDING) => {
                binding.extend_from_slice(hash)
            }
            // `y`: the client could bind, and was told that the server cannot.
            (METHOD, "n", _) | (METHOD, "y", None) => {}
            _ => return Err(malformed_login("method and binding to the certificate differ from what was offered")),
        }
        check_extensions(bare)?;
        let mut attributes = bare.split(',');
        let _user =
            attributes.next().and_then(|part| part.strip_prefix("n=")).ok_or_else(|| malformed_login("no `n=`"))?;
        let nonce = attributes.next().and_then(|part| part.strip_prefix("r=")).filter(|nonce| !nonce.is_empty());
        let nonce = format!("{}{own_nonce}", nonce.ok_or_else(|| malformed_login("no `r=` behind `n=`"))?);
        let server_first = format!("r={nonce},s={},i={}", verifier.salt(), verifier.iterations());
        let messages = format!("{bare},{server_first}");
        Ok(Self { verifier, binding, nonce, messages, server_first })
    }

    /// Returns the server's first message.
    pub fn first_message(&self) -> BytesMut {
        sasl_message(SASL_CONTINUE, self.server_first.as_bytes())
    }

    /// Checks the client's last message; returns the server's.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`] if the client has not the token, [`RequestFault::Request`].
    pub fn finish_exchange(&self, message: &[u8]) -> Result<BytesMut, RequestFault> {
        let last = str::from_utf8(message).map_err(|_| malformed_login("its last message is no text"))?;
        let (unproved, proof) = last.rsplit_once(",p=").ok_or_else(|| malformed_login("no `p=`"))?;
        check_extensions(unproved)?;
        let mut parts = unproved.split(',');
        let binding = parts.next().and_then(|part| BASE64.decode(part.strip_prefix("c=")?).ok());
        if binding.as_deref() != Some(&self.binding[..]) {
            return Err(malformed_login("it is bound to another certificate"));
        }
        if parts.next().and_then(|part| part.strip_prefix("r=")) != Some(self.nonce.as_str()) {
            return Err(malformed_login("`r=` is not the server's"));
        }
        let proof = BASE64.decode(proof).map_err(|_| malformed_login("`p=` is not in base 64"))?;
        let messages = format!("{},{unproved}", self.messages);
        let answer = self.verifier.check_proof(&messages, &proof).ok_or(RequestFault::Unauthenticated)?;
        Ok(sasl_message(SASL_FINAL, format!("v={}", BASE64.encode(answer)).as_bytes()))
    }
}

// A client that sends `m=` must not be let in by a server that does not know what it wants (RFC 5802, section 5.1).
fn check_extensions(message: &str) -> Result<(), RequestFault> {
    match message.split(',').any(|attribute| attribute.starts_with("m=")) {
        true => Err(malformed_login("it wants an extension (`m=`), and there is none")),
        false => Ok(()),
    }
}

fn initial_response(message: &[u8]) -> Result<(&str, &str), RequestFault> {
    split_response(message).ok_or_else(|| malformed_login("its first message is cut off or no text"))
}

// A method's name with a zero behind it, a length, a message.
fn split_response(message: &[u8]) -> Option<(&str, &str)> {
    let end = message.iter().position(|byte| *byte == 0)?;
    let (length, first) = message.get(end + 1..)?.split_first_chunk()?;
    if usize::try_from(i32::from_be_bytes(*length)).ok()? != first.len() {
        return None;
    }
    Some((str::from_utf8(&message[..end]).ok()?, str::from_utf8(first).ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    // RFC 7677, section 3: the password is `pencil`.
    const VERIFIER: &str = "SCRAM-SHA-256$4096:W22ZaJ0SNY7soEsUEjb6gQ==$\
                            WG5d8oPm3OtcPnkdi4Uo7BkeZkBFzpcXkuLmtbsT4qY=:wfPLwcE6nTWhTAmQ7tl2KeoiWGPlZqQxSrmfPwDl2dU=";
    const OWN_NONCE: &str = "%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0";
    const NONCE: &str = "rOprNGfwEbeRWgbNEkqO%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0";
    const PROOF: &str = "dHzbZapWIk4jUhN+Ute9ytag9zjfMHgsqmmiz7AndVQ=";

    fn initial(method: &str, text: &str) -> Vec<u8> {
        [method.as_bytes(), b"\0", &(text.len() as u32).to_be_bytes(), text.as_bytes()].concat()
    }

    #[test]
    fn a_login_is_that_of_the_standard() {
        let verifier = VERIFIER.parse().expect("a verifier");
        let first = initial(METHOD, "n,,n=user,r=rOprNGfwEbeRWgbNEkqO");
        let exchange = ScramExchange::with_nonce(&first, &verifier, None, OWN_NONCE).expect("a first message");
        assert_eq!(&exchange.first_message()[9..], format!("r={NONCE},s=W22ZaJ0SNY7soEsUEjb6gQ==,i=4096").as_bytes());
        let last = format!("c=biws,r={NONCE},p={PROOF}");
        let answer = exchange.finish_exchange(last.as_bytes()).expect("let in");
        assert_eq!(&answer[9..], b"v=6rriTRBi23WpRR/wtup+mMhUZUn/dB5nLTJRsjl95G4=");
        let wrong = last.replace("p=d", "p=e");
        assert!(matches!(exchange.finish_exchange(wrong.as_bytes()), Err(RequestFault::Unauthenticated)));
        for malformed in
            ["", "c=biws", &last.replace("biws", "eSws"), &last.replace("k0", "k1"), &last.replace(",p=", ",q=")]
        {
            assert!(
                matches!(exchange.finish_exchange(malformed.as_bytes()), Err(RequestFault::Request { .. })),
                "{malformed}"
            );
        }
    }

    #[test]
    fn extensions_are_refused() {
        let verifier = VERIFIER.parse().expect("a verifier");
        let begin = |bare: &str| {
            ScramExchange::with_nonce(&initial(METHOD, &format!("n,,{bare}")), &verifier, None, OWN_NONCE).map(drop)
        };
        assert!(begin("n=user,r=abc").is_ok() && begin("n=,r=abc,x=unknown").is_ok());
        for wrong in ["m=x,n=user,r=abc", "n=user,m=x,r=abc", "n=user,r=abc,m=x", "r=abc,n=user", "n=user", "n=user,r="]
        {
            assert!(matches!(begin(wrong), Err(RequestFault::Request { .. })), "{wrong}");
        }
        let first = initial(METHOD, "n,,n=user,r=rOprNGfwEbeRWgbNEkqO");
        let exchange = ScramExchange::with_nonce(&first, &verifier, None, OWN_NONCE).expect("a first message");
        let last = exchange.finish_exchange(format!("c=biws,r={NONCE},m=x,p={PROOF}").as_bytes());
        assert!(matches!(last, Err(RequestFault::Request { .. })));
    }

    #[test]
    fn a_login_is_bound_as_it_was_offered() {
        let verifier = VERIFIER.parse().expect("a verifier");
        let begin = |method, flag: &str, certificate| {
            let first = initial(method, &format!("{flag},,n=,r=abc"));
            ScramExchange::read_first(&first, &verifier, certificate).map(|exchange| exchange.binding)
        };
        let hash = Some(&b"hash"[..]);
        assert_eq!(begin(METHOD, "n", hash).expect("unbound"), b"n,,");
        assert_eq!(begin(METHOD, "y", None).expect("unbound"), b"y,,");
        let bound = begin(METHOD_PLUS, "p=tls-server-end-point", hash).expect("bound");
        assert_eq!(bound, b"p=tls-server-end-point,,hash");
        for (method, flag, certificate) in [
            // Somebody between the two has hidden the offer.
            (METHOD, "y", hash),
            (METHOD, "p=tls-server-end-point", hash),
            (METHOD_PLUS, "p=tls-server-end-point", None),
            (METHOD_PLUS, "p=tls-unique", hash),
            (METHOD_PLUS, "n", hash),
            ("SCRAM-SHA-1", "n", hash),
        ] {
            assert!(begin(method, flag, certificate).is_err(), "{method} {flag}");
        }
        for cut in [&b""[..], b"SCRAM-SHA-256", b"SCRAM-SHA-256\0\0\0\0\x09n,,", b"SCRAM-SHA-256\0\0\0\0\x03n,,"] {
            assert!(ScramExchange::read_first(cut, &verifier, None).is_err(), "{cut:?}");
        }
    }
}
