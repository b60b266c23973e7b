//! `echolake serve` as its clients see it: answers, refusals, queries that end with their client, and its own end.

mod agents;
mod attacks;
pub(crate) mod catalogue;
mod contract;
mod contributions;
mod dialect;
mod differences;
mod drain;
mod encryption;
mod escapes;
pub(crate) mod http;
mod lichtblick;
mod log;
mod lost_tables;
pub(crate) mod postgres;
mod projects;
pub(crate) mod server;
mod slices;
#[allow(dead_code, reason = "campaigns want the rest")]
pub(crate) mod tunnel;
mod watched;
mod workers;

use std::io::{self, Read as _};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::{TestFolder, TestFolderTemplate};
use http::{HttpRequest, HttpResponse};
use server::ServedLake;

/// Runs for hours unless it is ended.
const ENDLESS: &str = "select count(*) from generate_series(1, 1000000) a cross join generate_series(1, 1000000) b \
                       where a.value + b.value = 7";
/// Time to wait for an action of the server; a busy machine may be slow.
const EVENT_LIMIT: Duration = Duration::from_secs(60);

/// One run without sweeps.
fn lake() -> TestFolder {
    static ONE_RUN: TestFolderTemplate = TestFolderTemplate::new();
    ONE_RUN.place(|place| {
        place.acquire("flat", &["--ir-only"]);
        place.ok(&["ingest"]);
    })
}

pub(crate) fn served(place: &TestFolder, more: &[&str]) -> ServedLake {
    ServedLake::start(Path::new(super::ECHOLAKE), &place.path(""), more)
}

fn sql(server: &ServedLake, query: &str) -> HttpResponse {
    HttpRequest::post("/api/v1/sql", query).with("content-type", "text/plain").send(server)
}

fn get(server: &ServedLake, path: &str) -> HttpResponse {
    HttpRequest::get(path).send(server)
}

fn json(answer: &HttpResponse) -> Value {
    serde_json::from_slice(&answer.body).unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&answer.body)))
}

fn refused(answer: &HttpResponse, status: u16, code: &str) {
    let problem = json(answer);
    assert_eq!(answer.header("content-type"), Some("application/problem+json"), "{problem}");
    assert_eq!((answer.status, problem["code"].as_str()), (status, Some(code)), "{problem}");
    assert_eq!(problem["status"], status);
}

fn running(server: &ServedLake) -> f64 {
    running_of(&get(server, "/metrics"))
}

fn running_of(metrics: &HttpResponse) -> f64 {
    let text = metrics.text();
    let line = text.lines().find_map(|l| l.strip_prefix("echolake_running_queries ")).expect("a figure");
    line.parse().expect("a number")
}

