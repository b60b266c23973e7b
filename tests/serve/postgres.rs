//! As much of a Postgres client as these tests need: the simple protocol, a password, a CancelRequest.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;

use super::server::ServedLake;

/// A connection.
pub(crate) struct WireClient {
    stream: TcpStream,
    // What a CancelRequest must show.
    key: Vec<u8>,
}

/// Rows as texts, or the state of an error.
pub(crate) type TextRows = Result<Vec<Vec<Option<String>>>, String>;

impl WireClient {
    /// Connects as the user who sends a token; if none is required, the session has begun.
    pub fn connect(server: &ServedLake, options: Option<&str>) -> Self {
        Self::attempt(server, options).unwrap_or_else(|state| panic!("refused: {state}"))
    }

    /// The same; the error is the state of the refusal.
    pub fn attempt(server: &ServedLake, options: Option<&str>) -> Result<Self, String> {
        let (mut client, request) = Self::begin_login(server, "token", options)?;
        if request == [0; 4] {
            assert_eq!(client.ready(), None);
        }
        Ok(client)
    }

    /// Connects as this user; returns how the server wants to know that it is.
    pub fn start(server: &ServedLake, user: &str, options: Option<&str>) -> (Self, Vec<u8>) {
        Self::begin_login(server, user, options).unwrap_or_else(|state| panic!("refused: {state}"))
    }

    fn begin_login(server: &ServedLake, user: &str, options: Option<&str>) -> Result<(Self, Vec<u8>), String> {
        let mut stream = ServedLake::connect(&server.postgres);
        let mut body = 196_608_i32.to_be_bytes().to_vec();
        for (name, value) in
            [("user", user), ("database", "datafusion")].into_iter().chain(options.map(|o| ("options", o)))
        {
            body.extend([name.as_bytes(), b"\0", value.as_bytes(), b"\0"].concat());
        }
        body.push(0);
        stream.write_all(&((body.len() + 4) as i32).to_be_bytes()).expect("sent");
        stream.write_all(&body).expect("sent");
        let mut client = Self { stream, key: Vec::new() };
        let (kind, body) = client.message();
        if kind == b'E' {
            return Err(state(&body));
        }
        assert_eq!(kind, b'R', "{}", String::from_utf8_lossy(&body));
        Ok((client, body))
    }

    /// The number of the connection, as the server announces it.
    pub fn pid(&self) -> i32 {
        self.key.first_chunk().map_or(0, |pid| i32::from_be_bytes(*pid))
    }

    /// The state of the message with which the server ends the connection.
    pub fn farewell(&mut self) -> String {
        let (kind, body) = self.message();
        assert_eq!(kind, b'E', "{}", String::from_utf8_lossy(&body));
        state(&body)
    }

    /// Sends a token; returns the state of the refusal.
    pub fn log_in(&mut self, token: &str) -> Option<String> {
        self.send(b'p', &[token.as_bytes(), b"\0"].concat());
        self.ready()
    }

    pub fn query(&mut self, sql: &str) -> TextRows {
        self.begin(sql);
        self.rows()
    }

    /// The same by the extended protocol, with values as texts whose types the server finds.
    pub fn query_extended(&mut self, sql: &str, values: &[&str]) -> TextRows {
        self.prepare("", sql);
        self.execute("", values)
    }

    /// Prepares a statement of this name, without waiting for the answer.
    pub fn prepare(&mut self, name: &str, sql: &str) {
        self.send(b'P', &[name.as_bytes(), b"\0", sql.as_bytes(), b"\0", &[0; 2]].concat());
    }

    /// Runs a prepared statement.
    pub fn execute(&mut self, name: &str, values: &[&str]) -> TextRows {
        let mut bound = [b"\0", name.as_bytes(), b"\0", &[0; 2], &(values.len() as i16).to_be_bytes()[..]].concat();
        for value in values {
            bound.extend((value.len() as i32).to_be_bytes());
            bound.extend(value.as_bytes());
        }
        bound.extend([0; 2]);
        self.send(b'B', &bound);
        self.send(b'E', &[0; 5]);
        self.send(b'S', &[]);
        self.rows()
    }

    /// Asks and does not wait.
    pub fn begin(&mut self, sql: &str) {
        self.send(b'Q', &[sql.as_bytes(), b"\0"].concat());
    }

