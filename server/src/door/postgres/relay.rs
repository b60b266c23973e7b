//! Passes messages between a client and its engine, until one of both ends. What the client has sent is never kept for
//! another engine: a client whose engine ended connects and asks again.

use std::io;
use std::sync::Arc;

use bytes::{Buf as _, BytesMut};
use echolake_postgres::fatal_message;
use echolake_service::{ConnectionOpening, EngineRole, EngineSocket, RequestFault};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, ReadHalf, WriteHalf};
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};

use super::PostgresLogin;
use super::cancel_keys::{CancelKey, CancelKeys, CancelTarget};
use super::frames::{FrameHeader, HEADER, key_message};
use crate::door::encryption::DoorStream;
use crate::door::engine_process::EngineProcess;
use crate::door::server_door::ServerDoor;

/// Bytes that are read at once, and of an engine's message from which it is passed on before it is whole.
const READ_BYTES: usize = 256 << 10;
/// Bytes of a client's message from which it is passed on before it is whole, and that wait for an engine.
const ASK_BYTES: usize = 64 << 10;

/// A connection of a client that is logged in.
pub(super) struct MessageRelay {
    door: ServerDoor,
    keys: Arc<CancelKeys>,
    login: PostgresLogin,
    key: Option<CancelKey>,
    read: ReadHalf<DoorStream>,
    write: WriteHalf<DoorStream>,
    incoming: BytesMut,
    outgoing: BytesMut,
    /// Bytes of a long message that are still to come.
    rest: usize,
    /// Answers that the engine owes.
    awaited: AwaitedAnswers,
}

/// What a client waits for, by the types of messages alone. A Query and a Sync end with a ReadyForQuery each; another
/// message has one last answer, which the client waits for if it has sent a Flush.
#[derive(Default)]
struct AwaitedAnswers {
    ends: usize,
    /// Other messages that are not answered, and those of them that were sent before a Flush.
    others: usize,
    flushed: usize,
    /// True after an error, until the next Sync: the engine answers nothing before.
    is_skipping: bool,
}

impl AwaitedAnswers {
    fn count_request(&mut self, kind: u8) {
        match kind {
            b'Q' => self.ends += 1,
            b'S' => {
                self.ends += 1;
                self.is_skipping = false;
            }
            b'P' | b'B' | b'D' | b'E' | b'C' if !self.is_skipping => self.others += 1,
            b'H' => self.flushed = self.others,
            _ => {}
        }
    }

    fn count_answer(&mut self, kind: u8) {
        match kind {
            b'Z' => self.ends = self.ends.saturating_sub(1),
            b'1' | b'2' | b'3' | b'T' | b'n' | b'C' | b'I' | b's' => {
                self.others = self.others.saturating_sub(1);
                self.flushed = self.flushed.saturating_sub(1);
            }
            b'E' => {
                self.others = 0;
                self.flushed = 0;
                self.is_skipping = self.ends == 0;
            }
            _ => {}
        }
    }

    fn is_any(&self) -> bool {
        self.ends > 0 || self.flushed > 0
    }
}

/// A connection to an engine.
struct EngineLink {
    engine: Arc<EngineProcess>,
    read: OwnedReadHalf,
    write: OwnedWriteHalf,
    incoming: BytesMut,
    outgoing: BytesMut,
    /// Bytes of a long message that are still to come.
    rest: usize,
}

/// The reason for which passing on ends.
enum RelayEnd {
    Client,
    Engine,
    Broken(Box<RequestFault>),
}

fn broken_relay(fault: RequestFault) -> RelayEnd {
    RelayEnd::Broken(Box::new(fault))
}

impl Drop for MessageRelay {
    fn drop(&mut self) {
        if let Some(key) = &self.key {
            self.keys.remove_key(key);
        }
    }
}

impl MessageRelay {
    pub fn new(stream: DoorStream, door: ServerDoor, keys: Arc<CancelKeys>, login: PostgresLogin) -> Self {
        let (read, write) = tokio::io::split(stream);
        Self {
            door,
            keys,
            login,
            key: None,
            read,
            write,
            incoming: BytesMut::new(),
            outgoing: BytesMut::new(),
            rest: 0,
            awaited: AwaitedAnswers::default(),
        }
    }

