//! Contributions of users: annotations, which views honour and `AS OF` sees as they were, and predictions.

mod rooms;

use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int32Array, RecordBatch, RunArray, StringArray};
use arrow::datatypes::Int32Type;
use arrow::ipc::writer::StreamWriter;
use echolake_schema::tables::{Source, Table};
use serde_json::json;

use super::catalogue::lake;
use super::http::{HttpRequest, HttpResponse};
use super::projects::new_token;
use super::server::ServedLake;
use super::{get, json, refused, served, wait_until};
use crate::TestFolder;
use crate::annotation_kills::AnnotationKillCampaign;
use crate::contribution_campaign::ContributionCampaign;

fn find_run(place: &TestFolder) -> String {
    let runs = place.sql("select run_id from runs where surface_id = 'brick'");
    runs[0]["run_id"].as_str().expect("a name").to_owned()
}

fn annotate(server: &ServedLake, annotation: &serde_json::Value) -> HttpResponse {
    let body = json!({ "annotations": [annotation] }).to_string();
    HttpRequest::post("/api/v1/annotations", &body).with("content-type", "application/json").send(server)
}

fn predict(server: &ServedLake, version: &str, surface: &str, columns: &[(&str, Vec<f64>)]) -> HttpResponse {
    let request = format!("/api/v1/predictions?model=cnn&version={version}");
    HttpRequest::post_bytes(&request, arrow_stream(surface, columns))
        .with("content-type", "application/vnd.apache.arrow.stream")
        .send(server)
}

fn arrow_stream(surface: &str, columns: &[(&str, Vec<f64>)]) -> Vec<u8> {
    let rows = columns[0].1.len();
    let surfaces: ArrayRef = Arc::new(StringArray::from(vec![surface; rows]));
    let pairs: ArrayRef = Arc::new(Int32Array::from_iter_values(0..rows as i32));
    let values = columns.iter().map(|(name, values)| (*name, Arc::new(Float64Array::from(values.clone())) as ArrayRef));
    let keys = [("surface_id", surfaces), ("pair_id", pairs)];
    encode_stream(&keys.into_iter().chain(values).collect::<Vec<_>>())
}

fn predictions(version: &str, columns: &[(&str, ArrayRef)]) -> HttpRequest {
    HttpRequest::post_bytes(&format!("/api/v1/predictions?model=cnn&version={version}"), encode_stream(columns))
        .with("content-type", "application/vnd.apache.arrow.stream")
}

fn encode_stream(columns: &[(&str, ArrayRef)]) -> Vec<u8> {
    let batch = RecordBatch::try_from_iter(columns.iter().map(|(name, array)| (*name, array.clone()))).expect("rows");
    let mut writer = StreamWriter::try_new(Vec::new(), &batch.schema()).expect("a stream");
    writer.write(&batch).expect("written");
    writer.finish().expect("ended");
    writer.into_inner().expect("bytes")
}

