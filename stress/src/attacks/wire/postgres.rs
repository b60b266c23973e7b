//! Attacks on Postgres' protocol: lengths that lie, messages that never end, and more of everything than is sensible.

use super::super::super::observed_server::{QueryClient, startup_message, tagged_message};
use super::{WireAttack, WireFlow, define_attack};

pub(super) const ATTACKS: &[WireAttack] = &[
    define_attack(
        "query of 1 GiB before log-in",
        8,
        |_| begun_message(&startup_message(), b'Q'),
        WireFlow::Flood(megabyte_block, 1023),
    ),
    define_attack(
        "password of 1 GiB",
        8,
        |_| begun_message(&startup_message(), b'p'),
        WireFlow::Flood(megabyte_block, 1023),
    ),
    define_attack(
        "bind of 1 GiB before log-in",
        8,
        |_| begun_message(&startup_message(), b'B'),
        WireFlow::Flood(megabyte_block, 1023),
    ),
    define_attack(
        "copy data of 1 GiB before log-in",
        8,
        |_| begun_message(&startup_message(), b'd'),
        WireFlow::Flood(megabyte_block, 1023),
    ),
    define_attack(
        "query of 1 GiB",
        8,
        |client| begun_message(&log_in(client), b'Q'),
        WireFlow::Flood(megabyte_block, 1023),
    ),
    define_attack(
        "unknown message of 1 GiB",
        8,
        |client| begun_message(&log_in(client), b'~'),
        WireFlow::Flood(megabyte_block, 1023),
    ),
    define_attack(
        "copy data without copy",
        4,
        log_in,
        WireFlow::Flood(|_, _| tagged_message(b'd', &[b'1'; 1 << 20]), 2000),
    ),
    define_attack("log-ins without a password", 300, |_| startup_message(), WireFlow::Hold),
    define_attack("connections that say nothing", 300, |_| Vec::new(), WireFlow::Hold),
    define_attack("startup in single bytes", 100, |_| Vec::new(), WireFlow::Drip(|_| startup_message())),
    define_attack(
        "startup of 2 GiB",
        8,
        |_| [0x7f, 0xff, 0xff, 0xff, 0, 3, 0, 0].to_vec(),
        WireFlow::Flood(megabyte_block, 2047),
    ),
    define_attack("startup of length 0", 50, |_| vec![0; 64], WireFlow::ReadAnswer),
    define_attack("startup of a negative length", 50, |_| vec![0xff; 64], WireFlow::ReadAnswer),
    define_attack("startup with 100 000 parameters", 8, many_parameters, WireFlow::ReadAnswer),
    define_attack(
        "startup again and again",
        4,
        |_| startup_message(),
        WireFlow::Flood(|_, _| startup_message(), 100_000),
    ),
    define_attack(
        "requests for TLS",
        8,
        |_| Vec::new(),
        WireFlow::Flood(|_, _| [0, 0, 0, 8, 4, 0xd2, 0x16, 0x2f].repeat(1000), 1000),
    ),
    define_attack(
        "wrong passwords",
        8,
        |_| [startup_message(), tagged_message(b'p', b"no\0")].concat(),
        WireFlow::Reconnect(1000),
    ),
    define_attack("cancel flood", 8, |_| cancel_request(12), WireFlow::Reconnect(3000)),
    define_attack(
        "cancel with a long key",
        8,
        |_| [0, 0x10, 0, 0, 4, 0xd2, 0x16, 0x2e].to_vec(),
        WireFlow::Flood(megabyte_block, 1),
    ),
    define_attack("half a message", 100, |client| begun_message(&log_in(client), b'Q'), WireFlow::Hold),
    define_attack("query in single bytes", 100, log_in, WireFlow::Drip(|_| tagged_message(b'Q', &[b' '; 4000]))),
    define_attack(
        "message of a negative length",
        50,
        |client| [&log_in(client)[..], b"Q\xff\xff\xff\xff"].concat(),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "message of length 0",
        50,
        |client| [&log_in(client)[..], b"Q\0\0\0\0"].concat(),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "statements of 20 MiB",
        1,
        log_in,
        WireFlow::Flood(|_, number| named_statement(number, 20 << 20), 60),
    ),
    define_attack("statements of 2 MiB", 1, log_in, WireFlow::Flood(|_, number| named_statement(number, 2 << 20), 500)),
    define_attack("portals of 20 MiB", 1, log_in, WireFlow::Flood(|_, number| named_portal(number, 20 << 20), 161)),
    define_attack("portals of 3 MiB", 1, log_in, WireFlow::Flood(|_, number| named_portal(number, 3 << 20), 500)),
    define_attack(
        "statements without an end",
        4,
        log_in,
        WireFlow::Flood(|_, number| named_statement(number, 20), 100_000),
    ),
    define_attack("65 535 values", 4, log_in, WireFlow::Flood(|_, _| bind_values(65_535, 4), 20)),
    define_attack("values with lying lengths", 8, log_in, WireFlow::Flood(|_, _| bind_values(65_535, i32::MAX), 1)),
    define_attack("values of negative lengths", 8, log_in, WireFlow::Flood(|_, _| bind_values(1000, -2), 1)),
    define_attack("65 535 types", 4, log_in, WireFlow::Flood(|_, _| parse_types(65_535), 50)),
    define_attack(
        "types without values",
        8,
        log_in,
        WireFlow::Flood(|_, _| tagged_message(b'P', b"\0select 1\0\xff\xff"), 10),
    ),
    define_attack("pipelined queries", 4, log_in, WireFlow::Flood(|_, _| query_message("select 1").repeat(1000), 50)),
    define_attack(
        "pipelined queries unread",
        4,
        log_in,
        WireFlow::FloodUnread(|_, _| query_message("select repeat('x', 1000)").repeat(1000), 50),
    ),
    define_attack("answers unread", 8, |client| [log_in(client), query_message(ENDLESS)].concat(), WireFlow::Hold),
    define_attack(
        "flood of syncs",
        4,
        log_in,
        WireFlow::FloodUnread(|_, _| tagged_message(b'S', b"").repeat(100_000), 100),
    ),
    define_attack(
        "flood of flushes",
        4,
        log_in,
        WireFlow::FloodUnread(|_, _| tagged_message(b'H', b"").repeat(100_000), 100),
    ),
    define_attack(
        "executes of no portal",
        4,
        log_in,
        WireFlow::Flood(|_, _| tagged_message(b'E', b"no\0\0\0\0\0").repeat(10_000), 20),
    ),
    define_attack(
        "100 000 statements in a query",
        4,
        |client| [log_in(client), query_message(&";".repeat(1_000_000))].concat(),
        WireFlow::ReadAnswer,
    ),
    define_attack("function calls", 8, log_in, WireFlow::Flood(|_, _| tagged_message(b'F', &[0xff; 64]), 1000)),
    define_attack("cursors", 4, log_in, WireFlow::Flood(|_, _| cursor_queries(), 1)),
];

