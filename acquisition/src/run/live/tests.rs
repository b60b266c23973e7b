//! A client of another make than the server looks on while a simulated run goes on.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use tungstenite::Message;
use tungstenite::client::IntoClientRequest as _;

use super::*;

/// Bytes that wait for one client at most.
const WAITING_BYTES: usize = 16 << 20;
/// Messages of a megabyte that are not read: more than a client's queue and two sockets hold.
const UNREAD: u64 = 60;
/// Timeout of the other side; a busy machine needs some of it.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);

fn topic(channel: u16, name: &str) -> Topic {
    Topic {
        channel,
        topic: name.into(),
        encoding: "protobuf".into(),
        schema: "a.B".into(),
        schema_encoding: "protobuf".into(),
        schema_data: vec![1, 2, 3],
    }
}

type ViewerSocket = tungstenite::WebSocket<tungstenite::stream::MaybeTlsStream<TcpStream>>;

fn connect(server: &LiveServer) -> ViewerSocket {
    let mut request = format!("ws://{}", server.address()).into_client_request().expect("a request");
    let offered = "foxglove.sdk.v1".parse().expect("a header");
    request.headers_mut().insert("Sec-WebSocket-Protocol", offered);
    let stream = TcpStream::connect(server.address()).expect("connected");
    stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
    let stream = tungstenite::stream::MaybeTlsStream::Plain(stream);
    let (socket, response) = tungstenite::client(request, stream).expect("a handshake");
    assert_eq!(response.headers()["Sec-WebSocket-Protocol"], "foxglove.sdk.v1");
    socket
}

fn json(socket: &mut ViewerSocket) -> serde_json::Value {
    match socket.read().expect("a message") {
        Message::Text(text) => serde_json::from_str(&text).expect("JSON"),
        other => panic!("{other:?}"),
    }
}

