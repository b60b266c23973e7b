//! Tokens of projects: what shows runs of other projects to whoever may see them shows nothing to a token that may not,
//! over all protocols. What such a token is answered is what it would be answered if these runs did not exist.

mod attempts;
mod shared_engines;
mod timings;
mod tools;

use std::path::PathBuf;

use arrow::array::RecordBatch;
use arrow_flight::error::FlightError;
use arrow_flight::sql::client::FlightSqlServiceClient;
use futures::TryStreamExt as _;
use tonic::transport::Endpoint;

use super::escapes::FlightSqlClient;
use super::http::{HttpRequest, HttpResponse};
use super::postgres::WireClient;
use super::server::{ANSWER_LIMIT, ServedLake};
use super::{served, wait_until};
use crate::{TestFolder, TestFolderTemplate, stderr};
use attempts::{HiddenRun, ProjectAttempt, addresses, statements};

/// A served lake with tokens.
struct ProjectScene {
    place: TestFolder,
    server: ServedLake,
    /// Sees project `ours`.
    ours: String,
    /// Sees all.
    all: String,
}

pub(super) fn new_token(place: &TestFolder, args: &[&str]) -> (String, String) {
    let made = place.run(&[&["token"], args].concat());
    let token = stderr(&made).lines().next().expect("a token").to_owned();
    (token, String::from_utf8_lossy(&made.stdout).into_owned())
}

impl ProjectScene {
    fn serve(place: TestFolder) -> Self {
        let (ours, ours_lines) = new_token(&place, &["ann", "--project", "ours"]);
        let (all, all_lines) = new_token(&place, &["bob"]);
        std::fs::write(place.path("tokens.toml"), ours_lines + &all_lines).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml"]);
        Self { place, server, ours, all }
    }

    fn send(&self, request: HttpRequest, token: &str) -> HttpResponse {
        request.with("authorization", &format!("Bearer {token}")).send(&self.server)
    }

    fn sql(&self, sql: &str, token: &str) -> String {
        let answer = self.send(HttpRequest::post("/api/v1/sql", sql).with("content-type", "text/plain"), token);
        format!("{} {}", answer.status, answer.text())
    }

    fn get(&self, path: &str, token: &str) -> String {
        // Addresses in answers, and their tags, have the name by which the client asked.
        let answer = self.send(HttpRequest::get(path).host("localhost"), token);
        format!("{} {:?} {}", answer.status, answer.header("etag"), String::from_utf8_lossy(&answer.body))
    }

    /// The run that a token of `ours` must not see.
    fn hidden(&self) -> HiddenRun {
        let rows = self.place.sql("select run_id from runs where surface_id = 'wood_secret'");
        HiddenRun { surface: "wood_secret".to_owned(), run: rows[0]["run_id"].as_str().expect("a name").to_owned() }
    }

    fn version(&self) -> u64 {
        self.place.number("select max(version) from system.versions where \"table\" = 'runs'") as u64
    }

    /// Texts that nobody knows who does not see the hidden runs.
    fn marks(&self) -> Vec<String> {
        let rows =
            self.place.sql("select run_id, file_sha256 from runs where surface_id in ('wood_secret', 'prd_older')");
        assert_eq!(rows.len(), 2);
        let texts = rows.iter().flat_map(|row| {
            let run = row["run_id"].as_str().expect("a name");
            let tag = run.rsplit_once('-').expect("a tag").1;
            [tag, row["file_sha256"].as_str().expect("a digest")].map(str::to_owned)
        });
        texts.collect()
    }
}

/// Fails if an answer has a text that nobody knows who does not see the hidden runs; `asked` may be repeated in it.
fn check_marks(marks: &[String], asked: &str, answer: &str) {
    let rest = answer.replace(asked, "");
    for mark in marks.iter().filter(|mark| !asked.contains(mark.as_str())) {
        assert!(!rest.contains(mark), "{asked}: {answer}");
    }
    for name in ["wood_secret", "prd_older", "wood_waiting", "theirs"].iter().filter(|name| !asked.contains(*name)) {
        assert!(!rest.contains(name), "{asked}: {answer}");
    }
}

/// References, one surface of project `ours`; the same runs in both folders, and in the second two others' that come
/// last, and one that nobody has ingested.
fn with_and_without() -> [TestFolder; 2] {
    static WITHOUT: TestFolderTemplate = TestFolderTemplate::new();
    static WITH: TestFolderTemplate = TestFolderTemplate::new();
    let without = WITHOUT.place(|place| {
        for surface in ["flat", "foam"] {
            place.acquire(surface, &["--ir-only"]);
        }
        place.ok(&["ingest"]);
        place.acquire("brick_ours", &["--ir-only", "--project", "ours"]);
        place.ok(&["ingest"]);
    });
    let with = WITH.place(|place| {
        copy(&without, place);
        place.acquire("prd_older", &["--ir-only"]);
        place.acquire("wood_secret", &["--ir-only", "--project", "theirs"]);
        place.ok(&["ingest"]);
        place.acquire("wood_waiting", &["--ir-only", "--project", "theirs"]);
    });
    [without, with]
}

