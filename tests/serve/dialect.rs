//! SQL over the three protocols and the prompt: errors have place and hint, and all but Postgres' read one dialect.

use arrow_flight::error::FlightError;
use arrow_flight::sql::CommandGetTables;
use arrow_flight::sql::client::FlightSqlServiceClient;
use futures::TryStreamExt as _;
use tonic::transport::{Channel, Endpoint};

use super::http::HttpRequest;
use super::server::{ANSWER_LIMIT, ServedLake};
use super::{json, lake, postgres, served, sql};

/// A wrong statement, and what every protocol says of it.
struct WrongStatement {
    sql: &'static str,
    /// Line and column, from 1.
    place: (u64, u64),
    hint: &'static str,
}

const WRONG: [WrongStatement; 7] = [
    WrongStatement { sql: "select nonsense from runs", place: (1, 8), hint: "the columns are surface_id" },
    WrongStatement { sql: "select 'é',\n  pair_idd from pairs", place: (2, 3), hint: "did you mean `pair_id`?" },
    WrongStatement { sql: "select * from rums", place: (1, 15), hint: "did you mean `runs`?" },
    WrongStatement { sql: "selec 1", place: (1, 1), hint: "docs/clients.md" },
    WrongStatement { sql: "select *\nfrom points\ntablesample (10)", place: (3, 1), hint: "random()" },
    WrongStatement { sql: "select 1 +", place: (1, 11), hint: "docs/clients.md" },
    WrongStatement { sql: "select formatt(1)", place: (1, 8), hint: "SHOW FUNCTIONS" },
];

/// Friendly statements, and the one cell of their answers.
const FRIENDLY: [(&str, &str); 5] = [
    ("from pairs select count()", "45"),
    ("select max(columns('pair_.*')) from pairs", "44"),
    ("select arg_max(pair_id, -pair_id) as least from pairs", "0"),
    ("summarize select pair_id from pairs", "pair_id"),
    ("select count(*) from pairs version as of 0", "45"),
];

/// Statements that fail in the parser, the planner, functions, casts, readers of files, and limits.
const FAILING: [&str; 24] = [
    "select 1/0",
    "select 1/(pair_id - pair_id) from pairs",
    "select cast(panel as int) from surfaces",
    "select 9223372036854775807 + pair_id from pairs",
    "select regexp_match(panel, '(') from surfaces",
    "select arrow_cast(1, 'Nonsense')",
    "select date_trunc('nonsense', now())",
    "select to_timestamp(panel) from surfaces",
    "select [1][panel] from surfaces",
    "select * from mcap('nothing')",
    "select * from mcap('inbox/bad.mcap')",
    "select * from mcap('inbox/bad.mcap', '/ir')",
    "select nce_centre(1)",
    "select avg_list(1)",
    "select interval 'x'",
    "select (select pair_id from pairs)",
    "select repeat(panel, 10000000000) from surfaces",
    "select * from generate_series(1, 'x')",
    "select sum(panel) from surfaces",
    "select * from runs version as of 999999",
    "select cast(1e300 as decimal(3, 1))",
    "select x'zz'",
    "drop table runs",
    "select unnest(1)",
];

// What a backtrace, a path of the machine that built the program, and colours of a terminal have in them.
fn check_no_trace(statement: &str, text: &str) {
    let marks = ["backtrace", "/.cargo/", "/rustc/", ".rs:", "src/", "\u{1b}", "\\u001b", env!("CARGO_MANIFEST_DIR")];
    for mark in marks {
        assert!(!text.to_lowercase().contains(&mark.to_lowercase()), "{mark:?} in the error of {statement}: {text}");
    }
}

fn position(sql: &str, (line, column): (u64, u64)) -> String {
    let above: usize = sql.split_inclusive('\n').take(line as usize - 1).map(|line| line.chars().count()).sum();
    (above as u64 + column).to_string()
}

#[test]
fn errors_over_http_have_place_and_hint() {
    let folder = lake();
    let server = served(&folder, &[]);
    for WrongStatement { sql: text, place, hint } in WRONG {
        let problem = json(&sql(&server, text));
        let detail = problem["detail"].as_str().expect("a detail");
        assert!(problem["hint"].as_str().is_some_and(|given| given.contains(hint)), "{problem}");
        assert!(detail.contains("hint: "), "{detail}");
        let given = &problem["place"];
        assert_eq!(given["line"].as_u64().zip(given["column"].as_u64()), Some(place), "{problem}");
        assert_eq!(given["position"].to_string(), position(text, place), "{problem}");
        let mark = given["mark"].as_str().expect("a mark");
        assert!(mark.ends_with('^') && detail.contains(mark), "{problem}");
    }
}

