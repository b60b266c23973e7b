//! A connection's requests and answers, as far as they are needed to retry: the messages since the last statement that
//! was answered, prepared statements, and settings. The door sees only types of messages and tags of commands.

use std::collections::{BTreeMap, VecDeque};

use bytes::BytesMut;

use super::frames::{FrameHeader, HEADER};

/// Bytes of messages that are kept, of a statement that runs as of all that was prepared.
const KEPT_BYTES: usize = 64 << 10;
const PREPARED_BYTES: usize = 256 << 10;
/// Tags of commands that change the session and nothing else.
const SETTINGS: [&[u8]; 4] = [b"SET", b"RESET", b"DISCARD ALL", b"PREPARE"];
/// The tag of a command whose rows are fetched later.
const CURSOR: &[u8] = b"DECLARE CURSOR";

/// A connection's exchange with its engine.
#[derive(Default)]
pub(super) struct MessageExchange {
    /// Unanswered messages, the bytes of each part that requests an answer, and those of all such parts.
    asked: BytesMut,
    parts: VecDeque<usize>,
    part_bytes: usize,
    /// True if a part of the messages was too long to keep in `asked`.
    is_cut: bool,
    /// Texts to be prepared, until the engine has done so.
    parses: VecDeque<(Vec<u8>, Vec<u8>)>,
    prepared: BTreeMap<Vec<u8>, Vec<u8>>,
    prepared_bytes: usize,
    settings: Vec<Vec<u8>>,
    /// True if a prepared statement or setting was too long to keep, so that the session cannot be rebuilt.
    is_forgetful: bool,
    /// Answers to the statement that runs: messages that were passed on, and what was seen in them.
    answered: usize,
    has_rows: bool,
    sets: Option<bool>,
    pub(super) is_repeated: bool,
    pub(super) in_transaction: bool,
    pub(super) has_cursor: bool,
}

impl MessageExchange {
    /// Records a client's message, whole or as much as there is of a long one.
    pub(super) fn ask(&mut self, header: FrameHeader, bytes: &[u8]) {
        if bytes.len() < header.bytes || self.asked.len() + bytes.len() > KEPT_BYTES {
            self.is_cut = true;
        }
        if !self.is_cut {
            self.asked.extend_from_slice(bytes);
        }
        let body = bytes.get(HEADER..).unwrap_or_default();
        match header.kind {
            b'P' => self.parses.push_back((name(body).to_vec(), bytes.to_vec())),
            b'C' if body.first() == Some(&b'S') => self.close(name(&body[1..])),
            b'Q' | b'S' => {
                self.parts.push_back(self.asked.len() - self.part_bytes);
                self.part_bytes = self.asked.len();
            }
            _ => {}
        }
    }

    /// Returns whether an answer is pending.
    pub(super) fn is_waiting(&self) -> bool {
        !self.parts.is_empty() || !self.asked.is_empty() || self.is_cut
    }

    /// Returns whether the client has requested an answer to the running statement, and not only sent its parts.
    pub(super) fn has_end(&self) -> bool {
        !self.parts.is_empty()
    }

    /// Records an engine's message that is passed on.
    pub(super) fn answer(&mut self, kind: u8, body: &[u8]) {
        self.answered += 1;
        match kind {
            b'D' | b'd' => self.has_rows = true,
            b'1' => self.prepare(),
            b'C' => {
                let tag = body.strip_suffix(b"\0").unwrap_or(body);
                self.sets = Some(self.sets.unwrap_or(true) && SETTINGS.contains(&tag));
                self.has_cursor |= tag == CURSOR;
            }
            b'Z' => {
                self.in_transaction = body.first().is_some_and(|status| *status != b'I');
                self.finish();
            }
            _ => {}
        }
    }

    fn prepare(&mut self) {
        let Some((name, message)) = self.parses.pop_front() else { return };
        // The one without a name is for the statement that runs.
        if name.is_empty() {
            return;
        }
        self.close(&name);
        self.prepared_bytes += message.len();
        match self.prepared_bytes <= PREPARED_BYTES {
            true => drop(self.prepared.insert(name, message)),
            false => self.is_forgetful = true,
        }
    }

    fn close(&mut self, name: &[u8]) {
        if let Some(message) = self.prepared.remove(name) {
            self.prepared_bytes -= message.len();
        }
    }

    // The statement that ran is answered: what was asked after it remains.
    fn finish(&mut self) {
        let bytes = self.parts.pop_front().unwrap_or(self.asked.len());
        let statement = self.asked.split_to(bytes);
        self.part_bytes = self.part_bytes.saturating_sub(bytes);
        if self.sets == Some(true) {
            let kept: usize = self.settings.iter().map(Vec::len).sum();
            match !self.is_cut && kept + statement.len() <= KEPT_BYTES {
                true if self.settings.iter().any(|known| *known == statement) => {}
                true => self.settings.push(statement.to_vec()),
                false => self.is_forgetful = true,
            }
        }
        if self.parts.is_empty() {
            self.is_cut = false;
            self.parses.clear();
        }
        self.begin_answer();
        self.is_repeated = false;
    }

