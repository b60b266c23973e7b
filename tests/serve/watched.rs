//! A server that is watched: names of requests, system tables, figures, slow queries, and the audit.

use std::process::Command;

use echolake_acquisition::run::metrics::RunMetrics;
use echolake_testing::run_command;
use serde_json::Value;

use super::http::HttpRequest;
use super::server::ServedLake;
use super::{ENDLESS, get, json, lake, postgres, refused, served, sql, wait_until};

fn rows(server: &ServedLake, query: &str) -> Vec<Value> {
    let answer = sql(server, query);
    assert_eq!(answer.status, 200, "{query}: {}", answer.text());
    json(&answer).as_array().expect("rows").clone()
}

#[test]
fn every_answer_names_its_request() {
    let place = lake();
    let server = served(&place, &[]);
    for path in ["/health", "/ready", "/metrics", "/api/v1/tables", "/api/v1/nothing", "/nothing"] {
        let answer = get(&server, path);
        assert!(answer.header("x-request-id").is_some_and(|id| id.len() == 16), "{path}: {answer:?}");
        let named = HttpRequest::get(path).with("x-request-id", "my-request.7").send(&server);
        assert_eq!(named.header("x-request-id"), Some("my-request.7"), "{path}");
        let insane = HttpRequest::get(path).with("x-request-id", "<script>").send(&server);
        assert_ne!(insane.header("x-request-id"), Some("<script>"), "{path}");
    }
}

#[test]
fn queries_are_listed_while_they_run_and_after() {
    let place = lake();
    let server = served(&place, &[]);
    rows(&server, "select count(*) from runs");
    let ended = "select statement, protocol, outcome, rows, seconds >= plan_seconds as later from system.queries \
                 where outcome <> 'running'";
    wait_until("it is listed", || {
        rows(&server, ended).iter().any(|query| query["statement"] == "select count(*) from runs")
    });
    let listed = rows(&server, ended);
    let first = listed.last().expect("a query");
    assert_eq!((&first["protocol"], &first["outcome"]), (&"http".into(), &"answered".into()), "{first}");
    assert_eq!((&first["rows"], &first["later"]), (&1.into(), &true.into()), "{first}");
    assert!(sql(&server, "select nonsense from runs").status == 400);
    let failed = "select id from system.queries where outcome = 'query_invalid'";
    wait_until("its failure is listed", || rows(&server, failed).len() == 1);
    let own = rows(&server, "select statement from system.queries where outcome = 'running'");
    assert!(own[0]["statement"].as_str().is_some_and(|text| text.contains("'running'")), "a query sees itself");
}

#[test]
fn the_lake_and_connections_are_tables_over_postgres_too() {
    let place = lake();
    let server = served(&place, &[]);
    let mut client = postgres::WireClient::connect(&server, None);
    let one = |text: &str| Ok(vec![vec![Some(text.to_owned())]]);
    let own = "select count(*) from system.connections where protocol = 'postgres' and is_working";
    assert_eq!(client.query(own), one("1"));
    assert_eq!(client.query("select origin from system.ingests"), one("simulated"));
    let listed = "select count(*) from pg_class c join pg_namespace n on n.oid = c.relnamespace \
                  where n.nspname = 'system' and not pg_table_is_visible(c.oid) and c.relkind = 'r'";
    assert_eq!(client.query(listed), one("7"));
    assert_eq!(
        client.query("select obj_description('system.queries'::regclass, 'pg_class') like 'One row per query%'"),
        one("t")
    );
    let columns =
        "select count(*) from information_schema.columns where table_schema = 'system' and table_name = 'files'";
    assert_eq!(client.query(columns), one("8"));
    let time = "select ingested is not null and version > 0 from system.ingests";
    assert_eq!(client.query(time), one("t"));
    let files =
        "select count(*) = count(distinct path) and sum(rows) = 45 from system.files where \"table\" = 'measurements'";
    assert_eq!(client.query(files), one("t"));
    let versions = "select sum(rows_added) - sum(rows_removed) from system.versions where \"table\" = 'measurements'";
    assert_eq!(client.query(versions), one("45"));
}

