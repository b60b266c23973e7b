//! The player of recordings: sends each message when it is due, and obeys clients' commands.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use echolake_schema::Timestamp;

use super::clock::ReplayClock;
use super::cursor::{ChunkDamage, MessageCursor, latest_messages};
use super::recording::{Key, Recording};
use super::{ReplayOptions, ReplayState};
use crate::run::recorder::Topic;
use crate::viewer::{
    ClientQueue, PendingMessage, PlaybackRequest, PlaybackState, PlaybackStatus, PlayerCommand, ViewerState,
};

/// Interval at which clients get the time.
const TICK: Duration = Duration::from_millis(33);
/// Wait for clients that have enough to read.
const BREATH: Duration = Duration::from_millis(3);
/// Messages between two checks for commands.
const STRIDE: usize = 256;
/// Longest time without any message that is waited for, ns: 10 minutes.
const LONGEST_GAP: u64 = 600_000_000_000;
/// Most gaps that are named.
const MOST_NOTES: usize = 100;

/// Length of a recording, s.
pub(super) fn recording_secs(recording: &Recording) -> f64 {
    (recording.time_range().1 - recording.time_range().0) as f64 / 1e9
}

/// The topics of all recordings, each once.
pub(super) struct ReplayTopics {
    /// With the channels that clients know.
    pub all: Vec<Topic>,
    /// Of each recording: the clients' channel by the file's.
    of: Vec<BTreeMap<u16, u16>>,
}

impl ReplayTopics {
    /// None if there are more topics than channels.
    pub fn from_recordings(recordings: &[Recording]) -> Option<Self> {
        let mut all = Vec::<Topic>::new();
        let mut of = Vec::new();
        for recording in recordings {
            let mut channels = BTreeMap::new();
            for (id, topic) in &recording.topics {
                let same = |known: &Topic| Topic { channel: known.channel, ..topic.clone() } == *known;
                let channel = match all.iter().find(|known| known.topic == topic.topic && same(known)) {
                    Some(known) => known.channel,
                    None => {
                        let channel = u16::try_from(all.len() + 1).ok()?;
                        all.push(Topic { channel, ..topic.clone() });
                        channel
                    }
                };
                channels.insert(*id, channel);
            }
            of.push(channels);
        }
        Some(Self { all, of })
    }
}

/// The player of a replay: its recordings, its clock and its place in them.
pub(super) struct ReplayPlayer {
    recordings: Vec<Recording>,
    topics: ReplayTopics,
    shared: Arc<ViewerState>,
    told: Arc<Mutex<ReplayState>>,
    clock: ReplayClock,
    status: PlaybackStatus,
    /// The recording that is played.
    number: usize,
    cursor: MessageCursor,
    /// Counter of subscription changes when the cursor was made.
    wishes: u64,
    /// Damage that was reported already.
    damaged: BTreeSet<(usize, u64)>,
    /// Time before which no gap is searched for again: a search reads a chunk.
    next_search: u64,
}

impl ReplayPlayer {
    pub fn new(
        recordings: Vec<Recording>,
        topics: ReplayTopics,
        options: ReplayOptions,
        shared: Arc<ViewerState>,
        told: Arc<Mutex<ReplayState>>,
    ) -> Self {
        let start = recordings.first().map_or(0, |r| r.time_range().0);
        let status = if options.paused { PlaybackStatus::Paused } else { PlaybackStatus::Playing };
        Self {
            recordings,
            topics,
            shared,
            told,
            clock: ReplayClock::new(start, options.speed),
            status,
            number: 0,
            cursor: MessageCursor::starting_behind(at_all_of(start), BTreeSet::new()),
            wishes: 0,
            damaged: BTreeSet::new(),
            next_search: 0,
        }
    }

