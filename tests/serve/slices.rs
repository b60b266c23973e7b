//! Slices over HTTP as viewers, loaders and hostile clients ask for them, Foxglove's manifest, and the lake's files as
//! URLs.

use std::collections::BTreeSet;
use std::io::Read as _;

use serde_json::Value;

use super::http::HttpRequest;
use super::{ENDLESS, get, json, refused, running, running_of, served, wait_until};
use crate::{TestFolder, TestFolderTemplate};

/// Sweeps of two seconds: 45 of them are more than sockets hold.
const LONG_SWEEPS: &str = "duration_secs = 2.0";

/// One run with sweeps, one without.
fn lake() -> TestFolder {
    static TWO_RUNS: TestFolderTemplate = TestFolderTemplate::new();
    TWO_RUNS.place(|place| {
        place.acquire("flat", &[]);
        place.acquire("brick", &["--ir-only"]);
        place.ok(&["ingest"]);
    })
}

/// The path of a slice.
pub(super) fn slice(predicate: &str, more: &str) -> String {
    format!("/api/v1/slices.mcap?where={}{more}", encoded(predicate))
}

pub(super) fn encoded(text: &str) -> String {
    let one = |b: u8| if b.is_ascii_alphanumeric() { (b as char).to_string() } else { format!("%{b:02x}") };
    text.bytes().map(one).collect()
}

fn run_of(place: &TestFolder, surface: &str) -> String {
    let rows = place.sql(&format!("select run_id from runs where surface_id = '{surface}'"));
    rows[0]["run_id"].as_str().expect("a run").to_owned()
}

/// Topic and time of all messages, in the file's order; every CRC of it is checked.
fn messages(file: &[u8]) -> Vec<(String, u64)> {
    let options = mcap::sans_io::LinearReaderOptions::default()
        .with_validate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true);
    let mut reader = mcap::sans_io::LinearReader::new_with_options(options);
    let mut rest = file;
    while let Some(event) = reader.next_event() {
        if let mcap::sans_io::LinearReadEvent::ReadRequest(wanted) = event.expect("sound") {
            let (part, behind) = rest.split_at(wanted.min(rest.len()));
            reader.insert(part.len()).copy_from_slice(part);
            reader.notify_read(part.len());
            rest = behind;
        }
    }
    let stream = mcap::MessageStream::new(file).expect("an MCAP file");
    stream.map(|m| m.expect("whole")).map(|m| (m.channel.topic.clone(), m.log_time)).collect()
}

fn count(messages: &[(String, u64)], topic: &str) -> usize {
    messages.iter().filter(|(of, _)| of == topic).count()
}

#[test]
fn a_slice_streams_and_is_what_the_command_exports() {
    let place = lake();
    let server = served(&place, &[]);
    let predicate = "pair_id % 9 = 4 and surface_id in (select surface_id from surfaces)";
    let answer = get(&server, &slice(predicate, ""));
    assert_eq!((answer.status, answer.is_whole), (200, true), "{:?}", String::from_utf8_lossy(&answer.body));
    assert_eq!(answer.header("transfer-encoding"), Some("chunked"), "it is sent while it is cut");
    assert_eq!(answer.header("accept-ranges"), Some("bytes"));
    let found = messages(&answer.body);
    assert_eq!((count(&found, "/ir"), count(&found, "/sweep"), count(&found, "/panel/scene")), (10, 5, 2));
    place.ok(&["export", "mcap", "--where", predicate, "-o", "some.mcap"]);
    assert!(std::fs::read(place.path("some.mcap")).expect("a file") == answer.body, "the same bytes");
    let poses = get(&server, &slice("surface_id = 'flat'", "&topics=/microphone/pose,/speaker/pose&layout=in-time"));
    let found = messages(&poses.body);
    assert_eq!((count(&found, "/microphone/pose"), count(&found, "/speaker/pose"), found.len()), (45, 45, 90));
    assert!(found.is_sorted_by_key(|(_, time)| *time));
    let all = get(&server, &slice("surface_id = 'flat'", ""));
    assert!(poses.body.len() * 10 < all.body.len(), "{} of {}", poses.body.len(), all.body.len());
}

