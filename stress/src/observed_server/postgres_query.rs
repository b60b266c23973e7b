//! Queries over Postgres' protocol, simple and extended.

use std::io::{self, BufReader, ErrorKind, Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;

use super::query_client::AnswerDigest;
use super::{QueryClient, QueryOutcome};

/// Bytes of a message that is kept; rows are not.
const LARGEST_MESSAGE: u64 = 1 << 20;
/// Protocol 3.0.
const PROTOCOL_VERSION: i32 = 196_608;
/// Code of a CancelRequest, in place of a version.
const CANCEL_CODE: i32 = 80_877_102;

/// A session.
pub(crate) struct PostgresClient {
    stream: Arc<TcpStream>,
    reader: BufReader<StreamReader>,
    cancel_key: Vec<u8>,
}

/// A shared stream as its one reader.
struct StreamReader(Arc<TcpStream>);

impl io::Read for StreamReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        (&*self.0).read(buffer)
    }
}

/// First message of a session.
pub(crate) fn startup_message() -> Vec<u8> {
    let body = [&PROTOCOL_VERSION.to_be_bytes()[..], b"user\0token\0database\0datafusion\0\0"].concat();
    [&message_length(&body)[..], &body].concat()
}

/// A message with its type and length.
pub(crate) fn tagged_message(kind: u8, body: &[u8]) -> Vec<u8> {
    [&[kind][..], &message_length(body), body].concat()
}

fn message_length(body: &[u8]) -> [u8; 4] {
    u32::try_from(body.len() + 4).unwrap_or(u32::MAX).to_be_bytes()
}

impl PostgresClient {
    /// Connects and shows the client's token.
    ///
    /// # Errors
    /// The connection ends, or the state of a refusal.
    pub fn log_in(client: &QueryClient) -> io::Result<Result<Self, String>> {
        let stream = client.connections.connect(&client.addresses.postgres)?;
        let password = tagged_message(b'p', &[client.token.as_bytes(), b"\0"].concat());
        (&*stream).write_all(&[startup_message(), password].concat())?;
        let reader = BufReader::new(StreamReader(stream.clone()));
        let mut session = Self { stream, reader, cancel_key: Vec::new() };
        loop {
            match session.read_message(None)? {
                (b'E', body) => return Ok(Err(error_state(&body))),
                (b'K', body) => session.cancel_key = body,
                (b'Z', _) => return Ok(Ok(session)),
                _ => {}
            }
        }
    }

    /// Sends messages of the protocol.
    ///
    /// # Errors
    /// The connection ends.
    pub fn send(&self, bytes: &[u8]) -> io::Result<()> {
        (&*self.stream).write_all(bytes)
    }

    /// Asks by the simple protocol, and does not wait.
    ///
    /// # Errors
    /// The connection ends.
    pub fn begin_query(&self, sql: &str) -> io::Result<()> {
        self.send(&tagged_message(b'Q', &[sql.as_bytes(), b"\0"].concat()))
    }

    /// Reads the answer of the sent messages, up to the next ReadyForQuery.
    pub fn read_answer(&mut self) -> QueryOutcome {
        let mut digest = AnswerDigest::default();
        let mut failed = None;
        let mut is_complete = false;
        loop {
            match self.read_message(Some(&mut digest)) {
                Ok((b'E', body)) => failed = Some(error_state(&body)),
                Ok((b'C' | b'I', _)) => is_complete = true,
                Ok((b'Z', _)) => return answer_outcome(failed, is_complete, digest),
                Ok(_) => {}
                // A FATAL error ends the connection, but it has said why.
                Err(_) => return failed.map_or(lost_outcome(digest), QueryOutcome::Refused),
            }
        }
    }

    /// Asks, on a connection of its own, to end what runs in this session.
    ///
    /// # Errors
    /// The server does not accept it.
    pub fn send_cancel(&self, client: &QueryClient) -> io::Result<()> {
        let stream = client.connections.connect(&client.addresses.postgres)?;
        let body = [&CANCEL_CODE.to_be_bytes()[..], &self.cancel_key].concat();
        (&*stream).write_all(&[&message_length(&body)[..], &body].concat())
    }

    // Rows go into the digest, if there is one, and are not kept.
    fn read_message(&mut self, digest: Option<&mut AnswerDigest>) -> io::Result<(u8, Vec<u8>)> {
        let mut head = [0; 5];
        self.reader.read_exact(&mut head)?;
        let length = u32::from_be_bytes([head[1], head[2], head[3], head[4]]);
        let length = u64::from(length).checked_sub(4).ok_or(ErrorKind::InvalidData)?;
        let mut body = Vec::new();
        let mut limited = (&mut self.reader).take(length);
        let copied = match digest {
            Some(digest) if head[0] == b'D' => io::copy(&mut limited, digest)?,
            _ if length > LARGEST_MESSAGE => io::copy(&mut limited, &mut io::sink())?,
            _ => limited.read_to_end(&mut body)? as u64,
        };
        if copied == length { Ok((head[0], body)) } else { Err(ErrorKind::UnexpectedEof.into()) }
    }
}

/// Runs a query by the simple protocol.
pub(super) fn query_simple(client: &QueryClient, sql: &str) -> QueryOutcome {
    exchange_messages(client, &tagged_message(b'Q', &[sql.as_bytes(), b"\0"].concat()))
}

/// Runs a query by the extended protocol: Parse, Bind, Describe, Execute, Sync.
pub(super) fn query_extended(client: &QueryClient, sql: &str) -> QueryOutcome {
    let messages = [
        tagged_message(b'P', &[b"\0", sql.as_bytes(), b"\0\0\0"].concat()),
        tagged_message(b'B', b"\0\0\0\0\0\0\0\0"),
        tagged_message(b'D', b"P\0"),
        tagged_message(b'E', b"\0\0\0\0\0"),
        tagged_message(b'S', b""),
    ];
    exchange_messages(client, &messages.concat())
}

fn exchange_messages(client: &QueryClient, messages: &[u8]) -> QueryOutcome {
    match PostgresClient::log_in(client) {
        // The answer may come before all of a large query is read.
        Ok(Ok(mut session)) => {
            let _ = session.send(messages);
            session.read_answer()
        }
        Ok(Err(state)) => QueryOutcome::Refused(state),
        Err(_) => QueryOutcome::Disconnected,
    }
}

fn answer_outcome(failed: Option<String>, is_complete: bool, digest: AnswerDigest) -> QueryOutcome {
    match failed {
        Some(state) => QueryOutcome::Refused(state),
        None if is_complete => QueryOutcome::Answer(digest),
        None => QueryOutcome::Truncated,
    }
}

fn lost_outcome(digest: AnswerDigest) -> QueryOutcome {
    if digest.bytes > 0 { QueryOutcome::Truncated } else { QueryOutcome::Disconnected }
}

fn error_state(body: &[u8]) -> String {
    let field = body.split(|byte| *byte == 0).find_map(|field| field.strip_prefix(b"C"));
    String::from_utf8_lossy(field.unwrap_or(b"no state")).into_owned()
}
