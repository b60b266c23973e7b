//! The connections of a client, which can all be closed at once, whatever they wait for.

use std::io;
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::Duration;

use tokio::runtime::Runtime;
use tokio::sync::watch;

/// Longest time in which a server must accept a connection.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);

/// Runs what is asynchronous in the clients of all threads.
static CLIENT_RUNTIME: LazyLock<Runtime> = LazyLock::new(|| {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(2).enable_all().build().expect("a runtime")
});

/// Open connections from one address.
pub(crate) struct ClientConnections {
    /// Other clients come from other addresses; all of 127.0.0.0/8 is this machine.
    source: Ipv4Addr,
    streams: Mutex<Vec<Arc<TcpStream>>>,
    is_closed: watch::Sender<bool>,
}

impl ClientConnections {
    pub fn new(source: Ipv4Addr) -> Self {
        Self { source, streams: Mutex::default(), is_closed: watch::Sender::new(false) }
    }

    pub fn source(&self) -> Ipv4Addr {
        self.source
    }

    pub fn is_closed(&self) -> bool {
        *self.is_closed.borrow()
    }

    /// Opens a connection, on which reading and writing have no limit until [`Self::close_all`].
    ///
    /// # Errors
    /// The connection is not accepted, or all are closed already.
    pub fn connect(&self, address: &str) -> io::Result<Arc<TcpStream>> {
        if self.is_closed() {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        let stream = Arc::new(CLIENT_RUNTIME.block_on(connect_from(self.source, address))?);
        let mut streams = self.streams.lock().unwrap_or_else(PoisonError::into_inner);
        // Drops the streams that only this list still holds.
        streams.retain(|open| Arc::strong_count(open) > 1);
        streams.push(stream.clone());
        // It may have been closed meanwhile.
        if self.is_closed() {
            let _ = stream.shutdown(Shutdown::Both);
        }
        Ok(stream)
    }

    /// Closes all connections: whoever reads or writes on one gets an error.
    pub fn close_all(&self) {
        self.is_closed.send_replace(true);
        let mut streams = self.streams.lock().unwrap_or_else(PoisonError::into_inner);
        for stream in streams.drain(..) {
            // The server may have closed it already.
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Does something, and closes the connections at the limit, which ends whatever it waits for.
    pub fn close_after<T>(&self, limit: Duration, work: impl FnOnce() -> T) -> T {
        let (done, wait) = channel::<()>();
        std::thread::scope(|scope| {
            scope.spawn(move || {
                if wait.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                    self.close_all();
                }
            });
            let result = work();
            drop(done);
            result
        })
    }

    /// Runs asynchronous work of the client to its end; None if its connections are closed before.
    pub fn run<T>(&self, work: impl Future<Output = T>) -> Option<T> {
        let mut closing = self.is_closed.subscribe();
        CLIENT_RUNTIME.block_on(async {
            tokio::select! {
                done = work => Some(done),
                _ = closing.wait_for(|closed| *closed) => None,
            }
        })
    }
}

async fn connect_from(source: Ipv4Addr, address: &str) -> io::Result<TcpStream> {
    let address: SocketAddr = address.parse().map_err(|_| io::Error::from(io::ErrorKind::InvalidInput))?;
    let socket = tokio::net::TcpSocket::new_v4()?;
    socket.bind(SocketAddr::new(source.into(), 0))?;
    let stream = tokio::time::timeout(CONNECT_LIMIT, socket.connect(address)).await.map_err(io::Error::from)??;
    stream.set_nodelay(true)?;
    let stream = stream.into_std()?;
    stream.set_nonblocking(false)?;
    Ok(stream)
}