#[test]
fn what_cannot_be_cut_has_a_code() {
    let place = lake();
    let server = served(&place, &[]);
    for (path, status, code) in [
        (slice("pair_id > 1000000", ""), 404, "no_data"),
        (slice("this is no SQL", ""), 400, "query_invalid"),
        (slice("true) or (true", ""), 400, "query_invalid"),
        (slice("true; drop table runs", ""), 400, "query_invalid"),
        (slice("no_such_column = 1", ""), 400, "query_invalid"),
        (slice("pair_id in (select x from nothing)", ""), 400, "query_invalid"),
        (slice("1 / (pair_id - 5) = 7", ""), 422, "query_failed"),
        (slice("true", "&topics=/nope"), 400, "request_invalid"),
        (slice("true", "&layout=heap"), 400, "request_invalid"),
        (slice("true", "&topic=/ir"), 400, "request_invalid"),
        (slice("true", "&run=none"), 404, "not_found"),
        (slice("true", "&run=..%2f..%2fetc"), 404, "not_found"),
        (slice("true", "&id=other"), 410, "gone"),
        ("/api/v1/slices.mcap".to_owned(), 400, "request_invalid"),
        ("/api/v1/foxglove/manifest".to_owned(), 400, "request_invalid"),
        ("/api/v1/foxglove/manifest?where=true&topics=/nope".to_owned(), 400, "request_invalid"),
        ("/api/v1/files?table=none".to_owned(), 404, "not_found"),
    ] {
        let answer = get(&server, &path);
        refused(&answer, status, code);
        let ranged = HttpRequest::get(&path).with("range", "bytes=0-9").send(&server);
        refused(&ranged, status, code);
    }
    refused(&HttpRequest::post(&slice("true", ""), "").send(&server), 405, "method_not_allowed");
}

#[test]
fn slices_need_a_token_for_sql_and_files() {
    let place = lake();
    let mut lines = String::new();
    let mut token = |name: &str, change: &dyn Fn(String) -> String| {
        let made = place.run(&["token", name]);
        lines += &change(String::from_utf8_lossy(&made.stdout).into_owned());
        format!("Bearer {}", crate::stderr(&made).lines().next().expect("a token"))
    };
    let scopes = "scopes = [\"sql\", \"files\"]";
    let both = token("both", &|lines| lines);
    let sql = token("sql", &|lines| lines.replace(scopes, "scopes = [\"sql\"]"));
    let files = token("files", &|lines| lines.replace(scopes, "scopes = [\"files\"]"));
    let few = token("few", &|lines| lines.replace("rows = 10_000_000", "rows = 10"));
    std::fs::write(place.path("tokens.toml"), lines).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let path = slice("surface_id = 'flat'", "");
    let ask = |token: &str, path: &str| HttpRequest::get(path).with("authorization", token).send(&server);
    for path in [&path, "/api/v1/foxglove/manifest?where=surface_id='flat'", "/api/v1/files"] {
        refused(&get(&server, path), 401, "unauthenticated");
        assert_eq!(ask(&both, path).status, 200, "{path}");
        refused(&ask(&sql, path), 403, "forbidden");
    }
    refused(&ask(&files, &path), 403, "forbidden");
    refused(&ask(&few, &path), 422, "row_limit");
    assert_eq!(ask(&few, &slice("surface_id = 'flat' and pair_id < 10", "")).status, 200);
    // With a token, a page of another origin may request all that its token allows; with a cookie it may not.
    let elsewhere = HttpRequest::get(&path).with("origin", "https://viewer.example").with("authorization", &both);
    assert_eq!(elsewhere.send(&server).status, 200);
    let body = serde_json::json!({ "token": both.trim_start_matches("Bearer ") }).to_string();
    let begun = HttpRequest::post("/api/v1/session", &body).with("content-type", "application/json").send(&server);
    let cookie = begun.header("set-cookie").and_then(|c| c.split(';').next()).expect("a cookie").to_owned();
    let signed_in = |path: &str| HttpRequest::get(path).with("cookie", &cookie);
    assert_eq!(signed_in(&path).send(&server).status, 200);
    assert_eq!(signed_in(&path).with("origin", "https://viewer.example").send(&server).status, 403);
    // What the pages show needs nothing more than a fresh token.
    let run = run_of(&place, "brick");
    for path in ["/api/v1/surfaces/brick/mesh.glb", &format!("/api/v1/runs/{run}/file.mcap")] {
        assert_eq!(signed_in(path).send(&server).status, 200, "{path}");
    }
}

