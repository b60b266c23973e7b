//! Queue of messages for one client.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Limit of pending messages for one client, bytes: two minutes of a real rig's sweeps.
pub(super) const WAITING_BYTES: usize = 16 << 20;

/// Bytes that an entry costs beside its content.
const ENTRY_BYTES: usize = 64;

/// A pending message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PendingMessage {
    pub channel: u16,
    pub log_time_nanos: u64,
    pub data: Arc<[u8]>,
}

/// The next item to send to a client.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum OutgoingItem {
    /// A message and its subscription.
    Message(u32, PendingMessage),
    /// The time that messages are shown by, ns since 1970.
    Time(u64),
    /// An encoded state of playback.
    State(Vec<u8>),
}

/// Pending messages of one client.
#[derive(Default)]
pub(crate) struct ClientQueue {
    inner: Mutex<QueueState>,
}

#[derive(Default)]
struct QueueState {
    entries: VecDeque<QueueEntry>,
    /// Bytes of all entries but those of the current state.
    bytes: usize,
    /// Bytes of the current state of channels.
    kept: usize,
    wanted: BTreeMap<u16, ChannelSubscription>,
    /// The client controls playback, so it understands states.
    controls: bool,
}

/// A subscription.
struct ChannelSubscription {
    subscription: u32,
    /// True after it got the current state, so that new messages may follow.
    primed: bool,
}

enum QueueEntry {
    /// May be dropped.
    Message(PendingMessage),
    /// Current state of its channel, which is not dropped.
    Kept(PendingMessage),
    /// May be dropped.
    Time(u64),
    /// An answer; dropped if nothing else is left to drop.
    State(Vec<u8>),
}

impl QueueEntry {
    fn pending_bytes(&self) -> usize {
        match self {
            Self::Message(waiting) => ENTRY_BYTES + waiting.data.len(),
            Self::Kept(_) => 0,
            Self::Time(_) => ENTRY_BYTES,
            Self::State(encoded) => ENTRY_BYTES + encoded.len(),
        }
    }

    fn kept_bytes(&self) -> usize {
        match self {
            Self::Kept(waiting) => ENTRY_BYTES + waiting.data.len(),
            _ => 0,
        }
    }
}

impl QueueState {
    // Adds an entry, and drops the oldest ones that are too much; returns how many messages were among them.
    fn add_entry(&mut self, entry: QueueEntry) -> u64 {
        self.bytes += entry.pending_bytes();
        self.entries.push_back(entry);
        let mut lost = 0;
        while self.bytes > WAITING_BYTES {
            // The newest is sent, whatever its size.
            let old = self.entries.len() - 1;
            let first = |is_wanted: fn(&QueueEntry) -> bool| self.entries.iter().take(old).position(is_wanted);
            let oldest = first(|entry| matches!(entry, QueueEntry::Message(_) | QueueEntry::Time(_)));
            let oldest = oldest.or_else(|| first(|entry| matches!(entry, QueueEntry::State(_))));
            let Some(dropped) = oldest.and_then(|at| self.entries.remove(at)) else { break };
            self.bytes -= dropped.pending_bytes();
            lost += u64::from(matches!(dropped, QueueEntry::Message(_)));
        }
        lost
    }
}