    /// Answers the client until it or its engine ends, or until the server drains and nothing is asked.
    pub async fn answer_client(mut self) {
        if let Err(Some(fault)) = self.converse().await {
            self.door.metrics().record_failure(&fault);
            self.outgoing.extend_from_slice(&fatal_message(&fault));
        }
        // A client that hangs up needs no last message.
        let _ = self.write.write_all_buf(&mut self.outgoing).await;
        let _ = self.write.shutdown().await;
    }

    // The error is the last message to the client; None if the client is gone, or cannot be sent one.
    async fn converse(&mut self) -> Result<(), Option<RequestFault>> {
        let mut link = self.connect_engine().await?;
        let end = self.pass_on(&mut link).await;
        match end {
            RelayEnd::Client => Ok(()),
            // A message that was passed on in part can be followed by nothing: the client sees it broken off.
            _ if link.rest > 0 => Err(None),
            RelayEnd::Broken(fault) => Err(Some(*fault)),
            RelayEnd::Engine => Err(Some(self.find_fault(&link.engine).await)),
        }
    }

    async fn pass_on(&mut self, link: &mut EngineLink) -> RelayEnd {
        let drain = self.door.drain().clone();
        let client_end = self.door.engines().client_end(&self.login.client.name);
        loop {
            if let Err(end) = self.take_messages(link).and_then(|()| self.take_answers(link)) {
                return end;
            }
            let is_unread = !self.outgoing.is_empty();
            tokio::select! {
                // In this order: the engine's answer to the end of its client comes after the end itself, and is not
                // passed on.
                biased;
                () = client_end.cancelled() => return broken_relay(RequestFault::Unauthenticated),
                () = drain.wait_until_begun(), if !is_unread && !self.awaited.is_any() => {
                    self.outgoing = fatal_message(&RequestFault::Disconnected);
                    return RelayEnd::Client;
                }
                written = self.write.write_buf(&mut self.outgoing), if is_unread => {
                    if written.is_err() {
                        return RelayEnd::Client;
                    }
                }
                written = link.write.write_buf(&mut link.outgoing), if !link.outgoing.is_empty() => {
                    if written.is_err() {
                        // It may have said why.
                        link.outgoing.clear();
                    }
                }
                read = self.read.read_buf(&mut self.incoming),
                    if link.outgoing.len() < ASK_BYTES =>
                {
                    if read.unwrap_or(0) == 0 {
                        return RelayEnd::Client;
                    }
                }
                read = link.read.read_buf(&mut link.incoming), if !is_unread => {
                    if read.unwrap_or(0) == 0 {
                        return RelayEnd::Engine;
                    }
                }
            }
        }
    }

    // The client's messages, checked, to the engine.
    fn take_messages(&mut self, link: &mut EngineLink) -> Result<(), RelayEnd> {
        loop {
            let rest = self.incoming.split_to(self.rest.min(self.incoming.len()));
            self.rest -= rest.len();
            link.outgoing.extend_from_slice(&rest);
            if self.rest > 0 {
                return Ok(());
            }
            let Some(header) = FrameHeader::peek_from(&self.incoming).map_err(broken_relay)? else { return Ok(()) };
            header.check_header().map_err(broken_relay)?;
            let there = header.bytes.min(self.incoming.len());
            if there < header.bytes.min(ASK_BYTES) {
                return Ok(());
            }
            if header.kind == b'X' {
                return Err(RelayEnd::Client);
            }
            // Of a longer one, the engine ends the connection.
            if there == header.bytes {
                header.check_parts(&self.incoming[..there]).map_err(broken_relay)?;
            }
            self.awaited.count_request(header.kind);
            self.rest = header.bytes - there;
            link.outgoing.extend_from_slice(&self.incoming.split_to(there));
        }
    }

    // The engine's messages to the client, each when it is whole, so that an error can follow it.
    fn take_answers(&mut self, link: &mut EngineLink) -> Result<(), RelayEnd> {
        if !self.outgoing.is_empty() {
            return Ok(());
        }
        let mut passed = 0;
        while passed < link.incoming.len() {
            if link.rest > 0 {
                let bytes = link.rest.min(link.incoming.len() - passed);
                (passed, link.rest) = (passed + bytes, link.rest - bytes);
                continue;
            }
            let there = &link.incoming[passed..];
            let header = FrameHeader::peek_from(there).map_err(|_| RelayEnd::Engine)?;
            let Some(header) = header else { break };
            if there.len() < header.bytes && header.bytes <= READ_BYTES {
                break;
            }
            self.awaited.count_answer(header.kind);
            let bytes = header.bytes.min(there.len());
            (passed, link.rest) = (passed + bytes, header.bytes - bytes);
        }
        self.outgoing = link.incoming.split_to(passed);
        link.incoming.reserve(READ_BYTES);
        Ok(())
    }

