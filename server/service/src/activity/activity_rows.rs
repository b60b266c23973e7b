//! Tables of the server's activity, and their rows.

use serde::{Deserialize, Serialize};

/// A table of the server's activity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActivityTable {
    /// `system.queries`.
    Queries,
    /// `system.connections`.
    Connections,
}

/// Rows of such a table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActivityRows {
    /// Of `system.queries`.
    Queries(Vec<LoggedQuery>),
    /// Of `system.connections`.
    Connections(Vec<OpenConnection>),
}

/// A row of `system.queries`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LoggedQuery {
    /// Random number.
    pub id: u64,
    /// Name of its client.
    pub client: String,
    /// Protocol.
    pub protocol: String,
    /// Its text; None for other clients.
    pub statement: Option<String>,
    /// `running`, `answered`, or the code of its failure.
    pub outcome: String,
    /// Microseconds since 1970.
    pub started: i64,
    /// Seconds until it was planned.
    pub plan_seconds: Option<f64>,
    /// Seconds until it had its first rows.
    pub first_row_seconds: Option<f64>,
    /// Seconds until its last row was sent; None while it runs.
    pub seconds: Option<f64>,
    /// Rows of its answer; None while it runs.
    pub rows: Option<u64>,
    /// Bytes of these rows in memory.
    pub bytes: Option<u64>,
    /// The most that its operators held.
    pub memory_bytes: Option<u64>,
}

/// A row of `system.connections`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OpenConnection {
    /// Random number.
    pub id: u64,
    /// Name of its client, once it is known.
    pub client: Option<String>,
    /// Protocol.
    pub protocol: String,
    /// Address of the other side.
    pub peer: String,
    /// Microseconds since 1970.
    pub started: i64,
    /// Requests so far; over Postgres' protocol the session is one.
    pub requests: u64,
    /// True while a request is answered.
    pub is_working: bool,
}
