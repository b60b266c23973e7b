//! The end of a server: it takes nothing new, and lets what is running go on for a while.

use std::sync::Arc;

use tokio::sync::watch;

/// State of the server's end, shared by all of its connections.
#[derive(Clone, Default)]
pub(crate) struct ServerDrain(Arc<DrainState>);

#[derive(Default)]
struct DrainState {
    begun: watch::Sender<bool>,
    open: watch::Sender<usize>,
}

/// A connection whose end the server awaits, until this is dropped.
pub(crate) struct AwaitedConnection(ServerDrain);

impl Drop for AwaitedConnection {
    fn drop(&mut self) {
        self.0.0.open.send_modify(|open| *open -= 1);
    }
}

impl ServerDrain {
    /// Takes nothing new from now on.
    pub fn begin_drain(&self) {
        self.0.begun.send_replace(true);
    }

    /// Returns whether nothing new is taken.
    pub fn is_begun(&self) -> bool {
        *self.0.begun.borrow()
    }

    /// Waits until nothing new is taken.
    pub async fn wait_until_begun(&self) {
        // The sender lives in `self`, so there is no error to come.
        let _ = self.0.begun.subscribe().wait_for(|begun| *begun).await;
    }

    /// Counts a connection whose end is awaited; None if it comes too late for that.
    pub fn count_connection(&self) -> Option<AwaitedConnection> {
        // Counted before the look: one that finds no end begun is awaited by the end that follows.
        self.0.open.send_modify(|open| *open += 1);
        let counted = AwaitedConnection(self.clone());
        (!self.is_begun()).then_some(counted)
    }

    /// Returns the number of awaited connections.
    pub fn open_connections(&self) -> usize {
        *self.0.open.borrow()
    }

    /// Waits until no awaited connection is open.
    pub async fn wait_until_empty(&self) {
        let _ = self.0.open.subscribe().wait_for(|open| *open == 0).await;
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;

    use super::*;

    #[test]
    fn connections_before_the_end_are_awaited() {
        let drain = ServerDrain::default();
        let first = drain.count_connection().expect("before the end");
        assert!(drain.wait_until_begun().now_or_never().is_none());
        drain.begin_drain();
        assert!(drain.wait_until_begun().now_or_never().is_some());
        assert!(drain.count_connection().is_none(), "too late");
        assert!(drain.wait_until_empty().now_or_never().is_none());
        drop(first);
        assert!(drain.wait_until_empty().now_or_never().is_some());
    }
}
