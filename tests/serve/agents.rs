//! Programs that know nothing of echolake: agents by the Model Context Protocol, and readers of SOFA files.

use std::process::Command;

use echolake_testing::run_command;
use serde_json::{Value, json};

use super::http::{HttpRequest, HttpResponse};
use super::server::ServedLake;
use super::{get, lake, refused, served};

const STATELESS: &str = "2026-07-28";

fn message(id: u64, method: &str, params: Value) -> String {
    json!({ "jsonrpc": "2.0", "id": id, "method": method, "params": params }).to_string()
}

fn post(server: &ServedLake, body: &str) -> HttpResponse {
    HttpRequest::post("/mcp", body).with("content-type", "application/json").send(server)
}

fn json_of(answer: &HttpResponse) -> Value {
    serde_json::from_slice(&answer.body).unwrap_or_else(|e| panic!("{e}: {}", answer.text()))
}

// The value that a tool answers, or the text of its error.
fn call(server: &ServedLake, tool: &str, arguments: Value) -> Result<Value, String> {
    let answer = post(server, &message(7, "tools/call", json!({ "name": tool, "arguments": arguments })));
    assert_eq!(answer.status, 200, "{}", answer.text());
    let result = &json_of(&answer)["result"];
    let text = result["content"][0]["text"].as_str().expect("a text").to_owned();
    match result["isError"] == true {
        true => Err(text),
        false => {
            assert_eq!(serde_json::from_str::<Value>(&text).expect("JSON"), result["structuredContent"]);
            Ok(result["structuredContent"].clone())
        }
    }
}

