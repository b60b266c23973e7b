//! Postgres connections of the door. It logs clients in, checks the lengths of messages, and passes them on; if an
//! engine ends, it reports that on the connection, which ends with it.

mod cancel_keys;
mod frames;
mod relay;
mod scram;

use std::sync::Arc;
use std::time::Duration;

use bytes::{Buf as _, BytesMut};
use echolake_access::ScramVerifier;
use echolake_postgres::{PID_PARAMETER, fatal_message};
use echolake_service::request_span::{begin_connection, mark_startup};
use echolake_service::{ClientIdentity, RequestFault, ServerProtocol, TokenScope};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tracing::Instrument as _;

use super::connection_places::{ConnectionPlaces, PlaceWork, PlacedStream};
use super::encryption::{DoorStream, ProtocolEncryption};
use crate::door::server_door::ServerDoor;
use cancel_keys::CancelKeys;
use frames::{FrameHeader, HEADER, PASSWORD_WANTED, StartupPacket};
use relay::MessageRelay;
use scram::{ScramExchange, methods_message};

/// Connections at once.
const MOST: usize = 128;
/// Time limit for a login.
const LOGIN: Duration = Duration::from_secs(10);
/// Bytes of a startup packet, as in Postgres.
const STARTUP: usize = 10_000;
/// The user who sends a token as it is, as password: one of a line without a verifier.
const TOKEN_USER: &str = "token";
/// Delay of the answer to a wrong cancel key.
const WRONG_KEY: Duration = Duration::from_secs(1);

