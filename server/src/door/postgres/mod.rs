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
use tracing::Instrument as _;

use super::connection_places::{ConnectionPlaces, PlaceWork, PlacedStream};
use super::encryption::{DoorStream, ProtocolEncryption};
use crate::client_identity::ClientIdentity;
use crate::door::server_door::ServerDoor;
use crate::fault::RequestFault;
use crate::metrics::ServerProtocol;
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

/// Answers connections; never ends.
pub(super) async fn serve(door: ServerDoor, listener: TcpListener, encryption: ProtocolEncryption) {
    let places = ConnectionPlaces::new(listener, MOST).listed(&door.activity().connections, ServerProtocol::Postgres);
    let keys = Arc::new(CancelKeys::default());
    places
        .attend(|stream| {
            let (door, keys, encryption) = (door.clone(), keys.clone(), encryption.clone());
            let place = LoginPlace { door, keys, encryption, work: stream.work() };
            attend(stream, place)
        })
        .await;
}

/// What a login needs.
struct LoginPlace {
    door: ServerDoor,
    keys: Arc<CancelKeys>,
    encryption: ProtocolEncryption,
    work: PlaceWork,
}

async fn attend(stream: PlacedStream, place: LoginPlace) {
    let (evicted, work) = (stream.evicted(), place.work.clone());
    let login = async {
        tokio::select! {
            login = tokio::time::timeout(LOGIN, place.log_in(stream)) => login.ok().flatten(),
            () = evicted => None,
        }
    };
    let Some((mut stream, mut session)) = login.await else { return };
    let Some(_awaited) = place.door.drain().enter() else {
        place.refuse(&mut stream, &RequestFault::Draining).await;
        return;
    };
    work.hear_request();
    let _working = work.begin();
    let span = begin_connection(&mut session.startup, &session.client.name, STARTUP);
    MessageRelay::new(stream, place.door, place.keys, session).run().instrument(span).await;
}

/// A client that is logged in.
struct PostgresLogin {
    client: Arc<ClientIdentity>,
    /// The packet that it began with, which each of its engines is sent.
    startup: BytesMut,
}

impl LoginPlace {
    // None if the connection has nothing more to say.
    async fn log_in(&self, stream: PlacedStream) -> Option<(DoorStream, PostgresLogin)> {
        let mut stream = DoorStream::Left(stream);
        let login = loop {
            let step = self.take_packet(&mut stream).await;
            match (step, stream) {
                // What follows is encrypted.
                (Ok(LoginStep::Encrypt), DoorStream::Left(plain)) => stream = self.encryption.accept(plain).await?,
                (Ok(LoginStep::Again | LoginStep::Encrypt), same) => stream = same,
                (Ok(LoginStep::Done(login)), same) => {
                    stream = same;
                    break Ok(login);
                }
                (Ok(LoginStep::Nothing), _) => return None,
                (Err(fault), same) => {
                    stream = same;
                    break Err(fault);
                }
            }
        };
        match login {
            Ok(login) => Some((stream, login)),
            Err(fault) => {
                self.refuse(&mut stream, &fault).await;
                None
            }
        }
    }

    async fn refuse(&self, stream: &mut DoorStream, fault: &RequestFault) {
        self.door.metrics().record_failure(fault);
        // A client that hangs up needs no reason.
        let _ = stream.write_all(&fatal_message(fault)).await;
        let _ = stream.shutdown().await;
    }

    async fn take_packet(&self, stream: &mut DoorStream) -> Result<LoginStep, RequestFault> {
        let Some(startup) = read_startup(stream).await? else { return Ok(LoginStep::Nothing) };
        let is_encrypted = matches!(stream, DoorStream::Right(_));
        match StartupPacket::parse(&startup[4..])? {
            StartupPacket::Encryption { is_tls } => {
                let may = is_tls && self.encryption.is_on() && !is_encrypted;
                match (stream.write_all(if may { b"S" } else { b"N" }).await, may) {
                    (Err(_), _) => Ok(LoginStep::Nothing),
                    (Ok(()), true) => Ok(LoginStep::Encrypt),
                    (Ok(()), false) => Ok(LoginStep::Again),
                }
            }
            StartupPacket::Cancel { pid, secret } => {
                if !self.keys.cancel(pid, &secret).await {
                    tokio::time::sleep(WRONG_KEY).await;
                }
                Ok(LoginStep::Nothing)
            }
            StartupPacket::Session { .. } if self.encryption.is_on() && !is_encrypted => {
                Err(RequestFault::request("this server encrypts its connections; hint: sslmode=require"))
            }
            StartupPacket::Session { .. } if self.door.drain().is_begun() => Err(RequestFault::Draining),
            StartupPacket::Session { user } => {
                let token = match self.door.access().is_open() {
                    true => None,
                    false => Some(read_password(stream).await?),
                };
                let found = self.door.access().client(token.as_deref(), || ClientIdentity::user(&user));
                let found = found.and_then(|client| client.require(TokenScope::Sql).map(|()| client));
                let client = self.door.note_client(&self.work, ServerProtocol::Postgres, found)?;
                Ok(LoginStep::Done(PostgresLogin { client, startup }))
            }
        }
    }
}

/// What follows on a packet before the session.
enum LoginStep {
    /// Another packet.
    Again,
    /// A handshake.
    Encrypt,
    /// The session.
    Done(PostgresLogin),
    /// Nothing.
    Nothing,
}

fn broken() -> RequestFault {
    RequestFault::request("the login did not come whole")
}

// None at the end of the connection.
async fn read_startup(stream: &mut DoorStream) -> Result<Option<BytesMut>, RequestFault> {
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

async fn read_password(stream: &mut DoorStream) -> Result<String, RequestFault> {
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
