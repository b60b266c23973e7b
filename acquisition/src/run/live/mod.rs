//! A live view of a run: a WebSocket server that Foxglove and Lichtblick open, with every topic as it is recorded.
//!
//! Messages are sent before they are on the disk. A client that does not keep up loses its oldest messages; the run
//! never waits for it. The simulated rig's clock is not the wall clock, so viewers are told its time.

#[cfg(test)]
mod tests;

use std::net::SocketAddr;
use std::sync::Arc;

use echolake_schema::topics;

use crate::run::recorder::{Tap, Topic};
use crate::viewer::{ViewerAccess, ViewerClock, ViewerServer, ViewerState};

/// An error that prevents the live view.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The address cannot be listened on.
    #[error("cannot show the run live at {address}; hint: is the port taken?")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
}

/// The clock of a run that is shown live.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LiveClock {
    /// The wall clock.
    Wall,
    /// The simulated rig's, which runs ahead of the wall clock or behind it.
    Simulated,
}

/// A server that shows one run. Dropped, it disconnects its clients.
pub struct LiveServer(ViewerServer);

impl LiveServer {
    /// Listens; port 0 takes a free one.
    ///
    /// # Errors
    /// [`Error::Listen`].
    pub fn start(address: SocketAddr, access: ViewerAccess, clock: LiveClock) -> Result<Self, Error> {
        let clock = match clock {
            LiveClock::Wall => ViewerClock::Wall,
            LiveClock::Simulated => ViewerClock::Messages,
        };
        ViewerServer::start(address, access, Vec::new(), clock)
            .map(Self)
            .map_err(|source| Error::Listen { address, source })
    }

    /// Returns the address of its listener.
    pub fn address(&self) -> SocketAddr {
        self.0.address()
    }

    /// Returns the URL for viewers: the address, with the token if they need one.
    pub fn url(&self) -> String {
        self.0.url()
    }

    /// Returns the number of connected clients.
    pub fn clients(&self) -> usize {
        self.0.shared_state().clients().len()
    }

    /// Returns the tap through which a recorder sends its messages.
    pub fn tap(&self) -> Box<dyn Tap> {
        Box::new(LiveTap { shared: self.0.shared_state().clone(), light: Vec::new() })
    }
}

struct LiveTap {
    shared: Arc<ViewerState>,
    /// Channels whose last message is sent to new clients.
    light: Vec<u16>,
}

impl Tap for LiveTap {
    fn topics(&mut self, topics: Vec<Topic>) {
        self.light = topics.iter().filter(|t| is_light(&t.topic)).map(|t| t.channel).collect();
        self.shared.set_topics(topics);
    }

    fn message(&mut self, channel: u16, log_time_nanos: u64, data: &[u8]) {
        self.shared.send_message(channel, log_time_nanos, data, self.light.contains(&channel));
    }
}

fn is_light(topic: &str) -> bool {
    !matches!(topic, topics::SWEEP | topics::SWEEP_REPEAT | topics::SWEEP_AUDIO)
}
