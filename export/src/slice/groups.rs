//! The messages of wanted measurements, a measurement at a time.
//!
//! A recorder writes what an attempt rests on before its verdict: poses, air, sweep, response, verdict. So everything
//! up to a verdict belongs to the attempt that the first message with a pair names, and nothing else is decoded.

use std::collections::{BTreeSet, HashSet, VecDeque};

use echolake_schema::topics;
use mcap::records::ChunkIndex;

use super::source::{Message, Source};
use super::{ONCE, Taken};
use crate::error::{Error, Result};

/// Pair and attempt.
type Key = (u32, u32);

/// Reads a run's measurements in the order of its file.
pub(super) struct Groups {
    pub(super) source: Source,
    chunks: VecDeque<ChunkIndex>,
    /// Chunks with topics that stand in the file once.
    once: VecDeque<ChunkIndex>,
    wanted: HashSet<Key>,
    found: HashSet<Key>,
    /// Where the chunk that was read last ends.
    end: u64,
    /// Messages whose attempt is not known yet.
    pending: Vec<Message>,
    open: Option<Open>,
    ready: VecDeque<Vec<Message>>,
}

/// The attempt at hand.
struct Open {
    key: Key,
    messages: Vec<Message>,
    /// Time of its verdict, once that is there.
    verdict: Option<u64>,
}

impl Groups {
    pub(super) fn new(source: Source, taken: &[Taken]) -> Self {
        let times: BTreeSet<u64> = taken.iter().map(|t| u64::try_from(t.log_time_ns).unwrap_or(0)).collect();
        let has = |chunk: &&ChunkIndex| times.range(chunk.message_start_time..=chunk.message_end_time).next().is_some();
        let of_once = |chunk: &&ChunkIndex| {
            chunk.message_index_offsets.keys().any(|id| source.channels.get(id).is_some_and(|c| is_once(&c.topic)))
        };
        let sound = |chunk: &&ChunkIndex| chunk.message_start_time <= chunk.message_end_time;
        let chunks = source.chunks.iter().filter(sound).filter(has).cloned().collect();
        let once = source.chunks.iter().filter(of_once).cloned().collect();
        Self {
            chunks,
            once,
            wanted: taken.iter().map(|t| (t.pair, t.attempt)).collect(),
            found: HashSet::new(),
            end: 0,
            pending: Vec::new(),
            open: None,
            ready: VecDeque::new(),
            source,
        }
    }

    /// The next messages of topics that stand in the file once; None after the last.
    pub(super) async fn next_once(&mut self) -> Result<Option<Vec<Message>>> {
        let Some(chunk) = self.once.pop_front() else { return Ok(None) };
        let mut messages = self.source.messages(&chunk).await?;
        messages.retain(|m| is_once(&m.channel.topic));
        Ok(Some(messages))
    }

    /// All messages of the next wanted measurement, by time; None after the last.
    ///
    /// # Errors
    /// [`Error::Changed`] where one of them is not in the file.
    pub(super) async fn next(&mut self) -> Result<Option<Vec<Message>>> {
        loop {
            if let Some(mut group) = self.ready.pop_front() {
                group.sort_by_key(|m| m.log_time);
                return Ok(Some(group));
            }
            if self.found.len() == self.wanted.len() && self.open.is_none() {
                return Ok(None);
            }
            match self.chunks.pop_front() {
                Some(chunk) => self.read(&chunk).await?,
                None => {
                    self.close();
                    if self.ready.is_empty() {
                        return self.all_found().map(|()| None);
                    }
                }
            }
        }
    }

    fn all_found(&self) -> Result<()> {
        let missing = self.wanted.len() - self.found.len();
        if missing == 0 {
            return Ok(());
        }
        let reason = format!("{missing} of {} measurements are not where the tables say", self.wanted.len());
        let file = self.source.file.path.to_string();
        Err(Error::Changed { run: self.source.file.run.clone(), file, reason })
    }

    async fn read(&mut self, chunk: &ChunkIndex) -> Result<()> {
        if chunk_gap(&self.source.chunks, self.end, chunk.chunk_start_offset) {
            // What went before stands in chunks that have nothing wanted.
            self.close();
            self.pending.clear();
        }
        self.end = chunk.chunk_start_offset + chunk.chunk_length;
        for message in self.source.messages(chunk).await? {
            if !is_once(&message.channel.topic) {
                self.sort_in(message);
            }
        }
        Ok(())
    }