    /// The rows of what was asked.
    pub fn rows(&mut self) -> TextRows {
        let (mut rows, mut failed) = (Vec::new(), None);
        loop {
            match self.message() {
                (b'D', body) => rows.push(row(&body)),
                // Nothing follows.
                (b'E', body) if body.starts_with(b"SFATAL\0") => return Err(state(&body)),
                (b'E', body) => failed = Some(state(&body)),
                (b'Z', _) => return failed.map_or(Ok(rows), Err),
                _ => {}
            }
        }
    }

    /// The fields of the error of a query that is refused.
    pub fn refusal(&mut self, sql: &str) -> BTreeMap<char, String> {
        self.begin(sql);
        let mut fields = BTreeMap::new();
        loop {
            match self.message() {
                (b'E', body) => fields.extend(body.split(|b| *b == 0).filter_map(|field| {
                    let (kind, text) = field.split_first()?;
                    Some((char::from(*kind), String::from_utf8_lossy(text).into_owned()))
                })),
                (b'Z', _) => return fields,
                _ => {}
            }
        }
    }

    /// Ends what runs, as a second connection does.
    pub fn cancel(&self, server: &ServedLake) {
        let mut stream = ServedLake::connect(&server.postgres);
        let mut packet = ((8 + self.key.len()) as i32).to_be_bytes().to_vec();
        packet.extend(80_877_102_i32.to_be_bytes());
        packet.extend(&self.key);
        stream.write_all(&packet).expect("sent");
    }

    /// The state of the error with which a connection ends that sends no answer to its end.
    pub fn end_state(&mut self) -> String {
        let state = loop {
            match self.message() {
                (b'E', body) => break state(&body),
                (b'Z', _) => panic!("the answer came to its end"),
                _ => {}
            }
        };
        assert_eq!(self.stream.read(&mut [0]).unwrap_or(0), 0, "nothing follows {state}");
        state
    }

    pub fn send_raw(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).expect("sent");
    }

    fn send(&mut self, kind: u8, body: &[u8]) {
        self.send_raw(&[&[kind][..], &((body.len() + 4) as i32).to_be_bytes(), body].concat());
    }

    fn ready(&mut self) -> Option<String> {
        loop {
            match self.message() {
                (b'E', body) => return Some(state(&body)),
                (b'K', body) => self.key = body,
                (b'Z', _) => return None,
                _ => {}
            }
        }
    }

    fn message(&mut self) -> (u8, Vec<u8>) {
        let mut head = [0; 5];
        self.stream.read_exact(&mut head).expect("a message");
        let length = i32::from_be_bytes([head[1], head[2], head[3], head[4]]);
        let mut body = vec![0; length as usize - 4];
        self.stream.read_exact(&mut body).expect("a whole message");
        (head[0], body)
    }
}

fn row(body: &[u8]) -> Vec<Option<String>> {
    let mut rest = &body[2..];
    let mut values = Vec::new();
    while !rest.is_empty() {
        let length = i32::from_be_bytes([rest[0], rest[1], rest[2], rest[3]]);
        rest = &rest[4..];
        let value = usize::try_from(length).ok().map(|n| rest.split_at(n));
        values.push(value.map(|(text, _)| String::from_utf8_lossy(text).into_owned()));
        rest = value.map_or(rest, |(_, rest)| rest);
    }
    values
}

fn state(body: &[u8]) -> String {
    let field = body.split(|b| *b == 0).find(|f| f.first() == Some(&b'C')).expect("a state");
    String::from_utf8_lossy(&field[1..]).into_owned()
}

