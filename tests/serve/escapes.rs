//! The attempts to get out of the gate, over each of the three protocols and by agents' tools, and ways out that only
//! one of them has: none reads, writes or changes anything, and the server answers afterwards.

#[path = "../../query/src/session/attempts.rs"]
mod attempts;

use std::collections::BTreeMap;
use std::path::PathBuf;

use arrow_flight::error::FlightError;
use arrow_flight::sql::client::FlightSqlServiceClient;
use arrow_flight::{Action, FlightDescriptor, FlightInfo, Ticket};
use futures::TryStreamExt as _;
use tonic::transport::{Channel, Endpoint};

use attempts::{SECRET, files};

use super::http::HttpRequest;
use super::server::{ANSWER_LIMIT, ServedLake};
use super::slices::{encoded, slice};
use super::{TestFolder, get, lake, postgres, served};

/// A served lake with a secret beside it.
struct EscapeScene {
    place: TestFolder,
    server: ServedLake,
    before: BTreeMap<PathBuf, Vec<u8>>,
}

impl EscapeScene {
    fn new() -> Self {
        let place = lake();
        std::fs::write(place.path("secret.csv"), format!("a,b\n{SECRET},1\n")).expect("written");
        std::fs::create_dir(place.path("outside")).expect("made");
        let server = served(&place, &[]);
        let before = files(&place.path(""));
        Self { place, server, before }
    }

    fn attempts(&self) -> Vec<String> {
        attempts::attempts(&self.place.path("secret.csv"), &self.place.path("outside"))
    }

    fn unharmed(mut self) {
        assert!(self.server.is_up());
        let answer = super::sql(&self.server, "select count(*) n from pairs");
        assert_eq!(answer.text().trim(), r#"[{"n":45}]"#, "it still answers, and has its tables");
        assert_eq!(files(&self.place.path("")), self.before, "no file is written, changed or deleted");
        let said = self.server.said();
        assert!(!said.iter().any(|l| l.contains("panicked")), "{said:?}");
    }
}

pub(super) type FlightSqlClient = FlightSqlServiceClient<Channel>;

async fn flight(client: &mut FlightSqlClient, sql: &str) -> Result<String, FlightError> {
    let info = client.execute(sql.to_owned(), None).await?;
    fetched(client, info).await
}

async fn prepared(client: &mut FlightSqlClient, sql: &str) -> Result<String, FlightError> {
    let info = client.prepare(sql.to_owned(), None).await?.execute().await?;
    fetched(client, info).await
}

async fn fetched(client: &mut FlightSqlClient, info: FlightInfo) -> Result<String, FlightError> {
    let mut text = String::new();
    for ticket in info.endpoint.into_iter().filter_map(|e| e.ticket) {
        let batches: Vec<_> = client.do_get(ticket).await?.try_collect().await?;
        text.push_str(&format!("{batches:?}"));
    }
    Ok(text)
}

mod slow {
    use super::*;

    #[test]
    fn none_over_http() {
        let scene = EscapeScene::new();
        for (number, attempt) in scene.attempts().iter().enumerate() {
            let format = ["json", "csv", "parquet", "arrow"][number % 4];
            let answer = HttpRequest::post(&format!("/api/v1/sql?format={format}"), attempt)
                .with("content-type", "text/plain")
                .send(&scene.server);
            assert!(answer.status < 500, "{attempt}: {}", answer.status);
            assert!(!String::from_utf8_lossy(&answer.body).contains(SECRET), "{attempt}");
        }
        for path in [
            "/../secret.csv",
            "/..%2fsecret.csv",
            "/%2e%2e/secret.csv",
            "/api/v1/../../../secret.csv",
            "/api/v1/tables/..%2f..%2fsecret.csv",
            "//secret.csv",
            "/api/v1/sql?format=csv&query=select%201",
            "/lake.toml",
        ] {
            let answer = get(&scene.server, path);
            assert!(!String::from_utf8_lossy(&answer.body).contains(SECRET), "{path}");
        }
        scene.unharmed();
    }

    // As the predicate of a slice, which is part of a query of the server's.
    #[test]
    fn none_by_slices() {
        let scene = EscapeScene::new();
        let of_a_run =
            format!("&run={}", scene.place.sql("select run_id from runs")[0]["run_id"].as_str().expect("a run"));
        for (number, attempt) in scene.attempts().iter().enumerate() {
            let more = ["", "&layout=in-time", &of_a_run, "&topics=/ir"][number % 4];
            let manifest = format!("/api/v1/foxglove/manifest?where={}{more}", encoded(attempt));
            for path in [slice(attempt, more), manifest] {
                let answer = get(&scene.server, &path);
                assert!((400..500).contains(&answer.status), "{attempt}: {}", answer.status);
                assert!(!String::from_utf8_lossy(&answer.body).contains(SECRET), "{attempt}");
            }
        }
        // Those that are an expression once they are in parentheses.
        for attempt in scene.attempts().iter().filter(|a| a.starts_with("select")) {
            let answer = get(&scene.server, &slice(&format!("exists ({attempt})"), ""));
            assert!(answer.status < 500, "{attempt}: {}", answer.status);
            assert!(!String::from_utf8_lossy(&answer.body).contains(SECRET), "{attempt}");
        }
        scene.unharmed();
    }