#[test]
fn an_agent_asks_by_tools() {
    let place = lake();
    let server = served(&place, &[]);
    let greeted = json_of(&post(&server, &message(1, "initialize", json!({ "protocolVersion": "2025-06-18" }))));
    assert_eq!((&greeted["id"], &greeted["result"]["protocolVersion"]), (&json!(1), &json!("2025-06-18")));
    let notified = post(&server, r#"{"jsonrpc":"2.0","method":"notifications/initialized"}"#);
    assert_eq!((notified.status, notified.body.len()), (202, 0), "{}", notified.text());
    let tools = json_of(&post(&server, &message(2, "tools/list", json!({}))));
    let tools = tools["result"]["tools"].as_array().expect("a list");
    assert!(tools.iter().all(|tool| tool["annotations"]["readOnlyHint"] == true) && tools.len() == 7, "{tools:?}");

    let tables = call(&server, "list_tables", json!({})).expect("tables");
    let meanings: Vec<_> = tables["tables"].as_array().expect("a list").iter().map(|t| &t["meaning"]).collect();
    assert!(meanings.len() == 30 && meanings.iter().all(|meaning| meaning.is_string()), "{tables}");
    let described = call(&server, "describe_table", json!({ "table": "pairs" })).expect("a table");
    let direct = described["columns"].as_array().expect("a list").iter().find(|c| c["name"] == "direct_mm");
    assert_eq!(direct.expect("a column")["unit"], "mm");

    let rows = |sql: &str, most: u64| call(&server, "query", json!({ "sql": sql, "max_rows": most })).expect("rows");
    let pairs = "select pair_id, direct_mm from pairs order by pair_id";
    let all = rows(&format!("{pairs} limit 2"), 2);
    assert_eq!((&all["rows"], &all["truncated"]), (&json!([[0, 120.0], [1, 240.0]]), &json!(false)));
    assert_eq!(all["columns"][1], json!({ "name": "direct_mm", "type": "Float64", "unit": "mm" }));
    let some = rows(pairs, 3);
    assert_eq!((&some["row_count"], &some["truncated"]), (&json!(3), &json!(true)));
    assert!(some["note"].as_str().expect("a note").contains("max_rows = 3"), "{some}");
    let long = rows("select repeat('x', 1000) as text from generate_series(1, 500)", 1000);
    assert!(long["row_count"].as_u64().expect("a number") < 100 && long["truncated"] == true, "{}", long["note"]);
    let listed = rows("select statement, outcome from system.queries where statement like '%order by pair_id'", 10);
    assert_eq!(listed["rows"][0][1], "answered", "rows that nobody wanted are no failure: {listed}");
    let protocols = "select distinct protocol from system.queries";
    assert_eq!(rows(protocols, 10)["rows"], json!([["mcp"]]));

    let found = call(&server, "list_functions", json!({ "search": "itersine" })).expect("functions");
    assert!(found["functions"].is_array());
    let surface = call(&server, "surface_summary", json!({ "surface_id": "flat" })).expect("a surface");
    let run = surface["runs"][0].as_str().expect("a run");
    assert_eq!(surface["links"]["page"], format!("http://{}/surfaces/flat", server.http));
    let summary = call(&server, "run_summary", json!({ "run_id": run })).expect("a run");
    assert_eq!(summary["run"]["surface_id"], "flat");
    let slice = call(&server, "slice_url", json!({ "runs": [run], "where": "pair_id < 3" })).expect("a slice");
    assert_eq!((&slice["measurements"], &slice["runs"]), (&json!(3), &json!([run])));
    let url = slice["url"].as_str().expect("a URL");
    let file = get(&server, url.split_once(&server.http).expect("this server's").1);
    assert!(file.status == 200 && file.body.starts_with(b"\x89MCAP"), "{url}");
}

#[test]
fn hostile_agents_are_refused_with_a_hint() {
    let place = lake();
    let server = served(&place, &[]);
    for (tool, arguments, part) in [
        ("query", json!({ "sql": "drop table runs" }), "read_only: "),
        ("query", json!({ "sql": "select 1", "max_rows": 0 }), "hint: 1 to 1000"),
        ("query", json!({ "sql": "select 1", "limit": 1 }), "hint: max_rows, sql"),
        ("query", json!({ "sql": ["select 1"] }), "expected a string"),
        ("query", json!({ "sql": format!("select {}1", "(".repeat(9000)) }), "query_invalid: "),
        ("describe_table", json!({ "table": "pg_shadow" }), "hint: list_tables"),
        ("surface_summary", json!({ "surface_id": "../flat" }), "not_found: "),
        ("run_summary", json!({}), "missing field `run_id`"),
        ("slice_url", json!({ "where": "true) or (true" }), "hint: "),
        ("slice_url", json!({}), "hint: "),
        ("list_tables", json!({ "x": 1 }), "hint: it takes none"),
    ] {
        let refused = call(&server, tool, arguments).expect_err("a defect");
        assert!(refused.contains(part), "{tool}: {refused}");
    }
    let code = |body: &str| json_of(&post(&server, body))["error"]["code"].clone();
    assert_eq!(code("{"), -32700);
    assert_eq!(code(&message(1, "resources/list", json!({}))), -32601);
    assert_eq!(code(&message(1, "tools/call", json!({ "name": "drop_table" }))), -32602);
    let meta = json!({ "_meta": { "io.modelcontextprotocol/protocolVersion": "1999-01-01" } });
    assert_eq!(code(&message(1, "tools/list", meta)), -32022);
    refused(&get(&server, "/mcp"), 405, "method_not_allowed");
    let from_elsewhere = HttpRequest::post("/mcp", &message(1, "tools/list", json!({})));
    refused(&from_elsewhere.with("origin", "https://evil.example").send(&server), 403, "foreign_origin");
    let rebound = HttpRequest::post("/mcp", &message(1, "tools/list", json!({}))).host("evil.example");
    refused(&rebound.send(&server), 403, "foreign_origin");

    let made = place.run(&["token", "agent"]);
    let token = crate::stderr(&made).lines().next().expect("a token").to_owned();
    std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let listing = message(1, "tools/list", json!({}));
    refused(&post(&server, &listing), 401, "unauthenticated");
    let asked = HttpRequest::post("/mcp", &listing).with("authorization", &format!("Bearer {token}")).send(&server);
    assert_eq!(asked.status, 200);
}

#[test]
fn an_agent_of_this_machine_asks_over_pipes() {
    let place = lake();
    let meta = json!({ "io.modelcontextprotocol/protocolVersion": STATELESS });
    let lines = [
        message(1, "server/discover", json!({ "_meta": meta })),
        message(2, "tools/call", json!({ "_meta": meta, "name": "query", "arguments": { "sql": "select 7 as n" } })),
        message(3, "tools/call", json!({ "name": "surface_summary", "arguments": { "surface_id": "flat" } })),
        r#"{"jsonrpc":"2.0","method":"notifications/cancelled","params":{"requestId":99}}"#.to_owned(),
        "no message".to_owned(),
        format!("\"{}\"", "x".repeat(3 << 20)),
        message(4, "ping", json!({})),
    ];
    std::fs::write(place.path("messages"), lines.join("\n")).expect("written");
    let mut command = Command::new("sh");
    let asked = r#"exec "$0" --lake lake mcp --pages https://lab.example.org < messages"#;
    command.args(["-c", asked, crate::ECHOLAKE]).current_dir(place.path("")).env_remove("ECHOLAKE_LAKE");
    let ran = run_command(&mut command).expect("it starts");
    assert!(ran.status.success(), "{}", crate::stderr(&ran));
    let answers: Vec<Value> = String::from_utf8_lossy(&ran.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}")))
        .collect();
    assert_eq!(answers.len(), 6, "{answers:?}");
    let answer = |id: u64| &answers.iter().find(|answer| answer["id"] == id).expect("an answer")["result"];
    assert_eq!((&answer(1)["resultType"], &answer(1)["supportedVersions"][4]), (&json!("complete"), &json!(STATELESS)));
    assert_eq!(answer(2)["structuredContent"]["rows"], json!([[7]]));
    assert_eq!(answer(3)["structuredContent"]["links"]["page"], "https://lab.example.org/surfaces/flat");
    assert_eq!(answer(4), &json!({}));
    let failed: Vec<_> = answers.iter().filter(|answer| answer["id"].is_null()).map(|a| &a["error"]["code"]).collect();
    assert_eq!(failed, [-32700, -32700]);
    place.fails(1, &["mcp", "--pages", "localhost"], "hint: scheme, host and port alone");
}

#[test]
fn a_slice_is_a_sofa_file() {
    let place = lake();
    let server = served(&place, &[]);
    place.ok(&["export", "sofa", "-o", "out"]);
    let run = place.sql("select run_id from runs")[0]["run_id"].as_str().expect("a run").to_owned();
    let whole = get(&server, &format!("/api/v1/slices.sofa?run={run}"));
    assert_eq!(whole.status, 200, "{}", whole.text());
    assert!(std::fs::read(place.path("out/flat.sofa")).expect("a file") == whole.body, "the same bytes");
    assert_eq!(whole.header("content-disposition"), Some("attachment; filename=\"flat.sofa\""));
    let etag = whole.header("etag").expect("a tag").to_owned();
    let path = format!("/api/v1/slices.sofa?run={run}");
    assert_eq!(HttpRequest::get(&path).with("if-none-match", &etag).send(&server).status, 304);
    let some = get(&server, "/api/v1/slices.sofa?where=pair_id%20%3C%203");
    assert!(some.status == 200 && some.body.len() < whole.body.len());
    refused(&get(&server, "/api/v1/slices.sofa?where=pair_id%20%3C%200"), 404, "no_data");
    refused(&get(&server, "/api/v1/slices.sofa"), 400, "request_invalid");
    refused(&get(&server, &format!("/api/v1/slices.sofa?run={run}&topics=/ir")), 400, "request_invalid");
    let foreign = HttpRequest::get("/api/v1/slices.sofa?where=true").with("origin", "https://evil.example");
    refused(&foreign.send(&server), 403, "foreign_origin");
}
