//! What users add crosses no project, empties no cache that it does not concern, and its faults stop only its readers.

use std::time::Duration;

use serde_json::json;

use super::super::catalogue::lake;
use super::super::http::{HttpRequest, HttpResponse};
use super::super::projects::new_token;
use super::super::server::ServedLake;
use super::super::{get, json, refused, served};
use super::{annotate, arrow_stream, find_run, predict};
use crate::{TestFolder, stderr};

/// A lake in which projects `alpha` and `beta` have a surface `brick_wall` each.
fn two_projects() -> TestFolder {
    let place = TestFolder::new();
    for surface in ["flat", "foam"] {
        place.acquire(surface, &["--ir-only"]);
    }
    place.acquire("brick_wall", &["--ir-only", "--project", "alpha"]);
    // The name of a run has its second, then a random tag: of two runs of one second, the tag would say which is newer.
    std::thread::sleep(Duration::from_secs(1));
    place.acquire("brick_wall", &["--ir-only", "--project", "beta"]);
    place.ok(&["ingest"]);
    place
}

fn send_prediction(server: &ServedLake, token: &str, model: &str, value: f64, more: &str) -> HttpResponse {
    let body = arrow_stream("brick_wall", &[("tnce_10000", vec![value])]);
    let request = HttpRequest::post_bytes(&format!("/api/v1/predictions?model={model}&version=1{more}"), body);
    let request = request.with("content-type", "application/vnd.apache.arrow.stream");
    request.with("authorization", &format!("Bearer {token}")).send(server)
}