#[test]
fn views_leave_out_what_the_last_verdict_rejects_and_as_of_sees_it_as_it_was() {
    let place = lake();
    let run = find_run(&place);
    let server = served(&place, &[]);
    let count = |of: &str| place.number(&format!("select count(*) from {of} where surface_id = 'brick'"));
    let pairs = count("measurements");
    assert_eq!((count("annotations"), count("tnce_db"), count("ir")), (0.0, pairs, pairs));
    let bad = json!({
        "annotation_id": "bad-1", "run_id": run, "pair_ids": [1, 0, 1], "kind": "verdict", "value": "rejected",
        "comment": "the microphone was knocked",
    });
    let stored = json(&annotate(&server, &bad));
    let version = stored["lake_version"].as_u64().expect("a version");
    assert_eq!((stored["is_new"].as_bool(), &stored["annotation_ids"]), (Some(true), &json!(["bad-1"])));
    assert_eq!(json(&annotate(&server, &bad))["is_new"].as_bool(), Some(false), "sent again");
    let path = format!("/api/v1/runs/{run}/annotations");
    let shown = json(&get(&server, &path));
    assert_eq!((shown["rejected"].as_i64(), shown["total"].as_i64()), (Some(2), Some(1)), "{shown}");
    assert_eq!(json(&get(&server, &format!("{path}?pair=2")))["total"].as_i64(), Some(0));
    assert_eq!((count("tnce_db"), count("ir"), count("augmented")), (pairs - 2.0, pairs - 2.0, 8.0 * (pairs - 2.0)));
    assert_eq!((count("measurements"), count("tnce")), (pairs, pairs), "tables keep all");
    let kept = "select count(*) from measurements where surface_id = 'brick' and not is_rejected(run_id, pair_id)";
    assert_eq!(place.number(kept), pairs - 2.0);
    // The region of a microphone, accepted again: the last verdict counts.
    let good = json!({ "run_id": run, "microphones": [0], "kind": "verdict", "value": "accepted" });
    let accepted = json(&annotate(&server, &good))["lake_version"].as_u64().expect("a version");
    assert_eq!((accepted, count("tnce_db")), (version + 1, pairs));
    let whole = json!({ "run_id": run, "kind": "verdict", "value": "rejected", "comment": "the wrong panel" });
    assert_eq!(annotate(&server, &whole).status, 200);
    assert_eq!((count("tnce_db"), count("levels"), count("annotations")), (0.0, 0.0, 3.0));
    let as_of = |version: u64| count(&format!("tnce_db version as of {version}"));
    assert_eq!([version - 1, version, accepted].map(as_of), [pairs, pairs - 2.0, pairs]);
    assert_eq!(count(&format!("annotations version as of {version}")), 1.0);
    // What another annotation of this name says, and what is none, is refused; nothing of a request is stored then.
    let changed = json!({ "annotation_id": "bad-1", "run_id": run, "kind": "note", "comment": "other" });
    refused(&annotate(&server, &changed), 409, "taken");
    for wrong in [
        json!({ "run_id": "none", "kind": "note", "comment": "x" }),
        json!({ "run_id": run, "kind": "verdict", "value": "bad" }),
        json!({ "run_id": run, "pair_ids": [999_999], "kind": "note", "comment": "x" }),
        json!({ "run_id": run, "pair_ids": [1], "microphones": [0], "kind": "note", "comment": "x" }),
        json!({ "run_id": run, "kind": "label", "value": "x", "colour": "red" }),
    ] {
        refused(&annotate(&server, &wrong), 400, "request_invalid");
    }
    assert_eq!(count("annotations"), 3.0);
    drop(server);
    // The other tables can be deleted and made again; annotations stay.
    for table in Table::ALL.into_iter().filter(|table| table.source() != Source::Users) {
        std::fs::remove_dir_all(place.path(&format!("lake/tables/{}", table.name()))).expect("removed");
    }
    place.ok(&["ingest"]);
    assert_eq!((count("annotations"), count("tnce_db"), count("tnce")), (3.0, 0.0, pairs));
    place.ok(&["rebuild"]);
    assert_eq!((count("annotations"), count("tnce_db"), count("tnce")), (3.0, 0.0, pairs));
}

#[test]
fn predictions_of_a_model_stand_beside_the_measurements() {
    let place = lake();
    let server = served(&place, &[]);
    let measured: Vec<f64> = place
        .sql("select tnce_10000 as e from tnce where surface_id = 'brick' and pair_id < 2 order by pair_id")
        .iter()
        .map(|row| row["e"].as_f64().expect("a number"))
        .collect();
    // 3 dB too much, and 1 dB too little.
    let values = vec![measured[0] * 10f64.powf(0.3), measured[1] * 10f64.powf(-0.1)];
    let predicted = [("tnce_10000", values)];
    let stored = json(&predict(&server, "1", "brick", &predicted));
    assert_eq!(stored["is_new"].as_bool(), Some(true), "{stored}");
    assert_eq!(json(&predict(&server, "1", "brick", &predicted))["is_new"].as_bool(), Some(false), "sent again");
    let errors = json(&get(&server, "/api/v1/surfaces/brick/predictions"));
    let rms = errors[0]["rms_db"][2].as_f64().expect("an error");
    assert!((rms - 5f64.sqrt()).abs() < 1e-6 && errors[0]["pairs"] == 2, "{errors}");
    let pair = json(&get(&server, "/api/v1/surfaces/brick/pairs/1/predictions"));
    let level = pair[0]["tnce_db"][2].as_f64().expect("a level");
    assert!((level - (10.0 * measured[1].log10() - 1.0)).abs() < 1e-6, "{pair}");
    let rows = place.sql("select model, model_version, tnce_2500, author from predictions where pair_id = 0");
    assert_eq!(rows.len(), 1, "{rows:?}");
    assert_eq!((rows[0]["model"].as_str(), rows[0]["model_version"].as_str()), (Some("cnn"), Some("1")));
    assert!(rows[0]["tnce_2500"].is_null() && rows[0]["author"] == "programs");
    refused(&predict(&server, "1", "brick", &[("tnce_10000", vec![0.5])]), 409, "taken");
    for (surface, columns) in [
        ("none", ("tnce_10000", vec![0.5])),
        ("brick", ("tnce_db", vec![0.5])),
        ("brick", ("tnce_10000", vec![-3.0])),
        ("brick", ("tnce_10000", vec![f64::NAN])),
        ("brick", ("tnce_10000", vec![0.5; 5_000])),
    ] {
        refused(&predict(&server, "2", surface, &[columns]), 400, "request_invalid");
    }
    let text = HttpRequest::post("/api/v1/predictions?model=cnn&version=2", "no stream").send(&server);
    refused(&text, 400, "request_invalid");
    assert_eq!(place.number("select count(*) from predictions"), 2.0);
}

