//! The log of a server and its engines.

use std::io::{Read as _, Write as _};

use echolake_testing::ChildProcess;
use serde_json::Value;

use super::http::HttpRequest;
use super::lake;
use super::server::ServedLake;

/// A text that is in no other line.
const STATEMENT: &str = "select unheard_of from runs";

#[test]
fn a_failed_request_is_found_by_its_number() {
    let place = lake();
    let serve =
        ["--log-format", "json", "serve", "--listen", "127.0.0.1:0", "--flight-sql", "off", "--postgres", "off"];
    let mut command = place.command(&serve);
    let mut server = ChildProcess::start(command.env("RUST_LOG", "echolake=debug")).expect("the command starts");
    let told = server.wait_for_line("http://");
    let address = told.trim().trim_start_matches("http://");
    let request = HttpRequest::post("/api/v1/sql", STATEMENT).with("content-type", "text/plain");
    let mut stream = ServedLake::connect(address);
    stream.write_all(&request.bytes(address)).expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("answered");
    assert!(answer.contains("query_invalid"), "{answer}");
    let line = server.wait_for_line("unheard_of");
    let line: Value = serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line}"));
    assert_eq!(line["level"], "DEBUG");
    assert_eq!(line["fields"]["message"], "a request failed");
    assert_eq!(line["fields"]["code"], "query_invalid");
    let spans = line["spans"].as_array().expect("spans");
    assert_eq!(spans[0]["name"], "request");
    assert!(spans[0]["number"].as_u64().is_some_and(|number| number > 0), "{spans:?}");
    assert!(spans.iter().any(|span| span["protocol"] == "http" && span["client"].is_string()), "{spans:?}");
}

#[test]
fn statements_are_in_no_line_by_default() {
    let place = lake();
    let server = super::served(&place, &[]);
    super::refused(&super::sql(&server, STATEMENT), 400, "query_invalid");
    let said = server.said();
    assert!(!said.iter().any(|line| line.contains("unheard_of")), "{said:?}");
}
