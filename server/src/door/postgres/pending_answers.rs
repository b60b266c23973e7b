//! The answers that an engine owes a client, by the types of messages alone: a few bytes for each, whatever the client sends.

use std::collections::VecDeque;

/// The client's messages that are not answered, in their order.
#[derive(Default)]
pub(super) struct PendingAnswers {
    kinds: VecDeque<u8>,
    /// The number of those whose answers the client has requested; the engine may keep the others back.
    requested: usize,
    /// True after an error, until the next Sync: the engine answers nothing before.
    is_skipping: bool,
}

impl PendingAnswers {
    /// Adds a client's message.
    pub(super) fn ask(&mut self, kind: u8) {
        match kind {
            b'S' => self.is_skipping = false,
            b'Q' | b'P' | b'B' | b'D' | b'E' | b'C' if !self.is_skipping => {}
            // Flush requests answers and has none.
            b'H' => return self.requested = self.kinds.len(),
            _ => return,
        }
        self.kinds.push_back(kind);
        if matches!(kind, b'S' | b'Q') {
            self.requested = self.kinds.len();
        }
    }

    /// Takes off what an engine's message answers.
    pub(super) fn answer(&mut self, kind: u8) {
        let front = self.kinds.front();
        let answered = match kind {
            b'1' => b'P',
            b'2' => b'B',
            b'3' => b'C',
            b'T' | b'n' => b'D',
            b'C' | b'I' | b's' => b'E',
            b'Z' => {
                let end = self.kinds.iter().position(|kind| matches!(kind, b'S' | b'Q'));
                return self.take(end.map_or(self.kinds.len(), |end| end + 1));
            }
            // Of a query, whose end follows.
            b'E' if front == Some(&b'Q') => return,
            b'E' => {
                // What follows an error is not answered, up to the next Sync.
                let sync = self.kinds.iter().position(|kind| *kind == b'S');
                self.is_skipping = sync.is_none();
                return self.take(sync.unwrap_or(self.kinds.len()));
            }
            _ => return,
        };
        if front == Some(&answered) {
            self.take(1);
        }
    }

    fn take(&mut self, count: usize) {
        self.kinds.drain(..count);
        self.requested = self.requested.saturating_sub(count);
    }

    /// The number of messages.
    pub(super) fn len(&self) -> usize {
        self.kinds.len()
    }

    /// Returns whether the client waits for an answer.
    pub(super) fn is_requested(&self) -> bool {
        self.requested > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Of a conversation: types behind `>` are the client's, those behind `<` the engine's. Returns what is owed, and
    // behind a space what of it is requested.
    fn owed(conversation: &str) -> String {
        let mut pending = PendingAnswers::default();
        for part in conversation.split(' ') {
            for kind in part[1..].bytes() {
                if part.starts_with('>') { pending.ask(kind) } else { pending.answer(kind) }
            }
        }
        let kinds = String::from_utf8(pending.kinds.into()).expect("types are ASCII");
        format!("{kinds} {}", &kinds[..pending.requested])
    }

    #[test]
    fn what_was_answered_is_not_owed() {
        for (conversation, expected) in [
            (">Q", "Q Q"),
            (">Q <TDDC", "Q Q"),
            (">Q <TDDCZ", " "),
            (">Q <EZ", " "),
            (">QQ <TDCZ", "Q Q"),
            (">PBDES <12T", "ES ES"),
            (">PBDES <12TDDCZ", " "),
            (">PDS <1tTZ", " "),
            // Without a Sync, and a part of a portal's rows.
            (">PB", "PB "),
            (">PBEHP <12", "EP E"),
            (">PBEH <12Ds", " "),
            // An error: the rest up to Sync has no answer.
            (">PBES <1E", "S S"),
            (">PBESPBES <1EZ", "PBES PBES"),
            (">P <E >PPBE", " "),
            (">P <E >PPBQS", "S S"),
            (">P <E >PPBS <Z >P", "P "),
            // Notices and settings are no answers.
            (">EH <NSA", "E E"),
        ] {
            assert_eq!(owed(conversation), expected, "{conversation}");
        }
    }

    #[test]
    fn messages_after_an_error_are_not_kept() {
        let mut pending = PendingAnswers::default();
        pending.ask(b'P');
        pending.answer(b'E');
        (0..1_000_000).for_each(|_| pending.ask(b'P'));
        assert_eq!(pending.len(), 0);
    }
}
