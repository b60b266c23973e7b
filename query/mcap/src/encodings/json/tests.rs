//! JSON as columns: by schema or as text, and what JSON lacks.

use mcap::Compression;

use crate::tests::{NUMBERS, check, file_of, json_channel, json_file, lake, metric, number, options, put, refused};

#[tokio::test]
async fn json_channels_are_columns_by_their_schema_or_text() {
    let lake = lake().await;
    put(&lake, "inbox/j.mcap", json_file(options(Some(Compression::Zstd)), 3)).await;
    check(
        &lake,
        "select run_id, log_time, sequence, x, name, tags, \"at\", message_sequence \
         from mcap('inbox/j.mcap', '/point') where sequence in (0, 17) order by log_time_ns",
        &[
            " | 2026-01-06T00:00:00Z | 0 | 0.0 | p0 | [0, 1] | {z: -0.0} | 0",
            " | 2026-01-06T00:00:01.700Z | 17 | 4.25 | p17 | [17, 1] | {z: -4.25} | 17",
        ],
    )
    .await;
    check(&lake, "select json from mcap('inbox/j.mcap', '/note') limit 1", &[r#"{"free":"form"}"#]).await;
    check(
        &lake,
        "select topic, size, arrow_cast(data, 'Utf8') from mcap_messages('inbox/j.mcap', '/note') limit 1",
        &[r#"/note | 15 | {"free":"form"}"#],
    )
    .await;
    assert_eq!(number(&lake, "select count(*) from MCAP_MESSAGES('inbox/j.mcap')").await, 33);
    let sql = "select count(*) from mcap('inbox/j.mcap', '/point') a \
               join mcap('inbox/j.mcap', '/note') b on a.log_time_ns = b.log_time_ns";
    assert_eq!(number(&lake, sql).await, 3);
}

#[tokio::test]
async fn numbers_that_json_lacks_are_null_and_counted() {
    let lake = lake().await;
    let messages: [&[u8]; 5] = [
        br#"{"x":NaN,"n":1,"small":-Infinity}"#,
        br#"{"x":2.5,"n":Infinity,"small":3}"#,
        b"\xef\xbb\xbf{\"x\":\"\\\"NaN\\\\\",\"n\":NaN,\"small\":10}",
        br#"{"x":4,"n":"5","small":1.5}"#,
        br#"{"x":1e400,"n":-2E999,"small":1e0}"#,
    ];
    let schema = format!("\u{feff}{NUMBERS}");
    put(&lake, "inbox/n.mcap", file_of(&[json_channel(&schema, &messages)])).await;
    let sql = "select x, n, small from mcap('inbox/n.mcap', '/t') order by sequence";
    check(&lake, sql, &[" | 1 | ", "2.5 |  | 3", " |  | 10", "4.0 |  | ", " |  | 1"]).await;
    // Two of the first message, one of the second, two of each other.
    assert_eq!(metric(&lake, sql, "values_unfit").await, 9);
    put(&lake, "inbox/n.mcap", file_of(&[json_channel(NUMBERS, &[br#"{"x":Nan}"#])])).await;
    refused(&lake, "select x from mcap('inbox/n.mcap', '/t')", &["it is no JSON object"]).await;
}

#[tokio::test]
async fn integers_of_json_are_values_however_they_are_written() {
    let lake = lake().await;
    let numbers = ["7", "-7", "1.0", "1e3", "9223372036854775808", "18446744073709551615", "-9223372036854775808"];
    let messages: Vec<String> = numbers.iter().map(|n| format!(r#"{{"n":{n}}}"#)).collect();
    let messages: Vec<&[u8]> = messages.iter().map(String::as_bytes).collect();
    put(&lake, "inbox/i.mcap", file_of(&[json_channel(NUMBERS, &messages)])).await;
    let sql = "select n from mcap('inbox/i.mcap', '/t') order by sequence";
    let expected = ["7", "-7", "1", "1000", "9223372036854775808", "18446744073709551615", "-9223372036854775808"];
    check(&lake, sql, &expected).await;
    assert_eq!(metric(&lake, sql, "values_unfit").await, 0);
    let beyond: [&[u8]; 2] = [br#"{"n":18446744073709551616}"#, br#"{"n":1.5}"#];
    put(&lake, "inbox/b.mcap", file_of(&[json_channel(NUMBERS, &beyond)])).await;
    let sql = "select count(n), count(*) from mcap('inbox/b.mcap', '/t')";
    check(&lake, sql, &["0 | 2"]).await;
    check(
        &lake,
        "select arrow_typeof(small), arrow_typeof(n) from mcap('inbox/i.mcap', '/t') limit 1",
        &["Int64 | Decimal128(20, 0)"],
    )
    .await;
}
