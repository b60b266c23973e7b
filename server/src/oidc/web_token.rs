//! Signed tokens (JSON Web Tokens, RFC 7519 and 7515) and keys (RFC 7517). A key tells by which algorithm it is used; a
//! token that names another one is refused, so that no token chooses how it is checked.

use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD as BASE64;
use ring::signature::{ECDSA_P256_SHA256_FIXED, RSA_PKCS1_2048_8192_SHA256, RsaPublicKeyComponents, UnparsedPublicKey};
use serde::Deserialize;
use serde_json::{Map, Value};

/// Bytes of a token.
const LARGEST: usize = 16 << 10;
/// Seconds that the clocks of provider and server may differ by.
const CLOCK_SECS: f64 = 60.0;
/// Bytes of a coordinate of a point on the curve P-256.
const COORDINATE: usize = 32;

/// A token that is not checked yet.
pub(super) struct WebToken<'a> {
    header: TokenHeader,
    signed: &'a str,
    payload: Vec<u8>,
    signature: Vec<u8>,
}

#[derive(Deserialize)]
struct TokenHeader {
    alg: String,
    kid: Option<String>,
    /// Extensions that a reader must know; none are known here.
    crit: Option<Value>,
}

/// The claims of a token whose signature is right.
pub(super) struct TokenClaims(Map<String, Value>);

/// A key of a provider.
pub(super) struct SigningKey {
    id: Option<String>,
    kind: KeyKind,
}

enum KeyKind {
    /// Modulus and exponent, for RS256.
    Rsa(RsaPublicKeyComponents<Vec<u8>>),
    /// A point of the curve P-256, for ES256.
    Curve(Vec<u8>),
}

/// The document of a provider's keys.
#[derive(Deserialize)]
pub(super) struct KeyDocument {
    keys: Vec<Value>,
}

#[derive(Deserialize)]
struct KeyEntry {
    kty: String,
    kid: Option<String>,
    #[serde(rename = "use")]
    purpose: Option<String>,
    alg: Option<String>,
    crv: Option<String>,
    n: Option<String>,
    e: Option<String>,
    x: Option<String>,
    y: Option<String>,
}

impl<'a> WebToken<'a> {
    /// Reads a token; None if the text is none.
    pub(super) fn parse(text: &'a str) -> Option<Self> {
        let (signed, signature) = text.rsplit_once('.').filter(|_| text.len() <= LARGEST)?;
        let (header, payload) = signed.split_once('.')?;
        Some(Self {
            header: serde_json::from_slice(&BASE64.decode(header).ok()?).ok()?,
            signed,
            payload: BASE64.decode(payload).ok()?,
            signature: BASE64.decode(signature).ok()?,
        })
    }

    // A token that names no key is of the only one for its algorithm.
    fn key<'k>(&self, keys: &'k [SigningKey]) -> Option<&'k SigningKey> {
        let fits = |key: &&SigningKey| {
            key.algorithm() == self.header.alg && (self.header.kid.is_none() || key.id == self.header.kid)
        };
        let mut fitting = keys.iter().filter(fits);
        let key = fitting.next()?;
        fitting.next().is_none().then_some(key)
    }

    /// Checks the signature; returns the claims.
    ///
    /// # Errors
    /// The reason.
    pub(super) fn verify(&self, keys: &[SigningKey]) -> Result<TokenClaims, String> {
        if self.header.crit.is_some() {
            return Err("it has extensions that must be known (`crit`)".to_owned());
        }
        let key = self.key(keys).ok_or_else(|| {
            let TokenHeader { alg, kid, .. } = &self.header;
            let kid = kid.as_deref().unwrap_or_default();
            format!(
                "the provider has no key for its algorithm `{alg}` and key `{kid}`, or several; expected RS256 or ES256"
            )
        })?;
        let signed = self.signed.as_bytes();
        let is_right = match &key.kind {
            KeyKind::Rsa(key) => key.verify(&RSA_PKCS1_2048_8192_SHA256, signed, &self.signature),
            KeyKind::Curve(point) => {
                UnparsedPublicKey::new(&ECDSA_P256_SHA256_FIXED, point).verify(signed, &self.signature)
            }
        };
        is_right.map_err(|_| "its signature is wrong".to_owned())?;
        serde_json::from_slice(&self.payload)
            .map(TokenClaims::new)
            .map_err(|_| "its claims are no JSON object".to_owned())
    }
}