mod slow {
    use super::*;

    #[test]
    fn a_slice_ends_with_its_reader() {
        let place = TestFolder::new();
        let rig = crate::SMALL_RIG.replace("duration_secs = 0.03", LONG_SWEEPS);
        std::fs::write(place.path("rig.toml"), rig).expect("written");
        let run = place.acquire("flat", &[]);
        let bytes = std::fs::metadata(&run).expect("a run").len();
        assert!(bytes > 20_000_000, "{bytes} bytes are more than sockets hold");
        place.ok(&["ingest"]);
        let made = place.run(&["token", "one"]);
        let token = crate::stderr(&made).lines().next().expect("a token").to_owned();
        let lines = String::from_utf8_lossy(&made.stdout).replace("concurrent = 4", "concurrent = 1");
        let lines = lines.replace("\"files\"]", "\"files\", \"metrics\"]");
        std::fs::write(place.path("tokens.toml"), lines).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml"]);
        let bearer = format!("Bearer {token}");
        let ask = |path: &str| HttpRequest::get(path).with("authorization", &bearer);
        let running = || running_of(&ask("/metrics").send(&server));
        let mut unread = ask(&slice("true", "")).begin(&server);
        let mut start = [0; 12];
        unread.read_exact(&mut start).expect("a status");
        assert_eq!(&start, b"HTTP/1.1 200");
        wait_until("it waits for its reader", || running() == 1.0);
        let pause = std::time::Duration::from_millis(500);
        std::thread::sleep(pause);
        let before = server.resident_kib();
        std::thread::sleep(pause);
        assert!(running() == 1.0 && server.resident_kib() < before + 20_000, "what waits does not grow");
        refused(&ask(&slice("pair_id = 1", "")).send(&server), 429, "too_many");
        drop(unread);
        wait_until("it ends with its reader", || running() == 0.0);
        let mut predicate = ask(&slice(&format!("({ENDLESS}) = pair_id"), "")).begin(&server);
        wait_until("the predicate's query runs", || running() == 1.0);
        let _ = predicate.set_nonblocking(true);
        assert!(predicate.read(&mut start).is_err(), "it is not answered yet");
        drop(predicate);
        wait_until("it ends too", || running() == 0.0);
        // Its place is free when its operators are gone, which is after its end is counted.
        wait_until("its place is free", || ask(&slice("pair_id = 1", "")).send(&server).status == 200);
    }

    #[test]
    fn a_page_of_elsewhere_asks_of_runs_that_it_knows_alone() {
        let place = lake();
        let server = served(&place, &[]);
        let run = run_of(&place, "brick");
        let foreign = |path: &str| HttpRequest::get(path).with("origin", "https://evil.example").send(&server);
        refused(&foreign(&slice("true", "")), 403, "foreign_origin");
        refused(&foreign("/api/v1/foxglove/manifest?where=true"), 403, "foreign_origin");
        refused(&HttpRequest::get(&slice("true", "")).host("evil.example").send(&server), 403, "foreign_origin");
        refused(&foreign(&slice("cast(run_id as int) = 1", "&run=guessed")), 404, "not_found");
        let of_the_run = format!("&run={run}");
        for asking in [
            "pair_id in (select pair_id from tnce)",
            "exists (select * from runs)",
            "abs(pair_id) = 1",
            "pair_id + 1 = 2",
            "cardinality(array_repeat(make_array(range(0, 30000000)), 3000000)) > pair_id",
            &format!("{}!{}", "position(".repeat(22), " in 'x')".repeat(22)),
            &format!("cast(null as int{}) is null", "[]".repeat(8_000)),
            &format!("pair_id in ({}1)", "1,".repeat(1_500)),
        ] {
            refused(&foreign(&slice(asking, &of_the_run)), 400, "query_invalid");
            let manifest = format!("/api/v1/foxglove/manifest?where={}{of_the_run}", encoded(asking));
            refused(&foreign(&manifest), 400, "query_invalid");
        }
        let manifest = "/api/v1/foxglove/manifest?where=not%20pair_id%20between%205%20and%2099";
        assert_eq!(foreign(&format!("{manifest}{of_the_run}")).status, 200);
        let own = foreign(&slice("pair_id = 1 or surface_id = 'flat'", &of_the_run));
        assert_eq!((own.status, count(&messages(&own.body), "/ir")), (200, 1), "none of a run that it does not name");
    }

