//! Tokens in the headers of requests.

use base64::Engine as _;
use base64::alphabet::STANDARD;
use base64::engine::GeneralPurpose;
use base64::engine::general_purpose::NO_PAD;

/// Of basic credentials; padding is cut off before, since gRPC's clients leave it out.
const BASE64: GeneralPurpose = GeneralPurpose::new(&STANDARD, NO_PAD.with_decode_allow_trailing_bits(true));

/// The token of an `Authorization` header: a bearer's, or the password of a basic one.
pub fn of_header(value: &str) -> Option<String> {
    let (scheme, rest) = value.split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(rest.trim().to_owned());
    }
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    let pair = String::from_utf8(BASE64.decode(rest.trim().trim_end_matches('=')).ok()?).ok()?;
    Some(pair.split_once(':')?.1.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_of_headers() {
        for (value, expected) in [
            ("Bearer x", Some("x")),
            ("bearer  x ", Some("x")),
            ("Basic dXNlcjpwYXNzOndvcmQ=", Some("pass:word")),
            ("Basic dXNlcjpwYXNzOndvcmQ", Some("pass:word")),
            ("Basic !!", None),
            ("Basic dXNlcg==", None),
            ("Digest x", None),
            ("x", None),
        ] {
            assert_eq!(of_header(value).as_deref(), expected, "{value}");
        }
    }
}
