//! The messages of wanted measurements, a measurement at a time.
//!
//! A recorder writes what an attempt rests on before its verdict: poses, air, sweep, response, verdict. So everything
//! up to a verdict belongs to the attempt that the first message with a pair names, and nothing else is decoded. Where
//! sweeps and responses have chunks of their own, that holds in each of these lanes.

use std::collections::{BTreeMap, BTreeSet, HashSet, VecDeque};

use echolake_recording::ChunkIndex;
use echolake_schema::topics;
use prost::Message as _;

use super::source::{Message, Source};
use super::{ONCE, Taken, is_named};
use crate::error::{Error, Result};

/// Pair and attempt.
type Key = (u32, u32);

/// Reads a run's measurements, one after the other.
pub(super) struct Groups {
    pub source: Source,
    /// Chunks with topics that stand in the file once.
    once: VecDeque<ChunkIndex>,
    wanted: Wanted,
    found: HashSet<Key>,
    lanes: Vec<Lane>,
}

/// What is wanted.
struct Wanted {
    keys: HashSet<Key>,
    /// The same by time, for messages that nothing else assigns.
    times: BTreeMap<u64, Key>,
}

/// Topics that share chunks: a file has one lane, or sweeps, responses and everything else have one each.
struct Lane {
    /// Whether some of its topics name their pair.
    keyed: bool,
    /// Those with something wanted, in the file's order.
    chunks: VecDeque<ChunkIndex>,
    /// Where each of the lane's chunks begins, wanted or not.
    starts: Vec<u64>,
    /// Where the chunk that was read last begins.
    last: Option<u64>,
    /// Messages whose attempt is not known yet.
    pending: Vec<Message>,
    open: Option<Open>,
    ready: VecDeque<Open>,
}

/// What a lane has of one attempt.
struct Open {
    key: Key,
    messages: Vec<Message>,
    /// Time of the message that named the attempt.
    time: u64,
    /// Time of its verdict, once that is there.
    verdict: Option<u64>,
}

impl Groups {
    /// Reads the measurements of a run; lanes that have none of the topics are not read, where topics are named.
    pub fn new(source: Source, taken: &[Taken], topics: &[String]) -> Self {
        let wanted = Wanted {
            keys: taken.iter().map(|t| (t.pair, t.attempt)).collect(),
            times: taken.iter().map(|t| (t.message_time(), (t.pair, t.attempt))).collect(),
        };
        let topic = |id: &u16| source.channels.get(id).map_or("", |c| c.topic.as_str());
        let named = |id: &u16| is_named(topics, topic(id));
        let has_once =
            |chunk: &&ChunkIndex| chunk.message_index_offsets.keys().any(|id| is_once(topic(id)) && named(id));
        let once = source.chunks.iter().filter(has_once).cloned().collect();
        let lanes = split_lanes(&source.chunks).into_iter().filter(|(channels, _)| channels.iter().any(named));
        let lanes = lanes.map(|(channels, chunks)| {
            let keyed = channels.iter().any(|id| names_pair(topic(id)));
            Lane::new(keyed, chunks, &wanted)
        });
        Self { once, found: HashSet::new(), lanes: lanes.collect(), wanted, source }
    }

    /// The next messages of topics that stand in the file once; None after the last.
    pub async fn next_once(&mut self) -> Result<Option<Vec<Message>>> {
        let Some(chunk) = self.once.pop_front() else { return Ok(None) };
        let mut messages = self.source.read_messages(&chunk).await?;
        messages.retain(|m| is_once(&m.channel.topic));
        Ok(Some(messages))
    }

    /// All messages of the next wanted measurement, by time; None after the last.
    ///
    /// # Errors
    /// [`Error::Changed`] where one of them is not in the file.
    pub async fn next(&mut self) -> Result<Option<Vec<Message>>> {
        for lane in &mut self.lanes {
            lane.fill_ready(&self.source, &self.wanted).await?;
        }
        let first = self.lanes.iter().filter_map(|lane| lane.ready.front()).min_by_key(|open| open.time);
        let Some(key) = first.map(|open| open.key) else { return self.all_found().map(|()| None) };
        self.found.insert(key);
        let mut group = Vec::new();
        for lane in &mut self.lanes {
            if lane.ready.front().is_some_and(|open| open.key == key) {
                group.extend(lane.ready.pop_front().into_iter().flat_map(|open| open.messages));
            }
        }
        group.sort_by_key(|m| m.log_time);
        Ok(Some(group))
    }

    fn all_found(&self) -> Result<()> {
        let missing = self.wanted.keys.len() - self.found.len();
        if missing == 0 {
            return Ok(());
        }
        let source =
            format!("{missing} of {} measurements are not where the tables say", self.wanted.keys.len()).into();
        let file = self.source.file.path.to_string();
        Err(Error::Changed { run: self.source.file.run.clone(), file, source })
    }
}

