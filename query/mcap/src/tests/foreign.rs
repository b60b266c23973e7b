//! Files of other writers: summaries that leave parts out, messages in odd places, and schemas that are not ours.

use std::collections::BTreeMap;

use echolake_recording::opcode;
use mcap::MAGIC;

use super::*;

/// Bits of [`file_without`].
const PARTS: [&str; 6] = ["channels", "schemas", "statistics", "message indexes", "chunk indexes", "summary offsets"];

/// A file whose summary leaves out the parts whose bits are set.
fn file_without(parts: usize, chunks: bool) -> Vec<u8> {
    let has = |part: &str| PARTS.iter().position(|p| *p == part).is_none_or(|bit| parts & (1 << bit) == 0);
    let options = options(None)
        .use_chunks(chunks)
        .repeat_channels(has("channels"))
        .repeat_schemas(has("schemas"))
        .emit_statistics(has("statistics"))
        .emit_message_indexes(has("message indexes"))
        .emit_chunk_indexes(has("chunk indexes"))
        .emit_summary_offsets(has("summary offsets"));
    json_file(options, 3)
}

#[tokio::test]
async fn topics_say_how_their_file_was_read() {
    let lake = lake().await;
    for (part, expected) in [
        ("nothing", "summary"),
        ("summary offsets", "summary"),
        ("message indexes", "summary"),
        ("channels", "walk: its summary describes 0 of 2 channels"),
        ("schemas", "walk: its summary describes 0 of 1 schemas"),
        ("statistics", "walk: its summary has no statistics"),
        ("chunk indexes", "walk: its summary lists 0 of 4 chunks"),
    ] {
        let parts = PARTS.iter().position(|p| *p == part).map_or(0, |bit| 1 << bit);
        put(&lake, "inbox/p.mcap", file_without(parts, true)).await;
        check(&lake, "select distinct read_by from mcap_topics('inbox/p.mcap')", &[expected]).await;
    }
    let whole = file_without(0, true);
    let sql = "select distinct read_by from mcap_topics('inbox/p.mcap')";
    put(&lake, "inbox/p.mcap", whole[..whole.len() - 20].to_vec()).await;
    check(&lake, sql, &["walk: it has no summary"]).await;
    put(&lake, "inbox/p.mcap", whole[..whole.len() / 2].to_vec()).await;
    let begin = chunks_of(&whole).into_iter().map(|c| c.start).rfind(|at| *at < whole.len() / 2).expect("a chunk");
    check(&lake, sql, &[&format!("walk: it is cut off at byte {begin} of {}", whole.len() / 2)]).await;
}

