//! Users of an identity provider, which the test is.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpListener;
use std::time::{SystemTime, UNIX_EPOCH};

use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD as BASE64;
use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, KeyPair as _};
use serde_json::json;

use super::http::{HttpRequest, HttpResponse};
use super::postgres::WireClient;
use super::server::ServedLake;
use super::{json as json_of, lake, refused, served, wait_until};

struct TestIssuer {
    address: String,
    key: EcdsaKeyPair,
}

impl TestIssuer {
    fn start() -> Self {
        let random = SystemRandom::new();
        let document = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random).expect("a key");
        let key = EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, document.as_ref(), &random);
        let key = key.expect("a key");
        let point = key.public_key().as_ref();
        let (x, y) = (BASE64.encode(&point[1..33]), BASE64.encode(&point[33..]));
        let keys = json!({ "keys": [{ "kty": "EC", "crv": "P-256", "kid": "1", "x": x, "y": y }] });
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("an address"));
        let discovery = json!({ "issuer": address, "jwks_uri": format!("{address}/keys") });
        // It ends with the tests.
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let mut stream = stream.expect("a connection");
                let head = BufReader::new(&stream).lines().map_while(Result::ok).take_while(|line| !line.is_empty());
                let head: Vec<_> = head.collect();
                let is_of_keys = head.first().is_some_and(|line| line.starts_with("GET /keys "));
                let body = if is_of_keys { &keys } else { &discovery }.to_string();
                let length = body.len();
                let _ =
                    write!(stream, "HTTP/1.1 200 OK\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n{body}");
            }
        });
        Self { address, key }
    }

    // A token of a user in groups, for so many seconds.
    fn token(&self, user: &str, groups: &[&str], seconds: u64) -> String {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).expect("a time").as_secs();
        let claims = json!({ "iss": self.address, "aud": "lake", "sub": user, "groups": groups, "exp": now + seconds });
        let header = json!({ "alg": "ES256", "kid": "1" });
        let signed = format!("{}.{}", BASE64.encode(header.to_string()), BASE64.encode(claims.to_string()));
        let signature = self.key.sign(&SystemRandom::new(), signed.as_bytes()).expect("a signature");
        format!("{signed}.{}", BASE64.encode(signature))
    }
}

fn sql(server: &ServedLake, token: &str, text: &str) -> HttpResponse {
    let request = HttpRequest::post("/api/v1/sql", text).with("content-type", "text/plain");
    request.with("authorization", &format!("Bearer {token}")).send(server)
}

const GROUPS: &str =
    "[[group]]\nname = 'lab'\nscopes = ['sql']\nrows = 2\n[[group]]\nname = 'brick'\nprojects = ['brick']\n";

#[test]
fn groups_of_a_user_say_what_it_may() {
    let (place, issuer) = (lake(), TestIssuer::start());
    std::fs::write(place.path("tokens.toml"), GROUPS).expect("written");
    let oidc = ["--tokens", "tokens.toml", "--oidc", &issuer.address, "--oidc-audience", "lake"];
    let server = served(&place, &oidc);
    let ann = issuer.token("ann", &["staff", "lab"], 300);
    assert_eq!(json_of(&sql(&server, &ann, "select 7 as seven")), json!([{ "seven": 7 }]));
    let limited = sql(&server, &ann, "select value from generate_series(1, 3)");
    assert_eq!(json_of(&limited)["code"], "row_limit", "the group's limits hold");
    let files =
        |token: &str| HttpRequest::get("/api/v1/files").with("authorization", &format!("Bearer {token}")).send(&server);
    refused(&files(&ann), 403, "forbidden");
    assert_eq!(files(&issuer.token("bob", &["brick"], 300)).status, 200, "another group has other scopes");
    let own = sql(&server, &ann, "select distinct client from system.queries limit 2");
    assert_eq!(json_of(&own), json!([{ "client": "oidc:ann" }]));
    for wrong in
        [issuer.token("cyd", &["staff"], 300), TestIssuer::start().token("ann", &["lab"], 300), ann[1..].to_owned()]
    {
        refused(&sql(&server, &wrong, "select 1"), 401, "unauthenticated");
    }
    // A browser's session, and a login over Postgres' protocol.
    let body = json!({ "token": ann }).to_string();
    let session = HttpRequest::post("/api/v1/session", &body).with("content-type", "application/json").send(&server);
    let cookie = session.header("set-cookie").and_then(|cookie| cookie.split(';').next()).expect("a cookie").to_owned();
    assert_eq!(HttpRequest::get("/api/v1/tables").with("cookie", &cookie).send(&server).status, 200);
    let (mut client, _) = WireClient::start(&server, "token", None);
    assert_eq!(client.log_in(&ann), None);
    assert_eq!(client.query("select 7"), Ok(vec![vec![Some("7".to_owned())]]));
    // A group that is taken back ends what its users were doing.
    std::fs::write(place.path("tokens.toml"), GROUPS.replace("'lab'", "'staff'").replace("rows = 2", "rows = 9"))
        .expect("written");
    let more = "select value from generate_series(1, 3)";
    wait_until("the group is another", || sql(&server, &ann, more).status == 200);
    let is_told =
        || server.said().iter().any(|line| line.contains("it may no longer ask") && line.contains("oidc:ann"));
    wait_until("the log tells of it", is_told);
    assert!(!server.said().iter().any(|line| line.contains(&ann[..40])), "no token is in the log");
}

#[test]
fn what_cannot_be_a_provider_is_said() {
    let place = lake();
    std::fs::write(place.path("tokens.toml"), GROUPS).expect("written");
    let serve = ["serve", "--tokens", "tokens.toml"];
    place.fails(1, &serve, "the group `lab` is nobody's");
    place.fails(2, &[&serve[..], &["--oidc", "https://id.example.org"]].concat(), "--oidc-audience");
    let plain = ["--oidc", "http://id.example.org", "--oidc-audience", "lake"];
    place.fails(1, &[&serve[..], &plain].concat(), "it is http, expected https");
}
