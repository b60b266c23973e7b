//! Lines that an engine writes to standard output, for its door.

use std::io::Write as _;

use serde::{Deserialize, Serialize};

/// A line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum EngineReport {
    /// It has read the lake and can be assigned to a client.
    Ready,
    /// It ends itself, for this reason.
    Ending(String),
    /// Its counters, as [`crate::metrics::ServerMetrics::counters`] lists them.
    Counters(Vec<u64>),
}

impl EngineReport {
    /// Writes the line.
    pub(crate) fn send(&self) {
        let mut line = serde_json::to_vec(self).unwrap_or_default();
        line.push(b'\n');
        let mut stdout = std::io::stdout().lock();
        // If the door is gone, standard input ends too, and the engine with it.
        let _ = stdout.write_all(&line).and_then(|()| stdout.flush());
    }
}
