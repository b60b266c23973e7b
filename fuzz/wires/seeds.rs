//! The inputs that fuzzing begins with: requests as clients write them, and a message in each encoding.

use std::path::PathBuf;

use echolake_schema::messages::FILE_DESCRIPTOR_SET;

use crate::MessageInput;

const QUERY: &str = "select pair_id, direct_mm from pairs where pair_id < 2";
const JSON_SCHEMA: &str = r#"{"type":"object","properties":{"a":{"type":"integer"},"b":{"type":"array","items":{"type":
    "number"}},"c":{"type":"object","properties":{"d":{"type":"string","contentEncoding":"base64"}}}}}"#;
const ROS_DEFINITION: &str = "# a reading\nstd_msgs/Header header\nuint8 FAST=2\nfloat32 speed 1.5\nPoint[] points\n\
                              string name\nuint8[] data\nfloat64[3] low\nbuiltin_interfaces/Duration took\n\
                              ===\nMSG: a/Point\nfloat64 x\n\
                              ===\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n";

/// Fills the folder that `ECHOLAKE_SEEDS` names with a folder of files per target, and ends the process; without that
/// variable it does nothing.
///
/// # Panics
/// A file cannot be written, or a message is refused.
pub fn write_seeds_on_request() {
    if let Some(folder) = std::env::var_os("ECHOLAKE_SEEDS") {
        let folder = PathBuf::from(folder);
        for (target, name, bytes) in seeds() {
            let folder = folder.join(target);
            std::fs::create_dir_all(&folder).expect("a folder");
            std::fs::write(folder.join(name), bytes).expect("written");
        }
        std::process::exit(0);
    }
}