impl ClientQueue {
    fn lock_inner(&self) -> MutexGuard<'_, QueueState> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn wanted_channels(&self) -> Vec<u16> {
        self.lock_inner().wanted.keys().copied().collect()
    }

    /// Returns the subscribed channels whose messages go to it now.
    pub fn receiving_channels(&self) -> Vec<u16> {
        self.lock_inner().wanted.iter().filter(|(_, wanted)| wanted.primed).map(|(channel, _)| *channel).collect()
    }

    /// Returns whether messages of any channel go to it now.
    pub fn is_receiving(&self) -> bool {
        self.lock_inner().wanted.values().any(|wanted| wanted.primed)
    }

    /// Returns whether messages of a channel go to it now.
    pub fn receives_channel(&self, channel: u16) -> bool {
        self.lock_inner().wanted.get(&channel).is_some_and(|w| w.primed)
    }

    /// Returns whether it has enough to read for now.
    pub fn is_busy(&self) -> bool {
        let inner = self.lock_inner();
        inner.bytes + inner.kept >= WAITING_BYTES / 2
    }

    /// Returns the bytes of pending entries but those of the current state.
    #[cfg(test)]
    pub fn pending_bytes(&self) -> usize {
        self.lock_inner().bytes
    }

    pub fn subscribe(&self, channel: u16, subscription: u32) {
        self.lock_inner().wanted.insert(channel, ChannelSubscription { subscription, primed: false });
    }

    pub fn unsubscribe(&self, subscriptions: &[u32]) {
        self.lock_inner().wanted.retain(|_, wanted| !subscriptions.contains(&wanted.subscription));
    }

    pub fn hear_of_playback(&self) {
        self.lock_inner().controls = true;
    }

    /// Queues the current state of channels, by time; new messages follow from here on.
    pub fn queue_current_state(&self, channels: &BTreeSet<u16>, known: &[PendingMessage]) {
        let mut inner = self.lock_inner();
        inner.wanted.iter_mut().filter(|(id, _)| channels.contains(id)).for_each(|(_, wanted)| wanted.primed = true);
        let known: Vec<_> = known.iter().filter(|waiting| channels.contains(&waiting.channel)).cloned().collect();
        let known: Vec<_> = known.into_iter().map(QueueEntry::Kept).collect();
        let new: usize = known.iter().map(QueueEntry::kept_bytes).sum();
        if inner.kept + new > WAITING_BYTES {
            // A client that has not read the older state for so long does not need it any more.
            inner.entries.retain(|e| !matches!(e, QueueEntry::Kept(waiting) if channels.contains(&waiting.channel)));
            inner.kept = inner.entries.iter().map(QueueEntry::kept_bytes).sum();
        }
        inner.kept += new;
        inner.entries.extend(known);
    }

    /// Queues a new message; returns how many old ones are dropped for it.
    pub fn push(&self, message: PendingMessage) -> u64 {
        self.lock_inner().add_entry(QueueEntry::Message(message))
    }

    /// Queues the time; of several pending times only the latest matters.
    pub fn tell_time(&self, nanos: u64) {
        let mut inner = self.lock_inner();
        if let Some(QueueEntry::Time(_)) = inner.entries.back() {
            inner.entries.pop_back();
            inner.bytes -= ENTRY_BYTES;
        }
        inner.add_entry(QueueEntry::Time(nanos));
    }

    /// Queues the state of playback, if the client controls it.
    pub fn tell_state(&self, encoded: Vec<u8>) {
        let mut inner = self.lock_inner();
        if inner.controls {
            inner.add_entry(QueueEntry::State(encoded));
        }
    }

    /// Drops pending messages, because they are of another time; states are answers and stay. Channels need their
    /// current state anew.
    pub fn forget_pending(&self) {
        let mut inner = self.lock_inner();
        inner.entries.retain(|entry| matches!(entry, QueueEntry::State(_)));
        inner.bytes = inner.entries.iter().map(QueueEntry::pending_bytes).sum();
        inner.kept = 0;
        inner.wanted.values_mut().for_each(|wanted| wanted.primed = false);
    }

    /// Returns the next item to send.
    pub fn pop(&self) -> Option<OutgoingItem> {
        let mut inner = self.lock_inner();
        loop {
            let entry = inner.entries.pop_front()?;
            inner.bytes -= entry.pending_bytes();
            inner.kept -= entry.kept_bytes();
            match entry {
                QueueEntry::Time(nanos) => return Some(OutgoingItem::Time(nanos)),
                QueueEntry::State(encoded) => return Some(OutgoingItem::State(encoded)),
                QueueEntry::Message(waiting) | QueueEntry::Kept(waiting) => {
                    if let Some(wanted) = inner.wanted.get(&waiting.channel) {
                        return Some(OutgoingItem::Message(wanted.subscription, waiting));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waiting(channel: u16, log_time_nanos: u64, bytes: usize) -> PendingMessage {
        PendingMessage { channel, log_time_nanos, data: vec![0; bytes].into() }
    }

    fn drained(queue: &ClientQueue) -> Vec<(u16, u64)> {
        let mut all = Vec::new();
        while let Some(outgoing) = queue.pop() {
            match outgoing {
                OutgoingItem::Message(_, w) => all.push((w.channel, w.log_time_nanos)),
                OutgoingItem::Time(nanos) => all.push((0, nanos)),
                OutgoingItem::State(_) => all.push((0, 0)),
            }
        }
        all
    }

    #[test]
    fn the_oldest_are_lost_and_never_what_tells_where_things_stand() {
        let queue = ClientQueue::default();
        queue.subscribe(1, 10);
        queue.subscribe(2, 20);
        queue.queue_current_state(&[1, 2].into(), &[waiting(1, 5, WAITING_BYTES)]);
        let lost: u64 = (10..15).map(|time| queue.push(waiting(2, time, WAITING_BYTES / 3 - ENTRY_BYTES))).sum();
        assert_eq!(lost, 2);
        // One alone that is larger than all that may wait is still sent.
        assert_eq!(queue.push(waiting(2, 15, 2 * WAITING_BYTES)), 3);
        assert_eq!(drained(&queue), [(1, 5), (2, 15)]);
        assert_eq!(queue.pending_bytes(), 0);
    }

    #[test]
    fn what_is_of_another_time_is_forgotten() {
        let queue = ClientQueue::default();
        queue.subscribe(1, 10);
        queue.tell_state(vec![1]);
        assert_eq!(drained(&queue), [], "states are for those who control");
        queue.hear_of_playback();
        queue.queue_current_state(&[1].into(), &[waiting(1, 5, 1)]);
        queue.push(waiting(1, 6, 1));
        queue.tell_state(vec![1]);
        queue.tell_time(7);
        queue.forget_pending();
        assert!(!queue.receives_channel(1), "until it is told where things stand");
        queue.queue_current_state(&[1].into(), &[waiting(1, 2, 1)]);
        queue.queue_current_state(&[1].into(), &[waiting(1, 3, 1), waiting(2, 3, 1), waiting(1, 3, 1)]);
        queue.tell_time(3);
        queue.tell_time(4);
        assert_eq!(drained(&queue), [(0, 0), (1, 2), (1, 3), (1, 3), (0, 4)]);
        // A queue that is not read does not grow without bounds.
        for time in 0..9 {
            queue.queue_current_state(&[1].into(), &[waiting(1, time, WAITING_BYTES / 2)]);
            assert!(queue.is_busy());
        }
        assert_eq!(drained(&queue), [(1, 8)]);
    }

    #[test]
    fn times_and_states_count_and_do_not_grow_without_bounds() {
        let queue = ClientQueue::default();
        queue.subscribe(1, 10);
        queue.queue_current_state(&[1].into(), &[]);
        queue.hear_of_playback();
        queue.tell_state(vec![1; 100]);
        let half = WAITING_BYTES / 2 / ENTRY_BYTES;
        // Of 16 MB, with a time between any two messages, half are messages.
        for time in 0..2 * half as u64 {
            queue.push(waiting(1, time, 0));
            queue.tell_time(time);
            assert!(queue.pending_bytes() <= WAITING_BYTES);
        }
        let left = drained(&queue);
        assert_eq!((left[0], left.len()), ((0, 0), 1 + 2 * half - 3), "the answer stays, the oldest others are gone");
        assert_eq!(left.last(), Some(&(0, 2 * half as u64 - 1)));
        assert_eq!(queue.pending_bytes(), 0);
        for _ in 0..100 {
            queue.tell_state(vec![1; WAITING_BYTES / 10]);
            assert!(queue.pending_bytes() <= WAITING_BYTES);
        }
        assert_eq!(drained(&queue).len(), 9);
        queue.tell_state(vec![1; 100]);
        queue.forget_pending();
        assert_eq!(queue.pending_bytes(), ENTRY_BYTES + 100);
        assert_eq!((drained(&queue).len(), queue.pending_bytes()), (1, 0));
    }
}
