//! The catalogue over HTTP: the contract, files in ranges, what is kept, sessions, and what must stay data.

use rustix::process::Signal;
use serde_json::Value;

use super::contract::ApiContract;
use super::http::HttpRequest;
use super::projects::new_token;
use super::server::ServedLake;
use super::{get, json, refused, served};
use crate::{TestFolder, TestFolderTemplate};

/// Reliefs with both references, so that every answer has something in it.
pub(crate) fn lake() -> TestFolder {
    static THREE_RUNS: TestFolderTemplate = TestFolderTemplate::new();
    THREE_RUNS.place(|place| {
        for surface in ["flat", "foam", "brick"] {
            place.acquire(surface, &["--ir-only"]);
        }
        place.ok(&["ingest"]);
    })
}

fn run_of(server: &ServedLake, surface: &str) -> String {
    let runs = json(&get(server, &format!("/api/v1/runs?surface_id={surface}")));
    runs["items"][0]["run_id"].as_str().expect("a run").to_owned()
}

/// The path with its parts filled in.
fn filled(template: &str, surface: &str, run: &str, file: &str) -> String {
    let parts =
        [("{surface_id}", surface), ("{run_id}", run), ("{pair_id}", "7"), ("{table}", "points"), ("{file}", file)];
    let path = parts.into_iter().fold(template.to_owned(), |path, (name, value)| path.replace(name, value));
    match path.rsplit('/').next() {
        Some("grid" | "grid.svg") => format!("{path}?microphone=0"),
        Some("slices.mcap" | "manifest") => format!("{path}?where=pair_id%3C5"),
        Some("slices.sofa") => format!("{path}?where=surface_id%3D%27brick%27%20and%20pair_id%3C5"),
        _ => path,
    }
}

#[test]
fn curves_and_responses_come_as_arrow_too() {
    let place = lake();
    let server = served(&place, &[]);
    for path in ["/api/v1/surfaces/brick/curves", "/api/v1/surfaces/brick/pairs/7"] {
        let arrow = HttpRequest::get(path).with("accept", "application/vnd.apache.arrow.stream").send(&server);
        assert_eq!(arrow.header("content-type"), Some("application/vnd.apache.arrow.stream"));
        assert_eq!(arrow.body[..4], [0xff; 4], "a stream's first message");
        let plain = get(&server, path);
        assert_eq!(plain.header("content-type"), Some("application/json"));
        assert_ne!(plain.header("etag"), arrow.header("etag"));
    }
}

#[test]
fn numbers_are_those_of_sql() {
    let place = lake();
    let server = served(&place, &[]);
    let grid = json(&get(&server, "/api/v1/surfaces/brick/grid?microphone=3&over=flat-band"));
    let rows = place.sql(
        "select case when microphone = 3 then speaker else microphone end as point, microphone <> 3 as swapped, \
         pair_id, 10 * log10(tnce_band_10000) as level from tnce where surface_id = 'brick' and (microphone = 3 or \
         speaker = 3)",
    );
    assert!(rows.len() > 5, "{rows:?}");
    for row in &rows {
        let point = row["point"].as_u64().expect("a point") as usize;
        assert_eq!((&grid["pairs"][point], &grid["swapped"][point]), (&row["pair_id"], &row["swapped"]));
        let level = grid["bands"][2][point].as_f64().expect("a level");
        assert!((level - row["level"].as_f64().expect("a level")).abs() < 1e-5, "{row:?} {level}");
    }
    // As ingest kept them, and as the curves give them.
    let kept = &place.sql(
        "select max(abs(k - m)) as most, max(m) as top from (select unnest(s.mean_nce) as k, unnest(n.mean) as m
         from surface_stats s join (select run_id, avg_list(nce_10000) as mean from nce group by run_id) n using \
         (run_id)
         where s.surface_id = 'brick' and s.band = '10000')",
    )[0];
    let (most, top) = (kept["most"].as_f64().expect("a difference"), kept["top"].as_f64().expect("a mean"));
    assert!(most <= 1e-6 * top && top > 0.0, "{kept:?}");
    let curves = json(&get(&server, "/api/v1/surfaces/brick/curves?points=4096"));
    let last = curves["surface"]["bands"][2].as_array().and_then(|curve| curve.last()?.as_f64()).expect("a curve");
    assert!((last - top).abs() <= 1e-6 * top, "{last} {kept:?}");
    let pair = json(&get(&server, "/api/v1/surfaces/brick/pairs/7"));
    let ir = &place.sql("select ir from measurements where surface_id = 'brick' and pair_id = 7")[0]["ir"];
    assert_eq!(&pair["measured"], ir);
    let map = json(&get(&server, "/api/v1/map"));
    let placed = map["points"].as_array().expect("points").len() + map["left_out"].as_array().expect("names").len();
    assert_eq!(placed, 3, "{map}");
    let wav = get(&server, "/api/v1/surfaces/brick/pairs/7/ir.wav?signal=measured");
    assert_eq!(wav.body[..4], *b"RIFF");
    assert_eq!(wav.body.len(), 44 + 4 * ir.as_array().expect("samples").len());
    let png = get(&server, "/api/v1/surfaces/brick/thumbnail.png");
    assert_eq!(png.body[1..4], *b"PNG");
    let glb = get(&server, "/api/v1/surfaces/brick/mesh.glb");
    assert_eq!(glb.body[..4], *b"glTF");
    let heights = get(&server, "/api/v1/surfaces/brick/heightmap");
    let cells = place.number("select max(cells) from heightmaps") as usize;
    assert_eq!(heights.body.len(), 4 * cells * cells);
    let run = json(&get(&server, &format!("/api/v1/runs/{}", run_of(&server, "brick"))));
    let topic = run["topics"].as_array().expect("topics").iter().find(|t| t["topic"] == "/ir").expect("responses");
    assert_eq!(topic["messages"], 45);
    assert!(topic["bytes"].as_u64() > Some(45 * 384 * 4), "{topic}");
}