type Seed = (&'static str, String, Vec<u8>);

fn seeds() -> Vec<Seed> {
    let named = |target, seeds: Vec<Vec<u8>>| {
        seeds.into_iter().enumerate().map(move |(number, bytes)| (target, number.to_string(), bytes))
    };
    message_seeds()
        .chain(named("mcap_sql", vec![echolake_fuzz::run_of_wav()]))
        .chain(named("postgres", postgres_seeds()))
        .chain(named("http", http_seeds()))
        .chain(named("flight", flight_seeds()))
        .collect()
}

fn message_seeds() -> impl Iterator<Item = Seed> {
    // Each first member is a number or an empty list, and zeros are good values of all the others.
    let cdr = [&[0, 1, 0, 0][..], &[0; 96]].concat();
    let measurement = [&[0x08, 7, 0x10, 1, 0x31][..], &12.5f64.to_le_bytes(), &[0x72, 1, b'a', 0x72, 0]].concat();
    let json = br#"{"a": 1e3, "b": [0.5, null, -1], "c": {"d": "AAEC"}, "e": "a"}"#.to_vec();
    let inputs: [(&str, [&str; 2], &str, &[u8], Vec<u8>); 4] = [
        ("protobuf", ["protobuf"; 2], "echolake.v1.Measurement", FILE_DESCRIPTOR_SET, measurement),
        ("json", ["json", "jsonschema"], "a", JSON_SCHEMA.as_bytes(), json.clone()),
        ("json", ["json", "jsonschema"], "", b"", json),
        ("ros2", ["cdr", "ros2msg"], "a/msg/B", ROS_DEFINITION.as_bytes(), cdr),
    ];
    inputs.into_iter().map(|(target, [message_encoding, schema_encoding], type_name, schema, data)| {
        let input = MessageInput { type_name, schema, data: &data };
        let decoded = input.with_encodings(message_encoding, schema_encoding).decode();
        assert!(decoded.is_some(), "{input:?} is refused");
        (target, format!("{type_name}_").replace('/', "_"), input.to_bytes())
    })
}

fn http_seeds() -> Vec<Vec<u8>> {
    let first = "host: localhost\r\naccept: */*\r\n";
    let head = &format!("{first}connection: close\r\n");
    let post = |path: &str, kind: &str, body: &str| {
        let bytes = body.len();
        format!("POST {path} HTTP/1.1\r\n{head}content-type: {kind}\r\ncontent-length: {bytes}\r\n\r\n{body}")
    };
    let chunked = format!("{:x}\r\n{QUERY}\r\n0\r\n\r\n", QUERY.len());
    let json = "application/json";
    let call =
        r#"{"jsonrpc":"2.0","id":1,"method":"tools/call","params":{"name":"query","arguments":{"sql":"select 1"}}}"#;
    [
        post("/api/v1/sql", json, &format!(r#"{{"query": "{QUERY}", "format": "arrow"}}"#)),
        post("/api/v1/annotations", json, r#"{"annotations": [{"run_id": "a", "pair_ids": [1], "kind": "note"}]}"#),
        post("/api/v1/sql?format=parquet", "application/sql", QUERY),
        format!(
            "POST /api/v1/sql HTTP/1.1\r\n{head}content-type: text/plain\r\ntransfer-encoding: chunked\r\n\r\n{chunked}"
        ),
        format!(
            "GET /api/v1/tables HTTP/1.1\r\n{first}if-none-match: \"a\"\r\n\r\nGET /metrics HTTP/1.1\r\n{head}\r\n"
        ),
        format!("GET /api/v1/files HTTP/1.1\r\n{head}range: bytes=0-10,20-\r\norigin: http://a\r\n\r\n"),
        format!("HEAD /api/v1/slices.mcap?where=pair_id%3C2&topics=/ir&layout=by-topic HTTP/1.1\r\n{head}\r\n"),
        post("/mcp", json, call),
        post("/api/v1/session", json, r#"{"token": "a"}"#),
    ]
    .map(String::into_bytes)
    .into()
}

fn postgres_seeds() -> Vec<Vec<u8>> {
    let message = |kind: u8, body: &[u8]| [&[kind][..], &((body.len() + 4) as i32).to_be_bytes(), body].concat();
    let packet = |body: &[u8]| [&((body.len() + 4) as i32).to_be_bytes(), body].concat();
    let start = packet(b"\0\x03\0\0user\0me\0database\0datafusion\0client_encoding\0UTF8\0\0");
    let query = |sql: &str| message(b'Q', &[sql.as_bytes(), b"\0"].concat());
    let parse = message(b'P', b"s\0select pair_id from pairs where pair_id = $1\0\0\x01\0\0\0\x17");
    let bind = message(b'B', b"c\0s\0\0\x01\0\0\0\x01\0\0\0\x017\0\x01\0\x01");
    let describe = message(b'D', b"Pc\0");
    let execute = message(b'E', b"c\0\0\0\0\x02");
    let (close, sync, flush, end) =
        (message(b'C', b"Ss\0"), message(b'S', b""), message(b'H', b""), message(b'X', b""));
    let cursor = "begin; declare c cursor for select * from points; fetch 2 from c; close c; commit";
    let kinds =
        "select 1::int2, 0.5::real, 1.5::numeric(8,2), array[1.5], 'a'::text, now(), null, interval '1 day', true";
    [
        vec![query(QUERY), query("show server_version; set statement_timeout = '1s'"), end.clone()],
        vec![parse, message(b'D', b"Ss\0"), bind, describe, flush, execute, close, sync, end.clone()],
        vec![query(cursor), end.clone()],
        vec![query(kinds), query("copy pairs to stdout with (format csv, header)"), end.clone()],
        vec![
            query("select oid, relname from pg_class where relkind = 'r'"),
            message(b'd', b"1\n"),
            message(b'c', b""),
            end,
        ],
    ]
    .map(|messages| [start.clone(), messages.concat()].concat())
    .into_iter()
    .chain([packet(b"\x04\xd2\x16\x2f"), packet(b"\x04\xd2\x16\x2e\0\0\0\x01\0\0\0\x02")])
    .collect()
}

const STATEMENT_QUERY: &str = "type.googleapis.com/arrow.flight.protocol.sql.CommandStatementQuery";
const GET_TABLES: &str = "type.googleapis.com/arrow.flight.protocol.sql.CommandGetTables";
const PREPARE: &str = "type.googleapis.com/arrow.flight.protocol.sql.ActionCreatePreparedStatementRequest";

fn flight_seeds() -> Vec<Vec<u8>> {
    let any = |kind: &str, body: &[u8]| [field(1, kind.as_bytes()), field(2, body)].concat();
    let command = |bytes: &[u8]| [&[0x08, 2][..], &field(2, bytes)].concat();
    let query = command(&any(STATEMENT_QUERY, &field(1, QUERY.as_bytes())));
    let tables = command(&any(GET_TABLES, &[&field(3, b"%pairs%")[..], &[0x28, 1]].concat()));
    let prepare = any(PREPARE, &field(1, b"select pair_id from pairs where pair_id = $1"));
    let action = [field(1, b"CreatePreparedStatement"), field(2, &prepare)].concat();
    [
        flight_call("GetFlightInfo", &query),
        flight_call("GetFlightInfo", &tables),
        flight_call("GetSchema", &query),
        flight_call("DoGet", &field(1, &any(GET_TABLES, &[0x28, 1]))),
        flight_call("DoAction", &action),
        flight_call("DoPut", &[field(1, &query), field(2, b"")].concat()),
        flight_call("Handshake", &field(2, b"")),
        flight_call("ListActions", b""),
    ]
    .into()
}

// A field of protobuf that has a length.
fn field(number: u8, bytes: &[u8]) -> Vec<u8> {
    let length = bytes.len();
    let length = if length < 128 { vec![length as u8] } else { vec![length as u8 | 0x80, (length >> 7) as u8] };
    [&[number << 3 | 2][..], &length, bytes].concat()
}

// A connection with one call.
fn flight_call(method: &str, message: &[u8]) -> Vec<u8> {
    let path = format!("/arrow.flight.protocol.FlightService/{method}");
    let mut headers = vec![0x83, 0x86];
    // Names that HTTP/2 has numbers for: path, authority, content-type.
    for (start, value) in [(&[0x04][..], path.as_str()), (&[0x01], "localhost"), (&[0x0f, 0x10], "application/grpc")] {
        headers.extend(start);
        headers.push(value.len() as u8);
        headers.extend(value.bytes());
    }
    headers.extend(b"\0\x02te\x08trailers");
    let body = [&[0][..], &(message.len() as u32).to_be_bytes(), message].concat();
    let frame = |kind: u8, flags: u8, stream: u32, payload: &[u8]| {
        let length = (payload.len() as u32).to_be_bytes();
        [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
    };
    // Settings, headers, data, and that no more calls come.
    let frames = [frame(4, 0, 0, b""), frame(1, 4, 1, &headers), frame(0, 1, 1, &body), frame(7, 0, 0, &[0; 8])];
    [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(), frames.concat()].concat()
}