#[test]
fn errors_over_postgres_have_position_and_hint() {
    let folder = lake();
    let server = served(&folder, &[]);
    let mut client = postgres::WireClient::connect(&server, None);
    for WrongStatement { sql, place, hint } in WRONG {
        let fields = client.refusal(sql);
        assert_eq!(fields.get(&'P').cloned(), Some(position(sql, place)), "{sql}: {fields:?}");
        assert!(fields.get(&'H').is_some_and(|given| given.contains(hint)), "{sql}: {fields:?}");
        assert!(fields.get(&'M').is_some_and(|message| !message.contains("hint:")), "{sql}: {fields:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_over_flight_sql_have_place_and_hint() {
    let folder = lake();
    let server = served(&folder, &[]);
    let mut client = connect(&server).await;
    for WrongStatement { sql, place, hint } in WRONG {
        let Err(FlightError::Tonic(status)) = first_cell(&mut client, sql).await else { panic!("{sql}: no refusal") };
        let text = status.message();
        assert!(text.split_once("hint: ").is_some_and(|(_, given)| given.contains(hint)), "{text}");
        let number = |key: &str| status.metadata().get(key)?.to_str().ok()?.parse::<u64>().ok();
        assert_eq!(number("echolake-line").zip(number("echolake-column")), Some(place), "{text}");
        assert!(text.contains('^'), "{text}");
    }
    drop(client);
    tokio::task::spawn_blocking(move || drop(server)).await.expect("ended");
}

#[tokio::test(flavor = "multi_thread")]
async fn no_error_tells_where_the_program_was_built() {
    let folder = lake();
    // The server is started with RUST_BACKTRACE=1. A file whose second record, the header, is longer than it says.
    let broken = [b"\x89MCAP0\r\n\x01", &22_u64.to_le_bytes()[..], &[0xff; 4], &[0xc3; 600]].concat();
    std::fs::create_dir_all(folder.path("lake/inbox")).expect("a folder");
    std::fs::write(folder.path("lake/inbox/bad.mcap"), broken).expect("written");
    let server = served(&folder, &[]);
    let mut postgres = postgres::WireClient::connect(&server, None);
    let mut flight = connect(&server).await;
    let mut failed = 0;
    for statement in FAILING {
        let over_http = sql(&server, statement);
        check_no_trace(statement, &over_http.text());
        failed += u32::from(over_http.status != 200);
        check_no_trace(statement, &format!("{:?}", postgres.refusal(statement)));
        if let Err(error) = first_cell(&mut flight, statement).await {
            check_no_trace(statement, &format!("{error:?}"));
        }
    }
    assert!(failed > 20, "{failed} failures");
    let inbox = sql(&server, "select * from system.inbox").text();
    assert!(inbox.contains("bad.mcap"), "{inbox}");
    check_no_trace("select * from system.inbox", &inbox);
    drop((flight, postgres));
    tokio::task::spawn_blocking(move || drop(server)).await.expect("ended");
}

#[tokio::test(flavor = "multi_thread")]
async fn http_flight_sql_and_the_prompt_read_one_dialect() {
    let folder = lake();
    let server = served(&folder, &[]);
    let mut client = connect(&server).await;
    for (text, expected) in FRIENDLY {
        let request = HttpRequest::post("/api/v1/sql?format=csv", text).with("content-type", "text/plain");
        let answer = request.send(&server).text();
        let cell = answer.lines().nth(1).and_then(|line| line.split(',').next());
        assert_eq!(cell, Some(expected), "{text}: {answer}");
        let over_flight = first_cell(&mut client, text).await.unwrap_or_else(|e| panic!("{text}: {e}"));
        assert_eq!(over_flight, expected, "{text}");
        let printed = folder.ok(&["sql", text, "--format", "csv"]);
        let cell = printed.lines().nth(1).and_then(|line| line.split(',').next());
        assert_eq!(cell, Some(expected), "{text}: {printed}");
    }
    drop(client);
    tokio::task::spawn_blocking(move || drop(server)).await.expect("ended");
}

#[tokio::test(flavor = "multi_thread")]
async fn system_tables_are_listed_over_flight_sql() {
    let place = lake();
    let server = served(&place, &[]);
    let mut client = connect(&server).await;
    let wanted = CommandGetTables {
        db_schema_filter_pattern: Some("system".to_owned()),
        include_schema: true,
        ..CommandGetTables::default()
    };
    let info = client.get_tables(wanted).await.expect("a list");
    let ticket = info.endpoint.into_iter().find_map(|endpoint| endpoint.ticket).expect("a ticket");
    let batches: Vec<_> = client.do_get(ticket).await.expect("rows").try_collect().await.expect("rows");
    assert_eq!(batches.iter().map(|batch| batch.num_rows()).sum::<usize>(), 7);
}

pub(super) async fn connect(server: &ServedLake) -> FlightSqlServiceClient<Channel> {
    let endpoint = Endpoint::from_shared(format!("http://{}", server.flight_sql)).expect("a URL");
    let channel = endpoint.connect_timeout(ANSWER_LIMIT).timeout(ANSWER_LIMIT).connect().await;
    FlightSqlServiceClient::new(channel.expect("connected"))
}

async fn first_cell(client: &mut FlightSqlServiceClient<Channel>, sql: &str) -> Result<String, FlightError> {
    let info = client.execute(sql.to_owned(), None).await?;
    let ticket = info.endpoint.into_iter().find_map(|endpoint| endpoint.ticket).expect("a ticket");
    let batches: Vec<_> = client.do_get(ticket).await?.try_collect().await?;
    let batch = batches.iter().find(|batch| batch.num_rows() > 0).ok_or(FlightError::DecodeError("no row".into()))?;
    Ok(arrow::util::display::array_value_to_string(batch.column(0), 0).expect("a cell"))
}