#[test]
fn responses_are_analysed() {
    let place = lake();
    let server = served(&place, &[]);
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().expect("numbers").iter().map(|x| x.as_f64().expect("a number")).collect()
    };
    let pair = json(&get(&server, "/api/v1/surfaces/brick/pairs/7"));
    let path = "/api/v1/surfaces/brick/pairs/7/analysis";
    let found = json(&get(&server, path));
    for signal in ["measured", "reflected", "flat_reflected"] {
        let samples = numbers(&pair[signal]);
        let levels = numbers(&found[signal]["sample_db"]);
        let envelope = numbers(&found[signal]["envelope_db"]);
        for ((sample, level), over) in samples.iter().zip(&levels).zip(&envelope) {
            assert!((20.0 * sample.abs().max(1e-10).log10() - level).abs() < 1e-4, "{signal}: {sample} {level}");
            assert!(*over > level - 1e-4, "{signal}: {level} is over its envelope, {over}");
        }
        let bins = found["frequency_hz"].as_array().map(Vec::len);
        for name in ["level_db", "phase_deg", "group_delay_ms"] {
            assert_eq!(found[signal][name].as_array().map(Vec::len), bins, "{signal} {name}");
        }
    }
    // The direct sound is there after its path at the speed of sound at the reference temperature.
    let direct_s = found["direct_s"].as_f64().expect("a time");
    let direct_mm = pair["pair"]["direct_mm"].as_f64().expect("a length");
    assert!((direct_s * 343.2 - direct_mm / 1000.0).abs() < 1e-3, "{direct_s} {direct_mm}");
    let highest = numbers(&found["measured"]["envelope_db"]).into_iter().fold(f64::MIN, f64::max);
    assert!((found["direct_db"].as_f64().expect("a level") - highest).abs() < 3.0, "{found}");
    let other = json(&get(&server, &format!("{path}?octave=3&delay=none")));
    assert_eq!(other["removed_s"], 0.0);
    assert_ne!(other["measured"]["level_db"], found["measured"]["level_db"]);
    for wrong in ["?octave=49", "?delay=all"] {
        refused(&get(&server, &format!("{path}{wrong}")), 400, "request_invalid");
    }
    let picture = json(&get(&server, "/api/v1/surfaces/brick/pairs/7/spectrogram"));
    let levels = numbers(&picture["level_db"]);
    let cells = picture["times"].as_u64().zip(picture["bins"].as_u64()).map(|(times, bins)| (times * bins) as usize);
    assert_eq!(cells, Some(levels.len()));
    assert_eq!(levels.iter().copied().fold(f64::MIN, f64::max), 0.0);
    let foam = json(&get(&server, "/api/v1/surfaces/foam/pairs/7/analysis"));
    assert_eq!(foam["surface_id"], "foam");
}