impl TokenClaims {
    /// Claims of a token that is checked.
    pub(super) fn new(claims: Map<String, Value>) -> Self {
        Self(claims)
    }

    /// Checks issuer, audience and times; returns when it expires, seconds since 1970.
    ///
    /// # Errors
    /// The reason.
    pub(super) fn check(&self, issuer: &str, audience: &str, now: i64) -> Result<i64, String> {
        if self.text("iss") != Some(issuer) {
            return Err(format!("its issuer is `{}`, expected `{issuer}`", self.text("iss").unwrap_or_default()));
        }
        let audiences = self.texts("aud");
        if !audiences.iter().any(|found| found == audience) {
            return Err(format!("its audience is `{}`, expected `{audience}`", audiences.join(", ")));
        }
        let expires = self.time("exp")?.ok_or("it does not expire (`exp`)")?;
        if now as f64 >= expires + CLOCK_SECS {
            return Err("it has expired".to_owned());
        }
        for name in ["nbf", "iat"] {
            if self.time(name)?.is_some_and(|time| time > now as f64 + CLOCK_SECS) {
                return Err(format!("it is of the future (`{name}`)"));
            }
        }
        Ok((expires + CLOCK_SECS) as i64)
    }

    /// Returns a text.
    pub(super) fn text(&self, name: &str) -> Option<&str> {
        self.0.get(name)?.as_str()
    }

    /// Returns a text, or those of a list.
    pub(super) fn texts(&self, name: &str) -> Vec<String> {
        match self.0.get(name) {
            Some(Value::String(text)) => vec![text.clone()],
            Some(Value::Array(list)) => list.iter().filter_map(|text| text.as_str().map(str::to_owned)).collect(),
            _ => Vec::new(),
        }
    }

    /// Returns a truth value.
    pub(super) fn flag(&self, name: &str) -> Option<bool> {
        self.0.get(name)?.as_bool()
    }

    fn time(&self, name: &str) -> Result<Option<f64>, String> {
        match self.0.get(name) {
            None => Ok(None),
            Some(value) => value.as_f64().map(Some).ok_or_else(|| format!("its `{name}` is no number")),
        }
    }
}

impl KeyDocument {
    /// Returns the keys that can check signatures here; others are left out, as the standard says.
    pub(super) fn signing_keys(&self) -> Vec<SigningKey> {
        self.keys
            .iter()
            .filter_map(|key| serde_json::from_value(key.clone()).ok())
            .filter_map(SigningKey::new)
            .collect()
    }
}

impl SigningKey {
    fn new(entry: KeyEntry) -> Option<Self> {
        let decode = |text: Option<String>| BASE64.decode(text?).ok();
        let kind = match (entry.kty.as_str(), entry.crv.as_deref()) {
            ("RSA", _) => KeyKind::Rsa(RsaPublicKeyComponents { n: decode(entry.n)?, e: decode(entry.e)? }),
            ("EC", Some("P-256")) => {
                let (x, y) = (decode(entry.x)?, decode(entry.y)?);
                // An uncompressed point.
                let is_point = x.len() == COORDINATE && y.len() == COORDINATE;
                KeyKind::Curve(is_point.then(|| [&[4][..], &x, &y].concat())?)
            }
            _ => return None,
        };
        let key = Self { id: entry.kid, kind };
        let is_of_signatures = entry.purpose.is_none_or(|purpose| purpose == "sig");
        (is_of_signatures && entry.alg.is_none_or(|alg| alg == key.algorithm())).then_some(key)
    }

