//! What stops a query that runs.

use tokio::sync::watch;

/// A signal that stops a query from another task.
#[derive(Debug, Clone)]
pub(crate) struct StopSignal(watch::Sender<bool>);

impl StopSignal {
    pub(crate) fn new() -> Self {
        Self(watch::Sender::new(false))
    }

    /// Ends it.
    pub(crate) fn stop(&self) {
        self.0.send_replace(true);
    }

    /// Waits until the query is stopped.
    pub(crate) async fn wait_for_stop(&self) {
        // The sender lives in `self`, so there is no error to come.
        let _ = self.0.subscribe().wait_for(|stopped| *stopped).await;
    }
}