pub(crate) fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !done() {
        assert!(begun.elapsed() < EVENT_LIMIT, "{what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

// An engine may end with work that goes on after a query was cancelled: a client connects again.
fn begin_endless_query(server: &ServedLake) -> postgres::WireClient {
    for _ in 0..3 {
        let mut client = postgres::WireClient::connect(server, None);
        client.begin(ENDLESS);
        let begun = Instant::now();
        while begun.elapsed() < EVENT_LIMIT / 3 {
            if running(server) == 1.0 {
                return client;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    panic!("the query never runs");
}

#[test]
fn answers_in_every_format() {
    let place = lake();
    let server = served(&place, &[]);
    let query = "select pair_id, direct_mm from pairs order by pair_id limit 2";
    let answer = sql(&server, query);
    assert_eq!((answer.status, answer.header("content-type")), (200, Some("application/json")));
    assert_eq!(answer.text().trim(), r#"[{"pair_id":0,"direct_mm":120.0},{"pair_id":1,"direct_mm":240.0}]"#);
    assert_eq!(answer.header("x-content-type-options"), Some("nosniff"));
    let csv = HttpRequest::post("/api/v1/sql?format=csv", query).with("content-type", "application/sql").send(&server);
    assert_eq!(csv.text(), "pair_id,direct_mm\n0,120.0\n1,240.0\n");
    let body = serde_json::json!({ "query": query, "format": "csv" }).to_string();
    let wrapped = HttpRequest::post("/api/v1/sql", &body).with("content-type", "application/json").send(&server);
    assert_eq!(wrapped.text(), csv.text());
    let formulas = "select '=1+1' as a, -1.5 as b";
    let escaped = |path: &str| HttpRequest::post(path, formulas).with("content-type", "application/sql").send(&server);
    let plain = escaped("/api/v1/sql?format=csv&escape_formulas=false");
    assert_eq!((plain.header("content-type"), &*plain.text()), (Some("text/csv"), "a,b\n=1+1,-1.5\n"));
    let plain = escaped("/api/v1/sql?format=csv&escape_formulas=true");
    assert_eq!((plain.header("content-type"), &*plain.text()), (Some("text/csv"), "a,b\n'=1+1,-1.5\n"));
    refused(&escaped("/api/v1/sql?format=json&escape_formulas=true"), 400, "request_invalid");
    let body = serde_json::json!({ "query": formulas, "format": "csv", "escape_formulas": true }).to_string();
    let wrapped = HttpRequest::post("/api/v1/sql", &body).with("content-type", "application/json").send(&server);
    assert_eq!(wrapped.text(), "a,b\n'=1+1,-1.5\n");
    let arrow = HttpRequest::post("/api/v1/sql", query)
        .with("content-type", "text/plain")
        .with("accept", "application/vnd.apache.arrow.stream")
        .send(&server);
    assert_eq!(&arrow.body[..4], [0xff; 4], "a stream's first message");
    let parquet =
        HttpRequest::post("/api/v1/sql?format=parquet", query).with("content-type", "text/plain").send(&server);
    assert!(parquet.body.starts_with(b"PAR1") && parquet.body.ends_with(b"PAR1"));
    let tables = json(&get(&server, "/api/v1/tables"));
    let pairs = tables.as_array().expect("a list").iter().find(|t| t["name"] == "pairs").expect("pairs");
    let direct = pairs["columns"].as_array().expect("a list").iter().find(|c| c["name"] == "direct_mm");
    assert_eq!(direct.expect("a column")["unit"], "mm");
    for name in ["versions", "files", "ingests", "queries", "connections"] {
        let name = format!("system.{name}");
        let listed = tables.as_array().expect("a list").iter().find(|t| t["name"] == name).expect(&name);
        let columns = listed["columns"].as_array().expect("a list").iter().map(|c| c["name"].as_str().expect("a name"));
        let quoted: Vec<_> = columns.map(|column| format!("\"{column}\"")).collect();
        let all = sql(&server, &format!("select {} from {name}", quoted.join(", ")));
        assert_eq!(all.status, 200, "{name}: {}", all.text());
    }
    assert_eq!(get(&server, "/health").status, 200);
}

#[test]
fn what_is_wrong_has_a_code() {
    let place = lake();
    let server = served(&place, &[]);
    refused(&sql(&server, "select nonsense from runs"), 400, "query_invalid");
    refused(&sql(&server, "drop table runs"), 403, "read_only");
    refused(&sql(&server, "copy (select 1) to '/tmp/echolake-out.csv'"), 403, "read_only");
    refused(&sql(&server, "select 1/(value - 1) from generate_series(1, 2)"), 422, "query_failed");
    let long = "-".repeat(3 << 20);
    refused(&sql(&server, &long), 413, "request_too_large");
    let unknown_length = HttpRequest::post("/api/v1/sql", &long).with("content-type", "application/sql").chunked();
    refused(&unknown_length.send(&server), 413, "request_too_large");
    let post = |body: &str| HttpRequest::post("/api/v1/sql", body);
    refused(&post("select 1").send(&server), 400, "request_invalid");
    refused(
        &post("select 1").with("content-type", "text/plain").with("accept", "text/html").send(&server),
        400,
        "request_invalid",
    );
    refused(&post("{\"sql\": 1}").with("content-type", "application/json").send(&server), 400, "request_invalid");
    refused(
        &HttpRequest::post("/api/v1/sql?format=xlsx", "select 1").with("content-type", "text/plain").send(&server),
        400,
        "request_invalid",
    );
    refused(&get(&server, "/api/v1/sql"), 405, "method_not_allowed");
    refused(&get(&server, "/api/v1/nothing"), 404, "not_found");
    // A page of another origin, and a name that points here.
    for (name, value) in [("origin", "http://evil.example"), ("origin", "null"), ("sec-fetch-site", "cross-site")] {
        refused(
            &post("select 1").with("content-type", "text/plain").with(name, value).send(&server),
            403,
            "foreign_origin",
        );
    }
    refused(&HttpRequest::get("/api/v1/tables").host("evil.example").send(&server), 403, "foreign_origin");
    refused(&HttpRequest::get("/health").host("evil.example").send(&server), 403, "foreign_origin");
}

#[test]
fn a_short_answer_does_not_look_whole() {
    let place = lake();
    let server = served(&place, &[]);
    let query = "select 1/(900000 - value) as n from generate_series(1, 1000000)";
    let answer = sql(&server, query);
    assert_eq!(answer.status, 200);
    assert!(!answer.is_whole, "{} bytes", answer.body.len());
}

#[test]
fn postgres_answers_and_refuses() {
    let place = lake();
    let server = served(&place, &[]);
    let mut client = postgres::WireClient::connect(&server, None);
    let one = |text: &str| Ok(vec![vec![Some(text.to_owned())]]);
    assert_eq!(client.query("select count(*) from measurements"), one("45"));
    assert_eq!(client.query("select [1.5, 2.5]::float[]"), one("{1.5,2.5}"));
    assert_eq!(client.query("show server_version_num"), one("160006"));
    assert_eq!(client.query("select relname from pg_class where relname = 'pairs'"), one("pairs"));
    assert_eq!(client.query("select user"), one("postgres"));
    let pid = client.pid().to_string();
    assert_eq!(client.query("select pg_backend_pid()"), one(&pid));
    assert_eq!(client.query("select pid from pg_stat_activity"), one(&pid));
    assert_eq!(client.query("select name from pg_timezone_names"), one("UTC"));
    for (sql, state) in [
        ("drop table runs", "25006"),
        ("copy pairs to '/tmp/echolake-out'", "25006"),
        ("copy (select 1) to program 'sh'", "25006"),
        ("set datafusion.runtime.memory_limit = '900G'", "42704"),
        ("set default_transaction_read_only = off", "22023"),
        ("select * from nope", "42P01"),
        ("select nope from runs", "42703"),
        ("selec 1", "42601"),
        ("fetch 1 from nothing", "34000"),
    ] {
        assert_eq!(client.query(sql), Err(state.to_owned()), "{sql}");
    }
    assert_eq!(client.query("begin; declare c cursor for select pair_id from pairs order by 1; fetch 2 from c"), {
        Ok(vec![vec![Some("0".to_owned())], vec![Some("1".to_owned())]])
    });
    assert_eq!(client.query("select nope from runs"), Err("42703".to_owned()));
    assert_eq!(client.query("select 1"), Err("25P02".to_owned()), "the transaction failed");
    assert_eq!(client.query("rollback; select 3 as three"), one("3"));
    // What breaks the protocol breaks its own connection only.
    client.send_raw(b"Q\xff\xff\xff\xff");
    let mut other = postgres::WireClient::connect(&server, None);
    assert_eq!(other.query("select 4 as four"), one("4"));
}

// Drivers find out about tables in words of Postgres, and unnest keys.
#[test]
fn postgres_knows_keys_and_types_by_its_own_names() {
    let place = lake();
    let server = served(&place, &[]);
    let mut client = postgres::WireClient::connect(&server, None);
    let rows = |rows: &[&[&str]]| -> postgres::TextRows {
        Ok(rows.iter().map(|row| row.iter().map(|value| Some((*value).to_owned())).collect()).collect())
    };
    let keys = "select unnest(indkey) as number, generate_subscripts(indkey, 1) as place from pg_index";
    assert_eq!(client.query(&format!("{keys} where indrelid = 'pairs'::regclass")), rows(&[]));
    // An index of the catalogue's own, over two columns.
    assert_eq!(client.query(&format!("{keys} where indexrelid = 2837")), rows(&[&["1", "1"], &["2", "2"]]));
    let kinds = "select column_name, data_type from information_schema.columns where table_name = 'measurements' \
                 and column_name in ('ir', 'log_time', 'pair_id', 'snr_db', 'surface_id') order by 1";
    let expected: [&[&str]; 5] = [
        &["ir", "ARRAY"],
        &["log_time", "timestamp with time zone"],
        &["pair_id", "integer"],
        &["snr_db", "real"],
        &["surface_id", "text"],
    ];
    assert_eq!(client.query(kinds), rows(&expected));
    assert!(sql(&server, kinds).text().contains("Float32"), "Arrow's names over HTTP");
    assert!(client.query("show columns from pairs").is_ok_and(|columns| columns.len() > 1));
    assert!(client.query("select table_name from information_schema.tables").is_ok_and(|tables| tables.len() > 12));
}

#[test]
fn flight_sql_has_so_many_places() {
    let place = lake();
    let server = served(&place, &[]);
    let connect = || ServedLake::connect(&server.flight_sql);
    // A client that has a place is greeted at once, by the head of a frame of HTTP/2.
    let greeted = |stream: &mut TcpStream, patience: Duration| {
        stream.set_read_timeout(Some(patience)).expect("a limit of time");
        stream.read_exact(&mut [0; 9]).is_ok()
    };
    let mut open: Vec<_> = (0..128).map(|_| connect()).collect();
    assert!(open.iter_mut().all(|stream| greeted(stream, EVENT_LIMIT)));
    assert!(greeted(&mut connect(), EVENT_LIMIT), "one more has the place of the oldest, which asks for nothing");
    let oldest = open.first_mut().expect("the first");
    oldest.set_read_timeout(Some(EVENT_LIMIT)).expect("a limit of time");
    let closed = |read: io::Result<usize>| matches!(read, Ok(0) | Err(_));
    // Settings of HTTP/2 may be on their way.
    while !closed(oldest.read(&mut [0; 64])) {}
}

#[test]
fn it_stops_when_told() {
    let place = lake();
    let mut server = served(&place, &[]);
    let mut idle = postgres::WireClient::connect(&server, None);
    assert!(idle.query("select 1").is_ok());
    assert_eq!(server.terminate(), Some(0));
}

mod slow {
    use super::*;
    use std::path::Path;

    use crate::ECHOLAKE;
    use crate::fuzz::{FuzzCampaign, FuzzTarget};
    use crate::serve::server::ServedLake;

    // Long form: campaign `fuzz`.
    #[test]
    fn changed_input_harms_nothing() {
        for target in FuzzTarget::ALL {
            throw(target, ServedLake::start);
        }
    }

    #[test]
    fn changed_bytes_in_encrypted_connections_harm_nothing() {
        throw(FuzzTarget::Wire, ServedLake::start_encrypted);
    }

    fn throw(target: FuzzTarget, serve: fn(&Path, &Path, &[&str]) -> ServedLake) {
        let mut campaign = FuzzCampaign::new(Path::new(ECHOLAKE), 1, serve);
        // E6: damaged bodies are many, and cheap.
        let rounds = if target == FuzzTarget::Bodies { 500 } else { 100 };
        let outcome = campaign.throw(target, &mut |so_far| so_far.rounds < rounds);
        assert!(outcome.answered > 0, "{}: some are right all the same", target.name());
    }

    #[test]
    fn a_query_ends_with_its_client() {
        let place = lake();
        let server = served(&place, &[]);
        let asked = HttpRequest::post("/api/v1/sql", ENDLESS).with("content-type", "text/plain").begin(&server);
        wait_until("it runs", || running(&server) == 1.0);
        drop(asked);
        wait_until("it ends with its connection", || running(&server) == 0.0);
        drop(begin_endless_query(&server));
        wait_until("it ends with its connection", || running(&server) == 0.0);
        let mut client = begin_endless_query(&server);
        client.cancel(&server);
        assert_eq!(client.rows(), Err("57014".to_owned()));
        wait_until("it ends by a CancelRequest", || running(&server) == 0.0);
        assert_eq!(client.query("select 2 as two"), Ok(vec![vec![Some("2".to_owned())]]));
        // An engine may end with work that goes on after a query was cancelled: a client connects again.
        let ends = (0..3).filter_map(|_| {
            let mut client = postgres::WireClient::connect(&server, None);
            client.query("set statement_timeout = '200ms'").ok()?;
            client.query(ENDLESS).err().filter(|code| code != "58000")
        });
        assert_eq!({ ends }.next().as_deref(), Some("57014"));
    }

    #[test]
    fn tokens_let_in_and_are_needed_beyond_this_machine() {
        let place = lake();
        place.fails(1, &["serve", "--listen", "0.0.0.0:0"], "can be reached from other machines");
        place.fails(2, &["serve", "--listen", "somewhere"], "127.0.0.1:8080");
        place.fails(
            1,
            &["serve", "--listen", "off", "--flight-sql", "off", "--postgres", "off"],
            "nothing to listen on",
        );
        place.fails(1, &["serve", "--tokens", "none.toml"], "cannot read the tokens");
        let made = place.run(&["token", "analyst"]);
        let lines = String::from_utf8_lossy(&made.stdout).into_owned();
        assert!(lines.contains("\nscopes = [\"sql\", \"files\"]\n"), "{lines}");
        let watcher = place.run(&["token", "prometheus", "--scopes", "metrics"]);
        let watcher = String::from_utf8_lossy(&watcher.stdout).into_owned();
        assert!(watcher.contains("\nscopes = [\"metrics\"]\n"), "{watcher}");
        place.fails(
            2,
            &["token", "x", "--scopes", "sql,all"],
            "no scope `all`; hint: sql, files, metrics, annotate or annotate-references",
        );
        place.fails(1, &["token", "x", "--scopes", "metrics", "--project", "brick"], "of all projects");
        let token = super::super::stderr(&made).lines().next().expect("a token").to_owned();
        assert!(!lines.contains(&token), "only its hash is printed to be kept");
        std::fs::write(place.path("tokens.toml"), &lines).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml"]);
        let ask = |header: Option<String>| {
            let request = HttpRequest::post("/api/v1/sql", "select 1 as one").with("content-type", "text/plain");
            header.into_iter().fold(request, |request, value| request.with("authorization", &value)).send(&server)
        };
        assert_eq!(ask(Some(format!("Bearer {token}"))).text().trim(), r#"[{"one":1}]"#);
        for wrong in [None, Some("Bearer x".to_owned()), Some(format!("Bearer {}", &token[1..])), Some(token.clone())] {
            let answer = ask(wrong);
            assert_eq!((answer.status, answer.header("www-authenticate").is_some()), (401, true));
        }
        let metrics = HttpRequest::get("/metrics").with("authorization", &format!("Bearer {token}")).send(&server);
        assert_eq!(metrics.status, 403, "{}", metrics.text());
        let mut postgres = postgres::WireClient::connect(&server, None);
        assert_eq!(postgres.log_in("nonsense").as_deref(), Some("28P01"));
        let mut postgres = postgres::WireClient::connect(&server, None);
        assert_eq!(postgres.log_in(&token), None);
        assert_eq!(postgres.query("select 1 as one"), Ok(vec![vec![Some("1".to_owned())]]));
        // By its own name it is not sent: SCRAM, and a proof that is none.
        let (mut named, request) = postgres::WireClient::start(&server, "analyst", None);
        assert_eq!(request, b"\0\0\0\x0aSCRAM-SHA-256\0\0");
        assert_eq!(named.log_in(&token).as_deref(), Some("22023"));
        let (_, others) = postgres::WireClient::start(&server, "nobody", None);
        assert_eq!(others, request, "nobody learns which names there are");
        // Taken back, it ends what runs and what waits.
        let mut running = postgres::WireClient::connect(&server, None);
        assert_eq!(running.log_in(&token), None);
        running.begin(ENDLESS);
        let other = place.run(&["token", "other", "--days", "1"]);
        std::fs::write(place.path("tokens.toml"), &other.stdout).expect("written");
        wait_until("a new request is refused", || ask(Some(format!("Bearer {token}"))).status == 401);
        assert_eq!(running.end_state(), "28P01", "what runs is ended");
        let renewed = super::super::stderr(&other).lines().next().expect("a token").to_owned();
        assert_eq!(ask(Some(format!("Bearer {renewed}"))).status, 200);
    }
}