#[test]
fn neighbours_are_those_of_the_map_and_of_plain_sums() {
    let place = lake();
    let server = served(&place, &[]);
    let map = json(&get(&server, "/api/v1/map?neighbours=8"));
    let points = map["points"].as_array().expect("points");
    let brick = points.iter().find(|point| point["surface_id"] == "brick").expect("brick is on the map");
    let surfaces = json(&get(&server, "/api/v1/surfaces/brick/neighbours"));
    assert_eq!(surfaces["items"], brick["neighbours"]);
    assert_eq!(surfaces["items"][0]["surface_id"], "flat", "{surfaces}");
    assert_eq!(json(&get(&server, "/api/v1/surfaces/foam/neighbours"))["items"], Value::Array(Vec::new()));
    let found = json(&get(&server, "/api/v1/surfaces/brick/pairs/7/neighbours"));
    let samples = |surface: &str| -> Vec<f64> {
        let sql = format!("select unnest(reflected_ir) as x from nce where surface_id = '{surface}' and pair_id = 7");
        place.sql(&sql).iter().map(|row| row["x"].as_f64().expect("a sample")).collect()
    };
    let own = samples("brick");
    let flat = samples("flat");
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let product = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(a, b)| (a - mean(x)) * (b - mean(y))).sum::<f64>();
    let energy = |x: &[f64]| x.iter().map(|x| x * x).sum::<f64>();
    let items = found["items"].as_array().expect("items");
    // Nothing is left of Foam's response.
    assert_eq!((items.len(), &items[0]["surface_id"]), (1, &Value::from("flat")), "{found}");
    for (name, expected) in [
        ("correlation", product(&own, &flat) / (product(&own, &own) * product(&flat, &flat)).sqrt()),
        ("level_db", 10.0 * (energy(&flat) / energy(&own)).log10()),
    ] {
        let given = items[0][name].as_f64().expect("a number");
        assert!((given - expected).abs() < 1e-6, "{name}: {given} {expected}");
    }
    let foam = json(&get(&server, "/api/v1/surfaces/foam/pairs/7/neighbours"));
    assert_eq!(foam["items"], Value::Array(Vec::new()), "nothing is like silence");
    refused(&get(&server, "/api/v1/surfaces/brick/pairs/99999/neighbours"), 404, "not_found");
}

#[test]
fn facets_leave_their_own_filter_out() {
    let place = lake();
    let server = served(&place, &[]);
    let counts = |page: &Value, facet: &str| -> Vec<(String, u64)> {
        let facet = page["facets"].as_array().expect("facets").iter().find(|f| f["name"] == facet).expect("a facet");
        let pair = |v: &Value| (v["value"].as_str().expect("text").to_owned(), v["count"].as_u64().expect("a count"));
        facet["values"].as_array().expect("values").iter().map(pair).collect()
    };
    let all = json(&get(&server, "/api/v1/surfaces"));
    let typologies = counts(&all, "typology");
    assert_eq!((all["total"].as_u64(), typologies.iter().map(|t| t.1).sum::<u64>()), (Some(3), 3));
    let one = json(&get(&server, "/api/v1/surfaces?typology=reference"));
    assert_eq!(counts(&one, "typology"), typologies, "its own filter is left out");
    assert_eq!(one["total"].as_u64(), typologies.iter().find(|t| t.0 == "reference").map(|t| t.1));
    assert_eq!(counts(&one, "origin").iter().map(|o| o.1).sum::<u64>(), one["total"].as_u64().expect("a count"));
    let nothing = json(&get(&server, "/api/v1/surfaces?q=no+such+relief"));
    assert_eq!((&nothing["total"], nothing["items"].as_array().map(Vec::len)), (&Value::from(0), Some(0)));
    let sorted = json(&get(&server, "/api/v1/surfaces?sort=level&order=desc&limit=2&offset=1"));
    assert_eq!(sorted["items"].as_array().map(Vec::len), Some(2));
}

