//! The messages of a recording in the order of time, from any place in it. In memory are the chunks that overlap its
//! place, and of these the messages of the wanted channels.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::recording::{Key, Message, Recording};

/// Limit of messages in memory, bytes: a file whose chunks all overlap cannot be put into order.
const OVERLAP: usize = 512 << 20;

/// Damage in the file: its offset, and a text.
pub(super) type ChunkDamage = (u64, String);

/// A place in a recording.
#[derive(Debug, Default)]
pub(super) struct MessageCursor {
    wanted: BTreeSet<u16>,
    /// Key of the last message that was given out or skipped.
    passed: Key,
    next_chunk: usize,
    open: Vec<VecDeque<Message>>,
    bytes: usize,
}

impl MessageCursor {
    /// Starts right behind `passed`, with these of the file's channels.
    pub fn starting_behind(passed: Key, wanted: BTreeSet<u16>) -> Self {
        Self { wanted, passed, ..Self::default() }
    }

    /// Returns the key of the last message that was given out or skipped.
    pub fn last_passed(&self) -> Key {
        self.passed
    }

    /// Skips all messages up to this key.
    pub fn skip_to(&mut self, upto: Key) {
        self.passed = self.passed.max(upto);
    }

    /// Returns the time of the next message; None behind the last.
    pub fn peek_time(&mut self, recording: &Recording, damages: &mut Vec<ChunkDamage>) -> Option<u64> {
        self.open_chunks(recording, damages);
        self.earliest_head().map(|(_, key)| key.0)
    }

    /// Returns the next message, if [`Self::peek_time`] saw one.
    pub fn pop_message(&mut self) -> Option<Message> {
        let (at, key) = self.earliest_head()?;
        let message = self.open[at].pop_front()?;
        if self.open[at].is_empty() {
            self.open.swap_remove(at);
        }
        self.bytes -= message.data.len();
        self.passed = key;
        Some(message)
    }

    fn earliest_head(&self) -> Option<(usize, Key)> {
        let heads = self.open.iter().enumerate().filter_map(|(at, chunk)| Some((at, chunk.front()?.key)));
        heads.min_by_key(|(_, key)| *key)
    }

    // Opens chunks until none that is closed can have an earlier message than the next.
    fn open_chunks(&mut self, recording: &Recording, damages: &mut Vec<ChunkDamage>) {
        while let Some(chunk) = recording.chunks.get(self.next_chunk) {
            if self.earliest_head().is_some_and(|(_, key)| key.0 < chunk.start) {
                return;
            }
            self.next_chunk += 1;
            if chunk.end < self.passed.0 || !chunk.has_any(&self.wanted) {
                continue;
            }
            match recording.read_messages(chunk, &self.wanted) {
                Ok(messages) => {
                    let ahead: VecDeque<_> = messages.into_iter().filter(|m| m.key > self.passed).collect();
                    let bytes: usize = ahead.iter().map(|m| m.data.len()).sum();
                    if self.bytes + bytes > OVERLAP {
                        let what = format!("its chunks overlap by more than {OVERLAP} bytes; hint: sort it by time");
                        damages.push((chunk.offset, what));
                    } else if !ahead.is_empty() {
                        self.bytes += bytes;
                        self.open.push(ahead);
                    }
                }
                Err(what) => damages.push((chunk.offset, what)),
            }
        }
    }
}

/// Returns the state at a place: of each channel the messages of its latest time up to there, by time.
pub(super) fn latest_messages(
    recording: &Recording,
    upto: Key,
    channels: &BTreeSet<u16>,
    damages: &mut Vec<ChunkDamage>,
) -> Vec<Message> {
    let mut found: BTreeMap<u16, Vec<Message>> = BTreeMap::new();
    let mut chunks: Vec<_> = recording.chunks.iter().filter(|c| c.start <= upto.0).collect();
    // From the chunk that reaches farthest; a chunk that ends before the known messages has no later ones.
    chunks.sort_by_key(|c| std::cmp::Reverse((c.end.min(upto.0), c.start, c.offset)));
    for chunk in chunks {
        let open: BTreeSet<u16> = channels
            .iter()
            .copied()
            .filter(|c| found.get(c).and_then(|m| m.last()).is_none_or(|m| m.key.0 <= chunk.end))
            .collect();
        if open.is_empty() {
            break;
        }
        if !chunk.has_any(&open) {
            continue;
        }
        let messages = recording.read_messages(chunk, &open).unwrap_or_else(|what| {
            damages.push((chunk.offset, what));
            Vec::new()
        });
        for message in messages.into_iter().filter(|m| m.key <= upto) {
            let known = found.entry(message.channel).or_default();
            let at = known.last().map(|m| m.key.0);
            match at {
                Some(at) if at > message.key.0 => {}
                Some(at) if at == message.key.0 => known.push(message),
                _ => *known = vec![message],
            }
        }
    }
    let mut all: Vec<_> = found.into_values().flatten().collect();
    all.sort_by_key(|m| m.key);
    all
}
