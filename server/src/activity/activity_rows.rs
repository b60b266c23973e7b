//! Tables of the server's activity, and their rows.

use serde::{Deserialize, Serialize};

use super::query_log::LoggedQuery;

/// A table of the server's activity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ActivityTable {
    Queries,
    Connections,
}

/// Rows of such a table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ActivityRows {
    Queries(Vec<LoggedQuery>),
    Connections(Vec<OpenConnection>),
}

/// A row of `system.connections`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct OpenConnection {
    /// Random number.
    pub(crate) id: u64,
    /// Name of its client, once it is known.
    pub(crate) client: Option<String>,
    /// Protocol.
    pub(crate) protocol: String,
    /// Address of the other side.
    pub(crate) peer: String,
    /// Microseconds since 1970.
    pub(crate) started: i64,
    /// Requests so far; over Postgres' protocol the session is one.
    pub(crate) requests: u64,
    /// True while a request is answered.
    pub(crate) is_working: bool,
}