#[test]
fn references_are_not_data() {
    let place = lake();
    let server = served(&place, &[]);
    let foam = json(&get(&server, "/api/v1/surfaces/foam"));
    assert!(
        foam["mean"].as_array().is_some_and(|means| means.len() == 6 && means.iter().all(Value::is_null)),
        "{foam}"
    );
    assert!(foam["flat_mean"][0].is_f64(), "{foam}");
    let flat = json(&get(&server, "/api/v1/surfaces/flat"));
    let statistics = flat["statistics"].as_array().expect("statistics");
    let measured: Vec<_> = statistics.iter().map(|band| band["p90_mean_db"].clone()).collect();
    assert_eq!(foam["flat_measured_db"], Value::from(measured));
    assert_eq!(json(&get(&server, "/api/v1/surfaces/foam/curves"))["surface"]["pairs"], 0);
    let page = json(&get(&server, "/api/v1/surfaces"));
    for histogram in page["histograms"].as_array().expect("histograms") {
        let bins = histogram["bins"].as_array().expect("bins");
        let counted = bins.iter().filter_map(|bin| bin["count"].as_u64()).sum::<u64>();
        assert_eq!(counted, if histogram["name"] == "started" { 3 } else { 1 }, "{histogram}");
    }
    let facets = page["facets"].as_array().expect("facets");
    assert!(facets.iter().all(|facet| facet["distinguishes"] == false), "there is one design: {facets:?}");
}

#[test]
fn run_files_come_in_ranges_to_viewers_of_elsewhere() {
    let place = lake();
    let server = served(&place, &[]);
    let run = run_of(&server, "brick");
    let path = format!("/api/v1/runs/{run}/file.mcap");
    let file = std::fs::read(place.path(&format!("lake/runs/brick/{run}.mcap"))).expect("the file");
    let foreign =
        || HttpRequest::get(&path).with("origin", "https://viewer.example").with("sec-fetch-site", "cross-site");
    // A viewer begins with a plain GET and breaks it off once it has seen the headers.
    drop(foreign().begin(&server));
    let whole = foreign().send(&server);
    assert_eq!((whole.status, &whole.body), (200, &file));
    for (name, value) in [
        ("access-control-allow-origin", "*"),
        ("accept-ranges", "bytes"),
        ("cross-origin-resource-policy", "cross-origin"),
        ("content-length", &file.len().to_string()),
    ] {
        assert_eq!(whole.header(name), Some(value), "{name}");
    }
    let exposed = whole.header("access-control-expose-headers").expect("a list").to_ascii_lowercase();
    for name in ["accept-ranges", "content-length", "content-range", "etag"] {
        assert!(exposed.contains(name), "{name} in {exposed}");
    }
    assert!(whole.header("access-control-allow-credentials").is_none());
    let tag = whole.header("etag").expect("a tag").to_owned();
    let last = file.len() - 1;
    let part = |range: &str| foreign().with("range", range).send(&server);
    for (range, from, to) in
        [("bytes=0-7", 0, 7), ("bytes=-8", last - 7, last), (&*format!("bytes={}-", last), last, last)]
    {
        let answer = part(range);
        assert_eq!((answer.status, &answer.body[..]), (206, &file[from..=to]), "{range}");
        assert_eq!(answer.header("content-range"), Some(&*format!("bytes {from}-{to}/{}", file.len())));
    }
    let beyond = part(&format!("bytes={}-", file.len()));
    refused(&beyond, 416, "range_not_satisfiable");
    assert_eq!(beyond.header("content-range"), Some(&*format!("bytes */{}", file.len())));
    assert_eq!(foreign().with("if-none-match", &tag).send(&server).status, 304);
    let ranged = |known: &str| foreign().with("range", "bytes=0-7").with("if-range", known).send(&server).status;
    assert_eq!((ranged(&tag), ranged("\"other\"")), (206, 200));
    // If-Match comes before If-None-Match, and both before the range.
    let matched = |wanted: &str| foreign().with("if-match", wanted);
    for wanted in ["\"nope\"", "nope", &format!("W/{tag}"), ""] {
        let failed = [
            matched(wanted),
            matched(wanted).with("range", "bytes=0-7"),
            matched(wanted).with("if-none-match", &tag),
            matched(wanted).with("if-range", &tag).with("range", "bytes=9999999999-"),
        ];
        for request in failed {
            let answer = request.send(&server);
            refused(&answer, 412, "precondition_failed");
            assert_eq!(answer.header("etag"), Some(&*tag), "{wanted}");
        }
    }
    for wanted in [&*tag, "*", &format!("\"nope\", {tag}")] {
        assert_eq!(matched(wanted).send(&server).status, 200, "{wanted}");
        assert_eq!(matched(wanted).with("range", "bytes=0-7").send(&server).status, 206, "{wanted}");
        assert_eq!(matched(wanted).with("if-none-match", &tag).send(&server).status, 304, "{wanted}");
    }
    assert_eq!(HttpRequest::head(&path).with("if-match", "\"nope\"").send(&server).status, 412);
    let missing = |name: &str| HttpRequest::get("/api/v1/runs/none/file.mcap").with(name, "*").send(&server).status;
    assert_eq!((missing("if-match"), missing("if-none-match")), (404, 404));
    let asked = HttpRequest::options(&path)
        .with("origin", "https://viewer.example")
        .with("access-control-request-method", "GET")
        .with("access-control-request-headers", "range")
        .with("access-control-request-private-network", "true")
        .send(&server);
    assert_eq!(asked.status, 200);
    assert!(asked.header("access-control-allow-headers").is_some_and(|h| h.contains("range")));
    assert_eq!(asked.header("access-control-allow-private-network"), Some("true"));
    // All else is for the server's own pages.
    let other = |path: &str| HttpRequest::get(path).with("origin", "https://viewer.example").send(&server);
    assert_eq!(other("/api/v1/runs").status, 403);
    assert_eq!(other("/api/v1/tables/points").status, 403);
}

