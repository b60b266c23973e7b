//! A Foxglove WebSocket server on plain threads, shared by live views and replays.
//!
//! It never waits for a client. A client's queue is bounded; a client that does not keep up loses its oldest messages,
//! but never their order, and no message that tells it the current state.

mod access;
mod client;
mod handshakes;
mod protocol;
mod queue;

use std::collections::{BTreeMap, BTreeSet};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use crate::run::recorder::Topic;
use access::AccessCheck;
pub use access::ViewerAccess;
use handshakes::PendingHandshakes;
pub(crate) use protocol::{PlaybackRequest, PlaybackState, PlaybackStatus};
pub(crate) use queue::{ClientQueue, PendingMessage};

/// Limit of connected clients.
const CLIENTS: usize = 16;

/// A server. Dropped, it disconnects its clients.
pub(crate) struct ViewerServer {
    address: SocketAddr,
    shared: Arc<ViewerState>,
    thread: Option<JoinHandle<()>>,
}

/// The clock that clients show messages by.
pub(crate) enum ViewerClock {
    /// Their own.
    Wall,
    /// The latest message's time, which the server announces: messages are not of the time at which they are sent.
    Messages,
    /// A player's, which clients may control.
    Playback(PlaybackControl),
}

/// Playback that clients may control.
pub(crate) struct PlaybackControl {
    /// First and last time of the data, ns since 1970.
    pub range: (u64, u64),
    /// Queue of the player's commands.
    pub commands: SyncSender<PlayerCommand>,
}

/// Requests of clients to a player.
pub(crate) enum PlayerCommand {
    /// A client subscribed to channels, and first needs their current state.
    Subscribed(Arc<ClientQueue>, BTreeSet<u16>),
    /// Play, pause, seek.
    Playback(PlaybackRequest),
}

/// State that the server's threads share.
pub(crate) struct ViewerState {
    state: Mutex<State>,
    clock: ViewerClock,
    access: AccessCheck,
    handshakes: PendingHandshakes,
    ended: AtomicBool,
    /// Counts changes of the wanted channels.
    wishes: AtomicU64,
    /// Messages that clients lost.
    lost: AtomicU64,
}

#[derive(Default)]
struct State {
    topics: Vec<Topic>,
    /// The last message of each retained channel: new clients get it.
    last: BTreeMap<u16, PendingMessage>,
    clients: Vec<Arc<ClientQueue>>,
    /// The time that was announced last, ns since 1970.
    announced_nanos: Option<u64>,
}

impl ViewerServer {
    /// Listens; port 0 takes a free one.
    pub fn start(
        address: SocketAddr,
        access: ViewerAccess,
        topics: Vec<Topic>,
        clock: ViewerClock,
    ) -> Result<Self, std::io::Error> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let shared = Arc::new(ViewerState {
            state: Mutex::new(State { topics, ..State::default() }),
            clock,
            access: AccessCheck::new(access, address),
            handshakes: PendingHandshakes::default(),
            ended: AtomicBool::new(false),
            wishes: AtomicU64::new(0),
            lost: AtomicU64::new(0),
        });
        let thread = std::thread::spawn({
            let shared = shared.clone();
            move || accept_clients(&listener, &shared)
        });
        Ok(Self { address, shared, thread: Some(thread) })
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }

    pub fn url(&self) -> String {
        self.shared.access.viewer_url(self.address)
    }

    pub fn shared_state(&self) -> &Arc<ViewerState> {
        &self.shared
    }
}

impl Drop for ViewerServer {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        // Its accept waits for a connection.
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl ViewerState {
    fn lock_state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }

    pub fn topics(&self) -> Vec<Topic> {
        self.lock_state().topics.clone()
    }

    pub fn set_topics(&self, topics: Vec<Topic>) {
        self.lock_state().topics = topics;
    }

    /// Returns the connected clients.
    pub fn clients(&self) -> Vec<Arc<ClientQueue>> {
        self.lock_state().clients.clone()
    }

