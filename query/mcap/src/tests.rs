//! Runs as tables on files that the mcap crate writes: what comes out, what is read for it, and what damage does.

use std::io::Cursor;
use std::sync::Arc;

use arrow::array::{AsArray as _, RecordBatch};
use arrow::datatypes::Int64Type;
use arrow::util::pretty::pretty_format_batches;
use datafusion::config::Dialect;
use datafusion::error::Result as QueryResult;
use datafusion::prelude::SessionContext;
use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::VisitMut as _;
use echolake_lake::{FileName, Lake, ReferenceSurfaces, VisibleRun, encode_batches};
use echolake_lake_tables::{ColumnStore, LakeReaderFactory};
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};
use object_store::ObjectStoreExt as _;
use object_store::path::Path;

use crate::{McapCalls, McapFiles};

const SECOND: u64 = 1_000_000_000;
/// 2026-01-06, 00:00.
pub(crate) const START: u64 = 1_767_657_600 * SECOND;

/// A lake in memory, and one context for all that is asked of it.
pub(crate) struct TestLake {
    lake: Lake,
    files: Arc<McapFiles>,
    context: SessionContext,
}

pub(crate) async fn lake() -> TestLake {
    let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    let context = SessionContext::new();
    let footers = context.runtime_env().cache_manager.get_file_metadata_cache();
    let columns = Arc::new(ColumnStore::new(Arc::new(LakeReaderFactory::new(&lake, footers)), None, 1 << 20));
    let files = Arc::new(McapFiles::new(&lake, &columns));
    TestLake { lake, files, context }
}

pub(crate) async fn put(lake: &TestLake, path: &str, file: Vec<u8>) {
    lake.lake.store().put(&Path::from(path), file.into()).await.expect("written");
}

fn find_calls(statement: &mut Statement, calls: &mut McapCalls) {
    match statement {
        Statement::Statement(sql) => {
            let _ = sql.visit(calls);
        }
        Statement::Explain(explain) => find_calls(&mut explain.statement, calls),
        _ => {}
    }
}

async fn try_rows(lake: &TestLake, sql: &str) -> QueryResult<Vec<RecordBatch>> {
    let mut statement = lake.context.state().sql_to_statement(sql, &Dialect::Generic)?;
    let mut calls = McapCalls::default();
    find_calls(&mut statement, &mut calls);
    let snapshot = lake.lake.snapshot().await.expect("a snapshot");
    crate::register(&lake.context, &snapshot, &lake.files, calls).await?;
    let plan = lake.context.state().statement_to_plan(statement).await?;
    lake.context.execute_logical_plan(plan).await?.collect().await
}

async fn rows(lake: &TestLake, sql: &str) -> Vec<RecordBatch> {
    try_rows(lake, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"))
}

pub(crate) async fn number(lake: &TestLake, sql: &str) -> i64 {
    rows(lake, sql).await[0].column(0).as_primitive::<Int64Type>().value(0)
}

/// Checks an answer as it is printed, the frame aside.
pub(crate) async fn check(lake: &TestLake, sql: &str, expected: &[&str]) {
    let printed = pretty_format_batches(&rows(lake, sql).await).expect("printed").to_string();
    let lines: Vec<_> = printed.lines().filter(|l| l.starts_with('|')).skip(1).collect();
    let lines: Vec<String> =
        lines.iter().map(|l| l.trim_matches('|').split(" | ").map(str::trim).collect::<Vec<_>>().join(" | ")).collect();
    assert_eq!(lines, expected, "{sql}\n{printed}");
}

pub(crate) async fn refused(lake: &TestLake, sql: &str, expected: &[&str]) {
    let error = try_rows(lake, sql).await.map(|b| b.len()).expect_err(sql).to_string();
    for text in expected {
        assert!(error.contains(text), "{sql}: {error}");
    }
}

pub(crate) fn options(compression: Option<Compression>) -> WriteOptions {
    WriteOptions::new().compression(compression).chunk_size(Some(1000))
}

const POINT: &str = r#"{"type":"object","properties":{"x":{"type":"number"},"name":{"type":["string","null"]},
    "tags":{"type":"array","items":{"type":"integer"}},"at":{"type":"object","properties":{"z":{"type":"number"}}},
    "sequence":{"type":"integer"}}}"#;