    fn begin_answer(&mut self) {
        (self.answered, self.has_rows, self.sets) = (0, false, None);
    }

    /// Returns whether the running statement can be retried without the client seeing it.
    pub(super) fn is_repeatable(&self) -> bool {
        !self.is_cut && !self.has_rows && !self.is_repeated && !self.is_forgetful && !self.has_cursor
    }

    /// Returns whether a new engine can take the connection over.
    pub(super) fn is_transferable(&self) -> bool {
        !self.is_forgetful
    }

    /// Begins a retry; returns the number of messages of the new answer that the client has already.
    pub(super) fn repeat(&mut self) -> usize {
        self.is_repeated = true;
        self.parses.clear();
        std::mem::take(&mut self.answered)
    }

    /// Drops the running statement, after its failure was sent to the client.
    pub(super) fn fail(&mut self) {
        self.sets = None;
        if self.is_cut {
            // What came after it is not known.
            let parts = self.parts.len().saturating_sub(1);
            self.asked.clear();
            self.part_bytes = 0;
            self.parts = std::iter::repeat_n(0, parts).collect();
            self.is_cut = parts > 0;
            self.begin_answer();
        } else {
            self.finish();
        }
        self.has_cursor = false;
        self.in_transaction = false;
    }

    /// Returns the messages that set settings; the answer to each ends with ReadyForQuery.
    pub(super) fn settings(&self) -> impl Iterator<Item = &[u8]> {
        self.settings.iter().map(Vec::as_slice)
    }

    /// Returns the messages that prepared the named statements.
    pub(super) fn prepared(&self) -> impl Iterator<Item = &[u8]> {
        self.prepared.values().map(Vec::as_slice)
    }

    /// Returns the messages that are not answered.
    pub(super) fn unanswered(&self) -> &[u8] {
        &self.asked
    }
}

// Up to the zero that ends it.
fn name(body: &[u8]) -> &[u8] {
    body.split(|byte| *byte == 0).next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(exchange: &mut MessageExchange, kind: u8, body: &[u8]) -> Vec<u8> {
        let mut message = vec![kind];
        message.extend((body.len() as u32 + 4).to_be_bytes());
        message.extend(body);
        exchange.ask(FrameHeader { kind, bytes: message.len() }, &message);
        message
    }

    #[test]
    fn what_was_answered_is_not_asked_again() {
        let mut exchange = MessageExchange::default();
        let first = ask(&mut exchange, b'Q', b"select 1\0");
        let second = ask(&mut exchange, b'Q', b"select 2\0");
        assert_eq!(exchange.unanswered(), [first, second.clone()].concat());
        exchange.answer(b'T', b"");
        assert!(exchange.is_repeatable());
        exchange.answer(b'D', b"");
        assert!(!exchange.is_repeatable(), "rows are not sent twice");
        exchange.answer(b'Z', b"I");
        assert_eq!(exchange.unanswered(), second);
        assert!(exchange.is_repeatable());
        assert_eq!(exchange.repeat(), 0);
        assert!(!exchange.is_repeatable(), "once is enough");
        exchange.fail();
        assert!(!exchange.is_waiting());
    }

    #[test]
    fn settings_and_statements_are_prepared_again() {
        let mut exchange = MessageExchange::default();
        let set = ask(&mut exchange, b'Q', b"set timezone = 'UTC'\0");
        exchange.answer(b'C', b"SET\0");
        exchange.answer(b'Z', b"I");
        ask(&mut exchange, b'Q', b"select 1\0");
        exchange.answer(b'C', b"SELECT 1\0");
        exchange.answer(b'Z', b"I");
        let prepared = ask(&mut exchange, b'P', b"s1\0select 1\0\0\0");
        let wrong = ask(&mut exchange, b'P', b"s2\0selec\0\0\0");
        ask(&mut exchange, b'S', b"");
        exchange.answer(b'1', b"");
        exchange.answer(b'E', b"");
        exchange.answer(b'Z', b"I");
        assert_eq!(exchange.settings().collect::<Vec<_>>(), [set.as_slice()]);
        assert_eq!(exchange.prepared().collect::<Vec<_>>(), [prepared.as_slice()], "and not {wrong:?}");
        ask(&mut exchange, b'C', b"Ss1\0");
        assert_eq!(exchange.prepared().count(), 0);
    }

    #[test]
    fn long_messages_are_not_kept() {
        let mut exchange = MessageExchange::default();
        ask(&mut exchange, b'Q', &vec![b'x'; KEPT_BYTES]);
        assert!(exchange.is_waiting() && !exchange.is_repeatable() && exchange.unanswered().is_empty());
        exchange.answer(b'Z', b"I");
        assert!(!exchange.is_waiting() && exchange.is_repeatable());
    }
}