fn copy(from: &TestFolder, to: &TestFolder) {
    for (path, bytes) in crate::files_below(&from.path("")) {
        let path: PathBuf = to.path("").join(path);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        std::fs::write(path, bytes).expect("written");
    }
}

// A plan's text has times; an answer to `explain analyze` is never the same twice.
fn is_repeatable(sql: &str) -> bool {
    !sql.starts_with("explain analyze") && !sql.starts_with("explain verbose")
}

// The columns without their metadata, whose order is by chance; or the error.
fn column_texts(batches: &[RecordBatch]) -> Vec<String> {
    batches.iter().flat_map(|batch| batch.columns().iter().map(|column| format!("{column:?}"))).collect()
}

async fn flight_rows(client: &mut FlightSqlClient, sql: &str) -> String {
    let answer = async {
        let info = client.execute(sql.to_owned(), None).await?;
        let mut columns = Vec::new();
        for ticket in info.endpoint.into_iter().filter_map(|endpoint| endpoint.ticket) {
            let batches: Vec<_> = client.do_get(ticket).await?.try_collect().await?;
            columns.extend(column_texts(&batches));
        }
        Ok::<_, FlightError>(columns.join("\n"))
    };
    match answer.await {
        Ok(columns) => columns,
        Err(FlightError::Tonic(status)) => format!("{:?} {}", status.code(), status.message()),
        Err(other) => other.to_string(),
    }
}

mod slow {
    use super::*;

    #[test]
    fn others_runs_do_not_exist_over_http() {
        let [without, with] = with_and_without().map(ProjectScene::serve);
        let (marks, hidden) = (with.marks(), with.hidden());
        let statements = statements(&hidden, with.version());
        for ProjectAttempt { sql, .. } in &statements {
            let [theirs, seen] = [&with.all, &with.ours].map(|token| with.sql(sql, token));
            assert_ne!(theirs, seen, "whoever may see it sees it: {sql}");
            check_marks(&marks, sql, &seen);
            if is_repeatable(sql) {
                assert_eq!(seen, without.sql(sql, &without.ours), "{sql}");
            }
        }
        let file =
            with.place.sql("select path from system.files where \"table\" = 'nce' and surface_id = 'wood_secret'");
        let file = file[0]["path"].as_str().expect("a path").rsplit('/').next().expect("a name").to_owned();
        let addresses = addresses(&hidden, &file);
        for path in &addresses {
            let [theirs, seen] = [&with.all, &with.ours].map(|token| with.get(path, token));
            assert!(theirs.starts_with("200"), "{path}: {theirs}");
            assert_ne!(theirs, seen, "whoever may see it sees it: {path}");
            check_marks(&marks, path, &seen);
            assert_eq!(seen, without.get(path, &without.ours), "{path}");
        }
        assert!(statements.len() + addresses.len() > 300, "{} {}", statements.len(), addresses.len());
    }

