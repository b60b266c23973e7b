//! Postgres connections of the door. It logs clients in, checks the lengths of messages, and passes them on; if an
//! engine ends, it reports that on the connection, which continues with the next engine.

mod cancel_keys;
mod exchange;
mod frames;
mod relay;

use std::sync::Arc;
use std::time::Duration;

use bytes::{Buf as _, BytesMut};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::Instrument as _;

use super::connection_places::{ConnectionPlaces, PlacedStream};
use crate::client_identity::ClientIdentity;
use crate::door::server_door::ServerDoor;
use crate::fault::RequestFault;
use crate::request_span::begin_connection;
use crate::tokens::TokenScope;
use cancel_keys::CancelKeys;
use frames::{FrameHeader, HEADER, PASSWORD_WANTED, StartupPacket, fatal_message};
use relay::MessageRelay;

/// Connections at once.
const MOST: usize = 128;
/// Time limit for a login.
const LOGIN: Duration = Duration::from_secs(10);
/// Bytes of a startup packet, as in Postgres, and of a password.
const STARTUP: usize = 10_000;
/// Delay of the answer to a wrong cancel key.
const WRONG_KEY: Duration = Duration::from_secs(1);

/// Answers connections until `stopping`, then until their statements are answered.
pub(super) async fn serve(door: ServerDoor, listener: TcpListener, stopping: watch::Receiver<bool>) {
    let places = ConnectionPlaces::new(listener, MOST);
    let keys = Arc::new(CancelKeys::default());
    let mut stopped = stopping.clone();
    let mut open = JoinSet::new();
    loop {
        tokio::select! {
            _ = stopped.wait_for(|stopping| *stopping) => break,
            stream = places.next() => {
                drop(open.spawn(attend(stream, door.clone(), keys.clone(), stopping.clone())));
            }
            Some(_) = open.join_next() => {}
        }
    }
    while open.join_next().await.is_some() {}
}

async fn attend(mut stream: PlacedStream, door: ServerDoor, keys: Arc<CancelKeys>, stopping: watch::Receiver<bool>) {
    let evicted = stream.evicted();
    let login = async {
        tokio::select! {
            login = tokio::time::timeout(LOGIN, log_in(&mut stream, &door, &keys)) => login.ok().flatten(),
            () = evicted => None,
        }
    };
    let Some(mut session) = login.await else { return };
    let _working = stream.work().begin();
    let span = begin_connection(&mut session.startup, &session.client.name, STARTUP);
    MessageRelay::new(stream, door, keys, session).run(stopping).instrument(span).await;
}

/// A client that is logged in.
struct PostgresLogin {
    client: Arc<ClientIdentity>,
    /// The packet that it began with, which each of its engines is sent.
    startup: BytesMut,
}

// None if the connection has nothing more to say.
async fn log_in(stream: &mut PlacedStream, door: &ServerDoor, keys: &CancelKeys) -> Option<PostgresLogin> {
    match try_log_in(stream, door, keys).await {
        Ok(login) => login,
        Err(fault) => {
            door.metrics().record_failure(&fault);
            // A client that hangs up needs no reason.
            let _ = stream.write_all(&fatal_message(&fault)).await;
            let _ = stream.shutdown().await;
            None
        }
    }
}

async fn try_log_in(
    stream: &mut PlacedStream,
    door: &ServerDoor,
    keys: &CancelKeys,
) -> Result<Option<PostgresLogin>, RequestFault> {
    loop {
        let Some(startup) = read_startup(stream).await? else { return Ok(None) };
        match StartupPacket::parse(&startup[4..])? {
            StartupPacket::Encryption => {
                if stream.write_all(b"N").await.is_err() {
                    return Ok(None);
                }
            }
            StartupPacket::Cancel { pid, secret } => {
                if !keys.cancel(pid, &secret).await {
                    tokio::time::sleep(WRONG_KEY).await;
                }
                return Ok(None);
            }
            StartupPacket::Session { user } => {
                let token = match door.access().is_open() {
                    true => None,
                    false => Some(read_password(stream).await?),
                };
                let client = door.access().client(token.as_deref(), || ClientIdentity::user(&user))?;
                client.require(TokenScope::Sql)?;
                return Ok(Some(PostgresLogin { client, startup }));
            }
        }
    }
}

fn broken() -> RequestFault {
    RequestFault::request("the login did not come whole")
}

// None at the end of the connection.
async fn read_startup(stream: &mut PlacedStream) -> Result<Option<BytesMut>, RequestFault> {
    let mut length = [0; 4];
    if stream.read_exact(&mut length).await.is_err() {
        return Ok(None);
    }
    let bytes = usize::try_from(i32::from_be_bytes(length)).unwrap_or(0);
    if !(8..=STARTUP).contains(&bytes) {
        return Err(RequestFault::request(format!("a startup packet of {bytes} bytes; it has 8 to {STARTUP}")));
    }
    let mut packet = BytesMut::zeroed(bytes);
    packet[..4].copy_from_slice(&length);
    stream.read_exact(&mut packet[4..]).await.map_err(|_| broken())?;
    Ok(Some(packet))
}

async fn read_password(stream: &mut PlacedStream) -> Result<String, RequestFault> {
    stream.write_all(&PASSWORD_WANTED).await.map_err(|_| broken())?;
    let mut header = [0; HEADER];
    stream.read_exact(&mut header).await.map_err(|_| broken())?;
    let Some(header) = FrameHeader::peek(&header)? else { return Err(broken()) };
    if header.kind != b'p' {
        return Err(RequestFault::request("a password is expected"));
    }
    header.check()?;
    let mut password = BytesMut::zeroed(header.bytes - HEADER);
    stream.read_exact(&mut password).await.map_err(|_| broken())?;
    let end = password.iter().position(|byte| *byte == 0).unwrap_or(password.len());
    password.truncate(end);
    String::from_utf8(password.copy_to_bytes(end).to_vec()).map_err(|_| RequestFault::Unauthenticated)
}
