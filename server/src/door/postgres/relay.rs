//! Passes messages between a client and its engine, and keeps the connection if the engine ends.

use std::io;
use std::sync::Arc;

use bytes::{Buf as _, BytesMut};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, ReadHalf, WriteHalf};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};

use super::PostgresLogin;
use super::cancel_keys::{CancelKey, CancelKeys, CancelTarget};
use super::exchange::MessageExchange;
use super::frames::{FrameHeader, HEADER, READY, SYNC, error_message, fatal_message, key_message};
use crate::door::encryption::DoorStream;
use crate::door::engine_process::{EndReason, EngineLease, EngineProcess};
use crate::door::server_door::ServerDoor;
use crate::engine_socket::EngineSocket;
use crate::fault::RequestFault;

/// Bytes that are read at once, and of a message from which it is passed on before it is whole.
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
    /// Bytes of a long message that are still to come, and whether they are passed on.
    rest: usize,
    is_rest_dropped: bool,
    /// True if messages are skipped up to the next Sync, as after any error.
    is_skipping: bool,
    exchange: MessageExchange,
}

/// A connection to an engine.
struct EngineLink {
    engine: Arc<EngineProcess>,
    lease: Option<EngineLease>,
    read: OwnedReadHalf,
    write: OwnedWriteHalf,
    incoming: BytesMut,
    outgoing: BytesMut,
    /// Bytes of a long message that are still to come.
    rest: usize,
    /// Messages that the client knows already.
    known: usize,
}

/// The reason for which passing on ends.
enum RelayEnd {
    Client,
    Engine,
    Broken(Box<RequestFault>),
}

fn broken(fault: RequestFault) -> RelayEnd {
    RelayEnd::Broken(Box::new(fault))
}

impl Drop for MessageRelay {
    fn drop(&mut self) {
        if let Some(key) = &self.key {
            self.keys.remove(key);
        }
    }
}