const ENDLESS: &str = "select v, repeat('x', 1000) from generate_series(1, 1000000000) t(v)";

fn log_in(client: &QueryClient) -> Vec<u8> {
    [startup_message(), tagged_message(b'p', &[client.token.as_bytes(), b"\0"].concat())].concat()
}

fn query_message(sql: &str) -> Vec<u8> {
    tagged_message(b'Q', &[sql.as_bytes(), b"\0"].concat())
}

// The head of a message that is almost 1 GiB long.
fn begun_message(before: &[u8], kind: u8) -> Vec<u8> {
    [before, &[kind, 0x3f, 0xff, 0xff, 0xf0]].concat()
}

fn megabyte_block(_: &QueryClient, _: usize) -> Vec<u8> {
    vec![b'x'; 1 << 20]
}

fn many_parameters(_: &QueryClient) -> Vec<u8> {
    let body = [&[0, 3, 0, 0][..], &b"user\0me\0".repeat(100_000), b"\0"].concat();
    [&((body.len() + 4) as u32).to_be_bytes()[..], &body].concat()
}

fn cancel_request(process: u32) -> Vec<u8> {
    [&16_u32.to_be_bytes()[..], &80_877_102_u32.to_be_bytes(), &process.to_be_bytes(), &[7; 4]].concat()
}

fn prepare_message(name: &str, sql: &str, types: &[u8]) -> Vec<u8> {
    tagged_message(b'P', &[name.as_bytes(), b"\0", sql.as_bytes(), b"\0", types].concat())
}

fn named_statement(number: usize, bytes: usize) -> Vec<u8> {
    let sql = format!("select 1 as a{}", " ".repeat(bytes));
    [prepare_message(&format!("s{number}"), &sql, &[0, 0]), tagged_message(b'H', b"")].concat()
}

// Each with the statement that it needs, under the same name.
fn named_portal(number: usize, bytes: usize) -> Vec<u8> {
    let name = format!("p{number}\0s{number}\0");
    let length = (bytes as u32).to_be_bytes();
    let value = vec![b'x'; bytes];
    let bind = tagged_message(b'B', &[name.as_bytes(), &[0, 0, 0, 1], &length, &value, &[0, 0]].concat());
    let statement = prepare_message(&format!("s{number}"), "select $1::varchar as a", &[0, 1, 0, 0, 0, 25]);
    [statement, bind, tagged_message(b'H', b"")].concat()
}

// The values are four bytes long, whatever their lengths say.
fn bind_values(count: u16, length: i32) -> Vec<u8> {
    let value = [&length.to_be_bytes()[..], b"1234"].concat();
    let values = value.repeat(count.into());
    let bind = tagged_message(b'B', &[&b"\0s\0\0\0"[..], &count.to_be_bytes(), &values, &[0, 0]].concat());
    let placeholders: Vec<_> = (1..=count).map(|number| format!("${number}")).collect();
    let statement = prepare_message("s", &format!("select 1 in ({})", placeholders.join(",")), &[0, 0]);
    [statement, bind, tagged_message(b'E', b"\0\0\0\0\0"), tagged_message(b'S', b"")].concat()
}

fn parse_types(count: u16) -> Vec<u8> {
    let types = [&count.to_be_bytes()[..], &[0, 0, 0, 25].repeat(count.into())].concat();
    [prepare_message("", "select $1", &types), tagged_message(b'S', b"")].concat()
}

fn cursor_queries() -> Vec<u8> {
    let declare = |n| query_message(&format!("declare c{n} cursor for {ENDLESS}; fetch 100000 from c{n}"));
    [query_message("begin"), (0..100).flat_map(declare).collect()].concat()
}
