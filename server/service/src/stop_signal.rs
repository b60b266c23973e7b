//! What stops a query that runs.

use tokio::sync::watch;

/// A signal that stops a query from another task.
#[derive(Debug, Clone, Default)]
pub struct StopSignal(watch::Sender<bool>);

impl StopSignal {
    /// A signal that stops nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Ends it.
    pub fn stop(&self) {
        self.0.send_replace(true);
    }

    /// Waits until the query is stopped.
    pub async fn wait_for_stop(&self) {
        // The sender lives in `self`, so there is no error to come.
        let _ = self.0.subscribe().wait_for(|stopped| *stopped).await;
    }
}