impl MessageRelay {
    pub(super) fn new(stream: DoorStream, door: ServerDoor, keys: Arc<CancelKeys>, login: PostgresLogin) -> Self {
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
            is_rest_dropped: false,
            is_skipping: false,
            exchange: MessageExchange::default(),
        }
    }

    /// Answers the client until it goes, or until the server drains and nothing is asked.
    pub(super) async fn run(mut self) {
        if let Err(Some(fault)) = self.converse().await {
            self.door.metrics().record_failure(&fault);
            self.outgoing.extend_from_slice(&fatal_message(&fault));
        }
        // A client that hangs up needs no last message.
        let _ = self.write.write_all_buf(&mut self.outgoing).await;
        let _ = self.write.shutdown().await;
    }

    // The error is the last message to the client; None if the client is gone, or has it already.
    async fn converse(&mut self) -> Result<(), Option<RequestFault>> {
        let mut link = self.connect(true).await?;
        loop {
            match self.pass_on(&mut link).await {
                RelayEnd::Client => return Ok(()),
                RelayEnd::Broken(fault) => return Err(Some(*fault)),
                RelayEnd::Engine => link = self.recover(link).await?,
            }
        }
    }

    async fn pass_on(&mut self, link: &mut EngineLink) -> RelayEnd {
        let drain = self.door.drain().clone();
        loop {
            if let Err(end) = self.take_messages(link).and_then(|()| self.take_answers(link)) {
                return end;
            }
            let is_idle = !self.exchange.is_waiting() && self.outgoing.is_empty();
            tokio::select! {
                () = drain.begun(), if is_idle => {
                    self.outgoing = fatal_message(&RequestFault::Disconnected);
                    return RelayEnd::Client;
                }
                written = self.write.write_buf(&mut self.outgoing), if !self.outgoing.is_empty() => {
                    if written.is_err() {
                        return RelayEnd::Client;
                    }
                }
                written = link.write.write_buf(&mut link.outgoing), if !link.outgoing.is_empty() => {
                    if written.is_err() {
                        return RelayEnd::Engine;
                    }
                }
                read = self.read.read_buf(&mut self.incoming), if link.outgoing.len() < ASK_BYTES => {
                    if read.unwrap_or(0) == 0 {
                        return RelayEnd::Client;
                    }
                }
                read = link.read.read_buf(&mut link.incoming), if self.outgoing.is_empty() => {
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
            if self.rest > 0 {
                let bytes = self.incoming.split_to(self.rest.min(self.incoming.len()));
                self.rest -= bytes.len();
                if !self.is_rest_dropped {
                    link.outgoing.extend_from_slice(&bytes);
                }
                if self.rest > 0 {
                    return Ok(());
                }
            }
            let Some(header) = FrameHeader::peek(&self.incoming).map_err(broken)? else { return Ok(()) };
            header.check().map_err(broken)?;
            let there = header.bytes.min(self.incoming.len());
            if there < header.bytes.min(ASK_BYTES) {
                return Ok(());
            }
            if header.kind == b'X' {
                return Err(RelayEnd::Client);
            }
            // Of a longer one, the engine ends the connection.
            if there == header.bytes {
                header.check_parts(&self.incoming[..there]).map_err(broken)?;
            }
            if link.lease.is_none() && !self.is_skipping {
                link.lease = Some(link.engine.lease().ok_or(RelayEnd::Engine)?);
            }
            let bytes = self.incoming.split_to(there);
            (self.rest, self.is_rest_dropped) = (header.bytes - there, self.is_skipping);
            if self.is_skipping {
                if header.kind == b'S' {
                    self.is_skipping = false;
                    self.outgoing.extend_from_slice(&READY);
                }
                continue;
            }
            if !self.exchange.is_waiting() {
                // What came before this statement was not about it.
                self.take_cancel();
            }
            self.exchange.ask(header, &bytes);
            link.outgoing.extend_from_slice(&bytes);
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
            let header = FrameHeader::peek(there).map_err(|_| RelayEnd::Engine)?;
            let Some(header) = header else { break };
            if there.len() < header.bytes && header.bytes <= READ_BYTES {
                break;
            }
            let bytes = header.bytes.min(there.len());
            self.exchange.answer(header.kind, there.get(HEADER..bytes).unwrap_or_default());
            // A new engine's answer begins as the old one's did, or with an error.
            link.known = if header.kind == b'E' { 0 } else { link.known };
            if link.known > 0 {
                link.known -= 1;
                link.incoming.advance(bytes);
                continue;
            }
            (passed, link.rest) = (passed + bytes, header.bytes - bytes);
        }
        if !self.exchange.is_waiting() && !self.exchange.in_transaction && !self.exchange.has_cursor {
            link.lease = None;
        }
        self.outgoing = link.incoming.split_to(passed);
        link.incoming.reserve(READ_BYTES);
        Ok(())
    }

    // The engine has ended. The pending request is retried, or fails; the next engine is leased when it is needed.
    async fn recover(&mut self, old: EngineLink) -> Result<EngineLink, Option<RequestFault>> {
        // A message that is passed on in part can be followed by nothing.
        if old.rest > 0 {
            return Err(None);
        }
        let mut fault = engine_fault(&old.engine).await;
        let engine_was_lost = self.exchange.is_waiting();
        drop(old);
        self.is_rest_dropped = true;
        if !self.exchange.is_transferable() || (self.exchange.has_cursor && !engine_was_lost) {
            return Err(Some(fault));
        }
        if self.exchange.is_waiting() && !self.exchange.is_repeatable() {
            self.tell(&fault);
        }
        loop {
            if !self.exchange.is_waiting() {
                self.wait_for_client().await?;
            }
            match self.connect(false).await {
                Ok(mut link) => {
                    if self.exchange.is_waiting() && self.take_cancel() {
                        self.tell(&RequestFault::Cancelled);
                    }
                    if self.exchange.is_waiting() {
                        link.known = self.exchange.repeat();
                        link.outgoing.extend_from_slice(self.exchange.unanswered());
                    }
                    return Ok(link);
                }
                Err(Some(failed)) => fault = failed,
                Err(None) => return Err(None),
            }
            if !self.exchange.is_waiting() {
                return Err(Some(fault));
            }
            self.tell(&fault);
        }
    }

    // Whether the client has cancelled the statement that runs; an engine that ended may not have heard of it.
    fn take_cancel(&self) -> bool {
        self.key.as_ref().is_some_and(|key| self.keys.take_use(key))
    }

    fn tell(&mut self, fault: &RequestFault) {
        self.door.metrics().record_failure(fault);
        self.outgoing.extend_from_slice(&error_message(fault));
        match self.exchange.has_end() {
            true => self.outgoing.extend_from_slice(&READY),
            false => self.is_skipping = true,
        }
        self.exchange.fail();
    }

    async fn wait_for_client(&mut self) -> Result<(), Option<RequestFault>> {
        self.write.write_all_buf(&mut self.outgoing).await.map_err(|_| None)?;
        while self.incoming.is_empty() {
            tokio::select! {
                () = self.door.drain().begun() => {
                    self.outgoing = fatal_message(&RequestFault::Disconnected);
                    return Err(None);
                }
                read = self.read.read_buf(&mut self.incoming) => if read.unwrap_or(0) == 0 {
                    return Err(None);
                }
            }
        }
        Ok(())
    }

    // Begins a session on the client's engine; one that is not the first is brought to the state of the last one.
    async fn connect(&mut self, is_first: bool) -> Result<EngineLink, Option<RequestFault>> {
        let told = self.outgoing.len();
        let mut is_repeated = false;
        loop {
            let lease = self.door.engines().lease(&self.login.client).await.map_err(Some)?;
            let engine = lease.engine().clone();
            match self.start_session(lease, is_first).await {
                Ok(Some(link)) => return Ok(link),
                Ok(None) => return Err(None),
                Err(_) if is_repeated => return Err(Some(engine_fault(&engine).await)),
                Err(_) => {
                    self.outgoing.truncate(told);
                    is_repeated = true;
                    let _ = engine.why_ended().await;
                }
            }
        }
    }

    // None if the engine refuses the session; its error message is passed on to the client.
    async fn start_session(&mut self, lease: EngineLease, is_first: bool) -> io::Result<Option<EngineLink>> {
        let stream: UnixStream = lease.engine().connect(EngineSocket::Postgres).await?;
        let (read, write) = stream.into_split();
        let engine = lease.engine().clone();
        let (incoming, outgoing) = (BytesMut::with_capacity(READ_BYTES), BytesMut::new());
        let mut link = EngineLink { engine, lease: Some(lease), read, write, incoming, outgoing, rest: 0, known: 0 };
        link.write.write_all(&self.login.startup).await?;
        loop {
            let (kind, message) = link.next_message().await?;
            match kind {
                b'K' => {
                    let shown = self.take_key(&link, &message[HEADER..]);
                    if is_first {
                        self.outgoing.extend_from_slice(&shown);
                    }
                    continue;
                }
                b'E' => {
                    self.outgoing.extend_from_slice(&message);
                    return Ok(None);
                }
                _ if is_first => self.outgoing.extend_from_slice(&message),
                _ => {}
            }
            if kind == b'Z' {
                break;
            }
        }
        if !is_first {
            self.prepare_session(&mut link).await?;
        }
        Ok(Some(link))
    }

    // Keeps the engine's key, and returns the door's own for the client.
    fn take_key(&mut self, link: &EngineLink, mut engine_key: &[u8]) -> BytesMut {
        let pid = engine_key.try_get_i32().unwrap_or(0);
        if self.key.is_none() {
            self.key = CancelKeys::make(self.login.pid, engine_key.len());
        }
        let Some(key) = &self.key else { return BytesMut::new() };
        self.keys.set(key, CancelTarget { engine: link.engine.clone(), pid, secret: engine_key.to_vec() });
        key_message(key.pid, &key.secret)
    }

    async fn prepare_session(&self, link: &mut EngineLink) -> io::Result<()> {
        for message in self.exchange.settings() {
            link.write.write_all(message).await?;
            while link.next_message().await?.0 != b'Z' {}
        }
        for message in self.exchange.prepared() {
            link.write.write_all(message).await?;
        }
        link.write.write_all(&SYNC).await?;
        while link.next_message().await?.0 != b'Z' {}
        Ok(())
    }
}

impl EngineLink {
    async fn next_message(&mut self) -> io::Result<(u8, BytesMut)> {
        loop {
            let header = FrameHeader::peek(&self.incoming).map_err(io::Error::other)?;
            if let Some(header) = header.filter(|header| header.bytes <= self.incoming.len()) {
                return Ok((header.kind, self.incoming.split_to(header.bytes)));
            }
            if self.read.read_buf(&mut self.incoming).await? == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
        }
    }
}

async fn engine_fault(engine: &EngineProcess) -> RequestFault {
    match engine.why_ended().await {
        Some(EndReason::Failed(reason)) => RequestFault::EngineEnded { reason },
        _ => RequestFault::EngineEnded { reason: "it closed the connection".to_owned() },
    }
}