    #[test]
    fn others_runs_do_not_exist_over_postgres() {
        let [without, with] = with_and_without().map(ProjectScene::serve);
        let (marks, statements) = (with.marks(), statements(&with.hidden(), with.version()));
        let connect = |scene: &ProjectScene, token: &str| {
            let mut client = WireClient::connect(&scene.server, None);
            assert_eq!(client.log_in(token), None);
            client
        };
        let [mut theirs, mut ours] = [&with.all, &with.ours].map(|token| connect(&with, token));
        let mut alone = connect(&without, &without.ours);
        // Its EXPLAIN has no formats.
        for ProjectAttempt { sql, .. } in statements.iter().filter(|attempt| !attempt.sql.starts_with("explain format"))
        {
            let [all, seen] = [&mut theirs, &mut ours].map(|client| format!("{:?}", client.query(sql)));
            assert_ne!(all, seen, "whoever may see it sees it: {sql}");
            check_marks(&marks, sql, &seen);
            if is_repeatable(sql) {
                assert_eq!(seen, format!("{:?}", alone.query(sql)), "{sql}");
            }
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn others_runs_do_not_exist_over_flight_sql() {
        let [without, with] = with_and_without().map(ProjectScene::serve);
        let (marks, statements) = (with.marks(), statements(&with.hidden(), with.version()));
        let connect = async |scene: &ProjectScene, token: &str| {
            let endpoint = Endpoint::from_shared(format!("http://{}", scene.server.flight_sql)).expect("a URL");
            let channel = endpoint.connect_timeout(ANSWER_LIMIT).timeout(ANSWER_LIMIT).connect().await;
            let mut client = FlightSqlServiceClient::new(channel.expect("connected"));
            client.set_token(token.to_owned());
            client
        };
        let mut theirs = connect(&with, &with.all).await;
        let mut ours = connect(&with, &with.ours).await;
        let mut alone = connect(&without, &without.ours).await;
        for ProjectAttempt { sql, .. } in &statements {
            let [all, seen] = [flight_rows(&mut theirs, sql).await, flight_rows(&mut ours, sql).await];
            assert_ne!(all, seen, "whoever may see it sees it: {sql}");
            check_marks(&marks, sql, &seen);
            if is_repeatable(sql) {
                assert_eq!(seen, flight_rows(&mut alone, sql).await, "{sql}");
            }
        }
        // A ticket of somebody else is a statement, which runs for whoever shows it.
        let asked = "select surface_id from surfaces order by surface_id";
        let info = theirs.execute(asked.to_owned(), None).await.expect("planned");
        let ticket = info.endpoint.into_iter().find_map(|endpoint| endpoint.ticket).expect("a ticket");
        let batches = ours.do_get(ticket).await.expect("begun").try_collect::<Vec<_>>().await.expect("rows");
        let seen = column_texts(&batches).join("\n");
        assert_eq!(seen, flight_rows(&mut ours, asked).await);
        assert_ne!(seen, flight_rows(&mut theirs, asked).await);
    }

    #[test]
    fn files_with_rows_of_several_projects_show_those_that_may_be_seen() {
        let place = TestFolder::new();
        for surface in ["flat", "foam", "prd_older"] {
            place.acquire(surface, &["--ir-only"]);
        }
        // Nobody has a project yet, so these are merged.
        place.ok(&["ingest"]);
        place.ok(&["optimize"]);
        for (surface, project) in [("brick_ours", "ours"), ("wood_secret", "theirs")] {
            place.acquire(surface, &["--ir-only", "--project", project]);
            place.ok(&["ingest"]);
        }
        place.acquire("wood_waiting", &["--ir-only", "--project", "theirs"]);
        let scene = ProjectScene::serve(place);
        let (marks, hidden) = (scene.marks(), scene.hidden());
        for ProjectAttempt { sql, is_exact } in statements(&hidden, scene.version()) {
            let [all, seen] = [&scene.all, &scene.ours].map(|token| scene.sql(&sql, token));
            assert_ne!(all, seen, "whoever may see it sees it: {sql}");
            check_marks(&marks, &sql, &seen);
            assert!(!is_exact || seen.starts_with("200"), "{sql}: {seen}");
        }
        let counts = |token| scene.sql("select surface_id, count(*) as n from nce group by 1 order by 1", token);
        let ours = r#"[{"surface_id":"brick_ours","n":45},{"surface_id":"flat","n":45},{"surface_id":"foam","n":45}]"#;
        assert_eq!(counts(&scene.ours).trim(), format!("200 {ours}"));
        let merged = scene.place.sql("select path from system.files where path like '%merged%' and \"table\" = 'nce'");
        let name = merged[0]["path"].as_str().expect("a path").rsplit('/').next().expect("a name").to_owned();
        let path = format!("/api/v1/tables/nce/{name}");
        assert!(scene.get(&path, &scene.all).starts_with("200") && scene.get(&path, &scene.ours).starts_with("404"));
        let manifest = scene.get("/api/v1/files?table=nce", &scene.ours);
        assert!(manifest.contains(r#""rows_elsewhere":[{"table":"nce","rows":90}]"#), "{manifest}");
        let nce = "select sum(nce_2500[384]) as total from nce where surface_id = 'flat'";
        assert_eq!(scene.sql(nce, &scene.ours), scene.sql(nce, &scene.all));
    }

    #[test]
    fn a_token_that_is_given_other_projects_sees_those() {
        let [_, with] = with_and_without();
        let scene = ProjectScene::serve(with);
        let count = || scene.sql("select count(*) as n from runs", &scene.ours);
        assert_eq!(count().trim(), r#"200 [{"n":3}]"#);
        let path = scene.place.path("tokens.toml");
        let lines = std::fs::read_to_string(&path).expect("read");
        std::fs::write(&path, lines.replace(r#"projects = ["ours"]"#, r#"projects = ["ours", "theirs"]"#))
            .expect("written");
        wait_until("it sees both projects", || count().trim() == r#"200 [{"n":4}]"#);
        std::fs::write(&path, lines.replace(r#"projects = ["ours"]"#, r#"projects = ["others"]"#)).expect("written");
        wait_until("it sees the references alone", || count().trim() == r#"200 [{"n":2}]"#);
        let wrong = lines.replace(r#"projects = ["ours"]"#, "projects = []");
        std::fs::write(&path, wrong).expect("written");
        scene.place.fails(1, &["serve", "--tokens", "tokens.toml"], "projects of `ann` are none");
    }
}
