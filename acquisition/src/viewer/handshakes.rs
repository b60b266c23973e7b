//! Pending handshakes. Each has a time limit in all, and each address a number of them, so that clients that never
//! finish theirs keep no other client out: the oldest of their address is ended for a new one.

use std::io::{self, Read, Write};
use std::net::{IpAddr, Shutdown, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time limit of a handshake.
pub(super) const LONGEST_HANDSHAKE: Duration = Duration::from_secs(5);
/// Limit of pending handshakes per address.
const MOST_OF_ADDRESS: usize = 8;
/// Limit of pending handshakes in all.
const MOST_OF_ALL: usize = 64;

/// Handshakes in progress, oldest first.
#[derive(Default)]
pub(super) struct PendingHandshakes(Mutex<Vec<(IpAddr, Arc<TcpStream>)>>);

impl PendingHandshakes {
    /// Adds a client's, in the order of connecting; ends the oldest one if there are too many.
    pub fn add(&self, stream: &Arc<TcpStream>) -> io::Result<()> {
        let address = stream.peer_addr()?.ip();
        let mut pending = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let is_full = pending.iter().filter(|(of, _)| *of == address).count() >= MOST_OF_ADDRESS;
        let oldest = if is_full {
            pending.iter().position(|(of, _)| *of == address)
        } else {
            (pending.len() >= MOST_OF_ALL).then_some(0)
        };
        if let Some(oldest) = oldest {
            let (_, ended) = pending.remove(oldest);
            // Its client may be gone already.
            let _ = ended.shutdown(Shutdown::Both);
        }
        pending.push((address, stream.clone()));
        Ok(())
    }

    /// Removes a client's, because it is done or has failed.
    pub fn remove(&self, stream: &Arc<TcpStream>) {
        let mut pending = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        pending.retain(|(_, other)| !Arc::ptr_eq(other, stream));
    }
}

/// A client's connection, whose reads time out at the handshake's deadline, however slowly it drips.
pub(super) struct TimedStream {
    pub stream: Arc<TcpStream>,
    deadline: Option<Instant>,
}

impl TimedStream {
    /// A stream whose handshake has this long.
    pub fn new(stream: Arc<TcpStream>, limit: Duration) -> Self {
        Self { stream, deadline: Some(Instant::now() + limit) }
    }

    /// Ends the handshake's time: from now on the stream has its own limits.
    pub fn lift_deadline(&mut self) {
        self.deadline = None;
    }
}

impl Read for TimedStream {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if let Some(deadline) = self.deadline {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.stream.set_read_timeout(Some(left))?;
        }
        (&*self.stream).read(buffer)
    }
}

impl Write for TimedStream {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        (&*self.stream).write(buffer)
    }

    fn flush(&mut self) -> io::Result<()> {
        (&*self.stream).flush()
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn reads_that_drip_end_with_the_time_of_all() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a listener");
        let mut client = TcpStream::connect(listener.local_addr().expect("an address")).expect("connected");
        let (stream, _) = listener.accept().expect("a client");
        let limit = Duration::from_millis(200);
        let begun = Instant::now();
        let mut timed = TimedStream::new(Arc::new(stream), limit);
        let mut byte = [0];
        let ended = loop {
            // Each byte is in time for itself.
            client.write_all(b"A").expect("sent");
            std::thread::sleep(limit / 20);
            if let Err(error) = timed.read(&mut byte) {
                break error;
            }
        };
        assert!(matches!(ended.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock), "{ended}");
        assert!(begun.elapsed() >= limit);
        timed.lift_deadline();
        client.write_all(b"A").expect("sent");
        assert_eq!(timed.read(&mut byte).expect("a byte"), 1);
    }
}
