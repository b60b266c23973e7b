//! Agents of a project: tools of the Model Context Protocol.

use serde_json::{Value, json};

use super::attempts::{ProjectAttempt, statements};
use super::{HttpRequest, ProjectScene, check_marks, is_repeatable, with_and_without};

/// Calls a tool.
fn call(scene: &ProjectScene, token: &str, tool: &str, arguments: &Value) -> String {
    let params = json!({ "name": tool, "arguments": arguments });
    let message = json!({ "jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": params }).to_string();
    let answer = scene.send(HttpRequest::post("/mcp", &message).with("content-type", "application/json"), token);
    format!("{} {}", answer.status, answer.text()).replace(&scene.server.http, "host")
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
}