/// E9: rows that are sent again in another grouping are stored once, and others beside them are added.
#[test]
fn predictions_that_are_sent_again_are_stored_once() {
    let place = lake();
    let server = served(&place, &[]);
    let send = |rows: &[(&str, i32, f64)]| {
        let surfaces: ArrayRef = Arc::new(StringArray::from_iter_values(rows.iter().map(|row| row.0)));
        let pairs: ArrayRef = Arc::new(Int32Array::from_iter_values(rows.iter().map(|row| row.1)));
        let values: ArrayRef = Arc::new(Float64Array::from_iter_values(rows.iter().map(|row| row.2)));
        predictions("1", &[("surface_id", surfaces), ("pair_id", pairs), ("tnce_10000", values)]).send(&server)
    };
    let is_new = |rows: &[(&str, i32, f64)]| json(&send(rows))["is_new"].as_bool();
    let [flat, foam, brick] = [("flat", 0, 0.5), ("foam", 0, 0.25), ("brick", 0, 0.125)];
    assert_eq!(is_new(&[flat, foam]), Some(true));
    assert_eq!([is_new(&[flat]), is_new(&[foam, flat]), is_new(&[foam])], [Some(false); 3]);
    assert_eq!(is_new(&[brick, flat]), Some(true), "brick is");
    assert_eq!(is_new(&[("flat", 1, 0.5), brick]), Some(true), "another pair is");
    refused(&send(&[("brick", 1, 0.5), ("flat", 0, 0.75)]), 409, "taken");
    let stored = place.sql("select surface_id, pair_id, tnce_10000 as e from predictions order by 1, 2");
    let stored: Vec<_> =
        stored.iter().map(|row| (row["surface_id"].as_str(), row["pair_id"].as_i64(), row["e"].as_f64())).collect();
    let expected = [brick, flat, ("flat", 1, 0.5), foam];
    assert_eq!(stored, expected.map(|(surface, pair, e)| (Some(surface), Some(i64::from(pair)), Some(e))));
}

