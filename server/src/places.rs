//! Places of an address: no more connections are taken from the system than it has.

use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// How long to wait where the system has no more sockets.
const PAUSE: Duration = Duration::from_millis(100);

/// A connection's place, free again when this is dropped.
pub(crate) type Place = Option<OwnedSemaphorePermit>;

/// An address, and its places.
pub(crate) struct Places {
    listener: TcpListener,
    free: Arc<Semaphore>,
}

impl Places {
    /// An address with so many.
    pub(crate) fn new(listener: TcpListener, most: usize) -> Self {
        Self { listener, free: Arc::new(Semaphore::new(most)) }
    }

    /// The next connection. Where no place is free, clients wait until one is.
    pub(crate) async fn next(&self) -> (TcpStream, Place) {
        // Never closed, so there is always one to come.
        let place = self.free.clone().acquire_owned().await.ok();
        loop {
            match self.listener.accept().await {
                Ok((stream, _)) => {
                    // Answers are written whole: waiting for more of them only delays.
                    let _ = stream.set_nodelay(true);
                    return (stream, place);
                }
                // Who broke off already is no trouble; that there are no more sockets passes.
                Err(_) => tokio::time::sleep(PAUSE).await,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn one_more_waits_until_one_ends() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("its address");
        let places = Places::new(listener, 2);
        let mut clients = Vec::new();
        for _ in 0..3 {
            clients.push(TcpStream::connect(address).await.expect("connected"));
        }
        let (one, _two) = (places.next().await, places.next().await);
        let waited = tokio::time::timeout(Duration::from_millis(50), places.next()).await;
        assert!(waited.is_err(), "both places are taken");
        drop(one);
        let (third, _) = tokio::time::timeout(Duration::from_secs(60), places.next()).await.expect("a free place");
        assert_eq!(third.peer_addr().ok(), clients[2].local_addr().ok());
    }
}
