//! The end of a server: what runs goes on, nothing new is taken, and balancers hear of it.

use std::io::Read as _;

use arrow_flight::error::FlightError;
use arrow_flight::sql::client::FlightSqlServiceClient;
use tonic::transport::Endpoint;

use super::http::{HttpRequest, HttpResponse};
use super::server::ServedLake;
use super::{ENDLESS, EVENT_LIMIT, get, json, lake, postgres, refused, running, served, sql, wait_until};

/// An answer that fills all buffers on its way, so that it runs until it is read.
const LONG: &str = "select value, repeat('x', 100) as text from generate_series(1, 300000)";

#[tokio::main(flavor = "current_thread")]
async fn ask_flight_sql(server: &ServedLake) -> Option<tonic::Code> {
    let endpoint = Endpoint::from_shared(format!("http://{}", server.flight_sql)).expect("a URL");
    let channel = endpoint.timeout(EVENT_LIMIT).connect().await.expect("connected");
    match FlightSqlServiceClient::new(channel).execute("select 1".to_owned(), None).await {
        Err(FlightError::Tonic(status)) => Some(status.code()),
        _ => None,
    }
}

#[test]
fn what_takes_too_long_is_broken_off() {
    let place = lake();
    let mut server = served(&place, &["--drain", "500ms"]);
    let _running = HttpRequest::post("/api/v1/sql", ENDLESS).with("content-type", "text/plain").begin(&server);
    wait_until("it runs", || running(&server) == 1.0);
    server.signal("TERM");
    server.wait_for_line("are broken off");
    assert_eq!(server.wait(), Some(0));
}

#[test]
fn a_second_signal_ends_at_once() {
    let place = lake();
    let mut server = served(&place, &[]);
    let _running = HttpRequest::post("/api/v1/sql", ENDLESS).with("content-type", "text/plain").begin(&server);
    wait_until("it runs", || running(&server) == 1.0);
    server.signal("INT");
    wait_until("it drains", || get(&server, "/ready").status == 503);
    server.signal("INT");
    assert_eq!(server.wait(), Some(130));
}

mod slow {
    use super::*;

    #[test]
    fn it_is_not_ready_without_its_lake() {
        let place = lake();
        let server = served(&place, &[]);
        wait_until("it is ready", || get(&server, "/ready").status == 200);
        std::fs::rename(place.path("lake"), place.path("elsewhere")).expect("moved");
        wait_until("it is not ready", || get(&server, "/ready").status == 503);
        let answer = get(&server, "/ready");
        refused(&answer, 503, "not_ready");
        assert!(answer.text().contains("the lake cannot be read"), "{}", answer.text());
        assert_eq!(get(&server, "/health").status, 200, "it lives");
        std::fs::rename(place.path("elsewhere"), place.path("lake")).expect("moved");
        wait_until("it is ready again", || get(&server, "/ready").status == 200);
    }

    #[test]
    fn nothing_new_is_taken_and_what_runs_goes_on() {
        let place = lake();
        // The default of 30 s can be over, on a busy machine, before both answers are read.
        let mut server = served(&place, &["--drain", "10m"]);
        wait_until("it is ready", || get(&server, "/ready").status == 200);
        assert_eq!(json(&get(&server, "/ready"))["status"], "ready");
        let mut idle = postgres::WireClient::connect(&server, None);
        assert!(idle.query("select 1").is_ok());
        let mut busy = postgres::WireClient::connect(&server, None);
        busy.begin(LONG);
        let mut stream =
            HttpRequest::post("/api/v1/sql?format=csv", LONG).with("content-type", "text/plain").begin(&server);
        wait_until("both run", || running(&server) == 2.0);
        server.signal("TERM");
        wait_until("balancers hear of it", || get(&server, "/ready").status == 503);
        let ready = get(&server, "/ready");
        refused(&ready, 503, "server_stopping");
        assert!(ready.header("retry-after").is_some_and(|seconds| seconds.parse::<u32>().is_ok()), "{ready:?}");
        assert_eq!(get(&server, "/health").status, 200, "it lives");
        let answer = sql(&server, "select 1");
        refused(&answer, 503, "server_stopping");
        assert!(answer.header("retry-after").is_some());
        assert_eq!(postgres::WireClient::attempt(&server, None).err().as_deref(), Some("57P03"));
        assert_eq!(ask_flight_sql(&server), Some(tonic::Code::Unavailable));
        assert_eq!(idle.farewell(), "57P01");
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).expect("the rest");
        let whole = HttpResponse::read(&bytes).expect("an answer");
        assert!(whole.is_whole && whole.text().lines().count() == 300_001);
        assert_eq!(busy.rows().map(|rows| rows.len()), Ok(300_000));
        assert_eq!(busy.farewell(), "57P01");
        assert_eq!(server.wait(), Some(0));
    }

    #[test]
    fn it_is_not_ready_without_engines() {
        let place = lake();
        let program = place.path("program");
        std::fs::hard_link(crate::ECHOLAKE, &program)
            .or_else(|_| std::fs::copy(crate::ECHOLAKE, &program).map(drop))
            .expect("a copy");
        let server = ServedLake::start(&program, &place.path(""), &[]);
        wait_until("it is ready", || get(&server, "/ready").status == 200);
        std::fs::rename(&program, place.path("renamed")).expect("moved");
        // The spare, or the engine whose place it takes: the next one cannot be started.
        server.kill_statement_engine();
        wait_until("it is not ready", || get(&server, "/ready").status == 503);
        let answer = get(&server, "/ready");
        assert!(answer.text().contains("no engine can be started"), "{}", answer.text());
        assert_eq!(sql(&server, "select 1").status, 200, "there is an engine left");
        std::fs::rename(place.path("renamed"), &program).expect("moved");
        wait_until("it is ready again", || get(&server, "/ready").status == 200);
    }
}