/// E3: what is sent has the limits of its token's queries, and is listed among them.
#[test]
fn what_is_sent_has_the_ticket_of_a_query() {
    let place = lake();
    let limited = |name: &str, limit: &str| {
        let (token, lines) = new_token(&place, &[name, "--scopes", "sql,annotate"]);
        let named = lines.split("seconds").next().expect("who it is");
        (token, format!("{named}{limit}\n"))
    };
    let (few, few_lines) = limited("ann", "rows = 3");
    let (small, small_lines) = limited("bob", "memory_mb = 50");
    std::fs::write(place.path("tokens.toml"), few_lines + &small_lines).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let send_as =
        |token: &str, request: HttpRequest| request.with("authorization", &format!("Bearer {token}")).send(&server);
    let send = |request: HttpRequest| send_as(&few, request);
    let rows = |surface: &str, count: usize| {
        let surfaces: ArrayRef = Arc::new(StringArray::from(vec![surface; count]));
        let pairs: ArrayRef = Arc::new(Int32Array::from_iter_values(0..count as i32));
        let values: ArrayRef = Arc::new(Float64Array::from(vec![0.5; count]));
        predictions("1", &[("surface_id", surfaces), ("pair_id", pairs), ("tnce_10000", values)])
    };
    assert_eq!(send(rows("brick", 3)).status, 200);
    let many = send(rows("brick", 4));
    refused(&many, 413, "request_too_large");
    assert!(many.text().contains("more than 3 rows"), "{}", many.text());
    assert_eq!(send_as(&small, rows("foam", 3)).status, 200);
    refused(&send_as(&small, rows(&"x".repeat(800_000), 1)), 507, "memory_limit");
    // 1.9 GB in a kilobyte, if it were decoded.
    let ends = Int32Array::from(vec![i32::MAX]);
    let runs = RunArray::<Int32Type>::try_new(&ends, &StringArray::from(vec!["brick"])).expect("runs");
    let runs = send(predictions("1", &[("surface_id", Arc::new(runs))]));
    refused(&runs, 400, "request_invalid");
    assert!(runs.text().contains("`surface_id` is RunEndEncoded, expected string"), "{}", runs.text());
    let note = json!({ "run_id": find_run(&place), "kind": "note", "comment": "x" });
    let notes = |count: usize| {
        let body = json!({ "annotations": vec![&note; count] }).to_string();
        HttpRequest::post("/api/v1/annotations", &body).with("content-type", "application/json")
    };
    assert_eq!(send(notes(3)).status, 200);
    refused(&send(notes(4)), 413, "request_too_large");
    for (outcome, count) in [("answered", 2), ("request_invalid", 1), ("request_too_large", 2)] {
        let listed = format!(
            "select count(*) as n from system.queries where statement like '%are sent)' and outcome = '{outcome}'"
        );
        let listed = || send(HttpRequest::post("/api/v1/sql", &listed).with("content-type", "text/plain"));
        wait_until("they are listed", || json(&listed())[0]["n"].as_i64() == Some(count));
    }
}

/// E8: regions whose pairs are more than their request's bytes are stored.
#[test]
fn many_regions_of_a_request_are_stored() {
    let place = lake();
    let run = find_run(&place);
    let server = served(&place, &[]);
    let region = json!({ "run_id": run, "kind": "note", "comment": "seen", "microphones": [0, 1, 2, 3, 4, 5] });
    let body = json!({ "annotations": vec![region; 600] }).to_string();
    let sent = HttpRequest::post("/api/v1/annotations", &body).with("content-type", "application/json").send(&server);
    assert_eq!(json(&sent)["annotation_ids"].as_array().map(Vec::len), Some(600));
    assert_eq!(place.number("select count(*) from annotations"), 600.0);
}

#[test]
fn adding_needs_its_scope() {
    let place = lake();
    let run = find_run(&place);
    let (reader, reader_lines) = new_token(&place, &["ann"]);
    let (author, author_lines) = new_token(&place, &["bob", "--scopes", "sql,annotate"]);
    std::fs::write(place.path("tokens.toml"), reader_lines + &author_lines).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let note = json!({ "run_id": run, "kind": "note", "comment": "seen" });
    let send = |token: &str, body: serde_json::Value| {
        let request = HttpRequest::post("/api/v1/annotations", &body.to_string());
        let request = request.with("content-type", "application/json");
        request.with("authorization", &format!("Bearer {token}")).send(&server)
    };
    refused(&send("echolake_none", json!({ "annotations": [note] })), 401, "unauthenticated");
    refused(&send(&reader, json!({ "annotations": [note] })), 403, "forbidden");
    refused(&send(&author, json!({ "annotations": [note], "author": "ann" })), 400, "request_invalid");
    assert_eq!(send(&author, json!({ "annotations": [note] })).status, 200);
    let rows = place.sql("select author, comment from annotations");
    assert_eq!((rows.len(), rows[0]["author"].as_str()), (1, Some("bob")), "{rows:?}");
}

