//! The numbers follow the run, and arrive in Prometheus' format.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
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
