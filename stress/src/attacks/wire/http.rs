//! Attacks on HTTP: what comes slowly, what never ends, and what says of itself that it is larger or other than it is.

use super::super::super::observed_server::{QueryClient, percent_encoded};
use super::{WireAttack, WireFlow, define_attack};

pub(super) const ATTACKS: &[WireAttack] = &[
    define_attack("slow heads", 600, |_| b"GET /health HTTP/1.1\r\nhost: ".to_vec(), WireFlow::Drip(blank_block)),
    define_attack(
        "slow bodies without a token",
        600,
        |_| post_head("/api/v1/session", "content-length: 1000\r\n"),
        WireFlow::Drip(blank_block),
    ),
    define_attack(
        "slow bodies",
        600,
        |client| sql_head(client, "content-length: 100000\r\n"),
        WireFlow::Drip(blank_block),
    ),
    define_attack(
        "slow chunks",
        600,
        |client| sql_head(client, "transfer-encoding: chunked\r\n"),
        WireFlow::Drip(|_| b"1\r\n \r\n".repeat(300)),
    ),
    define_attack("connections that say nothing", 600, |_| Vec::new(), WireFlow::Hold),
    define_attack("heads without an end", 100, |_| b"GET /health HTTP/1.1\r\n".to_vec(), WireFlow::Hold),
    define_attack(
        "body of 2 GB",
        8,
        |client| sql_head(client, "content-length: 2000000000\r\n"),
        WireFlow::Flood(megabyte_block, 1900),
    ),
    define_attack(
        "body of 2^64 bytes",
        8,
        |client| sql_head(client, "content-length: 18446744073709551615\r\n"),
        WireFlow::Flood(megabyte_block, 500),
    ),
    define_attack(
        "endless chunks",
        8,
        |client| sql_head(client, "transfer-encoding: chunked\r\n"),
        WireFlow::Flood(|_, _| [&b"100000\r\n"[..], &vec![b' '; 1 << 20], b"\r\n"].concat(), 2000),
    ),
    define_attack(
        "chunks of one byte",
        8,
        |client| sql_head(client, "transfer-encoding: chunked\r\n"),
        WireFlow::Flood(|_, _| b"1\r\n \r\n".repeat(100_000), 100),
    ),
    define_attack(
        "chunk of 2^64 bytes",
        8,
        |client| [sql_head(client, "transfer-encoding: chunked\r\n"), b"ffffffffffffffff\r\n".to_vec()].concat(),
        WireFlow::Flood(megabyte_block, 500),
    ),
    define_attack(
        "chunk extension without an end",
        8,
        |client| [sql_head(client, "transfer-encoding: chunked\r\n"), b"1;a=".to_vec()].concat(),
        WireFlow::Flood(megabyte_block, 500),
    ),
    define_attack(
        "trailers without an end",
        8,
        |client| [sql_head(client, "transfer-encoding: chunked\r\n"), b"0\r\n".to_vec()].concat(),
        WireFlow::Flood(|_, _| b"a: b\r\n".repeat(100_000), 100),
    ),
    define_attack(
        "header of 500 MB",
        8,
        |_| b"GET /health HTTP/1.1\r\nhost: a\r\na: ".to_vec(),
        WireFlow::Flood(megabyte_block, 500),
    ),
    define_attack(
        "headers without an end",
        8,
        |_| b"GET /health HTTP/1.1\r\nhost: a\r\n".to_vec(),
        WireFlow::Flood(|_, _| b"a: b\r\n".repeat(100_000), 100),
    ),
    define_attack("path of 500 MB", 8, |_| b"GET /".to_vec(), WireFlow::Flood(megabyte_block, 500)),
    define_attack(
        "pipelined requests",
        8,
        |_| Vec::new(),
        WireFlow::Flood(|client, _| get_request(client, "/health").repeat(2000), 20),
    ),
    define_attack(
        "pipelined requests unread",
        8,
        |_| Vec::new(),
        WireFlow::FloodUnread(|client, _| get_request(client, "/api/v1/openapi.json").repeat(2000), 20),
    ),
    define_attack(
        "pipelined queries",
        8,
        |_| Vec::new(),
        WireFlow::Flood(|client, _| sql_request(client, "select 1").repeat(500), 20),
    ),
    define_attack("answers unread", 8, |client| sql_request(client, ENDLESS), WireFlow::Hold),
    define_attack("answers read by bytes", 64, |client| sql_request(client, ENDLESS), WireFlow::Drip(blank_block)),
    define_attack("queries that nobody waits for", 4, |client| sql_request(client, ENDLESS), WireFlow::Reconnect(500)),
    define_attack(
        "two lengths",
        8,
        |client| sql_head(client, "content-length: 5\r\ncontent-length: 50\r\n"),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "length and chunks",
        8,
        |client| {
            [
                sql_head(client, "content-length: 5\r\ntransfer-encoding: chunked\r\n"),
                b"0\r\n\r\nGET /health HTTP/1.1\r\n".to_vec(),
            ]
            .concat()
        },
        WireFlow::ReadAnswer,
    ),
    define_attack("JSON in JSON", 8, |client| json_request(client, &"[".repeat(1_900_000)), WireFlow::ReadAnswer),
    define_attack(
        "JSON with escapes",
        8,
        |client| json_request(client, &format!("{{\"query\": \"{}\"}}", "\\u0061".repeat(300_000))),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "ranges of a run",
        8,
        |client| {
            let ranges = (0..5000).map(|n| format!("{n}-")).collect::<Vec<_>>().join(",");
            with_headers(
                client,
                &format!("/api/v1/runs/{}/file.mcap", client.run),
                &format!("range: bytes={ranges}\r\n"),
            )
        },
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "run files unread",
        64,
        |client| get_request(client, &format!("/api/v1/runs/{}/file.mcap", client.run)),
        WireFlow::Hold,
    ),
    define_attack("slices that are kept", 8, |_| Vec::new(), WireFlow::Flood(kept_slices, 20)),
    define_attack(
        "slices unread",
        64,
        |client| get_request(client, &format!("/api/v1/slices.mcap?run={}", client.run)),
        WireFlow::Hold,
    ),
    define_attack(
        "slices of 100 runs",
        8,
        |client| {
            get_request(client, &format!("/api/v1/slices.mcap?{}", vec![format!("run={}", client.run); 100].join("&")))
        },
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "topics without an end",
        8,
        |client| get_request(client, &format!("/api/v1/slices.mcap?run={}&topics={}", client.run, "a,".repeat(20_000))),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "facets again and again",
        8,
        |_| Vec::new(),
        WireFlow::Flood(
            |client, _| {
                (0..200)
                    .flat_map(|n| get_request(client, &format!("/api/v1/surfaces?sort=level&offset={n}&limit={n}")))
                    .collect()
            },
            20,
        ),
    ),
    define_attack(
        "wrong tokens",
        8,
        |_| Vec::new(),
        WireFlow::Flood(
            |_, _| b"GET /api/v1/tables HTTP/1.1\r\nhost: a\r\nauthorization: Bearer echolake_0\r\n\r\n".repeat(1000),
            50,
        ),
    ),
    define_attack("sessions", 8, |_| Vec::new(), WireFlow::Flood(session_requests, 50)),
    define_attack(
        "preface of HTTP/2",
        8,
        |_| b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0".to_vec(),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "upgrade that never comes",
        100,
        |_| b"GET / HTTP/1.1\r\nhost: a\r\nconnection: upgrade\r\nupgrade: websocket\r\n\r\n".to_vec(),
        WireFlow::Hold,
    ),
    define_attack(
        "expect that is not followed",
        100,
        |client| sql_head(client, "expect: 100-continue\r\ncontent-length: 100\r\n"),
        WireFlow::Hold,
    ),
    define_attack("connections one after the other", 8, |_| b"\r\n".to_vec(), WireFlow::Reconnect(5000)),
];