/// A second of `/point` at ten a second for each of `seconds`, and one `/note` a second, in small chunks.
pub(crate) fn json_file(options: WriteOptions, seconds: u64) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut writer = options.create(&mut file).expect("a writer");
    let schema = writer.add_schema("Point", "jsonschema", POINT.as_bytes()).expect("added");
    let point = writer.add_channel(schema, "/point", "json", &Default::default()).expect("added");
    let note = writer.add_channel(0, "/note", "json", &Default::default()).expect("added");
    for tick in 0..seconds * 10 {
        let header = |channel_id| MessageHeader {
            channel_id,
            sequence: tick as u32,
            log_time: START + tick * SECOND / 10,
            publish_time: START,
        };
        let x = tick as f64 / 4.0;
        let data = format!(r#"{{"x":{x},"name":"p{tick}","tags":[{tick},1],"at":{{"z":-{x}}},"sequence":{tick}}}"#);
        writer.write_to_known_channel(&header(point), data.as_bytes()).expect("written");
        if tick % 10 == 0 {
            writer.write_to_known_channel(&header(note), br#"{"free":"form"}"#).expect("written");
            // The chunk ends here, so that the notes stand in each tenth of the chunks at most.
            writer.flush().expect("flushed");
        }
    }
    writer.finish().expect("finished");
    drop(writer);
    file.into_inner()
}

/// Makes a run that readers see out of a file.
async fn put_run(lake: &TestLake, surface: &str, run: &str, file: Vec<u8>) {
    use arrow::array::{ArrayRef, Int64Array, StringArray};
    let (surface, run) = (surface.parse().expect("an id"), run.parse().expect("an id"));
    put(lake, Lake::run_path(&surface, &run).as_ref(), file).await;
    let pointer = VisibleRun { surface, run, run_derivation: "d".into(), reference_derivation: None, verdicts: None };
    let schema = Table::Runs.schema(lake.lake.rig());
    let column = |field: &Arc<arrow::datatypes::Field>| -> ArrayRef {
        let text = match field.name().as_str() {
            "surface_id" => pointer.surface.as_str(),
            "run_id" => pointer.run.as_str(),
            _ => "d",
        };
        match field.data_type() {
            arrow::datatypes::DataType::Utf8 => Arc::new(StringArray::from(vec![text])),
            kind => arrow::compute::cast(&Int64Array::from(vec![0]), kind).expect("a number"),
        }
    };
    let batch = RecordBatch::try_new(schema.clone(), schema.fields().iter().map(column).collect()).expect("a row");
    let file = encode_batches(Table::Runs, &schema, &[batch]).expect("encoded");
    let staged = lake.lake.stage_file(Table::Runs, &FileName::Pointer(pointer.clone()), file).await.expect("staged");
    lake.lake.commit_staged(&[staged]).await.expect("committed");
}

/// A channel of a file: its topic, encoding and schema, and its messages.
pub(crate) struct TestChannel<'a> {
    pub topic: &'a str,
    pub encoding: &'a str,
    /// Name, encoding and data.
    pub schema: (&'a str, &'a str, &'a [u8]),
    pub messages: &'a [&'a [u8]],
}

pub(crate) fn file_of(channels: &[TestChannel<'_>]) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut writer = options(None).create(&mut file).expect("a writer");
    for channel in channels {
        let (name, encoding, data) = channel.schema;
        let schema = if name.is_empty() { 0 } else { writer.add_schema(name, encoding, data).expect("added") };
        let id = writer.add_channel(schema, channel.topic, channel.encoding, &Default::default()).expect("added");
        for (i, data) in channel.messages.iter().enumerate() {
            let header = MessageHeader { channel_id: id, sequence: i as u32, log_time: START, publish_time: START };
            writer.write_to_known_channel(&header, data).expect("written");
        }
    }
    writer.finish().expect("finished");
    drop(writer);
    file.into_inner()
}

pub(crate) fn json_channel<'a>(schema: &'a str, messages: &'a [&'a [u8]]) -> TestChannel<'a> {
    TestChannel { topic: "/t", encoding: "json", schema: ("T", "jsonschema", schema.as_bytes()), messages }
}

pub(crate) const NUMBERS: &str = r#"{"properties":{"x":{"type":"number"},"n":{"type":"integer"},
    "small":{"type":"integer","minimum":0,"maximum":9}}}"#;