#[cfg(feature = "web")]
#[test]
fn pages_are_part_of_the_program() {
    let place = lake();
    let server = served(&place, &[]);
    for address in ["/", "/surfaces/brick", "/sql?q=select%201"] {
        // A link on another page leads here.
        let page = HttpRequest::get(address).with("sec-fetch-site", "cross-site").send(&server);
        assert_eq!((page.status, page.header("content-type")), (200, Some("text/html; charset=utf-8")), "{address}");
        let policy = page.header("content-security-policy").expect("a policy");
        assert!(policy.contains("script-src 'self'") && !policy.contains("unsafe"), "{policy}");
    }
    let page = get(&server, "/").text();
    let script = page.split('"').find(|part| part.starts_with("./assets/") && part.ends_with(".js"));
    let script = script.and_then(|part| part.strip_prefix('.')).expect("a script");
    let packed = HttpRequest::get(script).with("accept-encoding", "gzip, br").send(&server);
    assert_eq!(packed.header("content-encoding"), Some("br"));
    assert!(packed.header("cache-control").is_some_and(|c| c.contains("immutable")));
    assert!(packed.body.len() < get(&server, script).body.len());
    let tag = packed.header("etag").expect("a tag").to_owned();
    let again = |encoding| HttpRequest::get(script).with("accept-encoding", encoding).with("if-none-match", &tag);
    assert_eq!(again("gzip, br").send(&server).status, 304);
    // E23: the same address in another encoding is other bytes.
    assert_eq!(again("identity").send(&server).status, 200);
    let tag_of = |encoding| {
        let answer = HttpRequest::get("/api/v1/surfaces").with("accept-encoding", encoding).send(&server);
        answer.header("etag").expect("a tag").to_owned()
    };
    assert_ne!(tag_of("gzip"), tag_of("identity"));
    assert_eq!(get(&server, "/assets/none.js").status, 404);
    assert_eq!(get(&server, "/favicon.ico").status, 404);
}

/// B14: pages offer a token what it may do.
#[test]
fn the_lake_says_whether_a_token_may_annotate() {
    let place = lake();
    assert_eq!(json(&get(&served(&place, &[]), "/api/v1/lake"))["may_annotate"], true, "without tokens");
    let (reader, reader_lines) = new_token(&place, &["ann"]);
    let (author, author_lines) = new_token(&place, &["bob", "--scopes", "sql,annotate"]);
    std::fs::write(place.path("tokens.toml"), reader_lines + &author_lines).expect("written");
    let server = served(&place, &["--tokens", "tokens.toml"]);
    let ask = |token: &str| {
        let request = HttpRequest::get("/api/v1/lake").with("authorization", &format!("Bearer {token}"));
        let answer = request.send(&server);
        (json(&answer)["may_annotate"].clone(), answer.header("etag").expect("a tag").to_owned())
    };
    let (readers, authors) = (ask(&reader), ask(&author));
    assert_eq!((&readers.0, &authors.0), (&Value::from(false), &Value::from(true)));
    assert_ne!(readers.1, authors.1, "a browser keeps no answer to another token");
}

mod slow {
    use super::*;