/// Answers connections; never ends.
pub(super) async fn serve_postgres_clients(door: ServerDoor, listener: TcpListener, encryption: ProtocolEncryption) {
    let places =
        ConnectionPlaces::new(listener, MOST).listed_among(&door.activity().connections, ServerProtocol::Postgres);
    let keys = Arc::new(CancelKeys::default());
    places
        .attend_connections(|stream| {
            let door = door.clone();
            let keys = keys.clone();
            let encryption = encryption.clone();
            let place = LoginPlace { door, keys, encryption, work: stream.work_handle() };
            attend_client(stream, place)
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

async fn attend_client(stream: PlacedStream, place: LoginPlace) {
    let evicted = stream.wait_for_eviction();
    let work = place.work.clone();
    let login = async {
        tokio::select! {
            login = tokio::time::timeout(LOGIN, place.log_in(stream)) => login.ok().flatten(),
            () = evicted => None,
        }
    };
    let Some((mut stream, mut session)) = login.await else { return };
    let Some(_awaited) = place.door.drain().count_connection() else {
        place.refuse_client(&mut stream, &RequestFault::Draining).await;
        return;
    };
    work.hear_request();
    mark_startup(&mut session.startup, PID_PARAMETER, &session.pid.to_string(), STARTUP);
    let _working = work.begin_work();
    let (span, number) = begin_connection(&mut session.startup, &session.client.name, STARTUP);
    session.number = number;
    MessageRelay::new(stream, place.door, place.keys, session).answer_client().instrument(span).await;
}

/// A client that is logged in.
struct PostgresLogin {
    client: Arc<ClientIdentity>,
    /// The packet that it began with, which its engine is sent.
    startup: BytesMut,
    /// The number of its connection there, and in its cancel key.
    pid: i32,
    /// The door's number of the connection.
    number: u64,
}

impl LoginPlace {
    // None if the connection has nothing more to say.
    async fn log_in(&self, stream: PlacedStream) -> Option<(DoorStream, PostgresLogin)> {
        let mut stream = DoorStream::Left(stream);
        let mut certificate = None;
        let login = loop {
            let step = self.take_packet(&mut stream, certificate.as_deref()).await;
            match (step, stream) {
                // What follows is encrypted.
                (Ok(LoginStep::Encrypt), DoorStream::Left(plain)) => {
                    let before = self.encryption.certificate_hash();
                    stream = self.encryption.shake_hands(plain).await?;
                    // If it was renewed meanwhile, the client may have got either.
                    certificate = before.filter(|before| self.encryption.certificate_hash().as_ref() == Some(before));
                }
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
                self.refuse_client(&mut stream, &fault).await;
                None
            }
        }
    }

    async fn refuse_client(&self, stream: &mut DoorStream, fault: &RequestFault) {
        self.door.metrics().record_failure(fault);
        // A client that hangs up needs no reason.
        let _ = stream.write_all(&fatal_message(fault)).await;
        let _ = stream.shutdown().await;
    }

    async fn take_packet(
        &self,
        stream: &mut DoorStream,
        certificate: Option<&[u8]>,
    ) -> Result<LoginStep, RequestFault> {
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
                if !self.keys.cancel_query(pid, &secret).await {
                    tokio::time::sleep(WRONG_KEY).await;
                }
                Ok(LoginStep::Nothing)
            }
            StartupPacket::Session { .. } if self.encryption.is_on() && !is_encrypted => {
                Err(RequestFault::bad_request("this server encrypts its connections; hint: sslmode=require"))
            }
            StartupPacket::Session { .. } if self.door.drain().is_begun() => Err(RequestFault::Draining),
            StartupPacket::Session { user } => {
                self.door.failed_logins().check_address(self.work.peer())?;
                let found = self.authenticate_user(stream, &user, certificate).await;
                if let Err(RequestFault::Unauthenticated) = &found {
                    self.door.failed_logins().count_failure(self.work.peer());
                }
                let found = found.and_then(|client| client.require_scope(TokenScope::Sql).map(|()| client));
                let client = self.door.note_client(&self.work, ServerProtocol::Postgres, found)?;
                let pid = CancelKeys::make_pid().map_err(RequestFault::defect("no random bytes"))?;
                Ok(LoginStep::Done(PostgresLogin { client, startup, pid, number: 0 }))
            }
        }
    }
}

impl LoginPlace {
    // Users of one name alone send their token. All others prove that they have the one of their name, whether there is
    // such a name or not: nobody learns by asking which names there are.
    async fn authenticate_user(
        &self,
        stream: &mut DoorStream,
        user: &str,
        certificate: Option<&[u8]>,
    ) -> Result<Arc<ClientIdentity>, RequestFault> {
        let access = self.door.access();
        if access.is_open() {
            return access.client_of_token(None, || ClientIdentity::local_user(user));
        }
        if user != TOKEN_USER {
            let (client, verifier) = access.scram_client(user);
            prove_token(stream, &verifier, certificate).await?;
            let client = client.ok_or(RequestFault::Unauthenticated)?;
            access.check_current(&client)?;
            return Ok(client);
        }
        let token = read_password(stream).await?;
        access.client_of_token(Some(&token), || ClientIdentity::local_user(user))
    }
}

async fn prove_token(
    stream: &mut DoorStream,
    verifier: &ScramVerifier,
    certificate: Option<&[u8]>,
) -> Result<(), RequestFault> {
    stream.write_all(&methods_message(certificate.is_some())).await.map_err(|_| broken_login())?;
    let first = read_response(stream).await?;
    let exchange = ScramExchange::read_first(&first, verifier, certificate)?;
    stream.write_all(&exchange.first_message()).await.map_err(|_| broken_login())?;
    let last = read_response(stream).await?;
    stream.write_all(&exchange.finish_exchange(&last)?).await.map_err(|_| broken_login())
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

fn broken_login() -> RequestFault {
    RequestFault::bad_request("the login did not come whole")
}

// None at the end of the connection.
async fn read_startup(stream: &mut DoorStream) -> Result<Option<BytesMut>, RequestFault> {
    let mut length = [0; 4];
    if stream.read_exact(&mut length).await.is_err() {
        return Ok(None);
    }
    let bytes = usize::try_from(i32::from_be_bytes(length)).unwrap_or(0);
    if !(8..=STARTUP).contains(&bytes) {
        return Err(RequestFault::bad_request(format!("a startup packet of {bytes} bytes; it has 8 to {STARTUP}")));
    }
    let mut packet = BytesMut::zeroed(bytes);
    packet[..4].copy_from_slice(&length);
    stream.read_exact(&mut packet[4..]).await.map_err(|_| broken_login())?;
    Ok(Some(packet))
}

async fn read_password(stream: &mut DoorStream) -> Result<String, RequestFault> {
    stream.write_all(&PASSWORD_WANTED).await.map_err(|_| broken_login())?;
    let mut password = read_response(stream).await?;
    let end = password.iter().position(|byte| *byte == 0).unwrap_or(password.len());
    String::from_utf8(password.copy_to_bytes(end).to_vec()).map_err(|_| RequestFault::Unauthenticated)
}

// What a client answers to a request for a password, or for a part of a proof.
async fn read_response(stream: &mut DoorStream) -> Result<BytesMut, RequestFault> {
    let mut header = [0; HEADER];
    stream.read_exact(&mut header).await.map_err(|_| broken_login())?;
    let Some(header) = FrameHeader::peek_from(&header)? else { return Err(broken_login()) };
    if header.kind != b'p' {
        return Err(RequestFault::bad_request("a password is expected"));
    }
    header.check_header()?;
    let mut response = BytesMut::zeroed(header.bytes - HEADER);
    stream.read_exact(&mut response).await.map_err(|_| broken_login())?;
    Ok(response)
}
