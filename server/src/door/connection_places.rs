//! Places for connections: a listener accepts a limited number. If all are taken, a new connection evicts the oldest
//! one without a request or a login, of the address that has the most, and never one of an address that has fewer than
//! its own: slow senders and crowds lock out no other client.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::io::{self, IoSlice};
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use chrono::Utc;
use echolake_service::{OpenConnection, ServerProtocol};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio::time::Sleep;

use crate::random_id::random_id;

/// Time to wait if the system has no more sockets.
const PAUSE: Duration = Duration::from_millis(100);
/// Bytes that a connection reads before it is the turn of others. A frame of HTTP/2 may have nine and no answer.
const TURN_BYTES: usize = 16 << 10;
/// Bytes that a connection may send outside of requests. Each of a flood of frames is small, and costs as much as one
/// that says something.
const IDLE_BYTES: usize = 1 << 20;
/// Time for which a client may read nothing of an answer.
const STALL: Duration = Duration::from_secs(300);
/// Time without work or bytes after which nothing of an answer is on its way any more.
const QUIET: Duration = Duration::from_secs(1);

/// An address, and its places.
pub(crate) struct ConnectionPlaces {
    listener: TcpListener,
    most: usize,
    taken: Arc<TakenPlaces>,
}

#[derive(Default)]
struct TakenPlaces {
    // In the order in which they were taken.
    all: Mutex<Vec<Arc<PlaceState>>>,
    freed: Notify,
}

struct PlaceState {
    id: u64,
    peer: SocketAddr,
    address: IpAddr,
    /// Microseconds since 1970.
    started: i64,
    client: Mutex<Option<String>>,
    requests: AtomicU64,
    working: AtomicUsize,
    /// Bytes since the last request.
    idle_bytes: AtomicUsize,
    /// Bytes that were written.
    written: AtomicUsize,
    evicted: Notify,
}

impl PlaceState {
    fn lock_client(&self) -> MutexGuard<'_, Option<String>> {
        self.client.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_idle(&self) -> bool {
        self.working.load(Ordering::Relaxed) == 0
    }

    fn connection_row(&self, protocol: ServerProtocol) -> OpenConnection {
        OpenConnection {
            id: self.id,
            client: self.lock_client().clone(),
            protocol: protocol.name().to_owned(),
            peer: self.peer.to_string(),
            started: self.started,
            requests: self.requests.load(Ordering::Relaxed),
            is_working: !self.is_idle(),
        }
    }
}

/// The connections of all protocols.
#[derive(Default)]
pub(crate) struct OpenConnections(Mutex<Vec<ProtocolPlaces>>);

struct ProtocolPlaces {
    protocol: ServerProtocol,
    most: usize,
    taken: Arc<TakenPlaces>,
}

impl OpenConnections {
    /// The number of open connections of each protocol, and its limit.
    pub fn protocol_counts(&self) -> Vec<(ServerProtocol, usize, usize)> {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.iter().map(|places| (places.protocol, places.taken.lock_places().len(), places.most)).collect()
    }

    /// The connections of a client, or of all.
    pub fn connection_rows(&self, client: &str, all: bool) -> Vec<OpenConnection> {
        let protocols = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut rows = Vec::new();
        for places in protocols.iter() {
            let taken = places.taken.lock_places();
            let seen = taken.iter().filter(|place| all || place.lock_client().as_deref() == Some(client));
            rows.extend(seen.map(|place| place.connection_row(places.protocol)));
        }
        rows
    }
}

impl ConnectionPlaces {
    /// Places of an address.
    pub fn new(listener: TcpListener, most: usize) -> Self {
        Self { listener, most, taken: Arc::default() }
    }

    /// Lists its connections among those of all protocols.
    pub fn listed_among(self, connections: &OpenConnections, protocol: ServerProtocol) -> Self {
        let places = ProtocolPlaces { protocol, most: self.most, taken: self.taken.clone() };
        connections.0.lock().unwrap_or_else(PoisonError::into_inner).push(places);
        self
    }

    /// The next connection in its place. If all places are taken by connections that work, it waits.
    pub async fn next_connection(&self) -> PlacedStream {
        loop {
            match self.listener.accept().await {
                Ok((stream, peer)) => {
                    // Answers are written whole: waiting for more of them only delays.
                    let _ = stream.set_nodelay(true);
                    if self.make_room(peer.ip()).await {
                        return self.place_stream(stream, peer);
                    }
                }
                // A client that hung up already is no problem; a lack of sockets passes.
                Err(_) => tokio::time::sleep(PAUSE).await,
            }
        }
    }