    /// Plays until the server has ended.
    pub fn run_player(mut self, commands: &Receiver<PlayerCommand>) {
        while !self.shared.has_ended() {
            let wait = self.play_step();
            self.tell_interface();
            match commands.recv_timeout(wait) {
                Ok(first) => self.obey_commands([first].into_iter().chain(commands.try_iter()).collect()),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    // Sends the messages that are due; returns the wait until the next one.
    fn play_step(&mut self) -> Duration {
        self.keep_to_wishes();
        let is_watched = !self.shared.wanted_channels().is_empty();
        self.clock.set_running(self.status == PlaybackStatus::Playing && is_watched);
        if self.status != PlaybackStatus::Playing || !is_watched {
            return TICK;
        }
        for _ in 0..STRIDE {
            let Some(next) = self.peek_time() else { return self.end_recording() };
            if next > self.clock.now() {
                return self.wait_for(next);
            }
            if self.shared.all_are_busy() {
                // A late message stays late; clients are not flooded to catch up.
                self.clock.set_time(next);
                return BREATH;
            }
            if let Some(message) = self.cursor.pop_message()
                && let Some(channel) = self.topics.of[self.number].get(&message.channel)
            {
                self.shared.send_message(*channel, message.key.0, &message.data, false);
            }
        }
        self.tell_time();
        Duration::ZERO
    }

    fn peek_time(&mut self) -> Option<u64> {
        let mut damages = Vec::new();
        let next = self.cursor.peek_time(&self.recordings[self.number], &mut damages);
        self.note_damages(damages);
        next
    }

    // On to the next recording, or to the end; what is wanted of this one is over before it is.
    fn end_recording(&mut self) -> Duration {
        let end = self.recordings[self.number].time_range().1;
        if self.clock.now() < end {
            return self.wait_for(end);
        }
        if self.number + 1 < self.recordings.len() {
            self.number += 1;
            let start = self.recordings[self.number].time_range().0;
            self.move_to_time(start);
            self.tell_state(true, String::new());
            self.show_to(&self.shared.clients());
        } else {
            self.clock.set_time(end);
            self.clock.set_running(false);
            self.status = PlaybackStatus::Ended;
            self.tell_state(false, String::new());
        }
        BREATH
    }

    // Nothing is due before a time.
    fn wait_for(&mut self, next: u64) -> Duration {
        if let Some(end) = self.find_gap_end(next) {
            return self.pass_gap(end);
        }
        // New subscribers get the state at the current time.
        let now = self.clock.now().min(next.saturating_sub(1));
        self.cursor.skip_to(at_all_of(now));
        self.tell_time();
        self.clock.time_until(next).min(TICK)
    }

    // The end of a gap at the current time, if there is one. Clients may have subscribed to some topics alone, and a
    // gap is one of all topics.
    fn find_gap_end(&mut self, next: u64) -> Option<u64> {
        let now = self.clock.now();
        if next.saturating_sub(now) <= LONGEST_GAP || now < self.next_search {
            return None;
        }
        let recording = &self.recordings[self.number];
        let mut all = MessageCursor::starting_behind(at_all_of(now), recording.topics.keys().copied().collect());
        let mut damages = Vec::new();
        let end = all.peek_time(recording, &mut damages).map_or(next, |time| time.min(next));
        self.note_damages(damages);
        self.next_search = now.saturating_add(LONGEST_GAP / 2);
        (end.saturating_sub(now) > LONGEST_GAP).then_some(end)
    }

    fn pass_gap(&mut self, end: u64) -> Duration {
        let start = self.current_time();
        let path = self.recordings[self.number].path().display().to_string();
        let time = |nanos: u64| Timestamp(i64::try_from(nanos).unwrap_or(i64::MAX));
        let secs = end.saturating_sub(start) / 1_000_000_000;
        let line = format!("`{path}` has no message for {secs} s, from {} to {}: passed over", time(start), time(end));
        {
            let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
            if told.notes.len() < MOST_NOTES {
                told.notes.push(line);
            }
        }
        self.move_to_time(end.saturating_sub(1));
        self.tell_state(true, String::new());
        self.show_to(&self.shared.clients());
        Duration::ZERO
    }

    fn move_to_time(&mut self, time: u64) {
        self.next_search = 0;
        self.clock.set_time(time);
        self.wishes = self.shared.wish_counter();
        self.cursor = MessageCursor::starting_behind(at_all_of(time), self.wanted_channels());
    }

    // Channels of the file with a subscription.
    fn wanted_channels(&self) -> BTreeSet<u16> {
        let wanted = self.shared.wanted_channels();
        self.topics.of[self.number].iter().filter(|(_, to)| wanted.contains(to)).map(|(from, _)| *from).collect()
    }

    fn keep_to_wishes(&mut self) {
        let wishes = self.shared.wish_counter();
        if wishes != self.wishes {
            self.wishes = wishes;
            self.cursor = MessageCursor::starting_behind(self.cursor.last_passed(), self.wanted_channels());
        }
    }

    fn obey_commands(&mut self, commands: Vec<PlayerCommand>) {
        let mut new: Vec<(Arc<ClientQueue>, BTreeSet<u16>)> = Vec::new();
        let seeks = |c: &PlayerCommand| matches!(c, PlayerCommand::Playback(request) if request.seek.is_some());
        // Who drags a slider seeks faster than anything can be shown.
        let mut seeks_left = commands.iter().filter(|c| seeks(c)).count();
        for command in commands {
            seeks_left -= usize::from(seeks(&command));
            match command {
                PlayerCommand::Subscribed(queue, wanted) => {
                    match new.iter_mut().find(|(q, _)| Arc::ptr_eq(q, &queue)) {
                        Some((_, channels)) => channels.extend(wanted),
                        None => new.push((queue, wanted)),
                    }
                }
                PlayerCommand::Playback(request) => self.control_playback(request, seeks_left == 0),
            }
        }
        for (queue, mut channels) in new {
            channels.retain(|channel| !queue.receives_channel(*channel));
            self.show_state(&[(queue, channels)]);
        }
    }

    fn control_playback(&mut self, request: PlaybackRequest, is_shown: bool) {
        // The next step lets it go again; the answer is of now.
        self.clock.set_running(false);
        if let Some(time) = request.seek {
            self.seek_to(time);
        }
        self.clock.set_speed(request.speed);
        // Behind the end there is only seeking.
        if self.status != PlaybackStatus::Ended {
            self.status = if request.plays { PlaybackStatus::Playing } else { PlaybackStatus::Paused };
        }
        let did_seek = request.seek.is_some();
        let clients = self.shared.clients();
        if did_seek {
            clients.iter().for_each(|client| client.forget_pending());
        }
        self.tell_state(did_seek, request.id);
        if did_seek && is_shown {
            self.show_to(&clients);
            self.tell_time();
        }
    }

    // To a time in this recording, or in the first that ends behind it; if none has that time, to its beginning.
    fn seek_to(&mut self, time: u64) {
        let here = self.recordings[self.number].time_range();
        if !(here.0..=here.1).contains(&time) {
            let found = self.recordings.iter().position(|r| time <= r.time_range().1);
            self.number = found.unwrap_or(self.recordings.len() - 1);
        }
        let (start, end) = self.recordings[self.number].time_range();
        self.move_to_time(time.clamp(start, end));
        if self.status == PlaybackStatus::Ended {
            self.status = PlaybackStatus::Paused;
        }
    }

    // Sends clients the current state of their channels.
    fn show_to(&mut self, clients: &[Arc<ClientQueue>]) {
        let all: Vec<_> = clients.iter().map(|c| (c.clone(), c.wanted_channels().into_iter().collect())).collect();
        self.show_state(&all);
    }

    fn show_state(&mut self, to: &[(Arc<ClientQueue>, BTreeSet<u16>)]) {
        let channels = &self.topics.of[self.number];
        let asked = |to_channel: &u16| to.iter().any(|(_, wanted)| wanted.contains(to_channel));
        let of_file = channels.iter().filter(|(_, to)| asked(to)).map(|(from, _)| *from).collect();
        let mut damages = Vec::new();
        let messages =
            latest_messages(&self.recordings[self.number], self.cursor.last_passed(), &of_file, &mut damages);
        let known: Vec<PendingMessage> = messages
            .into_iter()
            .filter_map(|m| {
                let channel = *channels.get(&m.channel)?;
                Some(PendingMessage { channel, log_time_nanos: m.key.0, data: m.data.into() })
            })
            .collect();
        for (queue, wanted) in to {
            self.shared.prime_client(queue, wanted, &known);
        }
        self.note_damages(damages);
    }

    fn current_time(&self) -> u64 {
        let (start, end) = self.recordings[self.number].time_range();
        self.clock.now().clamp(start, end)
    }

    fn tell_time(&self) {
        let time = self.current_time();
        self.shared.clients().iter().for_each(|client| client.tell_time(time));
    }

    fn tell_state(&self, did_seek: bool, request_id: String) {
        let state = PlaybackState {
            status: self.status,
            current_time: self.current_time(),
            speed: self.clock.speed(),
            did_seek,
            request_id,
        };
        self.shared.clients().iter().for_each(|client| client.tell_state(state.encode()));
    }

    // What is behind the replay's own interface.
    fn tell_interface(&self) {
        let recording = &self.recordings[self.number];
        let before: f64 = self.recordings[..self.number].iter().map(recording_secs).sum();
        let within = (self.current_time() - recording.time_range().0) as f64 / 1e9;
        let viewers = self.shared.clients().len();
        let lost = self.shared.lost_messages();
        let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        if told.recording != recording.path() {
            told.recording = recording.path().to_owned();
        }
        told.shown_secs = before + within;
        told.is_playing = self.status == PlaybackStatus::Playing;
        told.speed = self.clock.speed();
        (told.viewers, told.lost) = (viewers, lost);
    }

    fn note_damages(&mut self, damages: Vec<ChunkDamage>) {
        for (offset, what) in damages {
            if self.damaged.insert((self.number, offset)) {
                let path = self.recordings[self.number].path().display();
                let line = format!("`{path}` is damaged at byte {offset}: {what}; what stands there is left out");
                self.told.lock().unwrap_or_else(PoisonError::into_inner).damages.push(line);
            }
        }
    }
}

// Behind all messages of a time.
fn at_all_of(time: u64) -> Key {
    (time, u64::MAX, u32::MAX)
}
