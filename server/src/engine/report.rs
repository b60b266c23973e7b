//! Lines that an engine writes to standard output, for its door.

use std::io::Write as _;

use echolake_lake::CacheCounts;
use serde::{Deserialize, Serialize};

use crate::activity::{ActivityTable, LakeFigures, QueryEnd, QueryStart};
use crate::fault::FaultCode;

/// A line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum EngineReport {
    /// It has read the lake and can be assigned to a client.
    Ready,
    /// It ends itself, for this reason.
    Ending(String),
    /// A query begins.
    Started(QueryStart),
    /// A query has ended.
    Ended(QueryEnd),
    /// A request failed.
    Failure(FaultCode),
    /// State of the lake; None if it cannot be read.
    Lake(Option<LakeFigures>),
    /// What it read of an object store through its cache since the last such line.
    Cache(CacheCounts),
    /// It asks for its client's rows of a table of the server's activity.
    Ask {
        /// Number of the answer.
        number: u64,
        /// The table.
        table: ActivityTable,
    },
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