    /// Messages that clients lost because they did not keep up.
    pub fn lost_messages(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Returns a counter that changes whenever the wanted channels may have.
    pub fn wish_counter(&self) -> u64 {
        self.wishes.load(Ordering::Acquire)
    }

    /// Returns the channels whose messages go to any client now.
    pub fn wanted_channels(&self) -> BTreeSet<u16> {
        self.lock_state().clients.iter().flat_map(|client| client.receiving_channels()).collect()
    }

    /// Sends a client the current state of channels; new messages follow from here on.
    pub fn prime_client(&self, queue: &ClientQueue, channels: &BTreeSet<u16>, known: &[PendingMessage]) {
        queue.queue_current_state(channels, known);
        self.wishes.fetch_add(1, Ordering::Release);
    }

    /// Returns whether all subscribed clients have enough to read: then more messages help none of them.
    pub fn all_are_busy(&self) -> bool {
        let state = self.lock_state();
        let mut watching = state.clients.iter().filter(|client| client.is_receiving()).peekable();
        watching.peek().is_some() && watching.all(|client| client.is_busy())
    }

    /// Sends a message to all its subscribers; retains it for new clients, if `is_kept`.
    pub fn send_message(&self, channel: u16, log_time_nanos: u64, data: &[u8], is_kept: bool) {
        let mut state = self.lock_state();
        if matches!(self.clock, ViewerClock::Messages) {
            state.announce_time(log_time_nanos);
        }
        let wanted: Vec<_> = state.clients.iter().filter(|c| c.receives_channel(channel)).cloned().collect();
        // Without a receiver nothing is copied.
        if wanted.is_empty() && !is_kept {
            return;
        }
        let waiting = PendingMessage { channel, log_time_nanos, data: data.into() };
        let lost: u64 = wanted.iter().map(|client| client.push(waiting.clone())).sum();
        self.lost.fetch_add(lost, Ordering::Relaxed);
        if is_kept {
            state.last.insert(channel, waiting);
        }
    }

    /// Subscribes a client to channels; it first gets their current state.
    fn subscribe_client(&self, queue: &Arc<ClientQueue>, wishes: &[(u32, u16)]) {
        let channels: BTreeSet<u16> = wishes.iter().map(|(_, channel)| *channel).collect();
        // No new message comes between the current state and those that follow.
        let state = self.lock_state();
        wishes.iter().for_each(|(subscription, channel)| queue.subscribe(*channel, *subscription));
        match &self.clock {
            ViewerClock::Playback(playback) => {
                drop(state);
                // A player that is gone has no use for it.
                let _ = playback.commands.send(PlayerCommand::Subscribed(queue.clone(), channels));
            }
            ViewerClock::Wall | ViewerClock::Messages => {
                let known: Vec<_> = channels.iter().filter_map(|channel| state.last.get(channel)).cloned().collect();
                self.prime_client(queue, &channels, &known);
            }
        }
    }

    fn unsubscribe_client(&self, queue: &ClientQueue, subscriptions: &[u32]) {
        queue.unsubscribe(subscriptions);
        self.wishes.fetch_add(1, Ordering::Release);
    }

    fn control_playback(&self, queue: &ClientQueue, request: PlaybackRequest) {
        if let ViewerClock::Playback(playback) = &self.clock {
            queue.hear_of_playback();
            let _ = playback.commands.send(PlayerCommand::Playback(request));
        }
    }

    fn add_client(&self) -> Option<Arc<ClientQueue>> {
        let mut state = self.lock_state();
        (state.clients.len() < CLIENTS).then(|| {
            let queue = Arc::new(ClientQueue::default());
            if let Some(nanos) = state.announced_nanos {
                queue.tell_time(nanos);
            }
            state.clients.push(queue.clone());
            queue
        })
    }

    fn remove_client(&self, queue: &Arc<ClientQueue>) {
        self.lock_state().clients.retain(|client| !Arc::ptr_eq(client, queue));
        self.wishes.fetch_add(1, Ordering::Release);
    }
}

impl State {
    // Announces the time of a message; time that goes back would be a seek.
    fn announce_time(&mut self, nanos: u64) {
        if self.announced_nanos.is_none_or(|announced| announced < nanos) {
            self.announced_nanos = Some(nanos);
            self.clients.iter().for_each(|client| client.tell_time(nanos));
        }
    }
}

fn accept_clients(listener: &TcpListener, shared: &Arc<ViewerState>) {
    let mut threads: Vec<JoinHandle<()>> = Vec::new();
    for stream in listener.incoming() {
        if shared.has_ended() {
            break;
        }
        threads.retain(|thread| !thread.is_finished());
        let Ok(stream) = stream.map(Arc::new) else { continue };
        // Here and not on the client's thread: threads start in any order, and the oldest client is the first to go.
        if shared.handshakes.add(&stream).is_err() {
            continue;
        }
        let shared = shared.clone();
        threads.push(std::thread::spawn(move || client::serve_client(stream, &shared)));
    }
    for thread in threads {
        // A panic in a client's thread does not end the run.
        let _ = thread.join();
    }
}