    #[test]
    fn a_session_stands_for_a_token() {
        let place = lake();
        let open = served(&place, &[]);
        let shown = |server: &ServedLake, token: &str| {
            let body = serde_json::json!({ "token": token }).to_string();
            HttpRequest::post("/api/v1/session", &body).with("content-type", "application/json").send(server)
        };
        assert_eq!(shown(&open, "x").status, 404, "no tokens, no sessions");
        let made = place.run(&["token", "reader"]);
        let token = crate::stderr(&made).lines().next().expect("a token").to_owned();
        std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml"]);
        assert_eq!(get(&server, "/api/v1/surfaces").status, 401);
        assert_eq!(shown(&server, "wrong").status, 401);
        let begun = shown(&server, &token);
        assert_eq!(begun.status, 204);
        let cookie = begun.header("set-cookie").expect("a cookie");
        assert!(cookie.contains("; HttpOnly") && cookie.contains("; SameSite=Strict"), "{cookie}");
        assert!(!cookie.contains(&token), "the token itself is kept nowhere");
        let cookie = cookie.split(';').next().expect("name and value");
        let with = |name: &str, value: &str| {
            HttpRequest::get("/api/v1/surfaces").with("cookie", cookie).with(name, value).send(&server).status
        };
        assert_eq!(with("sec-fetch-site", "same-origin"), 200);
        assert_eq!(with("sec-fetch-site", "same-site"), 403, "a page on another port of this machine");
        assert_eq!(with("origin", "http://localhost:1"), 403);
        assert_eq!(HttpRequest::get("/api/v1/surfaces").with("cookie", "echolake=00").send(&server).status, 401);
        // A cached answer is not given to a client that is not authorised for it.
        assert_eq!(get(&server, "/api/v1/surfaces").status, 401);
    }

    #[test]
    fn every_path_keeps_the_contract() {
        let place = lake();
        let server = served(&place, &[]);
        let contract = ApiContract::read();
        let run = run_of(&server, "brick");
        let files = json(&get(&server, "/api/v1/tables/points"));
        let file = files[0]["file"].as_str().expect("a file");
        let check = |template: &str, path: &str, status: u16| {
            let answer = get(&server, path);
            let media_type = answer.header("content-type").unwrap_or_default();
            let objections = contract.objections(template, answer.status, media_type, &answer.body);
            assert!(objections.is_empty(), "{path}: {objections:?}");
            assert_eq!(answer.status, status, "{path}: {}", String::from_utf8_lossy(&answer.body));
            assert_eq!(answer.header("x-content-type-options"), Some("nosniff"));
        };
        for template in contract.gets() {
            check(template, &filled(template, "brick", &run, file), 200);
            for (surface, run, file) in [("none", "none", "none"), ("..%2F..%2Fetc", "%00", "..%2F..%2Flake.toml")] {
                if template.contains("{surface_id}") || template.contains("{run_id}") || template.contains("{file}") {
                    check(template, &filled(template, surface, run, file), 404);
                }
            }
        }
        for sort in ["run_id", "state", "duration", "measurements", "repeats", "damaged", "temperature"] {
            check("/api/v1/runs", &format!("/api/v1/runs?sort={sort}&order=asc"), 200);
        }
        for (template, path) in [
            ("/api/v1/surfaces", "/api/v1/surfaces?level=nonsense:1..2"),
            ("/api/v1/surfaces", "/api/v1/surfaces?level=2500:a..b"),
            ("/api/v1/surfaces", "/api/v1/surfaces?limit=0"),
            ("/api/v1/surfaces", "/api/v1/surfaces?limit=501"),
            ("/api/v1/surfaces", "/api/v1/surfaces?sort=surface_id;drop"),
            ("/api/v1/runs", "/api/v1/runs?order=up"),
            ("/api/v1/surfaces/{surface_id}/grid", "/api/v1/surfaces/brick/grid?microphone=10"),
            ("/api/v1/surfaces/{surface_id}/grid", "/api/v1/surfaces/brick/grid"),
            ("/api/v1/surfaces/{surface_id}/pairs/{pair_id}", "/api/v1/surfaces/brick/pairs/-1"),
            ("/api/v1/map", "/api/v1/map?neighbours=21"),
        ] {
            check(template, path, 400);
        }
    }

