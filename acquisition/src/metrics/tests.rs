//! The numbers follow the run, and arrive in the formats that stores read.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::Duration;

use echolake_schema::messages::{Measurement, Verdict};

use super::*;

/// Timeout of the other side; a busy machine needs some of it.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);

fn told() -> RunMetrics {
    let metrics = RunMetrics::new("0015_0", 2951, 100);
    let attempt = |verdict: Verdict, snr_db| Measurement { verdict: verdict.into(), snr_db, ..Measurement::default() };
    metrics.observe(&RunEvent::Attempt(&attempt(Verdict::Repeated, 12.0)));
    metrics.observe(&RunEvent::Attempt(&attempt(Verdict::Accepted, 61.5)));
    metrics
}

#[test]
fn a_pair_counts_when_it_is_safe() {
    let metrics = told();
    let value = |name: &str| {
        let line = format!("echolake_{name}{{surface=\"0015_0\"}} ");
        let text = metrics.prometheus();
        text.lines().find_map(|l| l.strip_prefix(&line)).map(|v| v.parse::<f64>().expect("a number"))
    };
    assert_eq!((value("attempts_total"), value("repeats_total")), (Some(2.0), Some(1.0)));
    assert_eq!((value("pairs_accepted"), value("snr_db")), (Some(100.0), Some(61.5)));
    metrics.observe(&RunEvent::Safe { verdicts: &[], accepted: 101, cost: Cost { checkpoints: 1, ..Cost::default() } });
    metrics.observe(&RunEvent::Paused);
    assert_eq!(
        (value("pairs_accepted"), value("checkpoints_total"), value("paused")),
        (Some(101.0), Some(1.0), Some(1.0))
    );
    assert_eq!(value("disk_free_bytes"), None);
    metrics.disk_free(5);
    metrics.broke_off();
    assert_eq!((value("disk_free_bytes"), value("broken_off")), (Some(5.0), Some(1.0)));
}

#[test]
fn prometheus_asks_and_gets_an_answer() {
    let server = MetricsServer::start(([127, 0, 0, 1], 0).into(), told()).expect("a server");
    let ask = |request: &str| {
        let mut stream = TcpStream::connect(server.address()).expect("connected");
        stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
        stream.write_all(format!("{request}\r\nHost: a\r\n\r\n").as_bytes()).expect("sent");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        answer
    };
    let answer = ask("GET /metrics HTTP/1.1");
    let (head, body) = answer.split_once("\r\n\r\n").expect("a head");
    assert!(head.starts_with("HTTP/1.1 200") && head.contains(&format!("Content-Length: {}", body.len())), "{head}");
    assert!(body.contains("# TYPE echolake_snr_db gauge\necholake_snr_db{surface=\"0015_0\"} 61.5\n"), "{body}");
    assert!(ask("GET / HTTP/1.1").starts_with("HTTP/1.1 404"));
    assert!(ask("POST /metrics HTTP/1.1").starts_with("HTTP/1.1 405"));
    assert!(ask("nonsense").starts_with("HTTP/1.1 405"));
}

#[test]
fn lines_have_no_unknown_numbers() {
    let metrics = told();
    let unknown = Measurement { snr_db: f64::NAN, temperature_c: 21.5, ..Measurement::default() };
    metrics.observe(&RunEvent::Attempt(&unknown));
    let line = metrics.influx(1_767_600_000_123_456_789);
    assert!(line.starts_with("echolake_run,surface=0015_0 pairs_planned=2951,pairs_accepted=100,"), "{line}");
    assert!(line.ends_with(" 1767600000123456789\n") && line.contains(",temperature_c=21.5,"), "{line}");
    assert!(!line.contains("NaN") && !line.contains("snr_db"), "{line}");
}

#[test]
fn targets_are_read_or_named() {
    let udp = PushTarget::Udp { host: "lab:8089".into() };
    assert_eq!("udp://lab:8089".parse(), Ok(udp));
    let http = PushTarget::Http { host: "lab:8428".into(), path: "/write?db=lab".into() };
    assert_eq!("http://lab:8428/write?db=lab".parse(), Ok(http));
    for wrong in ["lab:8089", "udp://lab", "http://lab:8428", "https://lab:1/write", "http://lab:1/a b", "http://:1/a"]
    {
        let error = wrong.parse::<PushTarget>().expect_err(wrong).to_string();
        assert!(error.contains(wrong) && error.contains("hint"), "{error}");
    }
}

#[test]
fn a_store_is_told_a_last_time_at_the_end() {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    socket.set_read_timeout(Some(ANSWER_LIMIT)).expect("set");
    let host = socket.local_addr().expect("an address").to_string();
    let (metrics, hour) = (told(), Duration::from_secs(3_600));
    drop(InfluxPush::start(PushTarget::Udp { host }, metrics, hour, |e| panic!("{e}")));
    let mut buffer = [0; 4096];
    let length = socket.recv(&mut buffer).expect("a datagram");
    assert!(String::from_utf8_lossy(&buffer[..length]).starts_with("echolake_run,surface=0015_0 "));
}

#[test]
fn a_store_that_refuses_is_told_of() {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a listener");
    let host = listener.local_addr().expect("an address").to_string();
    let answers = std::thread::spawn(move || {
        ["204 No Content", "400 Bad Request"].map(|status| {
            let (mut stream, _) = listener.accept().expect("a client");
            stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
            let mut request = Vec::new();
            let mut part = [0; 4096];
            while !request.ends_with(b"\n") || request.ends_with(b"\r\n\r\n") {
                let read = stream.read(&mut part).expect("a request");
                assert_ne!(read, 0, "it ends early: {}", String::from_utf8_lossy(&request));
                request.extend(&part[..read]);
            }
            write!(stream, "HTTP/1.1 {status}\r\nContent-Length: 0\r\n\r\n").expect("answered");
            String::from_utf8(request).expect("text")
        })
    });
    let target: PushTarget = format!("http://{host}/write?db=lab").parse().expect("a target");
    target.send("a b=1 2\n").expect("taken");
    let refused = target.send("a b=1 2\n").expect_err("refused").to_string();
    assert!(refused.contains("400 Bad Request"), "{refused}");
    let requests = answers.join().expect("an end");
    assert!(requests[0].starts_with("POST /write?db=lab HTTP/1.1\r\n") && requests[0].ends_with("\r\n\r\na b=1 2\n"));
}