    /// Attends to connections, each in a task of its own; never ends.
    pub async fn attend_connections<F: Future<Output = ()> + Send + 'static>(self, attend: impl Fn(PlacedStream) -> F) {
        let mut open = JoinSet::new();
        loop {
            tokio::select! {
                stream = self.next_connection() => drop(open.spawn(attend(stream))),
                Some(_) = open.join_next() => {}
            }
        }
    }

    fn place_stream(&self, stream: TcpStream, peer: SocketAddr) -> PlacedStream {
        let state = PlaceState {
            id: random_id(),
            peer,
            address: peer.ip(),
            started: Utc::now().timestamp_micros(),
            client: Mutex::default(),
            requests: AtomicU64::new(0),
            working: AtomicUsize::new(0),
            idle_bytes: AtomicUsize::new(0),
            written: AtomicUsize::new(0),
            evicted: Notify::new(),
        };
        let state = Arc::new(state);
        self.taken.lock_places().push(state.clone());
        PlacedStream { stream, state, taken: self.taken.clone(), turn_bytes: 0, stalled: None }
    }

    // Another machine has half of the places at most. False if the newcomer's address has had its share.
    async fn make_room(&self, address: IpAddr) -> bool {
        loop {
            let freed = self.taken.freed.notified();
            {
                let mut all = self.taken.lock_places();
                let own = all.iter().filter(|place| place.address == address).count();
                let is_crowd = !address.is_loopback() && own >= (self.most / 2).max(1);
                if !is_crowd && all.len() < self.most {
                    return true;
                }
                match oldest_idle(&all, |place| !is_crowd || place.address == address) {
                    // A crowd pushes out its own, and not one that has just come.
                    Some((_, places)) if places < own => return false,
                    Some((oldest, _)) => {
                        all.remove(oldest).evicted.notify_one();
                        return true;
                    }
                    None if is_crowd => return false,
                    None => {}
                }
            }
            freed.await;
        }
    }
}

// The oldest idle connection of the address that has the most places, and how many these are.
fn oldest_idle(all: &[Arc<PlaceState>], may: impl Fn(&PlaceState) -> bool) -> Option<(usize, usize)> {
    let mut counts = HashMap::new();
    all.iter().for_each(|place| *counts.entry(place.address).or_insert(0_usize) += 1);
    let idle = all.iter().enumerate().filter(|(_, place)| place.is_idle() && may(place));
    let counted = idle.map(|(index, place)| (index, counts.get(&place.address).copied().unwrap_or(0)));
    counted.max_by_key(|(index, places)| (*places, Reverse(*index)))
}

impl TakenPlaces {
    fn lock_places(&self) -> MutexGuard<'_, Vec<Arc<PlaceState>>> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection in its place. Writing fails if its client reads nothing for five minutes.
pub(crate) struct PlacedStream {
    stream: TcpStream,
    state: Arc<PlaceState>,
    taken: Arc<TakenPlaces>,
    turn_bytes: usize,
    stalled: Option<Pin<Box<Sleep>>>,
}

impl PlacedStream {
    /// Ends if the connection must leave its place.
    pub fn wait_for_eviction(&self) -> impl Future<Output = ()> + Send + 'static {
        let state = self.state.clone();
        async move { state.evicted.notified().await }
    }

    /// Marks the begin of work on the connection.
    pub fn work_handle(&self) -> PlaceWork {
        PlaceWork(self.state.clone())
    }

    fn watch_write(&mut self, context: &mut Context<'_>, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(done) = &written {
            self.stalled = None;
            self.state.written.fetch_add(*done.as_ref().unwrap_or(&0), Ordering::Relaxed);
            return written;
        }
        let stalled = self.stalled.get_or_insert_with(|| Box::pin(tokio::time::sleep(STALL)));
        stalled.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl Drop for PlacedStream {
    fn drop(&mut self) {
        self.taken.lock_places().retain(|place| !Arc::ptr_eq(place, &self.state));
        self.taken.freed.notify_one();
    }
}

/// Marks a connection that works, which keeps its place. A request works once it is whole and authenticated.
#[derive(Clone)]
pub(crate) struct PlaceWork(Arc<PlaceState>);

impl PlaceWork {
    /// Takes note of a request: what was sent up to here was one.
    pub fn hear_request(&self) {
        self.0.requests.fetch_add(1, Ordering::Relaxed);
        self.0.idle_bytes.store(0, Ordering::Relaxed);
    }

    /// Takes note of the client of a request; returns true if the one before was another's.
    pub fn name_client(&self, name: &str) -> bool {
        let mut known = self.0.lock_client();
        let is_other = known.as_deref() != Some(name);
        if is_other {
            *known = Some(name.to_owned());
        }
        is_other
    }

    /// The address of the other side.
    pub fn peer(&self) -> SocketAddr {
        self.0.peer
    }

    /// Waits until the connection does no work, and sends nothing more of what was done.
    pub async fn wait_until_quiet(&self) {
        let mut written = None;
        while !(self.0.is_idle() && written == Some(self.0.written.load(Ordering::Relaxed))) {
            written = self.0.is_idle().then(|| self.0.written.load(Ordering::Relaxed));
            tokio::time::sleep(QUIET).await;
        }
    }