const ENDLESS: &str = "select v, repeat('x', 1000) x from generate_series(1, 1000000000) t(v)";

fn post_head(path: &str, headers: &str) -> Vec<u8> {
    format!("POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n{headers}\r\n").into_bytes()
}

fn with_headers(client: &QueryClient, path: &str, headers: &str) -> Vec<u8> {
    let token = &client.token;
    format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n{headers}\r\n").into_bytes()
}

fn get_request(client: &QueryClient, path: &str) -> Vec<u8> {
    with_headers(client, path, "")
}

fn sql_head(client: &QueryClient, headers: &str) -> Vec<u8> {
    let token = &client.token;
    let kind = "content-type: text/plain\r\n";
    format!("POST /api/v1/sql HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n{kind}{headers}\r\n")
        .into_bytes()
}

fn sql_request(client: &QueryClient, sql: &str) -> Vec<u8> {
    [sql_head(client, &format!("content-length: {}\r\n", sql.len())), sql.as_bytes().to_vec()].concat()
}

fn json_request(client: &QueryClient, body: &str) -> Vec<u8> {
    let headers = format!("authorization: Bearer {}\r\ncontent-length: {}\r\n", client.token, body.len());
    [post_head("/api/v1/sql", &headers), body.as_bytes().to_vec()].concat()
}

fn blank_block(_: &QueryClient) -> Vec<u8> {
    vec![b' '; 900]
}

fn megabyte_block(_: &QueryClient, _: usize) -> Vec<u8> {
    vec![b'x'; 1 << 20]
}

// By ranges, so that each of them is kept.
fn kept_slices(client: &QueryClient, _: usize) -> Vec<u8> {
    let slice = |number: usize| {
        let filter = percent_encoded(&format!("pair_id <> {number}"));
        let path = format!("/api/v1/slices.mcap?run={}&where={filter}", client.run);
        with_headers(client, &path, "range: bytes=0-10\r\n")
    };
    (0..50).flat_map(slice).collect()
}

fn session_requests(client: &QueryClient, _: usize) -> Vec<u8> {
    let body = format!("{{\"token\": \"{}\"}}", client.token);
    let head = post_head("/api/v1/session", &format!("content-length: {}\r\n", body.len()));
    [head, body.into_bytes()].concat().repeat(200)
}