    // As every text that an agent's tools take.
    #[test]
    fn none_by_agents() {
        let scene = EscapeScene::new();
        for attempt in &scene.attempts() {
            let calls = [
                ("query", serde_json::json!({ "sql": attempt })),
                ("slice_url", serde_json::json!({ "where": attempt })),
                ("describe_table", serde_json::json!({ "table": attempt })),
                ("surface_summary", serde_json::json!({ "surface_id": attempt })),
                ("run_summary", serde_json::json!({ "run_id": attempt })),
            ];
            for (tool, arguments) in calls {
                let params = serde_json::json!({ "name": tool, "arguments": arguments });
                let message =
                    serde_json::json!({ "jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": params });
                let answer = HttpRequest::post("/mcp", &message.to_string()).send(&scene.server);
                assert_eq!(answer.status, 200, "{tool}: {attempt}");
                let text = String::from_utf8_lossy(&answer.body);
                assert!(!text.contains(SECRET), "{tool}: {attempt}");
                let is_plain = tool == "query" || text.contains("\"isError\":true");
                assert!(is_plain, "{tool}: {attempt}: {text}");
            }
        }
        scene.unharmed();
    }

    #[test]
    fn none_over_postgres() {
        let scene = EscapeScene::new();
        let outside = scene.place.path("outside").display().to_string();
        let own = [
            format!("copy pairs to '{outside}/own.csv' with (format csv)"),
            format!("copy (select 1) to program 'touch {outside}/own'"),
            "copy pairs from stdin".to_owned(),
            "copy pairs (pair_id) from stdin with (format binary)".to_owned(),
            "create temp table t as select 1; select * from t".to_owned(),
            "begin; set transaction read write; delete from runs; commit".to_owned(),
            "set session characteristics as transaction read write; delete from runs".to_owned(),
            "set default_transaction_read_only = off; delete from runs".to_owned(),
            "prepare p as delete from runs; execute p".to_owned(),
            "declare c cursor for delete from runs returning *; fetch all from c".to_owned(),
            "do $$ begin delete from runs; end $$".to_owned(),
        ];
        for attempt in scene.attempts().iter().chain(&own).filter(|a| !a.contains('\0')) {
            // An attempt may end its engine, and with it the connection.
            let mut client = postgres::WireClient::connect(&scene.server, None);
            let answer = format!("{:?}", client.query(attempt));
            assert!(!answer.contains(SECRET) && !answer.contains("XX000"), "{attempt}: {answer}");
        }
        scene.unharmed();
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn none_over_flight_sql() {
        let scene = EscapeScene::new();
        let endpoint = Endpoint::from_shared(format!("http://{}", scene.server.flight_sql)).expect("a URL");
        // Limits each request that is asked below without a limit of its own.
        let channel = endpoint.connect_timeout(ANSWER_LIMIT).timeout(ANSWER_LIMIT).connect().await;
        let mut client = FlightSqlServiceClient::new(channel.expect("connected"));
        for (number, attempt) in scene.attempts().iter().enumerate() {
            let answer = async {
                match number % 3 {
                    0 => flight(&mut client, attempt).await,
                    1 => prepared(&mut client, attempt).await,
                    _ => client.execute_update(attempt.clone(), None).await.map(|n| n.to_string()),
                }
            };
            let said =
                tokio::time::timeout(ANSWER_LIMIT, answer).await.unwrap_or_else(|_| panic!("{attempt}: no answer"));
            let said = format!("{said:?}");
            assert!(!said.contains(SECRET) && !said.contains("defect"), "{attempt}: {said}");
        }
        let secret = scene.place.path("secret.csv").display().to_string();
        for forged in ["select * from runs", &secret, "", "\u{0}", "tables/runs"] {
            let said = client.inner_mut().do_get(Ticket::new(forged.to_owned())).await;
            assert!(said.is_err(), "a ticket that nobody was given: {forged:?}");
            let path = FlightDescriptor::new_path(vec![forged.to_owned()]);
            assert!(client.inner_mut().get_flight_info(path).await.is_err(), "{forged:?}");
            let action = Action::new(forged.to_owned(), secret.clone());
            assert!(client.inner_mut().do_action(action).await.is_err(), "{forged:?}");
        }
        drop(client);
        tokio::task::spawn_blocking(|| scene.unharmed()).await.expect("unharmed");
    }
}