#[test]
fn the_catalogue_is_as_in_postgres() {
    let place = super::lake();
    let server = super::served(&place, &[]);
    let mut client = WireClient::connect(&server, None);
    for (sql, expected) in [
        ("select 1, 1", "1,1"),
        ("select pg_typeof(1)", "integer"),
        ("select pg_typeof(1.5::real), pg_typeof(array[1.5::real])", "real,real[]"),
        ("select pg_typeof(row_number() over ()), row_number() over () from pairs limit 1", "bigint,1"),
        ("select make_array(make_array(1, 2), make_array(3)), map(['a'], [1])", "[[1,2],[3]],{\"a\":1}"),
        ("select pg_size_pretty(20480::bigint)", "20 kB"),
        ("select format('%s-%I', 'a', 'b c')", "a-\"b c\""),
        ("select pg_backend_pid() > 0", "t"),
        (
            "select nspname from pg_namespace where nspname not like 'pg/_%' escape '/' order by 1 limit 1",
            "information_schema",
        ),
        ("select relkind from pg_class where relname in ('pairs', 'tnce_db') order by relname", "r;v"),
        (
            "select table_type from information_schema.tables where table_name in ('pairs', 'ir') order by table_name",
            "VIEW;BASE TABLE",
        ),
        (
            "select udt_schema, udt_name, is_identity from information_schema.columns where column_name = 'ir' and \
                table_name = 'measurements'",
            "pg_catalog,_float4,NO",
        ),
        (
            "select format_type(atttypid, atttypmod) from pg_attribute where attrelid = 'measurements'::regclass and \
                attname = 'ir'",
            "real[]",
        ),
        (
            "select count(*) > 10 from pg_description d where d.objoid = 'pairs'::regclass and classoid = \
                'pg_class'::regclass",
            "t",
        ),
        (
            "select col_description('pairs'::regclass, 1) is not null, obj_description('pairs'::regclass)",
            "t,One row per pair of grid points: distances and angles.",
        ),
        (
            "select d.description from pg_description d join pg_attribute a on attrelid = objoid and attnum = objsubid \
                where objoid = 'surface_stats'::regclass and attname in ('band', 'band_hz') order by attname",
            "Centre of the band in Hz, or total;Centre of the band; null for the total [Hz]",
        ),
        ("select has_table_privilege('pairs', 'SELECT'), has_table_privilege('pairs', 'INSERT')", "t,f"),
        ("select count(*) from information_schema.table_constraints", "0"),
        ("select p.proname from pg_type t join pg_proc p on p.oid = t.typinput where t.typname = 'bool'", "boolin"),
        ("select pg_get_function_result(oid) from pg_proc where proname = 'boolin'", "boolean"),
        (
            "select c.relname, exists(select 1 from pg_constraint k where k.conrelid = c.oid) from pg_class c where \
                relname = 'runs'",
            "runs,f",
        ),
        ("select pg_advisory_unlock_all()", ""),
        ("select 'integer'::regtype::int", "23"),
        ("select typinput, typinput::text from pg_type where typname = 'bool'", "boolin,boolin"),
        ("select pg_table_is_visible('information_schema.tables'::regclass)", "f"),
        // E19: the first statements of pgAdmin 4.
        (
            "SET DateStyle=ISO; SET client_min_messages=notice; SELECT set_config('bytea_output','hex',false) FROM \
                pg_show_all_settings() WHERE name = 'bytea_output'; SET client_encoding='utf-8';",
            "hex",
        ),
        ("select s.setting from pg_catalog.pg_show_all_settings() s where s.name = 'bytea_output'", "hex"),
        ("select count(*) = (select count(*) from pg_settings) from pg_show_all_settings()", "t"),
    ] {
        let rows = client.query(sql).unwrap_or_else(|state| panic!("{sql}: {state}"));
        let text = |row: &Vec<Option<String>>| {
            row.iter().map(|value| value.as_deref().unwrap_or("NULL")).collect::<Vec<_>>().join(",")
        };
        assert_eq!(rows.iter().map(text).collect::<Vec<_>>().join(";"), expected, "{sql}");
    }
    let copied = client.query("copy (select make_array(make_array(1, 2)), map(['a'], [1])) to stdout (format binary)");
    assert!(copied.is_ok(), "{copied:?}");
    assert_eq!(client.query("unlisten *"), Ok(Vec::new()));
    assert_eq!(client.query("listen news"), Err("25006".to_owned()));
}

// Within two seconds, too, for which plans once were kept.
#[test]
fn a_prepared_statement_sees_the_lake_at_its_start() {
    let place = super::lake();
    let server = super::served(&place, &[]);
    let mut client = WireClient::connect(&server, None);
    let one = |text: &str| Ok(vec![vec![Some(text.to_owned())]]);
    client.prepare("counted", "select count(*) from runs where $1::int = 1");
    assert_eq!(client.execute("counted", &["1"]), one("1"));
    place.acquire("foam", &["--ir-only"]);
    place.ok(&["ingest"]);
    // A plan of this moment.
    client.prepare("new", "select now()");
    let first = client.execute("new", &[]);
    assert_eq!(client.execute("counted", &["1"]), one("2"));
    assert_ne!(client.execute("new", &[]), first, "now() is the time of each run");
}