/// E1: a prediction belongs to the project of the surface's runs that its author sees.
#[test]
fn predictions_of_one_project_are_nothing_to_another() {
    let place = two_projects();
    let new =
        |name: &str, project: &[&str]| new_token(&place, &[&[name, "--scopes", "sql,annotate"], project].concat());
    let (alpha, alpha_lines) = new("ann", &["--project", "alpha"]);
    let (beta, beta_lines) = new("bob", &["--project", "beta"]);
    let (all, all_lines) = new("eve", &[]);
    std::fs::write(place.path("tokens.toml"), alpha_lines + &beta_lines + &all_lines).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    assert_eq!(json(&send_prediction(&server, &alpha, "cnn", 0.25, ""))["is_new"], true);
    let stored = json(&send_prediction(&server, &beta, "cnn", 0.5, ""));
    assert_eq!((stored["is_new"].as_bool(), stored["lake_version"].is_null()), (Some(true), true), "{stored}");
    let sql = |token: &str, statement: &str| {
        let request = HttpRequest::post("/api/v1/sql", statement).with("content-type", "text/plain");
        request.with("authorization", &format!("Bearer {token}")).send(&server).text().trim_end().to_owned()
    };
    let rows = "select author, project, tnce_10000 as value from predictions order by project";
    assert_eq!(sql(&alpha, rows), r#"[{"author":"ann","project":"alpha","value":0.25}]"#);
    assert_eq!(sql(&beta, rows), r#"[{"author":"bob","project":"beta","value":0.5}]"#);
    let page = |token: &str| {
        let path = "/api/v1/surfaces/brick_wall/pairs/0/predictions";
        let answer = HttpRequest::get(path).with("authorization", &format!("Bearer {token}")).send(&server);
        let authors: Vec<_> =
            json(&answer).as_array().expect("a list").iter().map(|row| row["author"].clone()).collect();
        authors
    };
    assert_eq!((page(&alpha), page(&beta)), (vec![json!("ann")], vec![json!("bob")]));
    // Who sees both projects names one, and a page shows the predictions of the run that it shows.
    refused(&send_prediction(&server, &all, "rnn", 0.75, ""), 400, "request_invalid");
    refused(&send_prediction(&server, &all, "rnn", 0.75, "&project=gamma"), 400, "request_invalid");
    assert_eq!(json(&send_prediction(&server, &all, "rnn", 0.75, "&project=alpha"))["is_new"], true);
    assert_eq!(page(&all), [json!("bob")]);
    let count = |token: &str| sql(token, "select count(*) as n from predictions");
    assert_eq!([&all, &alpha, &beta].map(|token| count(token)), [r#"[{"n":3}]"#, r#"[{"n":2}]"#, r#"[{"n":1}]"#]);
    // A merged file has rows of one project.
    place.ok(&["optimize"]);
    assert_eq!([&all, &alpha, &beta].map(|token| count(token)), [r#"[{"n":3}]"#, r#"[{"n":2}]"#, r#"[{"n":1}]"#]);
}

/// E10: a note changes the answers that have it, and a verdict those that rest on it.
#[test]
fn a_note_empties_no_cache_of_other_answers() {
    let place = lake();
    let run = find_run(&place);
    let server = served(&place, &[]);
    let of_runs = ["/api/v1/surfaces", "/api/v1/surfaces/brick", "/api/v1/surfaces/brick/pairs/0"];
    let of_notes = [format!("/api/v1/runs/{run}/annotations"), "/api/v1/tables".to_owned()];
    let etag = |path: &str| get(&server, path).header("etag").expect("a tag").to_owned();
    let tags = || (of_runs.map(etag), [etag(&of_notes[0]), etag(&of_notes[1])]);
    let before = tags();
    let note = json!({ "run_id": run, "kind": "note", "comment": "seen" });
    assert_eq!(annotate(&server, &note).status, 200);
    let noted = tags();
    assert_eq!(noted.0, before.0);
    assert!(noted.1[0] != before.1[0] && noted.1[1] != before.1[1], "{noted:?}");
    let verdict = json!({ "run_id": run, "pair_ids": [1], "kind": "verdict", "value": "rejected", "comment": "bad" });
    assert_eq!(annotate(&server, &verdict).status, 200);
    let judged = tags();
    for (judged, noted) in judged.0.iter().zip(&noted.0) {
        assert_ne!(judged, noted);
    }
    assert_eq!(predict(&server, "1", "brick", &[("tnce_10000", vec![0.5])]).status, 200);
    assert_eq!(tags().0, judged.0);
}

/// E4, E5: a lost or damaged file of annotations or predictions stops what reads it, by its name; `doctor` names it.
#[test]
fn a_lost_file_of_annotations_stops_only_what_reads_it() {
    for (table, is_cut) in [("annotations", false), ("predictions", true)] {
        let place = lake();
        let run = find_run(&place);
        let server = served(&place, &[]);
        let verdict =
            json!({ "run_id": run, "pair_ids": [1], "kind": "verdict", "value": "rejected", "comment": "bad" });
        assert_eq!(annotate(&server, &verdict).status, 200);
        assert_eq!(predict(&server, "1", "brick", &[("tnce_10000", vec![0.5])]).status, 200);
        let folder = place.path(&format!("lake/tables/{table}"));
        let files = std::fs::read_dir(folder).expect("listed").map(|entry| entry.expect("an entry").path());
        let files: Vec<_> = files.filter(|path| path.extension().is_some_and(|e| e == "parquet")).collect();
        assert_eq!(files.len(), 1);
        let name = files[0].file_name().expect("a name").to_string_lossy().into_owned();
        let bytes = std::fs::read(&files[0]).expect("read");
        match is_cut {
            true => std::fs::write(&files[0], &bytes[..bytes.len() / 2]).expect("written"),
            false => std::fs::remove_file(&files[0]).expect("removed"),
        }
        drop(server);
        let server = served(&place, &[]);
        let sql = |statement: &str| {
            HttpRequest::post("/api/v1/sql", statement).with("content-type", "text/plain").send(&server)
        };
        for whole in ["points", "tnce", "runs"] {
            assert_eq!(sql(&format!("select count(*) from {whole}")).status, 200, "{table}: {whole}");
        }
        assert_eq!(get(&server, "/api/v1/runs").status, 200, "{table}");
        let resting: &[&str] = if is_cut { &[] } else { &["tnce_db", "levels", "catalogue", "ir"] };
        for view in resting.iter().chain(&[table]) {
            let answer = sql(&format!("select * from {view}"));
            assert!(answer.status >= 500 && answer.text().contains(&name), "{view}: {}", answer.text());
        }
        let note = annotate(&server, &json!({ "run_id": run, "kind": "note", "comment": "seen" }));
        assert_eq!(note.status == 200, is_cut, "{}", note.text());
        // The same again, which is compared with what is stored; a file that has no rows of a version is not read.
        let other = predict(&server, "1", "brick", &[("tnce_10000", vec![0.5])]);
        assert_eq!(other.status == 200, !is_cut, "{}", other.text());
        let doctor = place.run(&["doctor"]);
        assert_eq!(doctor.status.code(), Some(3), "{}", stderr(&doctor));
        let found = String::from_utf8_lossy(&doctor.stdout).into_owned() + &stderr(&doctor);
        assert!(found.contains(&name) && found.contains(&format!("echolake rebuild {table}")), "{found}");
        let given_up = place.run(&["rebuild", table]);
        assert_eq!(given_up.status.code(), Some(3), "{}", stderr(&given_up));
        assert!(stderr(&given_up).contains("gave up 1 rows"), "{}", stderr(&given_up));
        assert_eq!(place.run(&["doctor"]).status.code(), Some(0), "{table}");
        assert_eq!(sql("select count(*) from levels").status, 200);
    }
}
