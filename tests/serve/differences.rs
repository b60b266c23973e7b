//! One statement has one answer: three hundred of them over HTTP, Flight SQL and both of Postgres' protocols.

use std::collections::BTreeSet;

use arrow::array::{Array, ArrayRef, AsArray as _};
use arrow::datatypes::DataType;
use arrow::record_batch::RecordBatch;
use arrow::util::display::array_value_to_string;
use arrow_flight::sql::client::FlightSqlServiceClient;
use futures::TryStreamExt as _;
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tonic::transport::Channel;

use super::dialect::connect;
use super::http::HttpRequest;
use super::postgres::{TextRows, WireClient};
use super::server::ServedLake;
use super::{lake, served};

/// Statements in all, and how many of them have to be answered; the others are refused over all protocols.
const STATEMENTS: usize = 300;
const ANSWERED: usize = 285;
const SEED: u64 = 50;

/// A statement that Postgres' protocol answers in another way than HTTP and Flight SQL, and why.
struct ProtocolDifference {
    sql: &'static str,
    reason: &'static str,
    /// The first cell, or the beginning of the refusal.
    over_http: Result<&'static str, &'static str>,
    over_postgres: Result<&'static str, &'static str>,
}

const DIFFERENCES: [ProtocolDifference; 5] = [
    ProtocolDifference {
        sql: r#"select '{a,"b,c"}'::text[] as v from pairs limit 1"#,
        reason: "Postgres writes arrays as texts; elsewhere a text is one element",
        over_http: Ok(r#"[{a,"b,c"}]"#),
        over_postgres: Ok(r#"{a,"b,c"}"#),
    },
    ProtocolDifference {
        sql: "select current_user as v from pairs limit 1",
        reason: "what Postgres' clients ask about their session is answered there alone",
        over_http: Err("no column `current_user`"),
        over_postgres: Ok("postgres"),
    },
    ProtocolDifference {
        sql: "from pairs select [2, 4] as v limit 1",
        reason: "friendly SQL that Postgres' grammar does not know is read as over HTTP, the rest as Postgres reads it",
        over_http: Ok("[2, 4]"),
        over_postgres: Ok("{2,4}"),
    },
    ProtocolDifference {
        sql: "select distinct lower(surface_id) as v from measurements order by lower(surface_id)",
        reason: "over Postgres distinct rows may be ordered by the expression of a column, elsewhere by its name",
        over_http: Err("ORDER BY expressions"),
        over_postgres: Ok("flat"),
    },
    ProtocolDifference {
        sql: "select 1e20::numeric as v from pairs limit 1",
        reason: "the library writes decimals of 96 bits",
        over_http: Ok("100000000000000001988.4624838656"),
        over_postgres: Err("0A000"),
    },
];

/// Statements of the kinds that were answered wrong once, and others that generators do not write.
const WRITTEN: &[&str] = &[
    "select array(select band from surface_stats where surface_id = 'flat' order by band desc) as v",
    "select array(select x from unnest(array[3, 1, 2]) as t(x)) as v from pairs limit 1",
    "select array_agg(pair_id order by pair_id desc) as v from pairs where pair_id < 5",
    "select case surface_id when 't' then 1 when 'flat' then 2 end as v from runs",
    "select case x when 't' then 1 else 0 end as v from (values ('true'), ('t'), ('false')) as q(x) order by v",
    "select (select max(direct_mm) from pairs p where p.speaker = q.speaker) as v from points, pairs q where point_id \
     = 0 order by q.pair_id limit 9",
    "select (select pair_id from pairs order by pair_id desc limit 1) as v from points where point_id = 0",
    "select 2.7::int as a, 3.5::int as b, -2.5::int as c, 0.49::bigint as d from pairs limit 1",
    "select cast(direct_mm / 7 as int) as v from pairs order by pair_id",
    "select cast(cast(direct_mm / 7 as decimal(12, 4)) as bigint) as v from pairs order by pair_id",
    "select count(*) as v from pairs group by cast(direct_mm / 100 as int) order by cast(direct_mm / 100 as int)",
    "select to_char(timestamp '2026-01-05 08:09:10.123456', 'YYYY-MM-DD HH24:MI:SS.MS') as v from pairs limit 1",
    "select to_char(log_time, 'FMDay DD Mon YYYY') as v from measurements order by pair_id limit 3",
    "select to_char(log_time, '%Y-%m-%d') as v from measurements order by pair_id limit 3",
    "select to_char(log_time, 'YYYY-Q') as v from measurements limit 1",
    "select to_timestamp('2026-01-05 08:09:10.5', 'YYYY-MM-DD HH24:MI:SS.US') as v from pairs limit 1",
    "select to_date('05/01/2026', 'DD/MM/YYYY') as v from pairs limit 1",
    "select coalesce(null, 5) as v, nullif(pair_id, 1) as w from pairs order by pair_id limit 3",
    "select 1.5::numeric as v, 12345678901234567890.5::numeric(30, 2) as w from pairs limit 1",
    "select timestamp '2026-01-05 08:00:00' as v, date '2026-01-05' as w, time '08:00:01' as x from pairs limit 1",
    "select timestamp '2026-01-05 08:00' as v from pairs limit 1",
    "select age(log_time) as v from measurements limit 1",
    // E18: one meaning of zones.
    "select timestamptz '2026-07-14 22:30:00+00' at time zone 'Europe/Berlin' as v",
    "select (to_timestamp(1784068200) at time zone 'Europe/Berlin')::date as v from pairs limit 1",
    "select timestamp '2026-07-15 00:30' at time zone 'Europe/Berlin' as v from pairs limit 1",
    // W1, W2.
    "select sum(log_time_ns) as v, sum(pair_id) over () as w from measurements group by pair_id order by pair_id",
    "select count(*) as v from pairs where pair_id > any (select pair_id from pairs where pair_id < 5)",
    "select nce_centre(ir) as v from measurements limit 1",
    "select 'NaN'::double as v, 'inf'::double as w, '-inf'::real as x from pairs limit 1",
    "select cast('NaN'::double as int) as v from pairs limit 1",
    "select 9223372036854775807 as v, -9223372036854775808 as w, 18446744073709551615 as x from pairs limit 1",
    "select 9223372036854775807 + pair_id as v from pairs order by pair_id desc limit 1",
    "select 0.1 + 0.2 as v, 1.0::real / 3 as w, 7 / 2 as x, -7 % 3 as y from pairs limit 1",
    "select 'it''s \"quoted\", {braced}, back\\slash, é, 	tab' as v from pairs limit 1",
    "select E'line\\nbreak' as v, '' as w, null as x from pairs limit 1",
    "select make_array('a,b', 'c \"d\"', null, '', 'NULL', '{}') as v from pairs limit 1",
    "select array[1.5, null, 'NaN'::double] as v, array[true, null] as w from pairs limit 1",
    "select make_array(make_array(1, 2), make_array(3)) as v, map(['a'], [1]) as w from pairs limit 1",
    "select ir as v from measurements order by pair_id limit 2",
    "select ir[1] as a, ir[-1] as b, ir[1:3] as c, array_length(ir) as d from measurements order by pair_id limit 3",
    "select arrow_cast('ab\\x', 'Binary') as v, decode('00ff', 'hex') as w from pairs limit 1",
    "select log_time + interval '1 day 2 hours' as v, log_time - interval '3 months' as w from measurements limit 1",
    "select date_trunc('hour', log_time) as v, extract(year from log_time) as w from measurements limit 1",
    "select max(log_time) - min(log_time) > interval '0 seconds' as v from measurements",
    "select row_number() over (order by pair_id) as v, rank() over (order by speaker) as w from pairs order by 1 limit \
        9",
    "select ntile(4) over (order by pair_id) as v, lag(pair_id) over (order by pair_id) as w from pairs order by \
        pair_id",
    "select pair_id from pairs where pair_id = any(array[1, 2, 99]) order by 1",
    "select pair_id from pairs where pair_id <> all(array[1, 2, null]) order by 1",
    "select pair_id from pairs where pair_id < any(array[2, 3]) order by 1",
    "select pair_id from pairs where pair_id in (select pair_id from measurements where snr_db > 0) order by 1",
    "select pair_id from pairs p where exists (select 1 from measurements m where m.pair_id = p.pair_id) order by 1",
    "select exists (select 1 from measurements where snr_db > 1e9) as v from pairs limit 1",
    "select not true as a, true and null as b, null or true as c, null = null as d from pairs limit 1",
    "select x from (values (1), (null), (3)) as t(x) order by x nulls first",
    "select unnest(array[3, 1, 2]) as v order by 1",
    "select generate_series(1, 4) as v from pairs limit 1",
    "select value from generate_series(1, 4) order by 1",
    "select sum(value) as v from generate_series(1, 1000)",
    "select distinct lower(surface_id) as v from measurements order by v",
    "select surface_id, count(*) from measurements group by surface_id having count(*) > 1 order by count(*)",
    "select pair_id::text as v from pairs where pair_id::text like '1%' order by pair_id::int",
    "select 'a_b' like 'a\\_b' as v, 'axb' like 'a\\_b' as w, 'A' ilike 'a' as x, 'abc' ~ '^a' as y from pairs limit 1",
    "select 'a_b' like 'a/_b' escape '/' as v from pairs limit 1",
    "with t as (select pair_id as p from pairs where pair_id < 3) select p, p * p as q from t order by p",
    "select pair_id from pairs union all select point_id from points order by 1 limit 20",
    "select pair_id from pairs intersect select point_id from points order by 1",
    "select pair_id, * from pairs limit 1",
    "select count(distinct speaker) as v, count(*) filter (where pair_id > 5) as w from pairs",
    "select string_agg(surface_id, ',' order by surface_id) as v from runs",
    "select p.pair_id, m.snr_db from pairs p left join measurements m on m.pair_id = p.pair_id order by 1 limit 7",
    "select nothing from pairs",
    "select pair_id from pairs where pair_id = 'x'",
    "select 1 / (pair_id - pair_id) as v from pairs",
    "select pg_catalog.count(*) as v from pairs",
    "select relname as v from pg_class, pairs limit 1",
];

/// Statements with one placeholder: its value as text, and as SQL.
const BOUND: [(&str, &str, &str); 14] = [
    ("select coalesce($1, 5) as v from pairs limit 1", "7", "7"),
    ("select nullif(pair_id, $1) as v from pairs order by pair_id limit 3", "1", "1"),
    ("select pair_id from pairs where pair_id = any($1) order by 1", "{ 1, 2 ,99}", "array[1, 2, 99]"),
    ("select run_id = any($1) as v from runs", r#"{"a,b","c \"d\"",NULL}"#, r#"array['a,b', 'c "d"', null]"#),
    ("select $1::text[] as v from pairs limit 1", r#"{"a,b","",NULL,"NULL"}"#, "array['a,b', '', null, 'NULL']"),
    ("select x = any($1) as v from (values ('a,b'), ('')) as t(x)", r#"{"a,b",""}"#, "array['a,b', '']"),
    ("select $1::int as v from pairs limit 1", "3", "3"),
    ("select pair_id from pairs where direct_mm > $1 order by 1 limit 4", "200.5", "200.5"),
    ("select count(*) as v from measurements where surface_id = $1", "flat", "'flat'"),
    (
        "select count(*) as v from measurements where log_time > $1::timestamptz",
        "2020-01-01 00:00:00+00",
        "'2020-01-01 00:00:00+00'",
    ),
    ("select pair_id from pairs order by 1 limit $1", "3", "3"),
    ("select pair_id from pairs where not $1::boolean order by 1 limit 2", "f", "false"),
    ("select case when pair_id > $1 then 'more' else 'less' end as v from pairs order by pair_id limit 3", "1", "1"),
    ("select greatest(pair_id, $1) as v from pairs order by pair_id limit 5", "3", "3"),
];

struct StatementGenerator(ChaCha8Rng);

impl StatementGenerator {
    fn pick(&mut self, texts: &[&str]) -> String {
        (*texts.choose(&mut self.0).expect("a text")).to_owned()
    }

    fn number(&mut self) -> String {
        let n = self.0.random_range(1..40);
        let kinds = [
            "pair_id",
            "microphone + speaker",
            "direct_mm",
            "image_mm - direct_mm",
            "sqrt(direct_mm)",
            "-incidence_deg",
        ];
        let number = self.pick(&kinds);
        match self.0.random_range(0..5) {
            0 => format!("{number} * {n}"),
            1 => format!("round({number} / {n}, 3)"),
            2 => format!("nullif({number}, {n})"),
            3 => format!("abs({number} - {n})"),
            _ => number,
        }
    }

    fn condition(&mut self) -> String {
        let n = self.0.random_range(0..45);
        match self.0.random_range(0..6) {
            0 => format!("pair_id between {n} and {}", n + 9),
            1 => format!("direct_mm > {}.5", n * 8),
            2 => format!("pair_id % 7 = {}", n % 7),
            3 => format!("pair_id in ({n}, 3, 5, null)"),
            4 => format!("not (microphone = {} or speaker > {n})", n % 9),
            _ => format!("pair_id = any(array[{n}, 4, 8])"),
        }
    }

    fn statement(&mut self) -> String {
        let (number, condition, limit) = (self.number(), self.condition(), self.0.random_range(1..12));
        let (second, other) = (self.condition(), self.number());
        match self.0.random_range(0..11) {
            0 => format!("select pair_id, {number} as v from pairs where {condition} order by pair_id limit {limit}"),
            1 => {
                let aggregate = self.pick(&["min", "max", "count", "sum", "avg", "stddev", "median", "array_agg"]);
                let value = match aggregate.as_str() {
                    "array_agg" => format!("array_agg({number} order by pair_id)"),
                    "min" | "max" | "count" => format!("{aggregate}({number})"),
                    // Sums of floats depend on their order in the last digits.
                    _ => format!("round(cast({aggregate}({number}) as double), 6)"),
                };
                format!("select {value} as v, count(*) as n from pairs where {condition}")
            }
            2 => {
                let key = self.pick(&["speaker", "pair_id % 4", "direct_mm > 200", "cast(direct_mm / 90 as int)"]);
                format!("select {key} as k, max({number}) as v, count(*) as n from pairs group by {key} order by 1")
            }
            3 => {
                let kind =
                    self.pick(&["int", "bigint", "smallint", "double", "real", "text", "numeric(14,3)", "boolean"]);
                format!("select pair_id, cast({number} as {kind}) as v from pairs order by pair_id limit {limit}")
            }
            4 => format!(
                "select case when {condition} then {number} when {second} then null else {other} end as v from pairs \
                 order by pair_id limit {limit}"
            ),
            5 => {
                let text = self.pick(&[
                    "upper(surface_id)",
                    "surface_id || '''s, ' || pair_id",
                    "substr(surface_id, 2, 2)",
                    "replace(surface_id, 'l', '\"{,}')",
                    "left(run_id, 3)",
                    "split_part(surface_id, 'a', 2)",
                    "surface_id like 'f%t'",
                    "case surface_id when 'flat' then 't' else 'f' end",
                    "regexp_replace(surface_id, '[a-f]', '*')",
                    "concat(surface_id, null, '-', pair_id)",
                ]);
                format!(
                    "select {text} as v from measurements where pair_id % {limit} = 0 order by pair_id limit {limit}"
                )
            }
            6 => {
                let part = self.pick(&["second", "minute", "hour", "day", "week", "month", "year"]);
                let time =
                    self.pick(&["log_time", "log_time + interval '36 hours'", "date '2026-02-28'", "log_time::date"]);
                let call = match self.0.random_range(0..4) {
                    0 => format!("date_trunc('{part}', {time})"),
                    1 => format!("extract({part} from {time})"),
                    2 => format!("to_char({time}, 'YYYY-MM-DD HH24:MI:SS')"),
                    _ => format!("cast({time} as text)"),
                };
                format!("select {call} as v from measurements order by pair_id limit {limit}")
            }
            7 => {
                let list = self.pick(&[
                    "ir[1:4]",
                    "array_slice(ir, 2, 3)",
                    "make_array(pair_id, null, 3)",
                    "array_append(make_array(surface_id), 'a,b')",
                    "array_has(make_array(1, 2, 3), pair_id)",
                    "array_position(make_array(5, 6, pair_id), 6)",
                    "list_energy(ir)",
                    "array_to_string(make_array(pair_id, 7), '|')",
                    "cardinality(ir)",
                    "string_to_array('a,b,,c', ',')",
                ]);
                format!("select {list} as v from measurements order by pair_id limit {limit}")
            }
            8 => format!(
                "select pair_id, (select count(*) from pairs p where p.speaker = q.speaker and p.pair_id > {limit}) as \
                 v from pairs q order by pair_id limit {limit}"
            ),
            9 => format!(
                "select pair_id, row_number() over (partition by speaker order by pair_id) as r, \
                 sum(pair_id) over (order by pair_id) as s from pairs where {condition} order by pair_id limit {limit}"
            ),
            _ => format!(
                "select x, count(*) as n from (select {number} > {limit} as x from pairs where {condition} union all \
                 values (true), (null)) as t group by x order by x nulls last"
            ),
        }
    }
}

fn statements() -> Vec<String> {
    let mut generator = StatementGenerator(ChaCha8Rng::seed_from_u64(SEED));
    let mut all: Vec<_> = WRITTEN.iter().map(|sql| (*sql).to_owned()).collect();
    let mut known: BTreeSet<_> = all.iter().cloned().collect();
    while all.len() + BOUND.len() < STATEMENTS {
        let next = generator.statement();
        if known.insert(next.clone()) {
            all.push(next);
        }
    }
    all
}

/// Rows of an answer, or the beginning of its refusal.
type ArrowRows = Result<Vec<RecordBatch>, String>;

fn over_http(server: &ServedLake, sql: &str) -> ArrowRows {
    let request = HttpRequest::post("/api/v1/sql?format=arrow", sql).with("content-type", "application/sql");
    let answer = request.send(server);
    // An error after the first byte breaks the connection off.
    if answer.status != 200 || !answer.is_whole {
        return Err(answer.text());
    }
    let reader = arrow::ipc::reader::StreamReader::try_new(answer.body.as_slice(), None).expect("a stream");
    reader.collect::<Result<_, _>>().map_err(|error| error.to_string())
}

async fn over_flight(client: &mut FlightSqlServiceClient<Channel>, sql: &str) -> ArrowRows {
    let rows = async {
        let info = client.execute(sql.to_owned(), None).await?;
        let ticket = info.endpoint.into_iter().find_map(|endpoint| endpoint.ticket).expect("a ticket");
        client.do_get(ticket).await?.try_collect().await
    };
    rows.await.map_err(|error: arrow_flight::error::FlightError| error.to_string())
}

fn cells(rows: &[RecordBatch]) -> Vec<Vec<(ArrayRef, usize)>> {
    let of_batch = |batch: &RecordBatch| {
        let columns = batch.columns().to_vec();
        (0..batch.num_rows()).map(move |row| columns.iter().map(|c| (c.clone(), row)).collect()).collect::<Vec<_>>()
    };
    rows.iter().flat_map(of_batch).collect()
}

/// Numbers and times without what only their writing adds.
fn plain(text: &str) -> String {
    let plain = text.trim_end_matches("+00:00").trim_end_matches("+00").trim_end_matches('Z').replace('T', " ");
    match plain.contains('.') {
        true => plain.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => plain,
    }
}

/// True if what Postgres sent is this value.
fn is_same(array: &ArrayRef, row: usize, sent: Option<&str>) -> bool {
    let Some(sent) = sent else { return array.is_null(row) || *array.data_type() == DataType::Null };
    if array.is_null(row) {
        return false;
    }
    let text = || array_value_to_string(array, row).expect("a text");
    match array.data_type() {
        DataType::Boolean => sent == if array.as_boolean().value(row) { "t" } else { "f" },
        DataType::Float32 => {
            let (own, sent) = (array.as_primitive::<arrow::datatypes::Float32Type>().value(row), sent.parse::<f32>());
            sent.is_ok_and(|sent| sent == own || (sent.is_nan() && own.is_nan()))
        }
        DataType::Float64 => {
            let (own, sent) = (array.as_primitive::<arrow::datatypes::Float64Type>().value(row), sent.parse::<f64>());
            sent.is_ok_and(|sent| sent == own || (sent.is_nan() && own.is_nan()))
        }
        DataType::Binary => sent.strip_prefix("\\x").is_some_and(|hex| hex == text()),
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => sent == text(),
        DataType::List(element) if element.data_type().is_nested() => sent.replace(' ', "") == text().replace(' ', ""),
        DataType::Map(..) | DataType::Struct(_) => {
            let bare = |text: &str| text.replace(['"', ' '], "");
            bare(sent) == bare(&text())
        }
        DataType::List(_) => {
            let (elements, list) = (elements(sent), array.as_list::<i32>().value(row));
            elements.len() == list.len() && elements.iter().enumerate().all(|(at, e)| is_same(&list, at, e.as_deref()))
        }
        _ => plain(sent) == plain(&text()),
    }
}

/// The elements of an array as Postgres writes it.
fn elements(text: &str) -> Vec<Option<String>> {
    let inner = text.strip_prefix('{').and_then(|text| text.strip_suffix('}')).expect("an array");
    let (mut all, mut element, mut is_quoted, mut was_quoted) = (Vec::new(), String::new(), false, false);
    let mut characters = inner.chars();
    while let Some(character) = characters.next() {
        match character {
            '\\' => element.extend(characters.next()),
            '"' => {
                is_quoted = !is_quoted;
                was_quoted = true;
            }
            ',' if !is_quoted => {
                all.push(Some(std::mem::take(&mut element)).filter(|e| was_quoted || e != "NULL"));
                was_quoted = false;
            }
            other => element.push(other),
        }
    }
    if !inner.is_empty() {
        all.push(Some(element).filter(|e| was_quoted || e != "NULL"));
    }
    all
}

/// What is wrong with an answer over Postgres' protocol to a statement that HTTP answered so.
fn difference(rows: &ArrowRows, sent: &TextRows) -> Option<String> {
    match (rows, sent) {
        (Err(_), Err(_)) => None,
        (Ok(rows), Ok(sent)) => {
            let own = cells(rows);
            let same = own.len() == sent.len()
                && own.iter().zip(sent).all(|(own, sent)| {
                    own.len() == sent.len()
                        && own.iter().zip(sent).all(|((array, row), sent)| is_same(array, *row, sent.as_deref()))
                });
            let shown = || arrow::util::pretty::pretty_format_batches(rows).expect("a table").to_string();
            (!same).then(|| format!("HTTP:\n{}\nPostgres: {sent:?}", shown()))
        }
        (rows, sent) => Some(format!("HTTP: {:?}\nPostgres: {sent:?}", rows.as_ref().map(|_| "rows"))),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn three_hundred_statements_have_one_answer() {
    let place = lake();
    let server = served(&place, &[]);
    let mut flight = connect(&server).await;
    let mut client = WireClient::connect(&server, None);
    let (mut wrong, mut answered) = (Vec::new(), 0);
    let unbound = statements().into_iter().map(|sql| (sql.clone(), sql, None));
    let bound = BOUND.iter().map(|(sql, text, value)| ((*sql).to_owned(), sql.replace("$1", value), Some(*text)));
    let all: Vec<_> = unbound.chain(bound).collect();
    assert_eq!(all.len(), STATEMENTS);
    for (sql, written, value) in all {
        let rows = over_http(&server, &written);
        answered += usize::from(rows.is_ok());
        let mut check = |protocol: &str, difference: Option<String>| {
            wrong.extend(difference.map(|difference| format!("{protocol}: {sql}\n{difference}")));
        };
        let by_flight = over_flight(&mut flight, &written).await;
        let tables = |rows: &ArrowRows| {
            let printed = arrow::util::pretty::pretty_format_batches(rows.as_deref().unwrap_or_default());
            (rows.is_ok(), printed.expect("a table").to_string())
        };
        check("Flight SQL", (tables(&rows) != tables(&by_flight)).then(|| format!("{rows:?}\n{by_flight:?}")));
        check("Postgres, simple", difference(&rows, &client.query(&written)));
        check(
            "Postgres, extended",
            difference(&rows, &client.query_extended(&sql, &value.into_iter().collect::<Vec<_>>())),
        );
    }
    assert!(wrong.is_empty(), "{} of them differ:\n{}", wrong.len(), wrong.join("\n\n"));
    assert!(answered >= ANSWERED, "{answered} are answered");
    drop(flight);
    tokio::task::spawn_blocking(move || drop(server)).await.expect("ended");
}

#[test]
fn known_differences_have_a_reason() {
    let place = lake();
    let server = served(&place, &[]);
    let mut client = WireClient::connect(&server, None);
    for ProtocolDifference { sql, reason, over_http: http, over_postgres } in DIFFERENCES {
        let rows = over_http(&server, sql);
        match (&rows, http) {
            (Ok(rows), Ok(expected)) => {
                let (array, row) = &cells(rows)[0][0];
                assert_eq!(array_value_to_string(array, *row).expect("a text"), expected, "{sql}: {reason}");
            }
            (Err(problem), Err(expected)) => assert!(problem.contains(expected), "{sql}: {problem}"),
            _ => panic!("{sql}: {rows:?}"),
        }
        match (client.query(sql), over_postgres) {
            (Ok(sent), Ok(expected)) => assert_eq!(sent[0][0].as_deref(), Some(expected), "{sql}: {reason}"),
            (Err(state), Err(expected)) => assert!(state.starts_with(expected), "{sql}: {state}"),
            (sent, _) => panic!("{sql}: {sent:?}"),
        }
    }
}