#[test]
fn a_connection_keeps_500_prepared_statements() {
    let place = super::lake();
    let server = super::served(&place, &[]);
    let mut client = WireClient::connect(&server, None);
    let two = Ok(vec![vec![Some("2".to_owned())]]);
    (0..500).for_each(|n| client.prepare(&format!("s{n}"), "select $1::int + 1"));
    assert_eq!(client.execute("s499", &["1"]), two);
    client.prepare("s500", "select $1::int + 1");
    assert_eq!(client.execute("s500", &["1"]), Err("53300".to_owned()));
    assert_eq!(client.query("deallocate s0"), Ok(Vec::new()));
    client.prepare("s500", "select $1::int + 1");
    assert_eq!(client.execute("s500", &["1"]), two);
}

#[test]
fn what_is_sent_after_an_error_is_not_kept() {
    const MIB: usize = 1 << 20;
    let place = super::lake();
    let server = super::served(&place, &[]);
    let mut client = WireClient::connect(&server, None);
    client.send(b'P', b"\0selec\0\0\0");
    let before = server.resident_kib();
    let long = [&b"s\0select '"[..], &vec![b'x'; MIB], b"'\0\0\0"].concat();
    let message = [&b"P"[..], &((long.len() + 4) as i32).to_be_bytes(), &long].concat();
    // The engine ends a connection that keeps it busy without a query.
    let _sent = (0..100).try_for_each(|_| client.stream.write_all(&message));
    let grown = server.resident_kib().saturating_sub(before);
    assert!(grown < 32 << 10, "the door grew by {grown} KiB");
    let mut next = WireClient::connect(&server, None);
    assert_eq!(next.query("select 7"), Ok(vec![vec![Some("7".to_owned())]]));
}

mod slow {
    use rustix::process::Signal;

    use super::super::{ENDLESS, lake, running, served, wait_until};
    use super::*;

    #[test]
    fn a_connection_ends_with_its_engine_and_nothing_is_run_again() {
        let place = lake();
        let server = served(&place, &[]);
        let mut idle = WireClient::connect(&server, None);
        idle.query("set application_name = 'x'").expect("set");
        let mut busy = WireClient::connect(&server, None);
        busy.begin(ENDLESS);
        wait_until("it runs", || running(&server) == 1.0);
        // An answer of which rows were sent.
        let mut reading = WireClient::connect(&server, None);
        reading.begin("select repeat('x', 1000) from generate_series(1, 1000000)");
        while reading.message().0 != b'D' {}
        server.signal_engines(Signal::KILL);
        for client in [&mut idle, &mut busy] {
            assert_eq!(client.end_state(), "58000");
        }
        // It may have been broken off within a message, which nothing can follow.
        let mut rest = Vec::new();
        let _ = reading.stream.read_to_end(&mut rest);
        assert!(!rest.ends_with(&[b'Z', 0, 0, 0, 5, b'I']), "a cut answer looks whole");
        let mut next = WireClient::connect(&server, None);
        assert_eq!(next.query("select 7"), Ok(vec![vec![Some("7".to_owned())]]));
        wait_until("nothing was begun again", || running(&server) == 0.0);
    }

    #[test]
    fn silent_clients_keep_nobody_waiting_and_go_on() {
        let place = lake();
        let server = served(&place, &[]);
        let start = |user: &str| {
            let (mut client, _) = WireClient::start(&server, user, None);
            client.ready();
            client
        };
        let seven = || Ok(vec![vec![Some("7".to_owned())]]);
        let mut in_transaction = start("a");
        in_transaction.query("begin").expect("begun");
        let mut with_cursor = start("b");
        with_cursor.query("begin; declare c cursor for select * from generate_series(1, 1000000)").expect("begun");
        let mut with_portal = start("c");
        with_portal.send(b'P', b"\0select * from generate_series(1, 1000000)\0\0\0");
        with_portal.send(b'B', b"p\0\0\0\0\0\0\0\0");
        with_portal.send(b'E', b"p\0\0\0\0\x01");
        with_portal.send(b'H', b"");
        // More than compute at once, of one client and of several.
        let mut unread: Vec<_> = ["d", "d", "d", "d", "d", "d", "e", "f", "g", "h"].map(start).into();
        for client in &mut unread {
            client.begin("select repeat('x', 1000) from generate_series(1, 100000)");
        }
        let mut others = ["d", "i", "j", "k"].map(start);
        for client in &mut others {
            assert_eq!(client.query("select 7"), seven());
        }
        assert_eq!(in_transaction.query("select 7"), seven());
        assert_eq!(with_cursor.query("fetch 1 from c"), Ok(vec![vec![Some("1".to_owned())]]));
        for mut client in unread.drain(..2) {
            assert_eq!(client.rows().map(|rows| rows.len()), Ok(100_000));
        }
    }
}
