//! A live view of a run: a WebSocket server that Foxglove and Lichtblick open, with every topic as it is recorded.
//!
//! What is sent is not yet on the disk. A client that does not keep up loses its oldest messages; the run never waits
//! for it.

mod client;
mod protocol;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use echolake_schema::topics;

use crate::recorder::{Tap, Topic};

/// Bytes that wait for one client at most: two minutes of a real rig's sweeps.
const WAITING_BYTES: usize = 16 << 20;
/// Clients at a time.
const CLIENTS: usize = 16;

/// Why there is no live view.
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

/// A server that shows one run. Dropped, it lets its clients go.
pub struct LiveServer {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// What the server's threads share.
#[derive(Default)]
pub(crate) struct Shared {
    state: Mutex<State>,
    ended: AtomicBool,
}

#[derive(Default)]
struct State {
    topics: Vec<Topic>,
    /// The last message of each light topic: who comes late sees where things stand.
    last: BTreeMap<u16, Waiting>,
    clients: Vec<Arc<Queue>>,
}

/// A message on its way.
#[derive(Clone)]
pub(crate) struct Waiting {
    pub(crate) channel: u16,
    pub(crate) log_time_nanos: u64,
    pub(crate) data: Arc<[u8]>,
}

/// What waits for one client.
#[derive(Default)]
pub(crate) struct Queue {
    inner: Mutex<Inner>,
}

#[derive(Default)]
struct Inner {
    messages: VecDeque<Waiting>,
    bytes: usize,
    wanted: BTreeMap<u16, u32>,
}

impl LiveServer {
    /// Listens; port 0 takes a free one.
    ///
    /// # Errors
    /// [`Error::Listen`].
    pub fn start(address: SocketAddr) -> Result<Self, Error> {
        let failed = |source| Error::Listen { address, source };
        let listener = TcpListener::bind(address).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let shared = Arc::new(Shared::default());
        let thread = std::thread::spawn({
            let shared = shared.clone();
            move || accept(&listener, &shared)
        });
        Ok(Self { address, shared, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// How many clients look on.
    pub fn clients(&self) -> usize {
        self.shared.state().clients.len()
    }

    /// What a recorder tells it through.
    pub fn tap(&self) -> Box<dyn Tap> {
        Box::new(LiveTap(self.shared.clone()))
    }
}

impl Drop for LiveServer {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        // Its accept waits for somebody to come.
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct LiveTap(Arc<Shared>);

impl Tap for LiveTap {
    fn topics(&mut self, topics: Vec<Topic>) {
        self.0.state().topics = topics;
    }

    fn message(&mut self, channel: u16, log_time_nanos: u64, data: &[u8]) {
        let mut state = self.0.state();
        let is_kept = state.topics.iter().any(|t| t.channel == channel && is_light(&t.topic));
        let wanted: Vec<_> = state.clients.iter().filter(|c| c.wants(channel)).cloned().collect();
        // Nothing is copied for nobody.
        if wanted.is_empty() && !is_kept {
            return;
        }
        let waiting = Waiting { channel, log_time_nanos, data: data.into() };
        wanted.iter().for_each(|client| client.push(waiting.clone()));
        if is_kept {
            state.last.insert(channel, waiting);
        }
    }
}

fn is_light(topic: &str) -> bool {
    !matches!(topic, topics::SWEEP | topics::SWEEP_AUDIO)
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

    /// A client wants a topic from now on, and first what is known of it.
    pub(crate) fn subscribe(&self, queue: &Queue, channel: u16, subscription: u32) {
        let state = self.state();
        queue.inner().wanted.insert(channel, subscription);
        if let Some(last) = state.last.get(&channel) {
            queue.push(last.clone());
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
    }
}

impl Queue {
    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wants(&self, channel: u16) -> bool {
        self.inner().wanted.contains_key(&channel)
    }

    fn push(&self, message: Waiting) {
        let mut inner = self.inner();
        inner.bytes += message.data.len();
        inner.messages.push_back(message);
        while inner.bytes > WAITING_BYTES && inner.messages.len() > 1 {
            let lost = inner.messages.pop_front().map_or(0, |m| m.data.len());
            inner.bytes -= lost;
        }
    }

    /// The next message and its subscription.
    pub(crate) fn pop(&self) -> Option<(u32, Waiting)> {
        let mut inner = self.inner();
        loop {
            let message = inner.messages.pop_front()?;
            inner.bytes -= message.data.len();
            if let Some(subscription) = inner.wanted.get(&message.channel) {
                return Some((*subscription, message));
            }
        }
    }

    pub(crate) fn unsubscribe(&self, subscriptions: &[u32]) {
        self.inner().wanted.retain(|_, subscription| !subscriptions.contains(subscription));
    }
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    let mut threads = Vec::new();
    for stream in listener.incoming() {
        if shared.has_ended() {
            break;
        }
        let (Ok(stream), Some(queue)) = (stream, shared.join()) else { continue };
        let shared = shared.clone();
        threads.push(std::thread::spawn(move || {
            client::serve(stream, &shared, &queue);
            shared.leave(&queue);
        }));
    }
    for thread in threads {
        // A client's thread that panicked is none of the run's business.
        let _ = thread.join();
    }
}
