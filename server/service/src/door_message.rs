//! Lines that an engine reads from standard input, of its door.

use serde::{Deserialize, Serialize};

use crate::activity::ActivityRows;
use crate::client_identity::ClientIdentity;

/// A line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DoorMessage {
    /// The client of the engine; the first line.
    Client(ClientIdentity),
    /// Cancel the query with this number.
    Cancel(u64),
    /// Rows that the engine asked for.
    Rows {
        /// Number of the answer.
        number: u64,
        /// The rows.
        rows: ActivityRows,
    },
}