    pub fn begin_work(&self) -> WorkingPlace {
        self.0.working.fetch_add(1, Ordering::Relaxed);
        WorkingPlace(self.0.clone())
    }
}

/// Work on a connection, until this is dropped.
pub(crate) struct WorkingPlace(Arc<PlaceState>);

impl Drop for WorkingPlace {
    fn drop(&mut self) {
        self.0.working.fetch_sub(1, Ordering::Relaxed);
    }
}

impl AsyncRead for PlacedStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.turn_bytes >= TURN_BYTES {
            self.turn_bytes = 0;
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        let bytes = buffer.filled().len() - before;
        self.turn_bytes = if read.is_ready() { self.turn_bytes + bytes } else { 0 };
        if self.state.is_idle() && self.state.idle_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes > IDLE_BYTES {
            return Poll::Ready(Err(io::Error::other("too much was sent without a request")));
        }
        read
    }
}

impl AsyncWrite for PlacedStream {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.watch_write(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, parts);
        self.watch_write(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpSocket;

    use super::*;

    #[tokio::test]
    async fn one_more_takes_the_place_of_the_oldest_that_does_not_work() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("its address");
        let places = ConnectionPlaces::new(listener, 2);
        let mut clients = Vec::new();
        for _ in 0..4 {
            clients.push(TcpStream::connect(address).await.expect("connected"));
        }
        let first = places.next_connection().await;
        let second = places.next_connection().await;
        let working = first.work_handle().begin_work();
        let third = places.next_connection().await;
        tokio::time::timeout(Duration::from_secs(60), second.wait_for_eviction())
            .await
            .expect("it must leave its place");
        let _third_works = third.work_handle().begin_work();
        let waited = tokio::time::timeout(Duration::from_millis(50), places.next_connection()).await;
        assert!(waited.is_err(), "all places are taken by connections that work");
        drop((working, first));
        clients.push(TcpStream::connect(address).await.expect("connected"));
        let next = tokio::time::timeout(Duration::from_secs(60), places.next_connection()).await.expect("a free place");
        assert_eq!(Some(next.state.address), clients[4].local_addr().ok().map(|a| a.ip()));
        assert!(next.state.id.abs_diff(third.state.id) > 1_000, "ids do not tell how many connect");
    }

    #[tokio::test]
    async fn a_crowd_pushes_out_its_own() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("its address");
        let places = ConnectionPlaces::new(listener, 3);
        let mut clients = Vec::new();
        let mut taken = Vec::new();
        for source in ["127.0.0.2:0", "127.0.0.3:0", "127.0.0.3:0", "127.0.0.3:0"] {
            let socket = TcpSocket::new_v4().expect("a socket");
            socket.bind(source.parse().expect("an address")).expect("bound");
            clients.push(socket.connect(address).await.expect("connected"));
            taken.push(places.next_connection().await);
        }
        tokio::time::timeout(Duration::from_secs(60), taken[1].wait_for_eviction())
            .await
            .expect("it must leave its place");
        let stays = tokio::time::timeout(Duration::from_millis(50), taken[0].wait_for_eviction()).await;
        assert!(stays.is_err(), "the only one of its address stays, though it is the oldest");
        let _works: Vec<_> = taken[2..].iter().map(|place| place.work_handle().begin_work()).collect();
        let socket = TcpSocket::new_v4().expect("a socket");
        socket.bind("127.0.0.3:0".parse().expect("an address")).expect("bound");
        let mut refused = socket.connect(address).await.expect("connected");
        assert!(tokio::time::timeout(Duration::from_millis(50), places.next_connection()).await.is_err());
        assert_eq!(refused.read(&mut [0]).await.expect("closed"), 0, "a crowd that works takes no other's place");
    }

    #[tokio::test]
    async fn what_is_no_request_is_limited_and_requests_are_not() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("its address");
        let places = ConnectionPlaces::new(listener, 1);
        let mut client = TcpStream::connect(address).await.expect("connected");
        let next = tokio::time::timeout(Duration::from_secs(60), places.next_connection());
        let mut place = next.await.expect("the only place");
        tokio::spawn(async move { while client.write_all(&[0; 1024]).await.is_ok() {} });
        let work = place.work_handle();
        let mut buffer = vec![0; IDLE_BYTES / 4];
        for _ in 0..12 {
            place.read_exact(&mut buffer).await.expect("a request");
            work.hear_request();
        }
        let mut read = 0;
        let failed = loop {
            match place.read(&mut buffer).await {
                Ok(bytes) => read += bytes,
                Err(failed) => break failed,
            }
        };
        assert_eq!(failed.to_string(), "too much was sent without a request");
        assert!(read <= IDLE_BYTES, "{read}");
    }
}