    // Begins a session on the engine of statements, or, if that ended before the session began, on the next one.
    async fn connect_engine(&mut self) -> Result<EngineLink, Option<RequestFault>> {
        let mut ended = None;
        loop {
            let engine = match self.door.engines().engine_for(EngineRole::Statements, &self.login.client).await {
                Ok(engine) => engine,
                Err(fault) => return Err(ended.or(Some(fault))),
            };
            match self.start_session(engine.clone()).await {
                Ok(link) => return link.ok_or(None),
                Err(_) if ended.is_some() => return Err(ended),
                Err(_) => {
                    self.outgoing.clear();
                    ended = Some(self.find_fault(&engine).await);
                }
            }
        }
    }

    // None if the engine refuses the session; its error message is passed on to the client.
    async fn start_session(&mut self, engine: Arc<EngineProcess>) -> io::Result<Option<EngineLink>> {
        let mut socket = engine.connect_socket(EngineSocket::Postgres).await?;
        ConnectionOpening::new(&self.login.client, Some(self.login.number)).write_to(&mut socket).await?;
        let (read, write) = socket.into_split();
        let incoming = BytesMut::with_capacity(READ_BYTES);
        let outgoing = BytesMut::new();
        let mut link = EngineLink { engine, read, write, incoming, outgoing, rest: 0 };
        link.write.write_all(&self.login.startup).await?;
        loop {
            let (kind, message) = link.next_message().await?;
            match kind {
                b'K' => {
                    let shown = self.take_key(&link, &message[HEADER..]);
                    self.outgoing.extend_from_slice(&shown);
                }
                _ => self.outgoing.extend_from_slice(&message),
            }
            match kind {
                b'E' => return Ok(None),
                b'Z' => return Ok(Some(link)),
                _ => {}
            }
        }
    }

    // Keeps the engine's key, and returns the door's own for the client.
    fn take_key(&mut self, link: &EngineLink, mut engine_key: &[u8]) -> BytesMut {
        let pid = engine_key.try_get_i32().unwrap_or(0);
        self.key = CancelKeys::make_key(self.login.pid, engine_key.len());
        let Some(key) = &self.key else { return BytesMut::new() };
        let client = self.login.client.clone();
        let target = CancelTarget { engine: link.engine.clone(), client, pid, secret: engine_key.to_vec() };
        self.keys.set_target(key, target);
        key_message(key.pid, &key.secret)
    }

    // The reason for which an engine ended.
    async fn find_fault(&self, engine: &EngineProcess) -> RequestFault {
        if let Err(refused) = self.door.access().check_current(&self.login.client) {
            return refused;
        }
        match engine.why_ended().await {
            Some(why) => why.fault(Some(self.login.number)),
            None => RequestFault::EngineLost { reason: "it closed the connection".to_owned() },
        }
    }
}

impl EngineLink {
    async fn next_message(&mut self) -> io::Result<(u8, BytesMut)> {
        loop {
            let header = FrameHeader::peek_from(&self.incoming).map_err(io::Error::other)?;
            if let Some(header) = header.filter(|header| header.bytes <= self.incoming.len()) {
                return Ok((header.kind, self.incoming.split_to(header.bytes)));
            }
            if self.read.read_buf(&mut self.incoming).await? == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Of a conversation: types behind `>` are the client's, those behind `<` the engine's.
    fn waits(conversation: &str) -> bool {
        let mut awaited = AwaitedAnswers::default();
        for part in conversation.split(' ') {
            for kind in part[1..].bytes() {
                if part.starts_with('>') { awaited.count_request(kind) } else { awaited.count_answer(kind) }
            }
        }
        awaited.is_any()
    }

    #[test]
    fn a_client_waits_for_what_it_requested() {
        for waiting in
            [">Q", ">Q <TDDC", ">QQ <TDCZ", ">PBDES <12T", ">PBEHP <12", ">PBESPBES <1EZ", ">P <E >PPBS", ">EH <NSA"]
        {
            assert!(waits(waiting), "{waiting}");
        }
        for idle in
            [">Q <TDDCZ", ">Q <EZ", ">PDS <1tTZ", ">PB", ">PBEH <12Ds", ">P <E >PPBE", ">P <E >PPBS <EZ >P", ">PH <1"]
        {
            assert!(!waits(idle), "{idle}");
        }
    }
}
