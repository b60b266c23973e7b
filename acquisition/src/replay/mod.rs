//! Recordings shown again: a WebSocket server that Foxglove controls (play, pause, speed, seek) and Lichtblick looks at.
//!
//! Several recordings are shown one after the other; what lies between them is left out, and where one begins before the
//! other ends, time goes back. Only chunks with topics that somebody wants are read, one after the other. Playback stands
//! while nobody looks on, and waits while all viewers have enough to read; where one is slower than another, it loses its
//! oldest messages.

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

use crate::viewer::{Playback, Server, ViewerAccess};
pub use clock::SPEEDS;
pub use error::Error;
use player::Player;
pub use recording::Recording;

/// Commands that wait for the player; clients with more wait, too.
const COMMANDS: usize = 256;

/// How a replay begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplayOptions {
    /// As a factor of real time; a client may change it.
    pub speed: f32,
    /// Whether it waits for a client's command to play, instead of for its first subscription.
    pub paused: bool,
}

/// How a replay stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// The recording that is shown.
    pub recording: PathBuf,
    /// Time of what is shown since the first recording began, without what lies between them, s.
    pub shown_secs: f64,
    /// Whether it goes on.
    pub is_playing: bool,
    /// As a factor of real time.
    pub speed: f32,
    /// Clients that look on.
    pub viewers: usize,
    /// Messages that some client lost because it did not keep up.
    pub lost: u64,
    /// What was found damaged, in words that name file and place.
    pub damages: Vec<String>,
}

/// A server that replays recordings. Dropped, it lets its clients go.
pub struct ReplayServer {
    // Dropped before the thread is waited for, because the server's end is the player's.
    server: Server,
    _thread: PlayerThread,
    standing: Arc<Mutex<Standing>>,
    length_secs: f64,
    range: (u64, u64),
}

impl ReplayServer {
    /// Listens; port 0 takes a free one. Recordings are shown in the order of their times.
    ///
    /// # Errors
    /// [`Error::Listen`], or [`Error::Nothing`] where there is no recording, or where there are more
    /// topics than channels.
    pub fn start(
        address: SocketAddr,
        access: ViewerAccess,
        mut recordings: Vec<Recording>,
        options: ReplayOptions,
    ) -> Result<Self, Error> {
        recordings.sort_by_key(|r| r.range().0);
        let (commands, obeyed) = mpsc::sync_channel(COMMANDS);
        let nothing = |reason| Error::Nothing { reason };
        let first = recordings.first().ok_or_else(|| nothing("there is no recording"))?;
        let range = recordings.iter().fold(first.range(), |all, r| (all.0, all.1.max(r.range().1)));
        let playback = Playback { range, commands };
        let length_secs = recordings.iter().map(player::secs).sum();
        let topics = player::Topics::of(&recordings).ok_or_else(|| nothing("there are more topics than channels"))?;
        let server = Server::start(address, access, topics.all.clone(), Some(playback))
            .map_err(|source| Error::Listen { address, source })?;
        let standing = Arc::new(Mutex::new(Standing {
            recording: first.path().to_owned(),
            shown_secs: 0.0,
            is_playing: false,
            speed: options.speed,
            viewers: 0,
            lost: 0,
            damages: Vec::new(),
        }));
        let player = Player::new(recordings, topics, options, server.shared().clone(), standing.clone());
        let thread = PlayerThread(Some(std::thread::spawn(move || player.run(&obeyed))));
        Ok(Self { server, _thread: thread, standing, length_secs, range })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// What viewers open: the address, with the token if they need one.
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

    /// How it stands.
    pub fn standing(&self) -> Standing {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The player's thread; dropped, it is waited for.
struct PlayerThread(Option<JoinHandle<()>>);

impl Drop for PlayerThread {
    fn drop(&mut self) {
        if let Some(thread) = self.0.take() {
            // One that panicked has told why.
            let _ = thread.join();
        }
    }
}