#[test]
fn files_that_are_handed_out_are_audited() {
    let place = lake();
    let made = place.run(&["token", "ann"]);
    std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
    let token = super::super::stderr(&made).lines().next().expect("a token").to_owned();
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let ask = |path: &str| HttpRequest::get(path).with("authorization", &format!("Bearer {token}")).send(&server);
    let runs = json(&ask("/api/v1/runs"));
    let run = runs["items"][0]["run_id"].as_str().unwrap_or_else(|| panic!("{runs}"));
    assert_eq!(ask(&format!("/api/v1/runs/{run}/file.mcap")).status, 200);
    let slice = ask(&format!("/api/v1/slices.mcap?run={run}&where=pair_id%3C77"));
    assert_eq!(slice.status, 200, "{}", slice.text());
    let said = server.said();
    let handed = said.iter().filter(|line| line.contains("a file is handed out")).count();
    assert_eq!(handed, 2, "{said:?}");
    let of_slice = said.iter().find(|line| line.contains("slices.mcap")).expect("a line of the slice");
    assert!(of_slice.contains(&format!("runs=\"{run}\"")), "{of_slice}");
    assert_eq!(slice.header("echolake-sliced-runs"), None, "that is between engine and door");
    assert!(!said.iter().any(|line| line.contains("pair_id")), "a predicate is a statement: {said:?}");
}

#[test]
fn figures_are_as_prometheus_wants_them() {
    let place = lake();
    let server = served(&place, &[]);
    rows(&server, "select value from generate_series(1, 2951)");
    assert_eq!(get(&server, "/ready").status, 200, "it has answered");
    let has = |text: &str, line: &str| text.lines().any(|l| l == line);
    let text = || get(&server, "/metrics").text();
    wait_until("an engine has looked at the lake", || has(&text(), "echolake_lake_runs 1"));
    wait_until("both engines and the spare run", || has(&text(), "echolake_engines 3"));
    wait_until("the query is counted", || has(&text(), "echolake_rows_total 2951"));
    let text = text();
    for line in [
        "echolake_lake_surfaces 1",
        "echolake_damaged_runs 0",
        "echolake_inbox_runs 0",
        "echolake_ready 1",
        "echolake_engines 3",
        "echolake_connections{protocol=\"postgres\"} 0",
        "echolake_query_seconds_count{outcome=\"answered\",protocol=\"http\"} 1",
    ] {
        assert!(has(&text, line), "{line} in {text}");
    }
    let rules = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/grafana/alerts.yaml");
    place.ok(&["doctor", "--prometheus", "doctor.prom"]);
    let checked = std::fs::read_to_string(place.path("doctor.prom")).expect("written");
    assert!(has(&checked, "echolake_doctor_findings{severity=\"damaged\"} 0"), "{checked}");
    let run = RunMetrics::new("flat", 45, 0);
    run.disk_free(1);
    let figures = [text.clone(), run.prometheus(), checked].join("\n");
    let expressions = std::fs::read_to_string(&rules).expect("the rules");
    let expressions = expressions.lines().filter_map(|line| line.trim().strip_prefix("expr: "));
    let mut named = 0;
    for expression in expressions {
        let names = expression.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
        let names: Vec<_> = names.filter(|name| name.starts_with("echolake_")).collect();
        assert!(!names.is_empty(), "an alert over no figure of a server: {expression}");
        for name in names {
            let found = figures.lines().any(|line| line.split(['{', ' ']).next() == Some(name));
            assert!(found, "there is no {name}, which an alert reads, in {figures}");
            named += 1;
        }
    }
    assert_eq!(named, 15);
    // Debian's package prometheus has it.
    std::fs::write(place.path("metrics.txt"), &text).expect("written");
    let metrics = format!("promtool check metrics < '{}'", place.path("metrics.txt").display());
    for check in [metrics, format!("promtool check rules '{}'", rules.display())] {
        let checked = run_command(Command::new("sh").args(["-c", &check])).expect("a shell");
        match checked.status.code() {
            Some(127) => eprintln!("skipped: there is no promtool"),
            code => assert_eq!(code, Some(0), "{}", String::from_utf8_lossy(&checked.stderr)),
        }
    }
}

mod slow {
    use super::*;