    #[test]
    fn answers_are_kept_until_the_lake_changes() {
        let place = lake();
        let server = served(&place, &[]);
        let before = get(&server, "/api/v1/surfaces");
        let tag = before.header("etag").expect("a tag").to_owned();
        let again = HttpRequest::get("/api/v1/surfaces").with("if-none-match", &tag).send(&server);
        assert_eq!((again.status, again.body.len()), (304, 0));
        let packed = HttpRequest::get("/api/v1/surfaces").with("accept-encoding", "gzip").send(&server);
        assert_eq!(packed.header("content-encoding"), Some("gzip"));
        assert!(packed.body.len() < before.body.len() / 2);
        // A tag is one resource's own: it is no other's, nor that of what does not exist.
        let asked = |path: &str, name: &str, tags: &str| HttpRequest::get(path).with(name, tags).send(&server).status;
        for (path, expected) in [
            ("/api/v1/surfaces", 304),
            ("/api/v1/surfaces?limit=1", 200),
            ("/api/v1/runs", 200),
            ("/api/v1/files", 200),
            ("/api/v1/surfaces/none", 404),
            ("/api/v1/surfaces/brick/pairs/99999", 404),
        ] {
            assert_eq!(asked(path, "if-none-match", &format!("\"x\", W/{tag}")), expected, "{path}");
        }
        for (path, expected) in [("/api/v1/surfaces/brick", [304, 200, 412]), ("/api/v1/surfaces/none", [404; 3])] {
            let statuses = [("if-none-match", "*"), ("if-match", "*"), ("if-match", &tag)];
            assert_eq!(statuses.map(|(name, tags)| asked(path, name, tags)), expected, "{path}");
        }
        let of_points = get(&server, "/api/v1/files?table=points").header("etag").expect("a tag").to_owned();
        assert_eq!(asked("/api/v1/files?table=points", "if-none-match", &of_points), 304);
        assert_eq!(asked("/api/v1/files?table=pairs", "if-none-match", &of_points), 200);
        assert_eq!(asked("/api/v1/files?table=pairs", "if-match", &of_points), 412);
        place.acquire("wavy", &["--ir-only"]);
        place.ok(&["ingest"]);
        let after = HttpRequest::get("/api/v1/surfaces").with("if-none-match", &tag).send(&server);
        assert_eq!((after.status, json(&after)["total"].as_u64()), (200, Some(4)));
        assert_ne!(after.header("etag"), Some(tag.as_str()));
    }

    // An engine that is stopped answers nothing: what comes nevertheless is the door's.
    #[test]
    fn cached_answers_need_no_engine_and_come_to_their_client_alone() {
        let place = lake();
        let made = place.run(&["token", "ann"]);
        let token = format!("Bearer {}", crate::stderr(&made).lines().next().expect("a token"));
        std::fs::write(place.path("tokens.toml"), &made.stdout).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml"]);
        let ask = |name: &str, value: &str| {
            let path = "/api/v1/surfaces?limit=2";
            HttpRequest::get(path).with("authorization", &token).with(name, value).send(&server)
        };
        let first = ask("accept", "*/*");
        let etag = first.header("etag").expect("a tag").to_owned();
        // The engine of statements describes a run, whose file it reads.
        let run = place.sql("select run_id from runs limit 1")[0]["run_id"].as_str().expect("a run").to_owned();
        let ask_run = |known: &str| {
            let request = HttpRequest::get(&format!("/api/v1/runs/{run}")).with("authorization", &token);
            request.with("if-none-match", known).send(&server)
        };
        let described = ask_run("\"none\"");
        server.signal_engines(Signal::STOP);
        let again = ask("accept", "*/*");
        let described_again = ask_run("\"none\"");
        let unchanged = ask("if-none-match", &etag).status;
        let failed = ask("if-match", "\"other\"").status;
        let unknown = get(&server, "/api/v1/surfaces?limit=2").status;
        let wrong = HttpRequest::get("/api/v1/surfaces?limit=2").with("authorization", "Bearer x").send(&server).status;
        server.signal_engines(Signal::CONT);
        assert_eq!((again.status, &again.body, again.header("etag")), (200, &first.body, Some(&*etag)));
        assert_eq!((described_again.status, &described_again.body), (200, &described.body));
        assert_eq!((unchanged, failed, unknown, wrong), (304, 412, 401, 401));
        assert_eq!(first.header("echolake-lasting-version"), None, "that is for the door");
        // The same address in another form, and what was refused, are answered by the engine.
        assert_eq!(ask("accept-encoding", "gzip").header("content-encoding"), Some("gzip"));
        place.acquire("wavy", &["--ir-only"]);
        place.ok(&["ingest"]);
        let after = ask("if-none-match", &etag);
        assert_eq!((after.status, json(&after)["total"].as_u64()), (200, Some(4)));
        let of_run = described.header("etag").expect("a tag");
        assert_eq!(ask_run(of_run).status, 304, "another run does not change what a run is");
        std::fs::write(place.path("tokens.toml"), "").expect("written");
        crate::serve::wait_until("its token is gone", || ask("accept", "*/*").status == 401);
    }

