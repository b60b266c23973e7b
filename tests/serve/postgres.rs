//! As much of a Postgres client as these tests need: the simple protocol, a password, a CancelRequest.

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
    /// Connects; if no token is required, the session has begun.
    pub(crate) fn connect(server: &ServedLake, options: Option<&str>) -> Self {
        let mut stream = ServedLake::connect(&server.postgres);
        let mut body = 196_608_i32.to_be_bytes().to_vec();
        for (name, value) in
            [("user", "me"), ("database", "datafusion")].into_iter().chain(options.map(|o| ("options", o)))
        {
            body.extend([name.as_bytes(), b"\0", value.as_bytes(), b"\0"].concat());
        }
        body.push(0);
        stream.write_all(&((body.len() + 4) as i32).to_be_bytes()).expect("sent");
        stream.write_all(&body).expect("sent");
        let mut client = Self { stream, key: Vec::new() };
        let (kind, body) = client.message();
        assert_eq!(kind, b'R', "{}", String::from_utf8_lossy(&body));
        if body == [0; 4] {
            assert_eq!(client.ready(), None);
        }
        client
    }

    /// Sends a token; returns the state of the refusal.
    pub(crate) fn log_in(&mut self, token: &str) -> Option<String> {
        self.send(b'p', &[token.as_bytes(), b"\0"].concat());
        self.ready()
    }

    pub(crate) fn query(&mut self, sql: &str) -> TextRows {
        self.begin(sql);
        self.rows()
    }

    /// Asks and does not wait.
    pub(crate) fn begin(&mut self, sql: &str) {
        self.send(b'Q', &[sql.as_bytes(), b"\0"].concat());
    }

    /// The rows of what was asked.
    pub(crate) fn rows(&mut self) -> TextRows {
        let (mut rows, mut failed) = (Vec::new(), None);
        loop {
            match self.message() {
                (b'D', body) => rows.push(row(&body)),
                (b'E', body) => failed = Some(state(&body)),
                (b'Z', _) => return failed.map_or(Ok(rows), Err),
                _ => {}
            }
        }
    }

    /// Ends what runs, as a second connection does.
    pub(crate) fn cancel(&self, server: &ServedLake) {
        let mut stream = ServedLake::connect(&server.postgres);
        let mut packet = ((8 + self.key.len()) as i32).to_be_bytes().to_vec();
        packet.extend(80_877_102_i32.to_be_bytes());
        packet.extend(&self.key);
        stream.write_all(&packet).expect("sent");
    }

    pub(crate) fn send_raw(&mut self, bytes: &[u8]) {
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