/// The ranges of a whole file's chunks.
fn chunks_of(file: &[u8]) -> Vec<std::ops::Range<usize>> {
    let (mut found, mut at) = (Vec::new(), MAGIC.len());
    while at < file.len() - MAGIC.len() {
        let length = u64::from_le_bytes(file[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
        found.extend((file[at] == opcode::CHUNK).then_some(at..at + 9 + length));
        at += 9 + length;
    }
    found
}

// A recorder that is killed leaves a chunk whose sizes it had not written yet.
#[tokio::test]
async fn a_last_chunk_that_was_never_closed_is_none() {
    let lake = lake().await;
    let whole = json_file(options(Some(Compression::Zstd)), 5);
    let chunks = chunks_of(&whole);
    let last = chunks.last().expect("chunks");
    let mut open = whole[..last.end - 10].to_vec();
    open[last.start + 1..last.start + 9].fill(0xFF);
    open[last.start + 25..last.start + 33].fill(0xFF);
    put(&lake, "inbox/open.mcap", open.clone()).await;
    put(&lake, "inbox/cut.mcap", whole[..last.start].to_vec()).await;
    let count = |file: &str| format!("select count(*) from mcap_messages('inbox/{file}.mcap')");
    let expected = number(&lake, &count("cut")).await;
    assert!((45..55).contains(&expected), "{expected}");
    assert_eq!(number(&lake, &count("open")).await, expected);
    let read_by = format!("walk: it is cut off at byte {} of {}", last.start, open.len());
    check(&lake, "select distinct read_by from mcap_topics('inbox/open.mcap')", &[&read_by]).await;
    // The same sizes in front of whole chunks are damage: these would be left out.
    let second = &chunks[1];
    let mut damaged = whole[..last.end].to_vec();
    damaged[second.start + 1..second.start + 9].fill(0xFF);
    put(&lake, "inbox/damaged.mcap", damaged).await;
    refused(&lake, &count("damaged"), &[&format!("at byte {}", chunks[2].start), "begins here behind what is read"])
        .await;
}

#[tokio::test]
async fn a_second_file_behind_the_first_is_refused() {
    let lake = lake().await;
    let (one, other) = (json_file(options(None), 2), json_file(options(Some(Compression::Zstd)), 4));
    for (first, second) in [(&one, &other), (&other, &one), (&one, &one)] {
        put(&lake, "inbox/two.mcap", [&first[..], second].concat()).await;
        for function in ["mcap_topics('inbox/two.mcap')", "mcap('inbox/two.mcap', '/point')"] {
            refused(&lake, &format!("select * from {function}"), &["inbox/two.mcap", "another file"]).await;
        }
    }
}

// A chunk in front of the data end, which no summary names. With one, the chunk is listed in its place.
#[tokio::test]
async fn a_channel_or_schema_that_is_used_again_is_refused() {
    let lake = lake().await;
    let whole = json_file(options(None), 2);
    let channel = |id: u16, schema: u16, topic: &str| {
        let text = |text: &str| [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
        let body = [&id.to_le_bytes()[..], &schema.to_le_bytes(), &text(topic), &text("json"), &[0; 4]].concat();
        record(opcode::CHANNEL, &body)
    };
    let schema = |id: u16, name: &str| {
        let text = |text: &str| [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
        record(opcode::SCHEMA, &[&id.to_le_bytes()[..], &text(name), &text("jsonschema"), &text("{}")].concat())
    };
    let chunks = chunks_of(&whole);
    let last = chunks.last().expect("chunks");
    for (again, expected) in [
        (channel(1, 1, "/other"), "channel 1"),
        (channel(1, 0, "/point"), "channel 1"),
        (schema(1, "Other"), "schema 1"),
        (schema(1, "Point"), "schema 1"),
    ] {
        let loose = [&whole[..last.start], &again, &whole[last.start..]].concat();
        put(&lake, "inbox/again.mcap", loose[..loose.len() - 60].to_vec()).await;
        refused(&lake, "select * from mcap('inbox/again.mcap', '/point')", &[expected, "is used again"]).await;
    }
    // The definition of the first chunk is other than that of the summary.
    for (part, other) in [("/point", "/joint"), ("\"name\":", "\"nome\":")] {
        let mut file = json_file(options(None).calculate_chunk_crcs(false), 2);
        let at = file.windows(part.len()).position(|w| w == part.as_bytes()).expect("it is there");
        assert!(chunks_of(&file)[0].contains(&at));
        file[at..at + part.len()].copy_from_slice(other.as_bytes());
        put(&lake, "inbox/again.mcap", file).await;
        refused(&lake, "select * from mcap('inbox/again.mcap', '/point')", &["is used again: with other content"])
            .await;
    }
}

#[tokio::test]
async fn names_in_files_and_errors_of_libraries_control_no_terminal() {
    let lake = lake().await;
    let channel =
        TestChannel { topic: "/\u{1b}[31m", encoding: "json", schema: ("T", "jsonschema", b"{"), messages: &[b"1"] };
    put(&lake, "inbox/e.mcap", file_of(&[channel])).await;
    refused(&lake, "select * from mcap('inbox/e.mcap', '/x')", &["the topics are /\\u{1b}[31m"]).await;
    // A channel whose topic is no text.
    let broken = record(opcode::CHANNEL, &[&[1, 0, 0, 0][..], &4u32.to_le_bytes(), &[0xFF; 4], &[0; 8]].concat());
    let file = [MAGIC, &record(opcode::HEADER, &[0; 8]), &broken, &record(opcode::DATA_END, &[0; 4])].concat();
    put(&lake, "inbox/b.mcap", file).await;
    let error = try_rows(&lake, "select * from mcap_topics('inbox/b.mcap')").await.map(|_| ()).expect_err("damaged");
    let error = error.to_string();
    assert!(error.contains("inbox/b.mcap") && error.contains("Record parse failed"), "{error}");
    assert!(!error.contains(".rs") && !error.contains('\u{1b}') && error.lines().count() == 1, "{error}");
}

fn record(code: u8, body: &[u8]) -> Vec<u8> {
    [&[code], (body.len() as u64).to_le_bytes().as_slice(), body].concat()
}

fn message_record(channel: u16, log_time: u64, data: &[u8]) -> Vec<u8> {
    let times = [log_time.to_le_bytes(), 0u64.to_le_bytes()].concat();
    record(opcode::MESSAGE, &[&channel.to_le_bytes(), 9u32.to_le_bytes().as_slice(), &times, data].concat())
}

// A message behind the chunks, in front of the end of the data, that the summary knows nothing of.
#[tokio::test]
async fn messages_outside_of_the_chunks_are_found() {
    let mut file = json_file(options(None), 3);
    let footer = file.len() - MAGIC.len() - 20;
    let summary = u64::from_le_bytes(file[footer..footer + 8].try_into().expect("eight bytes"));
    let loose = message_record(1, START, br#"{"x":1000}"#);
    let bytes = loose.len() as u64;
    file[footer..footer + 8].copy_from_slice(&(summary + bytes).to_le_bytes());
    // No place of summary offsets and no CRC.
    file[footer + 8..footer + 20].fill(0);
    let data_end = summary as usize - 13;
    file.splice(data_end..data_end, loose);
    let lake = lake().await;
    put(&lake, "inbox/l.mcap", file).await;
    check(&lake, "select count(*), sum(x) from mcap('inbox/l.mcap', '/point')", &["31 | 1108.75"]).await;
    let expected = ["walk: its summary lists chunks, but there are messages elsewhere"];
    check(&lake, "select distinct read_by from mcap_topics('inbox/l.mcap')", &expected).await;
}

#[tokio::test]
async fn a_message_of_a_channel_that_nothing_describes_is_damage() {
    let header = record(opcode::HEADER, &[0; 8]);
    let end = record(opcode::DATA_END, &[0; 4]);
    let file = [MAGIC, &header, &message_record(7, START, b"{}"), &end].concat();
    let lake = lake().await;
    put(&lake, "inbox/u.mcap", file).await;
    for function in ["mcap_topics('inbox/u.mcap')", "mcap_messages('inbox/u.mcap')"] {
        let sql = format!("select * from {function}");
        refused(&lake, &sql, &["channel 7, which no record describes", "at byte 25"]).await;
    }
}

#[tokio::test]
async fn a_channel_of_an_unknown_encoding_leaves_the_others_their_columns() {
    let lake = lake().await;
    let known = || json_channel(NUMBERS, &[br#"{"x":1.5}"#]);
    let unknown = |messages| TestChannel { topic: "/t", encoding: "smoke", schema: ("S", "signals", b"?"), messages };
    put(&lake, "inbox/none.mcap", file_of(&[known(), unknown(&[])])).await;
    check(&lake, "select x from mcap('inbox/none.mcap', '/t')", &["1.5"]).await;
    put(&lake, "inbox/some.mcap", file_of(&[unknown(&[b"puff"]), known()])).await;
    check(&lake, "select x from mcap('inbox/some.mcap', '/t') order by x", &["1.5", ""]).await;
    put(&lake, "inbox/empty.mcap", file_of(&[unknown(&[])])).await;
    refused(&lake, "select * from mcap('inbox/empty.mcap', '/t')", &["`smoke`", "`signals`"]).await;
    for (encoding, schema) in [("smoke", "signals"), ("ros1", "ros1msg"), ("flatbuffer", "flatbuffer"), ("cbor", "")] {
        let schema = (if schema.is_empty() { "" } else { "S" }, schema, b"?".as_slice());
        let channel = TestChannel { topic: "/t", encoding, schema, messages: &[b"puff"] };
        put(&lake, "inbox/alone.mcap", file_of(&[channel])).await;
        let encoding = format!("its messages are `{encoding}` with");
        let texts = [&encoding, schema.1, "decoded are `protobuf` with", "`cdr` with", "hint: mcap_messages"];
        refused(&lake, "select * from mcap('inbox/alone.mcap', '/t')", &texts).await;
        let sql = "select arrow_cast(data, 'Utf8') from mcap_messages('inbox/alone.mcap', '/t')";
        check(&lake, sql, &["puff"]).await;
    }
    // One without messages whose column has another type does not stand in the way.
    let other = json_channel(r#"{"properties":{"x":{"type":"string"}}}"#, &[]);
    put(&lake, "inbox/other.mcap", file_of(&[other, known()])).await;
    check(&lake, "select x from mcap('inbox/other.mcap', '/t')", &["1.5"]).await;
}

#[tokio::test]
async fn fields_keep_apart_whatever_their_names() {
    let schema = r#"{"properties":{"message_sequence":{"type":"string"},"sequence":{"type":"string"},
        "message_message_sequence":{"type":"string"},"log_time":{"type":"string"}}}"#;
    let message = br#"{"sequence":"a","message_sequence":"b","message_message_sequence":"c","log_time":"d"}"#;
    let lake = lake().await;
    put(&lake, "inbox/n.mcap", file_of(&[json_channel(schema, &[message])])).await;
    check(
        &lake,
        "select sequence, message_sequence, message_message_sequence, message_message_message_sequence, \
         message_log_time from mcap('inbox/n.mcap', '/t')",
        &["0 | b | c | a | d"],
    )
    .await;
}

#[tokio::test]
async fn times_that_64_bits_do_not_hold_are_null() {
    let mut file = Cursor::new(Vec::new());
    let mut writer = options(None).create(&mut file).expect("a writer");
    let channel = writer.add_channel(0, "/t", "json", &BTreeMap::new()).expect("added");
    for (log_time, publish_time) in [(5, u64::MAX), (1 << 63, 5), (u64::MAX, u64::MAX), ((1 << 63) - 1, 5)] {
        let header = MessageHeader { channel_id: channel, sequence: 0, log_time, publish_time };
        writer.write_to_known_channel(&header, b"{}").expect("written");
    }
    writer.finish().expect("finished");
    drop(writer);
    let lake = lake().await;
    put(&lake, "inbox/t.mcap", file.into_inner()).await;
    check(
        &lake,
        "select log_time_ns, cast(publish_time as bigint) from mcap_messages('inbox/t.mcap') order by 1, 2",
        &["5 | ", "9223372036854775807 | 5", " | 5", " | "],
    )
    .await;
    let count = |filter: &str| format!("select count(*) from mcap('inbox/t.mcap', '/t') where {filter}");
    for (filter, expected) in [
        ("true", 4),
        ("log_time_ns >= 0", 2),
        ("log_time_ns <= 9223372036854775807", 2),
        ("log_time_ns is null", 2),
        ("log_time > '2026-01-01T00:00:00Z'", 1),
    ] {
        assert_eq!(number(&lake, &count(filter)).await, expected, "{filter}");
    }
}

mod slow {
    use super::*;

    #[tokio::test]
    async fn a_summary_that_leaves_parts_out_hides_nothing() {
        let lake = lake().await;
        for (parts, chunks) in (0..1 << PARTS.len()).flat_map(|parts| [(parts, true), (parts, false)]) {
            let path = format!("inbox/{parts}_{chunks}.mcap");
            put(&lake, &path, file_without(parts, chunks)).await;
            check(&lake, &format!("select count(*), sum(x) from mcap('{path}', '/point')"), &["30 | 108.75"]).await;
            assert_eq!(number(&lake, &format!("select count(*) from mcap_messages('{path}')")).await, 33);
            check(
                &lake,
                &format!(
                    "select topic, schema_name, messages, first_time, last_time from mcap_topics('{path}') order by 1"
                ),
                &[
                    "/note |  | 3 | 2026-01-06T00:00:00Z | 2026-01-06T00:00:02Z",
                    "/point | Point | 30 | 2026-01-06T00:00:00Z | 2026-01-06T00:00:02.900Z",
                ],
            )
            .await;
        }
    }
}