    #[test]
    fn against_flat_is_the_same_number_everywhere() {
        let place = lake();
        let server = served(&place, &[]);
        let surface = &json(&get(&server, "/api/v1/surfaces/brick"))["surface"];
        let row = &place.sql(
            "select c.shown_against_flat_2500_db, c.shown_against_flat_total_db, c.against_flat_2500_db,
             b.p90_mean_db - f.p90_mean_db as difference,
             b.unbiased_p90_mean_db - f.unbiased_p90_mean_db as unbiased
             from catalogue c join surface_stats b using (surface_id) join surface_stats f on f.band = b.band
             where c.surface_id = 'brick' and f.surface_id = 'flat' and b.band = '2500'",
        )[0];
        let (levels, number) = (&surface["against_flat_db"], |name: &str| row[name].as_f64().expect("a level"));
        assert!((number("difference") - number("against_flat_2500_db")).abs() < 1e-9, "{row:?}");
        let unbiased = row["unbiased"].as_f64();
        assert_eq!(surface["has_foam"], unbiased.is_none());
        let shown = unbiased.unwrap_or_else(|| number("difference"));
        assert!((shown - number("shown_against_flat_2500_db")).abs() < 1e-9, "{row:?}");
        for (band, column) in [(0, "shown_against_flat_2500_db"), (5, "shown_against_flat_total_db")] {
            assert!((number(column) - levels[band].as_f64().expect("a level")).abs() < 1e-9, "{row:?} {levels}");
        }
        let grid = |over: &str| get(&server, &format!("/api/v1/surfaces/brick/grid?microphone=3{over}")).body;
        assert_eq!(grid(""), grid("&over=flat-band"));
    }

    #[test]
    fn what_is_asked_stays_data() {
        let place = lake();
        let server = served(&place, &[]);
        for text in [
            "'%20or%201=1--",
            "brick'%20union%20select%20*%20from%20runs--",
            "%3Cimg%20src=x%20onerror=alert(1)%3E",
            "%24%7B7*7%7D",
            "..%2f..%2flake.toml",
            "%00",
            "brick%0d%0aset-cookie:%20a=b",
            "%F0%9F%A7%B1",
        ] {
            for path in [
                "/api/v1/surfaces/X",
                "/api/v1/surfaces/X/grid?microphone=0",
                "/api/v1/runs/X",
                "/api/v1/runs/X/file.mcap",
                "/api/v1/tables/X",
                "/api/v1/tables/runs/X",
            ] {
                let answer = get(&server, &path.replace('X', text));
                assert_eq!(
                    (answer.status, answer.header("content-type")),
                    (404, Some("application/problem+json")),
                    "{path} {text}"
                );
                assert_eq!(answer.header("set-cookie"), None);
            }
            for path in [
                "/api/v1/surfaces?q=X",
                "/api/v1/surfaces?typology=X",
                "/api/v1/runs?q=X",
                "/api/v1/runs?surface_id=X",
                "/api/v1/correlations?typology=X",
            ] {
                let answer = get(&server, &path.replace('X', text));
                assert_eq!(answer.status, 200, "{path} {text}");
                let (total, surfaces) = (json(&answer)["total"].as_u64(), json(&answer)["surfaces"].as_u64());
                assert_eq!(total.or(surfaces), Some(0), "{path} {text}");
            }
            for path in [
                "/api/v1/surfaces?sort=X",
                "/api/v1/surfaces?sort_band=X",
                "/api/v1/runs?sort=X",
                "/api/v1/runs?offset=X",
            ] {
                assert_eq!(get(&server, &path.replace('X', text)).status, 400, "{path} {text}");
            }
        }
        // Bytes that are no text.
        assert_eq!(get(&server, "/api/v1/surfaces/%ff").status, 400);
        let wrong = HttpRequest::post("/api/v1/lake", "").send(&server);
        refused(&wrong, 405, "method_not_allowed");
        assert!(wrong.header("allow").is_some_and(|methods| methods.contains("GET")), "{:?}", wrong.header("allow"));
    }
}