#[tokio::test]
async fn topics_are_listed_with_their_times() {
    let lake = lake().await;
    put(&lake, "inbox/j.mcap", json_file(options(None), 2)).await;
    let whole = json_file(options(None), 2);
    put(&lake, "inbox/cut.mcap", whole[..whole.len() - 20].to_vec()).await;
    for (file, indexed) in [("inbox/j.mcap", true), ("inbox/cut.mcap", false)] {
        let sql = format!(
            "select topic, schema_name, message_encoding, messages, first_time, last_time, indexed \
             from mcap_topics('{file}') order by topic"
        );
        let note = format!("/note |  | json | 2 | 2026-01-06T00:00:00Z | 2026-01-06T00:00:01Z | {indexed}");
        let point = format!("/point | Point | json | 20 | 2026-01-06T00:00:00Z | 2026-01-06T00:00:01.900Z | {indexed}");
        check(&lake, &sql, &[&note, &point]).await;
    }
}

#[tokio::test]
async fn runs_are_asked_by_surface_run_and_pattern() {
    let lake = lake().await;
    for (surface, run) in [("flat", "r1"), ("foam", "r2"), ("0015_0", "r3")] {
        put_run(&lake, surface, run, json_file(options(Some(Compression::Lz4)), 2)).await;
    }
    for (pattern, expected) in [("flat", 20), ("r2", 20), ("f*", 40), ("*", 60), ("flat, r?", 60), ("00??_0", 20)] {
        let sql = format!("select count(*) from mcap('{pattern}', '/point')");
        assert_eq!(number(&lake, &sql).await, expected, "{sql}");
    }
    assert_eq!(number(&lake, "select count(x) from mcap('*', '/point') where surface_id like 'fo%'").await, 20);
    assert_eq!(number(&lake, "select count(*) from mcap('runs/flat/r1.mcap', '/point') where run_id = 'r1'").await, 20);
    check(&lake, "select distinct run_id from mcap('*', '/note') order by 1", &["r1", "r2", "r3"]).await;
    refused(&lake, "select * from mcap('wood', '/point')", &["no surface and no run is called `wood`"]).await;
    refused(&lake, "select * from mcap('*', '/pint')", &["no topic `/pint`", "/note, /point"]).await;
    refused(&lake, "select * from mcap('*')", &["is called with 1 texts"]).await;
    refused(&lake, "select * from mcap('fl' || 'at', '/point')", &["take texts, written out"]).await;
    for path in ["../x.mcap", "/etc/x.mcap", "file:///x.mcap", "inbox/%2e%2e/x.mcap", "lake.toml/"] {
        refused(&lake, &format!("select * from mcap('{path}', '/point')"), &["is no file in the lake"]).await;
    }
    refused(&lake, "select * from mcap('inbox/none.mcap', '/x')", &["cannot read `inbox/none.mcap`"]).await;
}

/// A metric of EXPLAIN ANALYZE.
pub(crate) async fn metric(lake: &TestLake, sql: &str, name: &str) -> u64 {
    let plan =
        pretty_format_batches(&rows(lake, &format!("explain analyze {sql}")).await).expect("printed").to_string();
    let (_, behind) = plan.split_once(&format!("{name}=")).unwrap_or_else(|| panic!("no {name} in {plan}"));
    let text: String = behind.chars().take_while(|c| c.is_ascii_digit() || *c == '.').collect();
    text.parse().unwrap_or_else(|_| panic!("{name}={behind}"))
}

