//! A client that queries in SQL, and the outcomes of its queries: a whole answer, an error, or neither.

use std::fmt::{self, Write as _};
use std::io;
use std::net::Ipv4Addr;
use std::sync::Arc;

use super::{ClientConnections, ServerAddresses};

/// A protocol for queries in SQL.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub(crate) enum QueryProtocol {
    Http,
    PostgresSimple,
    PostgresExtended,
    FlightSql,
    /// As `where` of a slice over HTTP.
    SliceFilter,
}

impl QueryProtocol {
    pub const ALL: [Self; 5] =
        [Self::Http, Self::PostgresSimple, Self::PostgresExtended, Self::FlightSql, Self::SliceFilter];
    /// Those that answer with the rows of any query.
    pub const ROWS: [Self; 4] = [Self::Http, Self::PostgresSimple, Self::PostgresExtended, Self::FlightSql];

    pub fn name(self) -> &'static str {
        match self {
            Self::Http => "http",
            Self::PostgresSimple => "postgres-simple",
            Self::PostgresExtended => "postgres-extended",
            Self::FlightSql => "flight-sql",
            Self::SliceFilter => "slice-where",
        }
    }
}

/// Outcome of a query.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum QueryOutcome {
    /// A whole answer.
    Answer(AnswerDigest),
    /// An error with its code: that of the problem, of the metadata `echolake-code`, or the SQLSTATE.
    Refused(String),
    /// The connection ended in the middle of an answer, which shows that it is not whole.
    Truncated,
    /// The connection ended, or was refused, before an answer began.
    Disconnected,
    /// The client closed its connections before the query ended.
    Abandoned,
}

impl QueryOutcome {
    /// Returns whether the query failed because its engine ended, by the codes of HTTP, Flight SQL and Postgres.
    pub fn is_engine_end(&self) -> bool {
        matches!(self, Self::Refused(code) if code == "query_ended_engine" || code == "58000")
    }
}

/// Digest that distinguishes answers: size and hash.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub(crate) struct AnswerDigest {
    pub bytes: u64,
    hash: u64,
}

impl AnswerDigest {
    pub fn update(&mut self, bytes: &[u8]) {
        self.bytes += bytes.len() as u64;
        for byte in bytes {
            // FNV-1a (Fowler, Noll, Vo), which does not depend on how the bytes are cut.
            self.hash = (self.hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

impl io::Write for AnswerDigest {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl fmt::Display for QueryOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Answer(_) => "answer",
            Self::Refused(code) => code,
            Self::Truncated => "truncated",
            Self::Disconnected => "connection closed",
            Self::Abandoned => "time limit",
        })
    }
}

/// A client of a server. Every query has a connection of its own.
#[derive(Clone)]
pub(crate) struct QueryClient {
    pub addresses: ServerAddresses,
    pub token: String,
    pub run: String,
    pub connections: Arc<ClientConnections>,
}

impl QueryClient {
    pub fn new(addresses: ServerAddresses, token: &str, run: &str) -> Self {
        let connections = Arc::new(ClientConnections::new(Ipv4Addr::LOCALHOST));
        Self { addresses, token: token.to_owned(), run: run.to_owned(), connections }
    }

    /// Lets it come from another address.
    pub fn with_source(mut self, source: Ipv4Addr) -> Self {
        self.connections = Arc::new(ClientConnections::new(source));
        self
    }
}

/// Encodes all that RFC 3986 reserves.
pub(crate) fn percent_encoded(text: &str) -> String {
    let mut encoded = String::new();
    for byte in text.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => encoded.push(byte as char),
            other => {
                let _ = write!(encoded, "%{other:02X}");
            }
        }
    }
    encoded
}
