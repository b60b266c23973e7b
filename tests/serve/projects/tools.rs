//! Agents and spreadsheets of a project: tools of the Model Context Protocol, and tables of Delta Sharing.

use serde_json::{Value, json};

use super::attempts::{ProjectAttempt, TABLES, statements};
use super::{HttpRequest, ProjectScene, check_marks, is_repeatable, with_and_without};

/// Views that are not shared, because they repeat the lists of other tables.
const NOT_SHARED: [&str; 2] = ["ir", "augmented"];

/// Calls a tool.
fn call(scene: &ProjectScene, token: &str, tool: &str, arguments: &Value) -> String {
    let params = json!({ "name": tool, "arguments": arguments });
    let message = json!({ "jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": params }).to_string();
    let answer = scene.send(HttpRequest::post("/mcp", &message).with("content-type", "application/json"), token);
    format!("{} {}", answer.status, answer.text()).replace(&scene.server.http, "host")
}

/// A file of a shared table.
struct SharedFile {
    /// Path of its signed address.
    path: String,
    /// Its line without what differs from server to server: address, id, and end of the address.
    about: String,
}

/// Lists a shared table; returns the version in the header, and the files.
fn list_shared(scene: &ProjectScene, token: &str, table: &str) -> (String, Vec<SharedFile>) {
    let path = format!("/delta-sharing/shares/echolake/schemas/lake/tables/{table}/query");
    let answer = scene.send(HttpRequest::post(&path, "{}").with("content-type", "application/json"), token);
    assert_eq!(answer.status, 200, "{table}: {}", answer.text());
    let version = answer.header("delta-table-version").expect("a version").to_owned();
    let lines = answer.text();
    let files = lines.lines().filter_map(|line| {
        let line: Value = serde_json::from_str(line).expect("JSON");
        let mut about = line.get("file")?.as_object()?.clone();
        let url = about.remove("url")?;
        let path = url.as_str()?.split_once(&scene.server.http)?.1.to_owned();
        about.retain(|name, _| !matches!(name.as_str(), "id" | "expirationTimestamp"));
        let about = format!("{} {about:?}", file_name(&path));
        Some(SharedFile { path, about })
    });
    (version, files.collect())
}

// The table and the name of the file, at the end of a signed address.
fn file_name(path: &str) -> &str {
    path.splitn(7, '/').nth(6).expect("a signed address")
}

fn download(scene: &ProjectScene, file: &SharedFile) -> Vec<u8> {
    let answer = HttpRequest::get(&file.path).send(&scene.server);
    assert_eq!(answer.status, 200, "{}: {}", file.about, answer.text());
    answer.body
}

mod slow {
    use super::*;

    #[test]
    fn others_runs_do_not_exist_for_agents() {
        let [without, with] = with_and_without().map(ProjectScene::serve);
        let (marks, hidden) = (with.marks(), with.hidden());
        let query = |ProjectAttempt { sql, .. }: &ProjectAttempt| {
            (sql.clone(), "query", json!({ "sql": sql, "max_rows": 1000 }))
        };
        let asked = |tool: &'static str, arguments: Value| (arguments.to_string(), tool, arguments);
        let tools = [
            asked("surface_summary", json!({ "surface_id": hidden.surface })),
            asked("run_summary", json!({ "run_id": hidden.run })),
            asked("slice_url", json!({ "runs": [hidden.run] })),
            asked("slice_url", json!({ "where": "pair_id < 3" })),
            asked("slice_url", json!({ "where": format!("surface_id = '{}'", hidden.surface) })),
            asked("slice_url", json!({ "runs": [hidden.run], "where": "pair_id < 3" })),
        ];
        for (asked, tool, arguments) in statements(&hidden, with.version()).iter().map(query).chain(tools) {
            let [theirs, seen] = [&with.all, &with.ours].map(|token| call(&with, token, tool, &arguments));
            assert_ne!(theirs, seen, "whoever may see it sees it: {asked}");
            check_marks(&marks, &asked, &seen);
            if is_repeatable(&asked) {
                assert_eq!(seen, call(&without, &without.ours, tool, &arguments), "{asked}");
            }
        }
    }

    #[test]
    fn others_runs_do_not_exist_in_shared_tables() {
        let [without, with] = with_and_without().map(ProjectScene::serve);
        let marks = with.marks();
        let about = |files: &[SharedFile]| files.iter().map(|file| file.about.clone()).collect::<Vec<_>>().join("\n");
        for table in TABLES.into_iter().filter(|table| !NOT_SHARED.contains(table)) {
            let [theirs, seen] = [&with.all, &with.ours].map(|token| list_shared(&with, token, table));
            let alone = list_shared(&without, &without.ours, table);
            assert_ne!(theirs.0, seen.0, "whoever may see it sees it: version of {table}");
            assert_ne!(about(&theirs.1), about(&seen.1), "whoever may see it sees it: {table}");
            check_marks(&marks, table, &about(&seen.1));
            assert_eq!((&seen.0, about(&seen.1)), (&alone.0, about(&alone.1)), "{table}");
            for (file, same) in seen.1.iter().zip(&alone.1) {
                assert!(download(&with, file) == download(&without, same), "{}", file.about);
            }
            // A signature is of one client and one file.
            let own = &seen.1.first().expect("a file").path;
            for hidden in theirs.1.iter().filter(|file| !about(&seen.1).contains(&file.about)) {
                assert!(!download(&with, hidden).is_empty());
                let signed = own.strip_suffix(file_name(own)).expect("its end").to_owned() + file_name(&hidden.path);
                let answer = with.send(HttpRequest::get(&signed), &with.ours);
                assert_eq!(answer.status, 401, "{signed}: {}", answer.text());
            }
        }
    }
}
