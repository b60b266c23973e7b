//! Replay of recordings: a WebSocket server that Foxglove controls (play, pause, speed, seek) and Lichtblick shows.
//!
//! Several recordings are shown one after the other; the time between them is left out, and so are gaps within one of
//! more than 10 minutes without a message. If a recording begins before the other ends, time goes back. Only chunks
//! with subscribed topics are read, one after the other. Playback stops while there is no viewer, and waits while all
//! viewers have enough to read; if one is slower than another, it loses its oldest messages.

mod clock;
mod cursor;
mod error;
mod player;
mod recording;
#[cfg(test)]
mod tests;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::mpsc;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use crate::viewer::{PlaybackControl, ViewerAccess, ViewerClock, ViewerServer};
pub use clock::SPEEDS;
pub use error::Error;
use player::ReplayPlayer;
pub use recording::Recording;

/// Limit of pending commands for the player; clients with more wait.
const COMMANDS: usize = 256;

/// Settings of a replay's begin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplayOptions {
    /// As a factor of real time; a client may change it.
    pub speed: f32,
    /// True to wait for a client's command to play, instead of for its first subscription.
    pub paused: bool,
}

/// State of a replay.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayState {
    /// The recording that is shown.
    pub recording: PathBuf,
    /// Played time since the begin of the first recording, without the gaps between recordings, s.
    pub shown_secs: f64,
    /// True while it plays.
    pub is_playing: bool,
    /// As a factor of real time.
    pub speed: f32,
    /// Connected clients.
    pub viewers: usize,
    /// Messages that clients lost because they did not keep up.
    pub lost: u64,
    /// Damage found so far, as texts that name file and place.
    pub damages: Vec<String>,
    /// Gaps that were passed over so far, as texts that name file and times.
    pub notes: Vec<String>,
}

/// A server that replays recordings. Dropped, it disconnects its clients.
pub struct ReplayServer {
    // Dropped before the thread is waited for, because the server's end is the player's.
    server: ViewerServer,
    _thread: PlayerThread,
    standing: Arc<Mutex<ReplayState>>,
    length_secs: f64,
    range: (u64, u64),
}

impl ReplayServer {
    /// Listens; port 0 takes a free one. Recordings are shown in the order of their times.
    ///
    /// # Errors
    /// [`Error::Listen`], or [`Error::Nothing`] if there is no recording, or if there are more topics than channels.
    pub fn start(
        address: SocketAddr,
        access: ViewerAccess,
        mut recordings: Vec<Recording>,
        options: ReplayOptions,
    ) -> Result<Self, Error> {
        recordings.sort_by_key(|r| r.time_range().0);
        let (commands, obeyed) = mpsc::sync_channel(COMMANDS);
        let nothing = |reason| Error::Nothing { reason };
        let first = recordings.first().ok_or_else(|| nothing("there is no recording"))?;
        let range = recordings.iter().fold(first.time_range(), |all, r| (all.0, all.1.max(r.time_range().1)));
        let playback = PlaybackControl { range, commands };
        let length_secs = recordings.iter().map(player::recording_secs).sum();
        let topics = player::ReplayTopics::from_recordings(&recordings)
            .ok_or_else(|| nothing("there are more topics than channels"))?;
        let server = ViewerServer::start(address, access, topics.all.clone(), ViewerClock::Playback(playback))
            .map_err(|source| Error::Listen { address, source })?;
        let standing = Arc::new(Mutex::new(ReplayState {
            recording: first.path().to_owned(),
            shown_secs: 0.0,
            is_playing: false,
            speed: options.speed,
            viewers: 0,
            lost: 0,
            damages: Vec::new(),
            notes: Vec::new(),
        }));
        let player = ReplayPlayer::new(recordings, topics, options, server.shared_state().clone(), standing.clone());
        let thread = PlayerThread(Some(std::thread::spawn(move || player.run_player(&obeyed))));
        Ok(Self { server, _thread: thread, standing, length_secs, range })
    }

    /// Returns the address of its listener.
    pub fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// Returns the URL for viewers: the address, with the token if they need one.
    pub fn url(&self) -> String {
        self.server.url()
    }

    /// First and last time, ns since 1970.
    pub fn range(&self) -> (u64, u64) {
        self.range
    }

    /// Length of all recordings together, s.
    pub fn length_secs(&self) -> f64 {
        self.length_secs
    }

    /// Returns its current state.
    pub fn standing(&self) -> ReplayState {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The player's thread; dropping it joins the thread.
struct PlayerThread(Option<JoinHandle<()>>);

impl Drop for PlayerThread {
    fn drop(&mut self) {
        if let Some(thread) = self.0.take() {
            // A thread that panicked has printed the reason.
            let _ = thread.join();
        }
    }
}
