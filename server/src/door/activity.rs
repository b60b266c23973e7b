//! The server's activity: its queries, its connections, and what engines report of the lake. The door keeps it for
//! `/metrics`, for `system.queries` and `system.connections`; engines report to it and ask for their client's rows.

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use chrono::{DateTime, Utc};
use echolake_service::{ActivityRows, ActivityTable, Error, LakeFigures};

use super::connection_places::OpenConnections;
use super::query_log::QueryLog;
use crate::metrics::ServerMetrics;

/// The door's knowledge of the server.
pub(crate) struct ServerActivity {
    pub metrics: ServerMetrics,
    pub queries: QueryLog,
    pub connections: OpenConnections,
    lake: Mutex<Option<(Instant, Option<LakeFigures>)>>,
    started: DateTime<Utc>,
}

impl ServerActivity {
    /// Nothing so far.
    ///
    /// # Errors
    /// [`Error::System`], which is a defect.
    pub fn new() -> Result<Self, Error> {
        Ok(Self {
            metrics: ServerMetrics::new().map_err(|e| Error::System(std::io::Error::other(e)))?,
            queries: QueryLog::default(),
            connections: OpenConnections::default(),
            lake: Mutex::default(),
            started: Utc::now(),
        })
    }

    /// Returns when the server started.
    pub fn start_time(&self) -> DateTime<Utc> {
        self.started
    }

    /// Takes what an engine found in the lake.
    pub fn set_lake(&self, figures: Option<LakeFigures>) {
        *self.lake.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), figures));
    }

    /// Returns what an engine last found in the lake, and when; None if the lake could not be read, or nobody has
    /// looked yet.
    pub fn lake_figures(&self) -> Option<(Instant, LakeFigures)> {
        let (at, figures) = (*self.lake.lock().unwrap_or_else(PoisonError::into_inner))?;
        Some((at, figures?))
    }

    /// Returns whether the last engine that looked could not read the lake.
    pub fn is_lake_unreadable(&self) -> bool {
        matches!(*self.lake.lock().unwrap_or_else(PoisonError::into_inner), Some((_, None)))
    }

    /// The rows of a table that the client of this name may see: its own, or all if it may see the server's figures.
    pub fn visible_rows(&self, table: ActivityTable, client: &str, sees_all: bool) -> ActivityRows {
        match table {
            ActivityTable::Queries => ActivityRows::Queries(self.queries.query_rows(client, sees_all)),
            ActivityTable::Connections => ActivityRows::Connections(self.connections.connection_rows(client, sees_all)),
        }
    }
}