/// E2: a verdict on a run of Flat, on which all levels rest, needs a right of its own and a confirmation, and what it
/// changes is told before. E13: pages say that levels do not follow it yet, until an ingest, which tells what it does.
#[test]
fn a_verdict_on_a_reference_needs_its_right_and_a_confirmation() {
    let place = lake();
    let runs = place.sql("select run_id from runs where surface_id = 'flat'");
    let flat = runs[0]["run_id"].as_str().expect("a name").to_owned();
    let (author, author_lines) = new_token(&place, &["bob", "--scopes", "sql,annotate"]);
    let (judge, judge_lines) = new_token(&place, &["eve", "--scopes", "sql,metrics,annotate,annotate-references"]);
    std::fs::write(place.path("tokens.toml"), author_lines + &judge_lines).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let send = |server: &ServedLake, token: Option<&str>, annotation: &serde_json::Value, is_confirmed: bool| {
        let body = json!({ "annotations": [annotation], "confirm_rederivation": is_confirmed }).to_string();
        let request = HttpRequest::post("/api/v1/annotations", &body).with("content-type", "application/json");
        let authorization = token.map(|token| format!("Bearer {token}"));
        authorization.iter().fold(request, |request, value| request.with("authorization", value)).send(server)
    };
    let bad = json!({ "run_id": flat, "pair_ids": [7], "kind": "verdict", "value": "rejected", "comment": "knocked" });
    let label = json!({ "run_id": flat, "kind": "label", "value": "odd" });
    let of_brick = json!({ "run_id": find_run(&place), "kind": "verdict", "value": "accepted" });
    for is_confirmed in [false, true] {
        refused(&send(&server, Some(&author), &bad, is_confirmed), 403, "forbidden");
    }
    let failures = |code: &str| {
        let metrics = HttpRequest::get("/metrics").with("authorization", &format!("Bearer {judge}")).send(&server);
        let start = format!("echolake_failures_total{{code=\"{code}\"}} ");
        metrics.text().lines().find_map(|line| line.strip_prefix(start.as_str()).map(str::to_owned))
    };
    // Counted after them.
    let of_none = json!({ "run_id": "none", "kind": "note", "comment": "seen" });
    refused(&send(&server, Some(&author), &of_none, false), 400, "request_invalid");
    wait_until("failures are counted", || failures("request_invalid").as_deref() == Some("1"));
    assert_eq!(failures("forbidden").as_deref(), Some("2"), "each once");
    assert_eq!([&label, &of_brick].map(|other| send(&server, Some(&author), other, false).status), [200, 200]);
    let told = |answer: &HttpResponse| {
        refused(answer, 409, "unconfirmed");
        let tables = ["nce", "tnce", "tnce_d4", "surface_stats"];
        let rows: f64 = tables.map(|table| place.number(&format!("select count(*) from {table}"))).iter().sum();
        let detail = json(answer)["detail"].as_str().expect("a text").to_owned();
        assert!(detail.contains(&format!("derives {rows} rows of 3 surfaces again")), "{detail}");
    };
    told(&send(&server, Some(&judge), &bad, false));
    assert_eq!(place.number("select count(*) from annotations"), 2.0, "nothing is stored");
    drop(server);
    // Without tokens, the owner confirms, too.
    let server = served(&place, &[]);
    told(&send(&server, None, &bad, false));
    assert_eq!(send(&server, None, &bad, true).status, 200);
    let unfollowed = || {
        let surface = json(&get(&server, "/api/v1/surfaces/brick"));
        let measured = surface["statistics"][0]["measurements"].as_i64().expect("a number");
        let lake = json(&get(&server, "/api/v1/lake"));
        (surface["unfollowed_runs"].clone(), lake["unfollowed_runs"].as_u64().expect("a number"), measured)
    };
    let (runs, of_lake, before) = unfollowed();
    assert_eq!((runs, of_lake), (json!([flat]), 1));
    let ingested = place.run(&["ingest"]);
    let printed = crate::stderr(&ingested);
    assert!(printed.contains("verdicts: 3 surfaces with"), "{printed}");
    assert_eq!(unfollowed(), (json!([]), 0, before - 1), "Flat lacks a pair");
    assert!(!crate::stderr(&place.run(&["ingest"])).contains("verdicts:"), "once");
}

#[test]
fn acknowledged_annotations_are_stored_once() {
    let mut campaign = AnnotationKillCampaign::new(Path::new(crate::ECHOLAKE), 7);
    let counts = campaign.kills(8, &mut |_| {});
    assert!(counts.killed == 8 && counts.acknowledged > 8, "{counts:?}");
}

/// E1, E4, E5: users of two projects, two servers, kills and faults, in random sequences.
#[test]
fn nothing_crosses_projects_or_is_lost_and_faults_stop_only_their_readers() {
    let mut campaign = ContributionCampaign::new(Path::new(crate::ECHOLAKE), 2);
    let counts = campaign.sequences(2, &mut |_| {});
    assert!(counts.sequences == 2 && counts.refused >= 8 && counts.unanswered == 2, "{counts:?}");
}
