//! Programs that know nothing of echolake: agents by the Model Context Protocol, spreadsheets by Delta Sharing.

use std::io::Write as _;
use std::process::Command;

use parquet::file::reader::{FileReader as _, SerializedFileReader};
use serde_json::{Value, json};

use super::http::{HttpRequest, HttpResponse};
use super::server::ServedLake;
use super::{get, lake, refused, served};
use crate::TestFolder;
use crate::child::run_command;

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
    assert!(meanings.len() == 22 && meanings.iter().all(|meaning| meaning.is_string()), "{tables}");
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

// The lines of a shared table's files, after protocol and metadata.
fn shared(server: &ServedLake, table: &str, body: &str) -> Vec<Value> {
    let path = format!("/delta-sharing/shares/echolake/schemas/lake/tables/{table}/query");
    let answer = HttpRequest::post(&path, body).with("content-type", "application/json").send(server);
    assert_eq!(answer.status, 200, "{}", answer.text());
    assert!(answer.header("delta-table-version").is_some());
    let lines: Vec<Value> = answer.text().lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(lines[0], json!({ "protocol": { "minReaderVersion": 1 } }));
    let schema = lines[1]["metaData"]["schemaString"].as_str().expect("a schema");
    assert_eq!(serde_json::from_str::<Value>(schema).expect("JSON")["type"], "struct");
    lines[2..].iter().map(|line| line["file"].clone()).collect()
}

// The path of a file's address.
fn path_of<'a>(server: &ServedLake, file: &'a Value) -> &'a str {
    file["url"].as_str().expect("a URL").split_once(&server.http).expect("this server's").1
}

fn number_of_rows(bytes: &[u8]) -> usize {
    let mut file = tempfile::tempfile().expect("a file");
    file.write_all(bytes).expect("written");
    let reader = SerializedFileReader::new(file).expect("a Parquet file");
    usize::try_from(reader.metadata().file_metadata().num_rows()).expect("a number")
}

#[test]
fn a_shared_file_needs_its_address_and_no_token() {
    let place = lake();
    let made = place.run(&["token", "office"]);
    let token = crate::stderr(&made).lines().next().expect("a token").to_owned();
    std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let bearer = format!("Bearer {token}");
    let ask = |path: &str| HttpRequest::get(path).with("authorization", &bearer).send(&server);
    refused(&get(&server, "/delta-sharing/profile.share"), 401, "unauthenticated");
    let profile = json_of(&ask("/delta-sharing/profile.share"));
    assert_eq!((&profile["bearerToken"], &profile["shareCredentialsVersion"]), (&json!(token), &json!(1)));
    assert_eq!(profile["endpoint"], format!("http://{}/delta-sharing", server.http));
    let path = "/delta-sharing/shares/echolake/schemas/lake/tables/runs/query";
    refused(&HttpRequest::post(path, "{}").send(&server), 401, "unauthenticated");
    let listed = HttpRequest::post(path, "{}").with("authorization", &bearer).send(&server);
    let line: Value = serde_json::from_str(listed.text().lines().nth(2).expect("a file")).expect("JSON");
    let address = path_of(&server, &line["file"]).to_owned();
    assert_eq!(get(&server, &address).status, 200);
    let parts: Vec<_> = address.split('/').collect();
    for (at, other) in [(3, "61"), (4, "99999999999"), (5, "00"), (6, "surfaces"), (7, "x.parquet")] {
        let mut changed = parts.clone();
        changed[at] = other;
        refused(&get(&server, &changed.join("/")), 401, "unauthenticated");
        refused(&ask(&changed.join("/")), 401, "unauthenticated");
    }
    assert!(!server.said().join("\n").contains(parts[5]), "no signature is in the log");
    // The token is taken back, and its addresses with it.
    std::fs::write(place.path("tokens.toml"), "").expect("written");
    super::wait_until("the address ends", || get(&server, &address).status == 401);
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

mod slow {
    use super::*;

    #[test]
    fn rows_that_were_replaced_are_not_shared() {
        let place = TestFolder::new();
        place.acquire("flat", &["--seed", "1", "--ir-only"]);
        place.acquire("flat_b", &["--seed", "2", "--ir-only"]);
        // Its rows do not change when `flat` does, and stay in merged files of which the rest goes.
        place.acquire("wavy", &["--seed", "3", "--ir-only", "--flat", "flat_b"]);
        place.ok(&["ingest"]);
        place.ok(&["optimize"]);
        place.acquire("flat", &["--seed", "9", "--ir-only"]);
        place.ok(&["ingest"]);
        let server = served(&place, &[]);
        for table in ["surfaces", "nce", "tnce"] {
            let mut rows = 0;
            for file in shared(&server, table, "{}") {
                let answer = get(&server, path_of(&server, &file));
                assert_eq!((answer.status, answer.body.len() as u64), (200, file["size"].as_u64().expect("a size")));
                rows += number_of_rows(&answer.body);
            }
            assert_eq!(place.number(&format!("select count(*) from {table}")), rows as f64, "{table}");
        }
    }

    #[test]
    fn tables_are_shared_as_files() {
        let place = lake();
        let server = served(&place, &[]);
        let tables = json_of(&get(&server, "/delta-sharing/shares/echolake/all-tables"));
        let names: Vec<_> = tables["items"].as_array().expect("a list").iter().map(|t| t["name"].clone()).collect();
        assert!(names.contains(&json!("tnce_db")) && !names.contains(&json!("ir")) && names.len() == 14, "{names:?}");
        let page = json_of(&get(&server, "/delta-sharing/shares/echolake/all-tables?maxResults=3&pageToken=12"));
        assert_eq!((page["items"].as_array().map(Vec::len), &page["nextPageToken"]), (Some(2), &Value::Null));
        shared(&server, "catalogue", "{}");
        let protocol = super::super::sql(
            &server,
            "select protocol from system.queries where statement like 'select * from catalogue%'",
        );
        assert_eq!(json_of(&protocol)[0]["protocol"], "sharing");
        for table in ["measurements", "pairs", "runs", "catalogue", "tnce_db"] {
            let rows = place.number(&format!("select count(*) from {table}"));
            let files = shared(&server, table, "{}");
            assert_eq!(files.len(), 1, "{table}");
            let file = get(&server, path_of(&server, &files[0]));
            assert_eq!(
                (file.status, file.body.len() as u64),
                (200, files[0]["size"].as_u64().expect("a size")),
                "{table}"
            );
            assert_eq!(number_of_rows(&file.body) as f64, rows, "{table}");
            let part = HttpRequest::get(path_of(&server, &files[0])).with("range", "bytes=0-3").send(&server);
            assert_eq!((part.status, part.body.as_slice()), (206, &b"PAR1"[..]), "{table}");
            let head = HttpRequest::head(path_of(&server, &files[0])).send(&server);
            assert_eq!(head.header("content-length"), Some(file.body.len().to_string().as_str()), "{table}");
        }
        assert!(shared(&server, "measurements", r#"{"limitHint": 0}"#).is_empty());
        let path = |rest: &str| format!("/delta-sharing/shares/echolake/schemas/lake/tables/{rest}");
        refused(&get(&server, &path("ir/metadata")), 404, "not_found");
        refused(&get(&server, &path("runs/changes?startingVersion=0")), 400, "request_invalid");
        refused(&HttpRequest::post(&path("runs/query"), r#"{"version": 0}"#).send(&server), 400, "request_invalid");
        let delta = HttpRequest::get(&path("runs/metadata")).with("delta-sharing-capabilities", "responseformat=delta");
        refused(&delta.send(&server), 501, "unsupported");
    }
}
