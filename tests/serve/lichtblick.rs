//! Lichtblick's session route, asked as Lichtblick asks it.

use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD as BASE64;
use serde_json::Value;

use super::http::{HttpRequest, HttpResponse};
use super::server::ServedLake;
use super::{get, json, lake, refused, served};

const VIEWER: &str = "http://localhost:8090";

fn ask(server: &ServedLake, id: &str) -> HttpResponse {
    let request =
        HttpRequest::get(&format!("/session/{id}?")).with("origin", VIEWER).with("sec-fetch-site", "same-site");
    request.with("content-type", "application/json").with("api-version", "1.0").send(server)
}

// The URLs of a session, as paths of this server.
fn paths(server: &ServedLake, answer: &Value) -> Vec<String> {
    let origin = format!("http://{}", server.http);
    let files = answer["data"]["mcaps"].as_array().unwrap_or_else(|| panic!("{answer}"));
    let url = |file: &Value| file["url"].as_str().expect("a URL").strip_prefix(&origin).expect("its origin").to_owned();
    files.iter().map(url).collect()
}

#[test]
fn a_session_lists_runs_and_slices() {
    let place = lake();
    let server = served(&place, &[]);
    let run = json(&get(&server, "/api/v1/runs"))["items"][0]["run_id"].as_str().expect("a run").to_owned();
    let answer = ask(&server, &run);
    assert_eq!(answer.header("access-control-allow-origin"), Some("*"));
    assert_eq!(paths(&server, &json(&answer)), [format!("/api/v1/runs/{run}/file.mcap")]);
    assert_eq!(json(&answer)["data"]["mcaps"][0]["metadata"]["surface_id"], "flat");
    let session = |query: &str| format!("q.{}", BASE64.encode(query));
    let slice = ask(&server, &session(&format!("run={run}&where=pair_id%20IN%20(0,1,77)&topics=/ir")));
    let slices = paths(&server, &json(&slice));
    assert!(slices.len() == 1 && !slices[0].contains(','), "a comma ends a URL there: {slices:?}");
    let cut = HttpRequest::get(&slices[0]).with("origin", VIEWER).send(&server);
    assert!(cut.status == 200 && cut.body.starts_with(b"\x89MCAP"), "{}", cut.status);
    // A program of this machine need not name runs; pages of elsewhere do.
    let of_all = session("where=pair_id%3C5");
    assert_eq!(paths(&server, &json(&get(&server, &format!("/session/{of_all}")))).len(), 1);
    refused(&ask(&server, &of_all), 403, "foreign_origin");
    refused(&ask(&server, "no-such-run"), 404, "not_found");
    refused(&ask(&server, "q.!"), 400, "request_invalid");
    let asks = "content-type,api-version";
    let preflight = HttpRequest::options(&format!("/session/{run}?"))
        .with("origin", VIEWER)
        .with("access-control-request-method", "GET")
        .with("access-control-request-headers", asks)
        .send(&server);
    let allowed = preflight.header("access-control-allow-headers").expect("allowed headers").to_owned();
    assert!(asks.split(',').all(|name| allowed.contains(name)), "{allowed}");
}