// Channels that share a chunk, by way of others too, and their chunks in the file's order.
fn split_lanes(chunks: &[ChunkIndex]) -> Vec<(BTreeSet<u16>, Vec<ChunkIndex>)> {
    let mut lanes: Vec<(BTreeSet<u16>, Vec<ChunkIndex>)> = Vec::new();
    for chunk in chunks.iter().filter(|c| c.message_start_time <= c.message_end_time) {
        let mut merged = (chunk.message_index_offsets.keys().copied().collect::<BTreeSet<_>>(), vec![chunk.clone()]);
        let (touched, rest) = lanes.into_iter().partition(|(channels, _)| !channels.is_disjoint(&merged.0));
        lanes = rest;
        for (channels, of) in touched {
            merged.0.extend(channels);
            merged.1.extend(of);
        }
        lanes.push(merged);
    }
    lanes.iter_mut().for_each(|(_, chunks)| chunks.sort_by_key(|c| c.chunk_start_offset));
    lanes
}

impl Lane {
    fn new(keyed: bool, chunks: Vec<ChunkIndex>, wanted: &Wanted) -> Self {
        let starts = chunks.iter().map(|c| c.chunk_start_offset).collect();
        let has = |c: &ChunkIndex| wanted.times.range(c.message_start_time..=c.message_end_time).next().is_some();
        let chunks = chunks.into_iter().filter(has).collect();
        Self { keyed, chunks, starts, last: None, pending: Vec::new(), open: None, ready: VecDeque::new() }
    }

    // Reads until the lane's next measurement is whole, or it has none.
    async fn fill_ready(&mut self, source: &Source, wanted: &Wanted) -> Result<()> {
        while self.ready.is_empty() {
            let Some(chunk) = self.chunks.pop_front() else {
                self.close_group(wanted);
                return Ok(());
            };
            let at = self.starts.binary_search(&chunk.chunk_start_offset).unwrap_or(0);
            if self.last != at.checked_sub(1).map(|before| self.starts[before]) {
                // What went before stands in chunks that have nothing wanted.
                self.close_group(wanted);
                self.pending.clear();
            }
            self.last = Some(chunk.chunk_start_offset);
            for message in source.read_messages(&chunk).await? {
                if !is_once(&message.channel.topic) {
                    self.sort_in(message, wanted);
                }
            }
        }
        Ok(())
    }

    fn sort_in(&mut self, message: Message, wanted: &Wanted) {
        let topic = message.channel.topic.as_str();
        let time = message.log_time;
        let key = if self.keyed { key_of(topic, &message.data) } else { wanted.times.get(&time).copied() };
        if let Some(key) = key {
            let verdict = (topic == topics::MEASUREMENT).then_some(time);
            if self.open.as_ref().is_none_or(|open| open.key != key) {
                self.close_group(wanted);
                self.open = Some(Open { key, messages: std::mem::take(&mut self.pending), time, verdict: None });
            }
            if let Some(open) = &mut self.open {
                open.verdict = verdict.or(open.verdict);
                if wanted.keys.contains(&key) {
                    open.messages.push(message);
                }
            }
            return;
        }
        // A line of the log behind a verdict, at its time, is about it.
        let of_open = |open: &&mut Open| match open.verdict {
            None => true,
            Some(of) => topic == topics::LOG && time == of,
        };
        match self.open.as_mut().filter(of_open) {
            _ if !self.keyed => {}
            Some(open) => open.messages.push(message),
            None => self.pending.push(message),
        }
    }

    fn close_group(&mut self, wanted: &Wanted) {
        self.ready.extend(self.open.take().filter(|open| wanted.keys.contains(&open.key)));
    }
}

/// Whether a topic stands in a run's file once.
pub(super) fn is_once(topic: &str) -> bool {
    ONCE.contains(&topic)
}

// The topics whose messages begin with pair and attempt.
fn names_pair(topic: &str) -> bool {
    matches!(topic, topics::SWEEP | topics::SWEEP_REPEAT | topics::IR | topics::MEASUREMENT)
}

/// The fields with which these messages begin.
#[derive(Clone, PartialEq, prost::Message)]
struct PairAttempt {
    #[prost(uint32, tag = "1")]
    pair_id: u32,
    #[prost(uint32, tag = "2")]
    attempt: u32,
}

fn key_of(topic: &str, data: &[u8]) -> Option<Key> {
    if !names_pair(topic) {
        return None;
    }
    let PairAttempt { pair_id, attempt } = PairAttempt::decode(data).ok()?;
    Some((pair_id, attempt))
}

#[cfg(test)]
mod tests {
    use echolake_schema::messages::{ImpulseResponse, Measurement, SampleFormat, SweepRecording};

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
            ..SweepRecording::default()
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
