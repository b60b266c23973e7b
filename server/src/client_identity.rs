//! Who asks: what the door found out about a client, and an engine is told.

use std::time::Duration;

use echolake_query::QueryQuota;
use serde::{Deserialize, Serialize};

use crate::fault::Fault;
use crate::tokens::Scope;

/// Name of the client that stands for the server's own pages, where there are no tokens.
const PAGES: &str = "pages";
/// Name of the client that stands for all pages of elsewhere.
const FOREIGN: &str = "foreign pages";

/// Name of the client that stands for all programs of this machine that ask over HTTP or Flight SQL.
const PROGRAMS: &str = "programs";

/// Returns how much of a limit of memory operators may count, who say that they hold less than they do: queries that are
/// refused more memory end alone, not their engine.
pub(crate) fn counted_bytes(memory: usize) -> usize {
    memory / 8 * 7
}

/// A client.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ClientIdentity {
    /// Name for logs and refusals; each has an engine of its own.
    pub(crate) name: String,
    /// Whether the server has no tokens, so that requests of foreign pages must be told from others.
    pub(crate) is_open: bool,
    pub(crate) scopes: Vec<Scope>,
    /// Limits, as [`QueryQuota`] has them.
    pub(crate) seconds: Option<u64>,
    pub(crate) memory_bytes: Option<usize>,
    pub(crate) rows: Option<u64>,
    pub(crate) concurrent: Option<usize>,
}

impl ClientIdentity {
    /// A client of a server without tokens.
    pub(crate) fn local(name: impl Into<String>) -> Self {
        let scopes = vec![Scope::Sql, Scope::Files, Scope::Metrics];
        let (seconds, memory_bytes, rows, concurrent) = (None, None, None, None);
        Self { name: name.into(), is_open: true, scopes, seconds, memory_bytes, rows, concurrent }
    }

    /// The server's own pages.
    pub(crate) fn pages() -> Self {
        Self::local(PAGES)
    }

    /// Programs of this machine, over HTTP or Flight SQL.
    pub(crate) fn programs() -> Self {
        Self::local(PROGRAMS)
    }

    /// A user of this machine, by their own word, over Postgres' protocol.
    pub(crate) fn user(name: &str) -> Self {
        Self::local(format!("user {name}"))
    }

    /// Pages of elsewhere.
    pub(crate) fn foreign() -> Self {
        Self::local(FOREIGN)
    }

    /// Limits of its queries.
    pub(crate) fn quota(&self) -> QueryQuota {
        QueryQuota {
            time: self.seconds.map(Duration::from_secs),
            memory: self.memory_bytes.map(counted_bytes),
            rows: self.rows,
            concurrent: self.concurrent,
        }
    }

    /// Checks that the client may do this.
    ///
    /// # Errors
    /// [`Fault::Forbidden`].
    pub(crate) fn require(&self, scope: Scope) -> Result<(), Fault> {
        match self.scopes.contains(&scope) {
            true => Ok(()),
            false => Err(Fault::Forbidden { name: self.name.clone(), scope }),
        }
    }
}