    fn sort_in(&mut self, message: Message) {
        let topic = message.channel.topic.as_str();
        if let Some(key) = key_of(topic, &message.data) {
            let verdict = (topic == topics::MEASUREMENT).then_some(message.log_time);
            if self.open.as_ref().is_none_or(|open| open.key != key) {
                self.close();
                self.open = Some(Open { key, messages: std::mem::take(&mut self.pending), verdict: None });
            }
            if let Some(open) = &mut self.open {
                open.verdict = verdict.or(open.verdict);
                if self.wanted.contains(&key) {
                    open.messages.push(message);
                }
            }
            return;
        }
        // A line of the log behind a verdict, at its time, is about it.
        let of_open = |open: &&mut Open| match open.verdict {
            None => true,
            Some(time) => topic == topics::LOG && message.log_time == time,
        };
        match self.open.as_mut().filter(of_open) {
            Some(open) => open.messages.push(message),
            None => self.pending.push(message),
        }
    }

    fn close(&mut self) {
        let Some(open) = self.open.take().filter(|open| self.wanted.contains(&open.key)) else { return };
        self.found.insert(open.key);
        self.ready.push_back(open.messages);
    }
}

fn is_once(topic: &str) -> bool {
    ONCE.contains(&topic)
}

// Whether a chunk stands between two places of the file.
fn chunk_gap(chunks: &[ChunkIndex], from: u64, to: u64) -> bool {
    let first = chunks.partition_point(|c| c.chunk_start_offset < from);
    chunks.get(first).is_some_and(|c| c.chunk_start_offset < to)
}

// Pair and attempt of the messages that have them: fields 1 and 2, varints that are left out where they are 0.
fn key_of(topic: &str, data: &[u8]) -> Option<Key> {
    if !matches!(topic, topics::SWEEP | topics::IR | topics::MEASUREMENT) {
        return None;
    }
    let (mut key, mut rest) = ((0, 0), data);
    while !rest.is_empty() {
        let tag = varint(&mut rest)?;
        match (tag >> 3, tag & 7) {
            (1, 0) => key.0 = u32::try_from(varint(&mut rest)?).ok()?,
            (2, 0) => key.1 = u32::try_from(varint(&mut rest)?).ok()?,
            (_, 0) => drop(varint(&mut rest)?),
            (_, 1) => rest = rest.get(8..)?,
            (_, 2) => {
                let length = usize::try_from(varint(&mut rest)?).ok()?;
                rest = rest.get(length..)?;
            }
            (_, 5) => rest = rest.get(4..)?,
            _ => return None,
        }
    }
    Some(key)
}

fn varint(rest: &mut &[u8]) -> Option<u64> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let (byte, behind) = rest.split_first()?;
        *rest = behind;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use echolake_schema::messages::{ImpulseResponse, Measurement, SampleFormat, SweepRecording};
    use prost::Message as _;

    use super::*;

    #[test]
    fn pair_and_attempt_are_found_without_decoding() {
        let sweep = SweepRecording {
            pair_id: 2950,
            attempt: 3,
            sample_rate_hz: 96e3,
            sample_count: 2,
            format: SampleFormat::S24le.into(),
            microphone: vec![1; 6].into(),
            loopback: vec![2; 6].into(),
            temperature_c: 20.0,
        };
        assert_eq!(key_of(topics::SWEEP, &sweep.encode_to_vec()), Some((2950, 3)));
        let ir = ImpulseResponse { pair_id: 0, attempt: 1, samples: vec![1.0; 9], ..ImpulseResponse::default() };
        assert_eq!(key_of(topics::IR, &ir.encode_to_vec()), Some((0, 1)), "0 is left out");
        let verdict = Measurement { pair_id: 300, attempt: 2, reasons: vec!["x".into()], ..Measurement::default() };
        assert_eq!(key_of(topics::MEASUREMENT, &verdict.encode_to_vec()), Some((300, 2)));
        assert_eq!(key_of(topics::SWEEP, &[0x0a, 0xff]), None, "cut off");
        assert_eq!(key_of("/tf", &sweep.encode_to_vec()), None);
    }
}
