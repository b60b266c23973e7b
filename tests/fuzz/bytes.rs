//! Changed bytes, and connections that carry them.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use rand::{Rng as _, RngCore as _};
use rand_chacha::ChaCha8Rng;

/// Time after which an answer to changed bytes is taken for endless.
const LONGEST_ANSWER: Duration = Duration::from_secs(300);

/// Replacements of four bytes: lengths and counts at their edges.
const EXTREMES: [u32; 8] = [0, 1, 3, 0x7f, 0xffff, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff];

/// Turns, replaces, removes or doubles some bytes, or cuts off the end; says what it did.
pub(super) fn change(random: &mut ChaCha8Rng, bytes: &mut Vec<u8>) -> String {
    let mut said = Vec::new();
    for _ in 0..random.random_range(1..=4) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        let length = random.random_range(1..=64.min(bytes.len() - at));
        match random.random_range(0..5) {
            0 => {
                bytes[at] ^= 1 << random.random_range(0..8);
                said.push(format!("a bit of {at} turned"));
            }
            1 => {
                let value = EXTREMES[random.random_range(0..EXTREMES.len())];
                let value = if random.random() { value.to_be_bytes() } else { value.to_le_bytes() };
                let end = bytes.len().min(at + 4);
                bytes[at..end].copy_from_slice(&value[..end - at]);
                said.push(format!("{value:?} at {at}"));
            }
            2 => {
                bytes.drain(at..at + length);
                said.push(format!("{length} bytes gone at {at}"));
            }
            3 => {
                let part = bytes[at..at + length].to_vec();
                bytes.splice(at..at, part);
                said.push(format!("{length} bytes twice at {at}"));
            }
            _ if random.random_ratio(1, 4) => {
                bytes.truncate(at);
                said.push(format!("cut at {at}"));
            }
            _ => {
                random.fill_bytes(&mut bytes[at..at + length]);
                said.push(format!("{length} bytes of chance at {at}"));
            }
        }
    }
    said.join(", ")
}

/// A changed request.
pub(super) fn http(random: &mut ChaCha8Rng, token: &str) -> Vec<u8> {
    let body = r#"{"query": "select pair_id from pairs limit 3", "format": "arrow"}"#;
    let mut bytes = match random.random_range(0..3) {
        0 => format!(
            "POST /api/v1/sql HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n\
             content-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
            body.len()
        ),
        1 => format!(
            "POST /api/v1/sql HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n\
             content-type: application/json\r\ntransfer-encoding: chunked\r\n\r\n{:x}\r\n{body}\r\n0\r\n\r\n",
            body.len()
        ),
        _ => format!(
            "GET /api/v1/tables HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n\
             range: bytes=0-10,20-\r\naccept: */*\r\n\r\n"
        ),
    }
    .into_bytes();
    change(random, &mut bytes);
    bytes
}

/// A connection to Postgres' port, log-in and all, with changes.
pub(super) fn postgres(random: &mut ChaCha8Rng, token: &str) -> Vec<u8> {
    let message = |kind: u8, body: &[u8]| [&[kind][..], &((body.len() + 4) as i32).to_be_bytes(), body].concat();
    let start = b"\0\x03\0\0user\0token\0database\0datafusion\0\0";
    let mut parts = vec![[&((start.len() + 4) as i32).to_be_bytes(), &start[..]].concat()];
    parts.push(message(b'p', &[token.as_bytes(), b"\0"].concat()));
    let query = b"select pair_id from pairs where pair_id = $1\0";
    parts.push(message(b'Q', b"select count(*) from pairs\0"));
    parts.push(message(b'P', &[b"s\0", &query[..], &[0, 1, 0, 0, 0, 23]].concat()));
    parts.push(message(b'D', b"Ss\0"));
    parts.push(message(b'B', b"c\0s\0\0\x01\0\0\0\x01\0\0\0\x017\0\x01\0\x01"));
    parts.push(message(b'E', b"c\0\0\0\0\x02"));
    parts.push(message(b'C', b"Pc\0"));
    parts.push(message(b'S', b""));
    parts.push(message(b'Q', b"copy pairs to stdout with (format csv)\0"));
    parts.push(message(b'd', b"1,2\n"));
    parts.push(message(b'X', b""));
    // Mostly the log-in stays whole, because nothing behind a broken one is read.
    let first = if random.random_ratio(4, 5) { 2 } else { 0 };
    let at = random.random_range(first..parts.len());
    change(random, &mut parts[at]);
    let (a, b) = (random.random_range(first..parts.len()), random.random_range(first..parts.len()));
    parts.swap(a, b);
    parts.concat()
}

/// HTTP/2's preface, and frames of chance whose lengths are right unless they are changed too.
pub(super) fn http2(random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut frames = Vec::new();
    for _ in 0..random.random_range(1..6) {
        let mut payload = vec![0; random.random_range(0..80)];
        random.fill_bytes(&mut payload);
        frames.extend(&(payload.len() as u32).to_be_bytes()[1..]);
        frames.extend([random.random_range(0..11_u8), random.random()]);
        frames.extend((random.random_range(0..4_u32)).to_be_bytes());
        frames.extend(payload);
    }
    if random.random() {
        change(random, &mut frames);
    }
    [&b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0"[..], &frames].concat()
}

/// Sends bytes and ends this side of the connection; returns how many came back until the server ended its own, or sent
/// nothing for as long as `patience`.
pub(super) fn send(address: &str, bytes: &[u8], patience: Duration) -> usize {
    let mut stream = TcpStream::connect(address).expect("connected");
    stream.set_read_timeout(Some(patience)).expect("a time");
    stream.set_write_timeout(Some(patience)).expect("a time");
    // A server may close as soon as it has seen enough.
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    let (mut heard, mut buffer) = (0, [0; 4096]);
    let end = Instant::now() + LONGEST_ANSWER;
    while let Ok(count @ 1..) = stream.read(&mut buffer) {
        heard += count;
        assert!(Instant::now() < end, "an answer without an end: {heard} bytes");
    }
    heard
}
