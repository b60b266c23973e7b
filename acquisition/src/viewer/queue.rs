//! What waits for one client.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Bytes that wait for one client at most: two minutes of a real rig's sweeps.
pub(super) const WAITING_BYTES: usize = 16 << 20;

/// A message on its way.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Waiting {
    pub(crate) channel: u16,
    pub(crate) log_time_nanos: u64,
    pub(crate) data: Arc<[u8]>,
}

/// What is sent.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Outgoing {
    /// A message and its subscription.
    Message(u32, Waiting),
    /// The time of playback, ns since 1970.
    Time(u64),
    /// An encoded state of playback.
    State(Vec<u8>),
}

/// What waits for one client.
#[derive(Default)]
pub(crate) struct Queue {
    inner: Mutex<Inner>,
}

#[derive(Default)]
struct Inner {
    entries: VecDeque<Entry>,
    /// Of messages that may be lost.
    bytes: usize,
    /// Of those that may not.
    kept: usize,
    wanted: BTreeMap<u16, Wanted>,
    /// The client controls playback, so it understands states.
    controls: bool,
}

/// A subscription.
struct Wanted {
    subscription: u32,
    /// Whether it was told what is known, so that what is new may follow.
    primed: bool,
}

enum Entry {
    /// May be lost.
    Message(Waiting),
    /// Tells where things stand: only a later one of its channel takes its place.
    Kept(Waiting),
    Time(u64),
    State(Vec<u8>),
}

impl Entry {
    fn bytes(&self) -> usize {
        match self {
            Self::Message(waiting) => waiting.data.len(),
            _ => 0,
        }
    }

    fn kept(&self) -> usize {
        match self {
            Self::Kept(waiting) => waiting.data.len(),
            _ => 0,
        }
    }
}

impl Queue {
    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn wanted(&self) -> Vec<u16> {
        self.inner().wanted.keys().copied().collect()
    }

    /// Those of them whose messages go to it now.
    pub(super) fn receiving(&self) -> Vec<u16> {
        self.inner().wanted.iter().filter(|(_, wanted)| wanted.primed).map(|(channel, _)| *channel).collect()
    }

    /// Whether messages of some channel go to it now.
    pub(super) fn is_receiving(&self) -> bool {
        self.inner().wanted.values().any(|wanted| wanted.primed)
    }

    /// Whether messages of a channel go to it now.
    pub(crate) fn receives(&self, channel: u16) -> bool {
        self.inner().wanted.get(&channel).is_some_and(|w| w.primed)
    }

    /// Whether it has enough to read for now.
    pub(super) fn is_busy(&self) -> bool {
        let inner = self.inner();
        inner.bytes + inner.kept >= WAITING_BYTES / 2
    }