    #[test]
    fn queries_of_all_protocols_are_cancelled_by_their_number() {
        let place = lake();
        let server = served(&place, &[]);
        let cancel = |id: u64| HttpRequest::post(&format!("/api/v1/queries/{id}/cancel"), "").send(&server);
        let endless = "select id, client, statement from system.queries where outcome = 'running' \
                       and (protocol = 'postgres' or statement like '%generate_series%' and statement not like \
                       '%system%')";
        let asked = HttpRequest::post("/api/v1/sql", ENDLESS).with("content-type", "text/plain").begin(&server);
        wait_until("it runs", || rows(&server, endless).len() == 1);
        let id = rows(&server, endless)[0]["id"].as_u64().expect("a number");
        assert_eq!(cancel(id).status, 202);
        wait_until("it ends", || rows(&server, endless).is_empty());
        drop(asked);
        let outcome = format!("select outcome from system.queries where id = {id}");
        assert_eq!(rows(&server, &outcome)[0]["outcome"], "cancelled");
        refused(&cancel(id), 404, "not_found");
        refused(&HttpRequest::post("/api/v1/queries/one/cancel", "").send(&server), 400, "request_invalid");
        // On a server without tokens everybody sees all queries, and the texts of their own.
        let mut client = postgres::WireClient::connect(&server, None);
        client.begin(ENDLESS);
        wait_until("it runs", || rows(&server, endless).len() == 1);
        let query = &rows(&server, endless)[0];
        assert_eq!((query["client"].as_str(), query["statement"].as_str()), (Some("user token"), None));
        assert_eq!(cancel(query["id"].as_u64().expect("a number")).status, 202);
        assert_eq!(client.rows(), Err("57014".to_owned()));
    }

    #[test]
    fn a_token_sees_its_own_queries() {
        let place = lake();
        let mut tokens = String::new();
        let mut secret = |name: &str, scopes: &str| {
            let made = place.run(&["token", name]);
            tokens += &String::from_utf8_lossy(&made.stdout).replace("[\"sql\", \"files\"]", scopes);
            crate::stderr(&made).lines().next().expect("a token").to_owned()
        };
        let ann = secret("ann", "[\"sql\"]");
        let bob = secret("bob", "[\"sql\"]");
        let chief = secret("chief", "[\"sql\", \"metrics\"]");
        std::fs::write(place.path("tokens.toml"), &tokens).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml", "--log-slow", "0ms"]);
        let ask = |token: &str, method: &'static str, path: &str, body: &str| {
            let request = if method == "GET" { HttpRequest::get(path) } else { HttpRequest::post(path, body) };
            let request = request.with("content-type", "text/plain");
            request.with("authorization", &format!("Bearer {token}")).send(&server)
        };
        let query = |token: &str, text: &str| json(&ask(token, "POST", "/api/v1/sql", text)).as_array().cloned();
        assert!(query(&ann, "select 'of ann' as text").is_some());
        let running = HttpRequest::post("/api/v1/sql", ENDLESS)
            .with("content-type", "text/plain")
            .with("authorization", &format!("Bearer {ann}"))
            .begin(&server);
        let all = "select id, client, statement, outcome from system.queries where client = 'ann'";
        wait_until("both are listed", || query(&chief, all).is_some_and(|rows| rows.len() == 2));
        let seen = query(&chief, all).expect("rows");
        assert!(seen.iter().all(|query| query["statement"].is_null()), "texts are their client's: {seen:?}");
        assert_eq!(query(&bob, all), Some(Vec::new()));
        let id = seen.iter().find(|query| query["outcome"] == "running").expect("it runs")["id"].clone();
        let cancel = format!("/api/v1/queries/{id}/cancel");
        refused(&ask(&bob, "POST", &cancel, ""), 404, "not_found");
        refused(&ask("nonsense", "POST", &cancel, ""), 401, "unauthenticated");
        assert_eq!(ask(&ann, "POST", &cancel, "").status, 202);
        wait_until("it ends", || query(&chief, all).is_some_and(|rows| rows.iter().all(|q| q["outcome"] != "running")));
        drop(running);
        assert_eq!(ask(&ann, "GET", "/api/v1/runs/none/file.mcap", "").status, 403);
        wait_until("slow queries are logged", || server.said().iter().any(|line| line.contains("of ann")));
        let said = server.said();
        let line = |parts: &[&str]| said.iter().find(|line| parts.iter().all(|part| line.contains(part))).cloned();
        assert!(line(&["a client has logged in", "client=\"ann\"", "protocol=\"http\"", "peer=127.0.0.1"]).is_some());
        assert!(line(&["a client was refused", "unauthenticated"]).is_some(), "{said:?}");
        assert!(line(&["a slow query", "client=\"ann\"", "outcome=\"cancelled\""]).is_some(), "{said:?}");
        for token in [&ann, &bob, &chief] {
            assert!(line(&[token]).is_none(), "a token is in the log");
        }
    }
}
