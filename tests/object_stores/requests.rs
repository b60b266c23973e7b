//! Requests that a server sends to an object store: what a page costs, and what the cache spares.

use serde_json::Value;

use super::s3_double::{S3Double, StoreBehaviour};
use super::{TestFolder, command, ok, recordings, run};
use crate::serve::http::HttpRequest;
use crate::serve::server::ServedLake;
use crate::stderr;

/// Surfaces of the lake under test.
const SURFACES: [&str; 4] = ["flat", "foam", "wood", "prd"];

fn lake() -> (TestFolder, S3Double) {
    let place = TestFolder::new();
    let runs = recordings(&place, &SURFACES);
    let store = S3Double::start(StoreBehaviour::Faultless);
    let mut args = vec!["ingest"];
    args.extend(runs.iter().map(String::as_str));
    ok(&place, &store, &args);
    (place, store)
}

fn serve(place: &TestFolder, store: &S3Double, more: &[&str]) -> ServedLake {
    ServedLake::start_command(&mut command(place, store, &[]), more)
}

fn get(server: &ServedLake, path: &str) -> Vec<u8> {
    let answer = HttpRequest::get(path).send(server);
    assert_eq!(answer.status, 200, "{path}: {}", answer.text());
    answer.body
}

fn sql(server: &ServedLake, query: &str) -> Value {
    let answer = HttpRequest::post("/api/v1/sql", query).with("content-type", "text/plain").send(server);
    assert_eq!(answer.status, 200, "{query}: {}", answer.text());
    serde_json::from_slice(&answer.body).expect("JSON")
}

/// Asks for what the surface's page asks for.
fn open_surface_page(server: &ServedLake, surface: &str) {
    for path in ["", "/curves?points=192", "/grid?microphone=0", "/grid.svg?microphone=0&frame=bare"] {
        get(server, &format!("/api/v1/surfaces/{surface}{path}"));
    }
}

/// The requests since the last call, but for looks at what is new: one a second, whatever is asked.
fn take_requests(store: &S3Double) -> Vec<String> {
    store.take_requests().into_iter().filter(|request| !request.contains("/_delta_log/")).collect()
}

fn metric(server: &ServedLake, name: &str) -> u64 {
    let text = String::from_utf8(get(server, "/metrics")).expect("text");
    let line = text.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_else(|| panic!("{name} in {text}"));
    line.trim().parse().expect("a number")
}

mod slow {
    use super::*;

    #[test]
    fn pages_and_queries_of_a_warm_server_stay_within_their_budgets() {
        let (place, store) = lake();
        let server = serve(&place, &store, &[]);
        get(&server, "/api/v1/surfaces?limit=60");
        open_surface_page(&server, "wood");
        sql(&server, "select ir from ir where surface_id = 'wood' and pair_id = 0");
        take_requests(&store);
        open_surface_page(&server, "prd");
        let page = take_requests(&store);
        assert!(page.len() <= 8, "{page:?}");
        sql(&server, "select ir from ir where surface_id = 'prd' and pair_id = 1");
        let response = take_requests(&store);
        assert!(response.len() <= 2, "{response:?}");
        sql(&server, "select avg(tnce_total) from tnce");
        let scan = take_requests(&store);
        assert!(scan.len() <= SURFACES.len(), "{scan:?}");
        open_surface_page(&server, "prd");
        assert!(take_requests(&store).is_empty(), "answers are kept");

        // What never changes is not asked for its size: neither for SQL, nor for a file, nor for a slice.
        let runs = sql(&server, "select run_id from runs where surface_id = 'wood'");
        let run = runs[0]["run_id"].as_str().expect("a name");
        sql(&server, "select count(*) from mcap_messages('*')");
        get(&server, &format!("/api/v1/runs/{run}/file.mcap"));
        get(&server, &format!("/api/v1/slices.mcap?where=run_id%20%3D%20%27{run}%27%20and%20pair_id%20%3D%200"));
        let all = take_requests(&store);
        assert!(all.iter().all(|request| request.starts_with("GET ")) && !all.is_empty(), "{all:?}");
    }

    #[test]
    fn engines_and_commands_share_the_folder_of_a_cache() {
        let (place, store) = lake();
        let cache = place.path("cache").display().to_string();
        let args = ["--cache", cache.as_str(), "--cache-size", "200MB"];
        let scan = "select avg(tnce_total), count(*) from tnce";
        let (expected, fetched) = {
            let server = serve(&place, &store, &args);
            let answer = sql(&server, scan);
            // Engines tell what they have counted a moment later.
            let blocks = || metric(&server, "echolake_cache_blocks_total{from=\"store\"}");
            crate::serve::wait_until("the engine counts its blocks", || blocks() > 0);
            assert!(metric(&server, "echolake_cache_fetched_bytes_total") > 0);
            (answer, take_requests(&store).len())
        };
        assert!(fetched >= SURFACES.len(), "{fetched}");
        let server = serve(&place, &store, &args);
        take_requests(&store);
        assert_eq!(sql(&server, scan), expected);
        let again = take_requests(&store);
        let is_table = |request: &&String| request.ends_with(".parquet") && !request.contains("/rig.");
        assert!(!again.iter().any(|request| is_table(&request)), "{again:?}");
        crate::serve::wait_until("the engine counts what it found", || {
            metric(&server, "echolake_cache_blocks_total{from=\"disk\"}") > 0
        });
        let with_cache = [&["sql", "--json", scan][..], &args].concat();
        let answer: Value = serde_json::from_str(&ok(&place, &store, &with_cache)).expect("JSON");
        assert_eq!(answer, expected);
        assert!(!take_requests(&store).iter().any(|request| is_table(&request)));

        // A folder that cannot be used is said before anything is served.
        std::fs::write(place.path("file"), "x").expect("written");
        let output = run(&place, &store, &["sql", "select 1", "--cache", "file"]);
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1) && said.contains("cannot hold a cache") && said.contains("hint"),
            "{said}"
        );
        let output = run(&place, &store, &["sql", "select 1", "--cache", "cache", "--cache-size", "1MB"]);
        assert!(output.status.code() == Some(2) && stderr(&output).contains("100MB"), "{}", stderr(&output));
    }
}
