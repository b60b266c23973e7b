//! The server's activity: its queries, its connections, and what engines report of the lake. The door keeps it for
//! `/metrics`, for `system.queries` and `system.connections`; engines report to it and ask for their client's rows.

mod lake_figures;
mod query_log;
mod query_watch;

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use chrono::{DateTime, Utc};
use serde::{Deserialize, Serialize};

pub(crate) use lake_figures::LakeFigures;
pub(crate) use query_log::{LoggedQuery, QueryLog};
pub(crate) use query_watch::{QueryEnd, QueryStart, QueryTimer, QueryWatch, RunningWatches};

use crate::Error;
use crate::client_identity::ClientIdentity;
use crate::door::connection_places::OpenConnections;
use crate::metrics::ServerMetrics;
use crate::tokens::TokenScope;

/// The door's knowledge of the server.
pub(crate) struct ServerActivity {
    pub(crate) metrics: ServerMetrics,
    pub(crate) queries: QueryLog,
    pub(crate) connections: OpenConnections,
    lake: Mutex<Option<(Instant, Option<LakeFigures>)>>,
    started: DateTime<Utc>,
}

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

/// Returns a random number of a query or connection: one that is counted would tell a client how much others ask. It has 53
/// bits, so that a page's numbers hold it, and is not 0.
pub(crate) fn random_id() -> u64 {
    (getrandom::u64().unwrap_or(0) >> 11).max(1)
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

impl ServerActivity {
    /// Nothing so far.
    ///
    /// # Errors
    /// [`Error::System`], which is a defect.
    pub(crate) fn new() -> Result<Self, Error> {
        Ok(Self {
            metrics: ServerMetrics::new().map_err(|e| Error::System(std::io::Error::other(e)))?,
            queries: QueryLog::default(),
            connections: OpenConnections::default(),
            lake: Mutex::default(),
            started: Utc::now(),
        })
    }

    /// Returns when the server started.
    pub(crate) fn started(&self) -> DateTime<Utc> {
        self.started
    }

    /// Takes what an engine found in the lake.
    pub(crate) fn set_lake(&self, figures: Option<LakeFigures>) {
        *self.lake.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), figures));
    }

    /// Returns what an engine last found in the lake, and when; None if the lake could not be read, or nobody has looked
    /// yet.
    pub(crate) fn lake(&self) -> Option<(Instant, LakeFigures)> {
        let (at, figures) = (*self.lake.lock().unwrap_or_else(PoisonError::into_inner))?;
        Some((at, figures?))
    }

    /// Returns whether the last engine that looked could not read the lake.
    pub(crate) fn is_lake_unreadable(&self) -> bool {
        matches!(*self.lake.lock().unwrap_or_else(PoisonError::into_inner), Some((_, None)))
    }

    /// The rows of a table that a client may see: its own, or all if it may see the server's figures.
    pub(crate) fn rows(&self, table: ActivityTable, client: &ClientIdentity) -> ActivityRows {
        let all = client.require(TokenScope::Metrics).is_ok();
        match table {
            ActivityTable::Queries => ActivityRows::Queries(self.queries.rows(&client.name, all)),
            ActivityTable::Connections => ActivityRows::Connections(self.connections.rows(&client.name, all)),
        }
    }
}