    fn algorithm(&self) -> &'static str {
        match self.kind {
            KeyKind::Rsa(_) => "RS256",
            KeyKind::Curve(_) => "ES256",
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    // RFC 7515, appendices A.2 and A.3: the same claims, signed by RS256 and by ES256.
    const PAYLOAD: &str =
        "eyJpc3MiOiJqb2UiLA0KICJleHAiOjEzMDA4MTkzODAsDQogImh0dHA6Ly9leGFtcGxlLmNvbS9pc19yb290Ijp0cnVlfQ";
    const RS256: &str = "eyJhbGciOiJSUzI1NiJ9";
    const RS256_SIGNATURE: &str = "cC4hiUPoj9Eetdgtv3hF80EGrhuB__dzERat0XF9g2VtQgr9PJbu3XOiZj5RZmh7AAuHIm4Bh-0Qc_lF5YKt_O8W2Fp5juj\
        Gbds9uJdbF9CUAr7t1dnZcAcQjbKBYNX4BAynRFdiuB--f_nZLgrnbyTyWzO75vRK5h6xBArLIARNPvkSjtQBMHlb1L07Qe7K0GarZRmB_eSN9383LcO\
        Ln6_dO--xi12jzDwusC-eOkHWEsqtFZESc6BfI7noOPqvhJ1phCnvWh6IeYI2w9QOYEUipUTI8np6LbgGY9Fs98rqVt5AXLIhWkWywlVmtVrBp0igcN_\
        IoypGlUPQGe77Rw";
    const ES256: &str = "eyJhbGciOiJFUzI1NiJ9";
    const ES256_SIGNATURE: &str =
        "DtEhU3ljbEg8L38VWAfUAqOyKAM6-Xx-F4GawxaepmXFCgfTjDxw5djxLa8ISlSApmWQxfKTUJqPP3-Kg6NU1Q";

    fn keys() -> Vec<SigningKey> {
        let document = json!({ "keys": [
            { "kty": "RSA", "kid": "r", "e": "AQAB",
              "n": "ofgWCuLjybRlzo0tZWJjNiuSfb4p4fAkd_wWJcyQoTbji9k0l8W26mPddxHmfHQp-Vaw-4qPCJrcS2mJPMEzP1Pt0Bm4d4QlL-yRT-SFd2lZS\
                    -pCgNMsD1W_YpRPEwOWvG6b32690r2jZ47soMZo9wGzjb_7OMg0LOL-bSf63kpaSHSXndS5z5rexMdbBYUsLA9e-KXBdQOS-UTo7WTBEMa2R2CapHg\
                    665xsmtdVMTBQY4uDZlxvb3qCo5ZwKh9kG4LT6_I5IhlJH7aGhyxXFvUK-DWNmoudF8NAco9_h9iaGNj8q2ethFkMLs91kzk2PAcDTW9gb54h4FRWy\
                    uXpoQ" },
            { "kty": "EC", "kid": "e", "use": "sig", "crv": "P-256",
              "x": "f83OJ3D2xF1Bg8vub9tLe1gHMzV76e8Tus9uPHvRVEU", "y": "x_FEzRu9m36HLN_tue659LNpXW6pCyStikYjKIWI5a0" },
            { "kty": "EC", "kid": "e2", "use": "enc", "crv": "P-256",
              "x": "f83OJ3D2xF1Bg8vub9tLe1gHMzV76e8Tus9uPHvRVEU", "y": "x_FEzRu9m36HLN_tue659LNpXW6pCyStikYjKIWI5a0" },
            { "kty": "EC", "kid": "short", "crv": "P-256", "x": "AAAA", "y": "AAAA" },
            { "kty": "oct", "k": "AAAA" }, { "kty": 7 }, null,
        ] });
        serde_json::from_value::<KeyDocument>(document).expect("a document").signing_keys()
    }

    fn check(header: &str, payload: &str, signature: &str) -> Result<(), String> {
        let token = format!("{header}.{payload}.{signature}");
        WebToken::parse(&token).ok_or("no token")?.verify(&keys()).map(drop)
    }

    #[test]
    fn signatures_are_those_of_the_standard() {
        assert_eq!(keys().len(), 2, "those that sign, by algorithms that are known");
        assert_eq!(check(RS256, PAYLOAD, RS256_SIGNATURE), Ok(()));
        assert_eq!(check(ES256, PAYLOAD, ES256_SIGNATURE), Ok(()));
        let wrong = "its signature is wrong";
        assert_eq!(check(RS256, &PAYLOAD.replace("eyJpc3", "eyJpc4"), RS256_SIGNATURE), Err(wrong.to_owned()));
        assert_eq!(check(ES256, PAYLOAD, &ES256_SIGNATURE.replace("DtEh", "DtEi")), Err(wrong.to_owned()));
        assert_eq!(check(ES256, PAYLOAD, ""), Err(wrong.to_owned()));
    }

    #[test]
    fn no_token_chooses_how_it_is_checked() {
        let header = |header: Value| BASE64.encode(header.to_string());
        for (alg, expected) in [("none", "no key"), ("HS256", "no key"), ("RS512", "no key"), ("RS256", "signature")] {
            let refused = check(&header(json!({ "alg": alg })), PAYLOAD, ES256_SIGNATURE).expect_err(alg);
            assert!(refused.contains(expected), "{alg}: {refused}");
        }
        let other = check(&header(json!({ "alg": "ES256", "kid": "r" })), PAYLOAD, ES256_SIGNATURE);
        assert!(other.expect_err("another's key").contains("no key"));
        let critical = check(&header(json!({ "alg": "ES256", "crit": ["b64"] })), PAYLOAD, ES256_SIGNATURE);
        assert!(critical.expect_err("an extension").contains("`crit`"));
        for text in ["", ".", "..", "a.b.c", "echolake_00", "e30.e30.", &format!("{RS256}.{}", "a".repeat(LARGEST))] {
            assert!(WebToken::parse(text).is_none(), "{text}");
        }
    }

    #[test]
    fn claims_are_checked() {
        let right =
            json!({ "iss": "https://id", "aud": ["x", "lake"], "exp": 1000, "nbf": 900.5, "groups": ["a", 7, "b"] });
        let check = |changes: Value| {
            let mut claims = right.as_object().expect("claims").clone();
            claims.extend(changes.as_object().expect("claims").clone());
            TokenClaims::new(claims).check("https://id", "lake", 950)
        };
        assert_eq!(check(json!({})), Ok(1060));
        assert_eq!(check(json!({ "aud": "lake", "exp": 891 })), Ok(951));
        for (changes, expected) in [
            (json!({ "iss": "https://id/" }), "its issuer is `https://id/`"),
            (json!({ "iss": null }), "its issuer is ``"),
            (json!({ "aud": "lakes" }), "its audience is `lakes`"),
            (json!({ "aud": [] }), "its audience is ``"),
            (json!({ "exp": 890 }), "it has expired"),
            (json!({ "exp": "1000" }), "its `exp` is no number"),
            (json!({ "nbf": 1011 }), "it is of the future (`nbf`)"),
            (json!({ "iat": 1011 }), "it is of the future (`iat`)"),
        ] {
            let refused = check(changes).expect_err(expected);
            assert!(refused.contains(expected), "{refused}");
        }
        let claims = TokenClaims::new(right.as_object().expect("claims").clone());
        assert_eq!((claims.texts("groups"), claims.texts("iss").len()), (vec!["a".to_owned(), "b".to_owned()], 1));
    }
}
