//! Lines that an engine reads from standard input, of its door.

use serde::{Deserialize, Serialize};

use crate::activity::ActivityRows;

/// A line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DoorMessage {
    /// Cancel the query with this number.
    Cancel(u64),
    /// End all that the client of this name does: it may no longer, or may do other things now.
    EndClient(String),
    /// Rows that the engine asked for.
    Rows {
        /// Number of the answer.
        number: u64,
        /// The rows.
        rows: ActivityRows,
    },
}
