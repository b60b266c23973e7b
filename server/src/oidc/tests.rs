//! A provider of the tests' own.

use std::sync::atomic::{AtomicBool, Ordering};

use axum::Router;
use axum::http::StatusCode;
use axum::routing::get;
use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD as BASE64;
use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, KeyPair as _};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use tokio::net::TcpListener;
use tokio::task::JoinSet;

use super::*;

const PAUSE: Duration = Duration::from_millis(20);

/// A provider that answers while `is_up`.
struct TestIssuer {
    address: String,
    keys: Arc<Mutex<Vec<Value>>>,
    is_up: Arc<AtomicBool>,
    _server: JoinSet<()>,
}

struct TestKey {
    pair: EcdsaKeyPair,
    id: &'static str,
}

impl TestKey {
    fn new(id: &'static str) -> Self {
        let random = SystemRandom::new();
        let document = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random).expect("a key");
        let pair = EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, document.as_ref(), &random);
        Self { pair: pair.expect("a key"), id }
    }

    fn public(&self) -> Value {
        let point = self.pair.public_key().as_ref();
        let (x, y) = (BASE64.encode(&point[1..33]), BASE64.encode(&point[33..]));
        json!({ "kty": "EC", "crv": "P-256", "kid": self.id, "x": x, "y": y })
    }

    fn sign(&self, claims: &Value) -> String {
        let header = json!({ "alg": "ES256", "kid": self.id });
        let signed = format!("{}.{}", BASE64.encode(header.to_string()), BASE64.encode(claims.to_string()));
        let signature = self.pair.sign(&SystemRandom::new(), signed.as_bytes()).expect("a signature");
        format!("{signed}.{}", BASE64.encode(signature))
    }
}

impl TestIssuer {
    async fn start(keys: Vec<Value>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("an address"));
        let keys = Arc::new(Mutex::new(keys));
        let is_up = Arc::new(AtomicBool::new(true));
        let discovery = json!({ "issuer": address, "jwks_uri": format!("{address}/keys") });
        let answer = |is_up: &AtomicBool, document: Value| match is_up.load(Ordering::Relaxed) {
            true => Ok(document.to_string()),
            false => Err(StatusCode::SERVICE_UNAVAILABLE),
        };
        let (first, second, published) = (is_up.clone(), is_up.clone(), keys.clone());
        let router = Router::new()
            .route("/.well-known/openid-configuration", get(move || async move { answer(&first, discovery) }))
            .route(
                "/keys",
                get(move || async move { answer(&second, json!({ "keys": *published.lock().expect("no panic") })) }),
            );
        let mut server = JoinSet::new();
        server.spawn(async move { axum::serve(listener, router).await.expect("served") });
        Self { address, keys, is_up, _server: server }
    }

    fn claims(&self, name: &str) -> Value {
        let now = Utc::now().timestamp();
        json!({ "iss": self.address, "aud": "lake", "sub": name, "exp": now + 300, "iat": now, "groups": ["lab"] })
    }

    fn provider(&self) -> (Arc<IdentityProvider>, JoinSet<()>) {
        let settings = OidcSettings {
            issuer: self.address.clone(),
            audience: "lake".to_owned(),
            name_claim: "sub".to_owned(),
            groups_claim: "groups".to_owned(),
        };
        let provider = IdentityProvider::with_pause(settings, PAUSE).expect("a provider");
        let mut upkeep = JoinSet::new();
        upkeep.spawn(provider.clone().keep_up());
        (provider, upkeep)
    }
}

async fn log_in(provider: &IdentityProvider, token: &str) -> Option<UserLogin> {
    provider.await_key(token).await;
    provider.log_in(token, Sha256::digest(token).into())
}

