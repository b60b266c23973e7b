//! A Foxglove WebSocket server on plain threads: what live views and replays have in common.
//!
//! It never waits for a client. What waits for one is bounded; one that does not keep up loses its oldest messages, but
//! never their order, and nothing that tells it where things stand.

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

use crate::recorder::Topic;
use access::AccessCheck;
pub use access::ViewerAccess;
use handshakes::PendingHandshakes;
pub(crate) use protocol::{PlaybackRequest, PlaybackState, PlaybackStatus};
pub(crate) use queue::{Queue, Waiting};

/// Clients at a time.
const CLIENTS: usize = 16;

/// A server. Dropped, it lets its clients go.
pub(crate) struct Server {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// What may be controlled, where something may.
pub(crate) struct Playback {
    /// First and last time of the data, ns since 1970.
    pub(crate) range: (u64, u64),
    /// Who obeys.
    pub(crate) commands: SyncSender<Command>,
}

/// What clients want of a player.
pub(crate) enum Command {
    /// A client wants channels, and first what is known of them.
    Subscribed(Arc<Queue>, BTreeSet<u16>),
    /// Play, pause, seek.
    Playback(PlaybackRequest),
}

/// What the server's threads share.
pub(crate) struct Shared {
    state: Mutex<State>,
    playback: Option<Playback>,
    access: AccessCheck,
    handshakes: PendingHandshakes,
    ended: AtomicBool,
    /// Counts what changes the channels that are wanted.
    wishes: AtomicU64,
    /// Messages that clients lost.
    lost: AtomicU64,
}

#[derive(Default)]
struct State {
    topics: Vec<Topic>,
    /// The last message of each channel that is kept: who comes late sees where things stand.
    last: BTreeMap<u16, Waiting>,
    clients: Vec<Arc<Queue>>,
}

impl Server {
    /// Listens; port 0 takes a free one.
    pub(crate) fn start(
        address: SocketAddr,
        access: ViewerAccess,
        topics: Vec<Topic>,
        playback: Option<Playback>,
    ) -> Result<Self, std::io::Error> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let shared = Arc::new(Shared {
            state: Mutex::new(State { topics, ..State::default() }),
            playback,
            access: AccessCheck::new(access, address),
            handshakes: PendingHandshakes::default(),
            ended: AtomicBool::new(false),
            wishes: AtomicU64::new(0),
            lost: AtomicU64::new(0),
        });
        let thread = std::thread::spawn({
            let shared = shared.clone();
            move || accept(&listener, &shared)
        });
        Ok(Self { address, shared, thread: Some(thread) })
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    pub(crate) fn url(&self) -> String {
        self.shared.access.url(self.address)
    }

    pub(crate) fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        // Its accept waits for somebody to come.
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }

    pub(crate) fn topics(&self) -> Vec<Topic> {
        self.state().topics.clone()
    }

    pub(crate) fn set_topics(&self, topics: Vec<Topic>) {
        self.state().topics = topics;
    }

    /// Those who look on.
    pub(crate) fn clients(&self) -> Vec<Arc<Queue>> {
        self.state().clients.clone()
    }

    /// Messages that clients lost because they did not keep up.
    pub(crate) fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Changes whenever the wanted channels may have.
    pub(crate) fn wishes(&self) -> u64 {
        self.wishes.load(Ordering::Acquire)
    }

    /// The channels whose messages go to somebody now.
    pub(crate) fn wanted(&self) -> BTreeSet<u16> {
        self.state().clients.iter().flat_map(|client| client.receiving()).collect()
    }

    /// Tells a client what is known of channels; what is new follows from here on.
    pub(crate) fn prime(&self, queue: &Queue, channels: &BTreeSet<u16>, known: &[Waiting]) {
        queue.prime(channels, known);
        self.wishes.fetch_add(1, Ordering::Release);
    }

    /// Whether all who want something have enough to read: then nobody is served by more.
    pub(crate) fn all_are_busy(&self) -> bool {
        let state = self.state();
        let mut watching = state.clients.iter().filter(|client| client.is_receiving()).peekable();
        watching.peek().is_some() && watching.all(|client| client.is_busy())
    }

    /// Sends a message to all who want it; keeps it for those who come late, where that is wished.
    pub(crate) fn send(&self, channel: u16, log_time_nanos: u64, data: &[u8], is_kept: bool) {
        let mut state = self.state();
        let wanted: Vec<_> = state.clients.iter().filter(|c| c.receives(channel)).cloned().collect();
        // Nothing is copied for nobody.
        if wanted.is_empty() && !is_kept {
            return;
        }
        let waiting = Waiting { channel, log_time_nanos, data: data.into() };
        let lost: u64 = wanted.iter().map(|client| client.push(waiting.clone())).sum();
        self.lost.fetch_add(lost, Ordering::Relaxed);
        if is_kept {
            state.last.insert(channel, waiting);
        }
    }

    /// A client wants channels from now on, and first what is known of them.
    fn subscribe(&self, queue: &Arc<Queue>, wishes: &[(u32, u16)]) {
        let channels: BTreeSet<u16> = wishes.iter().map(|(_, channel)| *channel).collect();
        // Nothing new comes between what is known and what follows.
        let state = self.state();
        wishes.iter().for_each(|(subscription, channel)| queue.subscribe(*channel, *subscription));
        match &self.playback {
            Some(playback) => {
                drop(state);
                // A player that is gone has nobody left to tell.
                let _ = playback.commands.send(Command::Subscribed(queue.clone(), channels));
            }
            None => {
                let known: Vec<_> = channels.iter().filter_map(|channel| state.last.get(channel)).cloned().collect();
                self.prime(queue, &channels, &known);
            }
        }
    }

    fn unsubscribe(&self, queue: &Queue, subscriptions: &[u32]) {
        queue.unsubscribe(subscriptions);
        self.wishes.fetch_add(1, Ordering::Release);
    }

    fn control(&self, queue: &Queue, request: PlaybackRequest) {
        if let Some(playback) = &self.playback {
            queue.hear_of_playback();
            let _ = playback.commands.send(Command::Playback(request));
        }
    }

    fn join(&self) -> Option<Arc<Queue>> {
        let mut state = self.state();
        (state.clients.len() < CLIENTS).then(|| {
            let queue = Arc::new(Queue::default());
            state.clients.push(queue.clone());
            queue
        })
    }

    fn leave(&self, queue: &Arc<Queue>) {
        self.state().clients.retain(|client| !Arc::ptr_eq(client, queue));
        self.wishes.fetch_add(1, Ordering::Release);
    }
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    let mut threads: Vec<JoinHandle<()>> = Vec::new();
    for stream in listener.incoming() {
        if shared.has_ended() {
            break;
        }
        threads.retain(|thread| !thread.is_finished());
        let Ok(stream) = stream else { continue };
        let shared = shared.clone();
        threads.push(std::thread::spawn(move || client::serve(stream, &shared)));
    }
    for thread in threads {
        // A client's thread that panicked is none of the run's business.
        let _ = thread.join();
    }
}