    // As Lichtblick does: a plain GET whose headers are read and which is then broken off, then ranges.
    #[test]
    fn a_viewer_of_elsewhere_reads_a_slice_by_ranges() {
        let place = lake();
        let server = served(&place, &[]);
        let run = run_of(&place, "flat");
        let path = slice("pair_id < 20", &format!("&run={run}"));
        let foreign =
            || HttpRequest::get(&path).with("origin", "https://viewer.example").with("sec-fetch-site", "cross-site");
        let mut first = foreign().begin(&server);
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            first.read_exact(&mut byte).expect("headers");
            head.push(byte[0]);
        }
        drop(first);
        let head = String::from_utf8(head).expect("text").to_ascii_lowercase();
        let value = |name: &str| {
            let line = head.lines().find_map(|l| l.strip_prefix(&format!("{name}: ")));
            line.unwrap_or_else(|| panic!("no {name} in {head}")).to_owned()
        };
        assert!(head.starts_with("http/1.1 200"), "{head}");
        assert_eq!((value("accept-ranges").as_str(), value("access-control-allow-origin").as_str()), ("bytes", "*"));
        assert_eq!(value("cross-origin-resource-policy"), "cross-origin");
        for name in ["accept-ranges", "content-length", "content-range", "etag"] {
            assert!(value("access-control-expose-headers").contains(name), "{name}");
        }
        let (length, tag) = (value("content-length").parse::<usize>().expect("a length"), value("etag"));
        // It begins with the end, which holds the index.
        let (mut file, block) = (vec![0; length], 100_000);
        let mut starts: Vec<_> = (0..length).step_by(block).collect();
        starts.reverse();
        for start in starts {
            let end = (start + block).min(length);
            let part = foreign().with("range", &format!("bytes={start}-{}", end - 1)).send(&server);
            assert_eq!((part.status, part.header("etag")), (206, Some(tag.as_str())));
            assert_eq!(part.header("content-range"), Some(&*format!("bytes {start}-{}/{length}", end - 1)));
            file[start..end].copy_from_slice(&part.body);
        }
        assert_eq!(count(&messages(&file), "/sweep"), 20);
        let streamed = get(&server, &path);
        assert!(streamed.body == file && streamed.header("etag") == Some(tag.as_str()), "the same, however it is read");
        let headed = HttpRequest::head(&path).send(&server);
        assert_eq!((headed.status, headed.header("content-length")), (200, Some(&*length.to_string())));
        assert_eq!(foreign().with("if-none-match", &tag).send(&server).status, 304);
        let ranged = |known: &str| foreign().with("range", "bytes=0-7").with("if-range", known).send(&server).status;
        assert_eq!((ranged(&tag), ranged("\"other\"")), (206, 200));
        refused(&foreign().with("range", &format!("bytes={length}-")).send(&server), 416, "range_not_satisfiable");
        // What others add to the lake changes nothing of it.
        place.acquire("wavy", &["--ir-only"]);
        place.ok(&["ingest"]);
        assert_eq!(foreign().with("if-none-match", &tag).send(&server).status, 304);
        let asked = HttpRequest::options(&path)
            .with("origin", "https://viewer.example")
            .with("access-control-request-method", "GET")
            .with("access-control-request-headers", "range,authorization")
            .with("access-control-request-private-network", "true")
            .send(&server);
        assert_eq!((asked.status, asked.header("access-control-allow-private-network")), (200, Some("true")));
    }

    #[test]
    fn the_lakes_files_are_urls_that_outlive_what_replaces_them() {
        let place = lake();
        let server = served(&place, &[]);
        let list = |query: &str| json(&get(&server, &format!("/api/v1/files{query}")));
        let before = list("?table=measurements&table=environment");
        let files = before["files"].as_array().expect("files").clone();
        let tables: BTreeSet<_> = files.iter().filter_map(|f| f["table"].as_str()).collect();
        assert_eq!(tables, BTreeSet::from(["environment", "measurements"]));
        assert!(list("")["files"].as_array().expect("files").len() > files.len());
        let base = format!("http://{}", server.http);
        let path =
            |file: &Value| file["url"].as_str().expect("a URL").strip_prefix(&base).expect("of this server").to_owned();
        let mut rows = 0;
        for file in &files {
            let whole = get(&server, &path(file));
            assert_eq!((whole.status, whole.body.len() as u64), (200, file["bytes"].as_u64().expect("bytes")));
            let end = HttpRequest::get(&path(file)).with("range", "bytes=-4").send(&server);
            assert_eq!((end.status, &end.body[..]), (206, &b"PAR1"[..]));
            let headed = HttpRequest::head(&path(file)).send(&server);
            assert_eq!(headed.header("content-length"), Some(&*whole.body.len().to_string()));
            assert_eq!(file["superseded_rows"], 0);
            rows += if file["table"] == "measurements" { file["rows"].as_u64().expect("rows") } else { 0 };
        }
        assert_eq!(rows, 90);
        place.ok(&["optimize"]);
        place.acquire("wavy", &["--ir-only"]);
        place.ok(&["ingest"]);
        let after = list("?table=measurements");
        assert_ne!(after["version"], before["version"]);
        let replaced: Vec<_> = files.iter().filter(|f| f["table"] == "measurements").collect();
        let urls: Vec<_> = after["files"].as_array().expect("files").iter().map(|f| &f["url"]).collect();
        assert!(replaced.iter().all(|file| !urls.contains(&&file["url"])), "they were merged: {urls:?}");
        for file in &replaced {
            assert_eq!(get(&server, &path(file)).status, 200, "who reads by the old list goes on");
            std::fs::remove_file(place.path(&format!("lake/{}", path(file).trim_start_matches("/api/v1/"))))
                .expect("vacuumed");
            refused(&get(&server, &path(file)), 410, "gone");
        }
        refused(&get(&server, "/api/v1/tables/measurements/none.parquet"), 404, "not_found");
        let foreign = HttpRequest::get("/api/v1/files").with("origin", "https://evil.example").send(&server);
        refused(&foreign, 403, "foreign_origin");
        assert_eq!(running(&server), 0.0);
    }

    #[test]
    fn the_manifest_says_what_comes() {
        let place = lake();
        let server = served(&place, &[]);
        let (flat, brick) = (run_of(&place, "flat"), run_of(&place, "brick"));
        let whole = json(&get(&server, &format!("/api/v1/foxglove/manifest?run={flat}&run={brick}")));
        let sources = whole["sources"].as_array().expect("sources");
        assert_eq!(sources.len(), 2);
        for source in sources {
            assert_eq!(source["supportsRangeRequests"], true);
            assert_eq!(source.as_object().expect("a source").len(), 2, "no other kind's fields: {source}");
            let file = get(&server, source["url"].as_str().expect("a path"));
            assert!(file.status == 200 && file.body.starts_with(b"\x89MCAP0\r\n"));
        }
        let path =
            "/api/v1/foxglove/manifest?where=pair_id%20%3c%207%20or%20attempt%20%3e%2099%20or%20surface_id=%27wavy%27";
        let topics = "&topics=/ir,/environment,/log,/panel/scene";
        let asked = || json(&get(&server, &format!("{path}{topics}")));
        let manifest = asked();
        let text = |value: &Value| value.as_str().unwrap_or_else(|| panic!("{value}")).to_owned();
        let ids = |manifest: &Value| -> Vec<_> {
            manifest["sources"].as_array().expect("sources").iter().map(|s| text(&s["id"])).collect()
        };
        assert_eq!(ids(&manifest).len(), 2, "a source a run");
        let source = &manifest["sources"][0];
        let data = get(&server, &text(&source["url"]));
        assert_eq!((data.status, data.is_whole), (200, true), "{source}");
        let found = messages(&data.body);
        assert_eq!(count(&found, "/ir"), 7);
        assert!(found.is_sorted_by_key(|(_, time)| *time), "the data ascend");
        let summary = mcap::Summary::read(&data.body).expect("sound").expect("a summary");
        let (topics, schemas) =
            (source["topics"].as_array().expect("topics"), source["schemas"].as_array().expect("schemas"));
        for channel in summary.channels.values() {
            let topic = topics.iter().find(|t| t["name"] == channel.topic.as_str()).expect("every channel is in it");
            assert_eq!(topic["messageEncoding"], channel.message_encoding.as_str());
            let schema = channel.schema.as_ref().expect("a schema");
            let told = schemas.iter().find(|s| s["id"] == topic["schemaId"]).expect("its schema is too");
            assert_eq!(
                (&told["name"], &told["encoding"]),
                (&Value::from(&*schema.name), &Value::from(&*schema.encoding))
            );
            assert_eq!(text(&told["data"]).len(), schema.data.len().div_ceil(3) * 4);
        }
        let numbers: BTreeSet<_> = schemas.iter().map(|s| s["id"].as_u64().expect("a number")).collect();
        assert!(numbers.len() == schemas.len() && !numbers.contains(&0), "{numbers:?}");
        let names: BTreeSet<_> = topics.iter().map(|t| t["name"].to_string()).collect();
        assert_eq!(names.len(), topics.len(), "each topic once");
        let time =
            |value: &Value| chrono::DateTime::parse_from_rfc3339(&text(value)).expect("a time").timestamp_nanos_opt();
        let (start, end) = (time(&source["startTime"]).expect("in range"), time(&source["endTime"]).expect("in range"));
        assert!(found.iter().all(|(_, t)| (start..=end).contains(&(*t as i64))), "{start} to {end}");
        assert_eq!(ids(&asked()), ids(&manifest), "the same, the same keys");
        // The lake grows: what was cut of other runs keeps its key, and no key is ever given other data.
        place.acquire("wavy", &["--ir-only"]);
        place.ok(&["ingest"]);
        let after = ids(&asked());
        assert!(after.len() == 3 && ids(&manifest).iter().all(|id| after.contains(id)), "{after:?}");
        let data = text(&source["url"]);
        assert_eq!(get(&server, &data).status, 200);
        refused(&get(&server, &data.replace("7%20or", "8%20or")), 410, "gone");
        // Of the lake, a layout has only the length and the rate of responses.
        let layout =
            HttpRequest::get("/api/v1/layouts/echolake.json").with("origin", "https://viewer.example").send(&server);
        assert_eq!((layout.status, layout.header("access-control-allow-origin")), (200, Some("*")));
        assert!(json(&layout)["configById"].is_object());
    }

    #[test]
    fn a_run_file_that_was_changed_or_moved_is_said() {
        let place = lake();
        let server = served(&place, &[]);
        let run = run_of(&place, "flat");
        let file = place.path(&format!("lake/runs/flat/{run}.mcap"));
        let original = std::fs::read(&file).expect("the run");
        let path = slice("surface_id = 'flat'", "");
        std::fs::write(&file, &original[..original.len() / 2]).expect("cut short");
        refused(&get(&server, &path), 409, "file_changed");
        refused(&get(&server, "/api/v1/foxglove/manifest?where=surface_id='flat'"), 409, "file_changed");
        // Of the same size: what is read is checked by its CRCs, and a slice that began is broken off.
        let mut flipped = original.clone();
        let middle = flipped.len() / 2;
        flipped[middle] ^= 0x55;
        std::fs::write(&file, &flipped).expect("changed");
        let answer = get(&server, &path);
        assert!(answer.status >= 400 || !answer.is_whole, "{} bytes look whole", answer.body.len());
        let ranged = HttpRequest::get(&path).with("range", "bytes=0-9").send(&server);
        assert!([409, 503].contains(&ranged.status), "{}", ranged.status);
        std::fs::remove_file(&file).expect("moved");
        refused(&get(&server, &path), 409, "file_changed");
        std::fs::write(&file, &original).expect("brought back");
        let whole = get(&server, &path);
        assert_eq!((whole.status, whole.is_whole), (200, true));
        assert_eq!(get(&server, &slice("surface_id = 'brick'", "")).status, 200);
    }
}