#[tokio::test]
async fn only_what_is_asked_for_is_read() {
    let lake = lake().await;
    put(&lake, "inbox/j.mcap", json_file(options(None), 40)).await;
    let all = "select x from mcap('inbox/j.mcap', '/point')";
    let chunks = metric(&lake, all, "chunks_read").await;
    assert!(chunks > 40, "{chunks}");
    let whole = metric(&lake, "select size from mcap_messages('inbox/j.mcap')", "chunks_read").await;
    assert_eq!(metric(&lake, all, "chunks_pruned").await, whole - chunks);
    // Notes are in one chunk of each second.
    let notes = "select json from mcap('inbox/j.mcap', '/note')";
    assert_eq!(metric(&lake, notes, "chunks_read").await, 40);
    for (filter, expected) in [
        ("log_time < '2026-01-06T00:00:02Z'", 20),
        ("log_time between '2026-01-06T00:00:10Z' and '2026-01-06T00:00:10.5Z'", 6),
        ("log_time_ns = 1767657605000000000", 1),
        ("log_time_ns > 1767657639000000000", 9),
        ("'2026-01-06T00:00:39Z' <= log_time and x > 97", 10),
        ("log_time > '2027-01-01'", 0),
        ("log_time_ns < -9223372036854775808", 0),
        ("surface_id = 'flat'", 0),
        ("run_id is null", 400),
    ] {
        let sql = format!("select count(x) from mcap('inbox/j.mcap', '/point') where {filter}");
        assert_eq!(number(&lake, &sql).await, expected, "{sql}");
        if expected < 100 {
            let read = metric(&lake, &sql, "chunks_read").await;
            assert!(read * 8 < chunks, "{filter}: {read} of {chunks}");
        }
    }
    assert_eq!(rows(&lake, &format!("{all} limit 7")).await.iter().map(RecordBatch::num_rows).sum::<usize>(), 7);
}

#[tokio::test]
async fn every_way_to_store_messages_is_read() {
    let lake = lake().await;
    let ways: [(&str, WriteOptions); 6] = [
        ("zstd", options(Some(Compression::Zstd))),
        ("lz4", options(Some(Compression::Lz4))),
        ("none", options(None)),
        ("unchunked", options(None).use_chunks(false)),
        ("unindexed", options(None).emit_message_indexes(false).emit_chunk_indexes(false)),
        ("bare", options(None).emit_summary_records(false).emit_summary_offsets(false).calculate_chunk_crcs(false)),
    ];
    for (name, options) in ways {
        put(&lake, &format!("inbox/{name}.mcap"), json_file(options, 20)).await;
        let sql = format!("select count(*), sum(x), min(log_time_ns) from mcap('inbox/{name}.mcap', '/point')");
        check(&lake, &sql, &["200 | 4975.0 | 1767657600000000000"]).await;
        assert_eq!(number(&lake, &format!("select count(*) from mcap_messages('inbox/{name}.mcap')")).await, 220);
    }
}

// What is cut off is missing, what stands in whole chunks before is there.
#[tokio::test]
async fn files_that_are_cut_off_give_what_they_have() {
    let whole = json_file(options(Some(Compression::Zstd)), 5);
    let lake = lake().await;
    let mut seen = 0;
    for length in (0..whole.len()).rev().step_by(61) {
        put(&lake, "inbox/cut.mcap", whole[..length].to_vec()).await;
        let sql = "select count(*) from mcap_messages('inbox/cut.mcap')";
        match try_rows(&lake, sql).await {
            Ok(batches) => {
                let count = batches[0].column(0).as_primitive::<Int64Type>().value(0);
                seen = if seen == 0 { 55 } else { seen };
                assert!(count <= seen, "{length}: {count} after {seen}");
                seen = count.max(1);
            }
            Err(e) => assert!(length < 8, "{length}: {e}"),
        }
    }
}

mod foreign;

mod slow {
    use super::*;

    #[tokio::test]
    async fn a_flipped_bit_is_an_error_or_harmless() {
        let whole = json_file(options(Some(Compression::Zstd)), 5);
        let lake = lake().await;
        let mut state: u64 = 7;
        let (mut errors, mut fine) = (0, 0);
        for _ in 0..600 {
            // A linear congruential generator: Knuth, MMIX.
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let mut file = whole.clone();
            let at = (state >> 16) as usize % file.len();
            file[at] ^= 1 << ((state >> 8) % 8);
            put(&lake, "inbox/flip.mcap", file).await;
            match try_rows(&lake, "select count(*), sum(x) from mcap('inbox/flip.mcap', '/point')").await {
                Ok(batches) => {
                    fine += 1;
                    assert_eq!(batches[0].column(0).as_primitive::<Int64Type>().value(0), 50, "byte {at}");
                }
                Err(e) => {
                    errors += 1;
                    assert!(e.to_string().contains("inbox/flip.mcap"), "byte {at}: {e}");
                }
            }
        }
        assert!(errors > 100 && fine > 100, "{errors} errors, {fine} harmless");
    }
}