#[tokio::test]
async fn users_log_in_by_keys_that_change_and_a_provider_that_is_away() {
    let (first, second) = (TestKey::new("1"), TestKey::new("2"));
    let issuer = TestIssuer::start(vec![first.public()]).await;
    let (provider, _upkeep) = issuer.provider();
    let token = first.sign(&issuer.claims("ann"));
    let ann = log_in(&provider, &token).await.expect("let in");
    assert_eq!((ann.name.as_str(), &ann.groups[..]), ("ann", &["lab".to_owned()][..]));
    assert_eq!(provider.known_login(&Sha256::digest(&token).into()), Some(ann.clone()));
    assert_eq!(provider.known_logins(|login| login.name == "ann"), [ann]);
    let stranger = TestKey::new("1").sign(&issuer.claims("ann"));
    assert_eq!(log_in(&provider, &stranger).await, None, "another's key of that name");
    // A new key is fetched when a token names it.
    issuer.keys.lock().expect("no panic").push(second.public());
    tokio::time::sleep(2 * PAUSE).await;
    assert!(log_in(&provider, &second.sign(&issuer.claims("bob"))).await.is_some());
    // While the provider is away, known keys serve.
    issuer.is_up.store(false, Ordering::Relaxed);
    tokio::time::sleep(2 * PAUSE).await;
    assert_eq!(log_in(&provider, &TestKey::new("3").sign(&issuer.claims("ann"))).await, None);
    assert!(log_in(&provider, &first.sign(&issuer.claims("cyd"))).await.is_some());
    // A key that the provider took back is none.
    *issuer.keys.lock().expect("no panic") = vec![second.public()];
    issuer.is_up.store(true, Ordering::Relaxed);
    let dan = first.sign(&issuer.claims("dan"));
    let taken_back = async {
        while log_in(&provider, &dan).await.is_some() {
            tokio::time::sleep(PAUSE).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), taken_back).await.expect("its key is none");
    assert!(log_in(&provider, &second.sign(&issuer.claims("dan"))).await.is_some());
}

#[tokio::test]
async fn tokens_are_checked() {
    let key = TestKey::new("1");
    let issuer = TestIssuer::start(vec![key.public()]).await;
    let (provider, _upkeep) = issuer.provider();
    for (claim, value) in [
        ("iss", json!("https://elsewhere")),
        ("aud", json!("other")),
        ("exp", json!(Utc::now().timestamp() - 61)),
        ("sub", json!("")),
        ("sub", json!("a\nb")),
        ("sub", json!(7)),
        ("sub", json!("x".repeat(MOST_NAME_CHARS + 1))),
    ] {
        let mut claims = issuer.claims("ann");
        claims[claim] = value;
        assert_eq!(log_in(&provider, &key.sign(&claims)).await, None, "{claims}");
    }
    assert!(log_in(&provider, &key.sign(&issuer.claims("ann"))).await.is_some());
    for number in 0..MOST_LOGINS {
        assert!(log_in(&provider, &key.sign(&issuer.claims(&number.to_string()))).await.is_some());
    }
    assert_eq!(provider.known_logins(|_| true).len(), MOST_LOGINS);
}

#[test]
fn addresses_are_https_or_of_this_machine() {
    for (text, is_right) in [
        ("https://id.example.org/realms/lab", true),
        ("http://127.0.0.1:8080", true),
        ("http://[::1]:8080", true),
        ("http://localhost", true),
        ("http://id.example.org", false),
        ("file:///etc/passwd", false),
        ("id.example.org", false),
        ("", false),
    ] {
        assert_eq!(check_address(text).is_ok(), is_right, "{text}");
    }
}

#[test]
fn addresses_of_users_are_names_only_if_they_are_verified() {
    let name = |claims: Value| {
        let claims = serde_json::from_value(claims).map(TokenClaims::new).expect("claims");
        user_name(&claims, "email").ok()
    };
    assert_eq!(name(json!({ "email": "a@x", "email_verified": true })).as_deref(), Some("a@x"));
    assert_eq!(name(json!({ "email": "a@x" })), None);
    assert_eq!(name(json!({ "email": "a@x", "email_verified": "true" })), None);
}