    /// Bytes of messages that wait.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        self.inner().bytes
    }

    pub(super) fn subscribe(&self, channel: u16, subscription: u32) {
        self.inner().wanted.insert(channel, Wanted { subscription, primed: false });
    }

    pub(super) fn unsubscribe(&self, subscriptions: &[u32]) {
        self.inner().wanted.retain(|_, wanted| !subscriptions.contains(&wanted.subscription));
    }

    pub(super) fn hear_of_playback(&self) {
        self.inner().controls = true;
    }

    /// Tells what is known of channels, by time; what is new follows from here on.
    pub(crate) fn prime(&self, channels: &BTreeSet<u16>, known: &[Waiting]) {
        let mut inner = self.inner();
        inner.wanted.iter_mut().filter(|(id, _)| channels.contains(id)).for_each(|(_, wanted)| wanted.primed = true);
        let known: Vec<_> = known.iter().filter(|waiting| channels.contains(&waiting.channel)).cloned().collect();
        let new: usize = known.iter().map(|waiting| waiting.data.len()).sum();
        if inner.kept + new > WAITING_BYTES {
            // Whoever has not read for so long how things stood need not know any more.
            inner.entries.retain(|e| !matches!(e, Entry::Kept(waiting) if channels.contains(&waiting.channel)));
            inner.kept = inner.entries.iter().map(Entry::kept).sum();
        }
        inner.kept += new;
        inner.entries.extend(known.into_iter().map(Entry::Kept));
    }

    /// A new message; returns how many old ones are lost by it.
    pub(super) fn push(&self, message: Waiting) -> u64 {
        let mut inner = self.inner();
        inner.bytes += message.data.len();
        inner.entries.push_back(Entry::Message(message));
        let mut lost = 0;
        while inner.bytes > WAITING_BYTES {
            let oldest = inner.entries.iter().position(|entry| matches!(entry, Entry::Message(_)));
            // The newest is sent however large it is.
            let Some(oldest) = oldest.filter(|at| at + 1 < inner.entries.len()) else { break };
            inner.bytes -= inner.entries.remove(oldest).map_or(0, |entry| entry.bytes());
            lost += 1;
        }
        lost
    }

    /// What the time is; only the latest of times that wait together matters.
    pub(crate) fn tell_time(&self, nanos: u64) {
        let mut inner = self.inner();
        if let Some(Entry::Time(_)) = inner.entries.back() {
            inner.entries.pop_back();
        }
        inner.entries.push_back(Entry::Time(nanos));
    }

    /// How playback stands, for those who control it.
    pub(crate) fn tell_state(&self, encoded: Vec<u8>) {
        let mut inner = self.inner();
        if inner.controls {
            inner.entries.push_back(Entry::State(encoded));
        }
    }

    /// Forgets what waits, because it is of another time; states are answers and stay. Channels want to be told anew what
    /// is known.
    pub(crate) fn forget(&self) {
        let mut inner = self.inner();
        inner.entries.retain(|entry| matches!(entry, Entry::State(_)));
        (inner.bytes, inner.kept) = (0, 0);
        inner.wanted.values_mut().for_each(|wanted| wanted.primed = false);
    }

    /// The next that is sent.
    pub(crate) fn pop(&self) -> Option<Outgoing> {
        let mut inner = self.inner();
        loop {
            let entry = inner.entries.pop_front()?;
            inner.bytes -= entry.bytes();
            inner.kept -= entry.kept();
            match entry {
                Entry::Time(nanos) => return Some(Outgoing::Time(nanos)),
                Entry::State(encoded) => return Some(Outgoing::State(encoded)),
                Entry::Message(waiting) | Entry::Kept(waiting) => {
                    if let Some(wanted) = inner.wanted.get(&waiting.channel) {
                        return Some(Outgoing::Message(wanted.subscription, waiting));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waiting(channel: u16, log_time_nanos: u64, bytes: usize) -> Waiting {
        Waiting { channel, log_time_nanos, data: vec![0; bytes].into() }
    }

    fn drained(queue: &Queue) -> Vec<(u16, u64)> {
        let mut all = Vec::new();
        while let Some(outgoing) = queue.pop() {
            match outgoing {
                Outgoing::Message(_, w) => all.push((w.channel, w.log_time_nanos)),
                Outgoing::Time(nanos) => all.push((0, nanos)),
                Outgoing::State(_) => all.push((0, 0)),
            }
        }
        all
    }

    #[test]
    fn the_oldest_are_lost_and_never_what_tells_where_things_stand() {
        let queue = Queue::default();
        queue.subscribe(1, 10);
        queue.subscribe(2, 20);
        queue.prime(&[1, 2].into(), &[waiting(1, 5, WAITING_BYTES)]);
        let lost: u64 = (10..15).map(|time| queue.push(waiting(2, time, WAITING_BYTES / 3))).sum();
        assert_eq!(lost, 2);
        // One alone that is larger than all that may wait is still sent.
        assert_eq!(queue.push(waiting(2, 15, 2 * WAITING_BYTES)), 3);
        assert_eq!(drained(&queue), [(1, 5), (2, 15)]);
        assert_eq!(queue.bytes(), 0);
    }

    #[test]
    fn what_is_of_another_time_is_forgotten() {
        let queue = Queue::default();
        queue.subscribe(1, 10);
        queue.tell_state(vec![1]);
        assert_eq!(drained(&queue), [], "states are for those who control");
        queue.hear_of_playback();
        queue.prime(&[1].into(), &[waiting(1, 5, 1)]);
        queue.push(waiting(1, 6, 1));
        queue.tell_state(vec![1]);
        queue.tell_time(7);
        queue.forget();
        assert!(!queue.receives(1), "until it is told where things stand");
        queue.prime(&[1].into(), &[waiting(1, 2, 1)]);
        queue.prime(&[1].into(), &[waiting(1, 3, 1), waiting(2, 3, 1), waiting(1, 3, 1)]);
        queue.tell_time(3);
        queue.tell_time(4);
        assert_eq!(drained(&queue), [(0, 0), (1, 2), (1, 3), (1, 3), (0, 4)]);
        // What nobody reads does not grow without bounds.
        for time in 0..9 {
            queue.prime(&[1].into(), &[waiting(1, time, WAITING_BYTES / 2)]);
            assert!(queue.is_busy());
        }
        assert_eq!(drained(&queue), [(1, 8)]);
    }
}
