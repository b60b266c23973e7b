//! What the door writes on a connection of Postgres' protocol to an engine before the client's own bytes: a line of JSON
//! that names the client and the connection.

use std::io;

use serde::{Deserialize, Serialize};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::UnixStream;

use crate::client_identity::ClientIdentity;

/// Bytes of the longest line.
const LONGEST: usize = 64 << 10;

/// The opening of a connection.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConnectionOpening {
    /// The client, as [`crate::EngineServices::find_client`] reads it.
    pub client: String,
    /// The door's number of the connection.
    pub number: Option<u64>,
}

impl ConnectionOpening {
    /// The opening of a connection of this client.
    pub fn new(client: &ClientIdentity, number: Option<u64>) -> Self {
        Self { client: client.to_text(), number }
    }

    /// Writes it.
    ///
    /// # Errors
    /// The engine has ended.
    pub async fn write_to(&self, socket: &mut UnixStream) -> io::Result<()> {
        let mut line = serde_json::to_vec(self)?;
        line.push(b'\n');
        socket.write_all(&line).await
    }

    /// Reads it, and nothing behind it.
    ///
    /// # Errors
    /// The connection ends before, or the line is none.
    pub async fn read_from(mut socket: UnixStream) -> io::Result<(UnixStream, Self)> {
        let mut line = Vec::new();
        loop {
            match socket.read_u8().await? {
                b'\n' => return Ok((socket, serde_json::from_slice(&line)?)),
                _ if line.len() == LONGEST => return Err(io::ErrorKind::InvalidData.into()),
                byte => line.push(byte),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_opening_is_read_and_nothing_behind_it() {
        let (mut door, engine) = UnixStream::pair().expect("a pair");
        let client = ClientIdentity::local_client("user 'a\n\0'");
        let opening = ConnectionOpening::new(&client, Some(7));
        opening.write_to(&mut door).await.expect("written");
        door.write_all(b"rest").await.expect("written");
        let (mut engine, read) = ConnectionOpening::read_from(engine).await.expect("read");
        assert_eq!(read, opening);
        assert_eq!(ClientIdentity::parse_text(&read.client).expect("a client"), client);
        drop(door);
        let mut rest = Vec::new();
        engine.read_to_end(&mut rest).await.expect("read");
        assert_eq!(rest, b"rest");
    }
}