fn data(socket: &mut ViewerSocket) -> (u32, u64, Vec<u8>) {
    match socket.read().expect("a message") {
        Message::Binary(bytes) => {
            assert_eq!(bytes[0], 1);
            let subscription = u32::from_le_bytes(bytes[1..5].try_into().expect("four"));
            (subscription, u64::from_le_bytes(bytes[5..13].try_into().expect("eight")), bytes[13..].to_vec())
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_client_sees_what_it_subscribes_to_and_what_it_came_too_late_for() {
    let server =
        LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let mut tap = server.tap();
    tap.topics(vec![topic(1, "/panel/scene"), topic(2, "/sweep"), topic(3, "/log")]);
    tap.message(1, 10, b"the panel");
    tap.message(2, 11, b"a sweep that nobody waited for");
    let mut socket = connect(&server);
    assert_eq!(json(&mut socket)["op"], "serverInfo");
    let advertised = json(&mut socket);
    let channels = advertised["channels"].as_array().expect("channels");
    assert_eq!(channels.len(), 3);
    assert_eq!(
        channels[1],
        serde_json::json!({"id": 2, "topic": "/sweep", "encoding": "protobuf", "schemaName": "a.B",
            "schemaEncoding": "protobuf", "schema": "AQID"})
    );
    let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":70,"channelId":1},{"id":71,"channelId":2}]}"#;
    socket.send(Message::text(subscribe)).expect("sent");
    assert_eq!(data(&mut socket), (70, 10, b"the panel".to_vec()));
    tap.message(3, 12, b"a line that was not asked for");
    tap.message(2, 13, b"a sweep");
    assert_eq!(data(&mut socket), (71, 13, b"a sweep".to_vec()));
    drop(server);
    assert!(matches!(socket.read(), Ok(Message::Close(_)) | Err(_)), "it is let go");
}

fn time(socket: &mut ViewerSocket) -> u64 {
    match socket.read().expect("a message") {
        Message::Binary(bytes) => {
            assert_eq!(bytes[0], 2);
            u64::from_le_bytes(bytes[1..].try_into().expect("eight"))
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn viewers_are_told_the_time_of_a_simulated_run_alone() {
    let start = |clock| LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), clock);
    let wall = start(LiveClock::Wall).expect("a server");
    assert_eq!(json(&mut connect(&wall))["capabilities"], serde_json::json!([]));
    let simulated = start(LiveClock::Simulated).expect("a server");
    let mut tap = simulated.tap();
    tap.topics(vec![topic(1, "/tf")]);
    tap.message(1, 10, b"first");
    let mut socket = connect(&simulated);
    assert_eq!(json(&mut socket)["capabilities"], serde_json::json!(["time"]));
    json(&mut socket);
    assert_eq!(time(&mut socket), 10, "before anything is shown");
    socket.send(Message::text(r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":1}]}"#)).expect("sent");
    assert_eq!(data(&mut socket), (7, 10, b"first".to_vec()));
    for at in [22, 20] {
        tap.message(1, at, b"next");
    }
    assert_eq!(time(&mut socket), 22);
    assert_eq!(data(&mut socket).1, 22);
    assert_eq!(data(&mut socket).1, 20, "time does not go back");
}

#[test]
fn a_client_that_sleeps_loses_the_oldest_and_stops_nobody() {
    let server =
        LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let mut tap = server.tap();
    tap.topics(vec![topic(2, "/sweep")]);
    let mut socket = connect(&server);
    json(&mut socket);
    json(&mut socket);
    socket.send(Message::text(r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":2}]}"#)).expect("sent");
    let begun = Instant::now();
    while !server.0.shared_state().clients().iter().any(|c| c.receives_channel(2)) {
        assert!(begun.elapsed() < ANSWER_LIMIT, "the subscription arrives");
        std::thread::sleep(Duration::from_millis(5));
    }
    for time in 0..UNREAD {
        tap.message(2, time, &vec![0; 1 << 20]);
    }
    let waiting = server.0.shared_state().clients()[0].pending_bytes();
    assert!(waiting <= WAITING_BYTES, "{waiting}");
    let mut last = 0;
    while last != UNREAD - 1 {
        let (_, time, _) = data(&mut socket);
        assert!(time >= last);
        last = time;
    }
}

#[test]
fn browsers_that_are_no_viewers_are_told() {
    let server =
        LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let mut stream = TcpStream::connect(server.address()).expect("connected");
    stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
    let request = "GET / HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
        Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
    stream.write_all(request.as_bytes()).expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    assert!(answer.starts_with("HTTP/1.1 400") && answer.contains("Foxglove"), "{answer}");
}

#[test]
fn an_address_that_is_taken_is_named() {
    let server =
        LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let error = LiveServer::start(server.address(), ViewerAccess::default(), LiveClock::Wall)
        .map(drop)
        .expect_err("taken")
        .to_string();
    assert!(error.contains(&server.address().to_string()) && error.contains("taken?"), "{error}");
}

/// The bytes of a handshake, without its end.
fn handshake_start(path: &str, more: &str) -> String {
    format!(
        "GET {path} HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
         Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n{more}"
    )
}

fn answer(server: &LiveServer, path: &str, more: &str) -> String {
    let mut stream = TcpStream::connect(("127.0.0.1", server.address().port())).expect("connected");
    stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
    stream.write_all(format!("{}\r\n", handshake_start(path, more)).as_bytes()).expect("sent");
    let mut answer = vec![0; 1 << 10];
    let length = stream.read(&mut answer).expect("an answer");
    String::from_utf8_lossy(&answer[..length]).into_owned()
}

#[test]
fn pages_of_elsewhere_are_refused() {
    let server =
        LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let refused = answer(&server, "/", "Origin: https://evil.example\r\n");
    assert!(refused.starts_with("HTTP/1.1 403") && refused.contains("--allow-origin"), "{refused}");
    assert!(answer(&server, "/", "Origin: http://localhost:8090\r\n").starts_with("HTTP/1.1 101"));
}

#[test]
fn other_machines_need_the_token_of_the_address() {
    let server =
        LiveServer::start(([0, 0, 0, 0], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let refused = answer(&server, "/", "");
    assert!(refused.starts_with("HTTP/1.1 403") && refused.contains("token"), "{refused}");
    let url = server.url();
    let (_, path) = url.split_at(format!("ws://{}", server.address()).len());
    assert!(answer(&server, path, "").starts_with("HTTP/1.1 101"), "{url}");
}

#[test]
fn handshakes_that_drip_lock_nobody_out() {
    let server =
        LiveServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), LiveClock::Wall).expect("a server");
    let drip = |_| {
        let mut stream = TcpStream::connect(server.address()).expect("connected");
        stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
        stream.write_all(handshake_start("/", "").as_bytes()).expect("sent");
        stream
    };
    let mut dripping: Vec<_> = (0..40).map(drip).collect();
    assert_eq!(json(&mut connect(&server))["op"], "serverInfo");
    let ended = dripping[0].read(&mut [0]);
    assert!(matches!(ended, Ok(0) | Err(_)), "the oldest goes for a new one: {ended:?}");
}
