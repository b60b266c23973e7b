//! The identity of a client: the door determines it and names it to an engine with each request.

use std::collections::BTreeSet;
use std::time::Duration;

use echolake_lake::Lake;
use echolake_query::QueryQuota;
use echolake_schema::ProjectName;
use serde::{Deserialize, Serialize};

use crate::fault::RequestFault;
use crate::token_scope::TokenScope;

/// Name of the client for requests of the server's own pages, if there are no tokens.
const PAGES: &str = "pages";
/// Name of the client for requests of pages from other origins.
const FOREIGN: &str = "foreign pages";

/// Name of the client for all programs of this machine that send requests over HTTP or Flight SQL.
const PROGRAMS: &str = "programs";

/// Returns the part of a memory limit that operators may account for. They report less than they hold; with this
/// margin, a query that is refused more memory fails alone and does not end its engine.
pub fn counted_bytes(memory: usize) -> usize {
    memory / 8 * 7
}

/// A client.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClientIdentity {
    /// Name for logs and refusals.
    pub name: String,
    /// True if the server has no tokens, so that requests of foreign pages must be distinguished from others.
    pub is_open: bool,
    /// What it may do.
    pub scopes: Vec<TokenScope>,
    /// The projects whose runs it may see; None for all runs.
    pub projects: Option<BTreeSet<ProjectName>>,
    /// Seconds of a query; this and the following are limits, as [`QueryQuota`] has them.
    pub seconds: Option<u64>,
    /// Bytes that its queries may hold.
    pub memory_bytes: Option<usize>,
    /// Rows of an answer.
    pub rows: Option<u64>,
    /// Queries at once.
    pub concurrent: Option<usize>,
    /// Number of its token, which another token of the same name does not have; None if it has none.
    pub token: Option<u64>,
}

impl ClientIdentity {
    /// A client of a server without tokens.
    pub fn local_client(name: impl Into<String>) -> Self {
        let scopes = TokenScope::NAMED.into_iter().map(|(_, scope)| scope).collect();
        Self {
            name: name.into(),
            is_open: true,
            scopes,
            projects: None,
            seconds: None,
            memory_bytes: None,
            rows: None,
            concurrent: None,
            token: None,
        }
    }

    /// The server's own pages.
    pub fn own_pages() -> Self {
        Self::local_client(PAGES)
    }

    /// Programs of this machine, over HTTP or Flight SQL.
    pub fn local_programs() -> Self {
        Self::local_client(PROGRAMS)
    }

    /// A user of this machine, by their own word, over Postgres' protocol.
    pub fn local_user(name: &str) -> Self {
        Self::local_client(format!("user {name}"))
    }

    /// Pages of other origins.
    pub fn foreign_pages() -> Self {
        Self::local_client(FOREIGN)
    }

    /// The text by which the door names it to an engine.
    pub(crate) fn to_text(&self) -> String {
        // Its fields are texts and numbers, which always have a form in JSON.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// Reads what [`ClientIdentity::to_text`] has written.
    ///
    /// # Errors
    /// [`RequestFault::Internal`].
    pub(crate) fn parse_text(text: &str) -> Result<Self, RequestFault> {
        serde_json::from_str(text).map_err(RequestFault::defect("the door names a client otherwise"))
    }

    /// What it may see and do, in a text that is equal for clients with equal rights. Without tokens, who asks from where
    /// is a right of its own: a page of elsewhere may not what the server's own page may.
    pub fn rights_text(&self) -> String {
        let name = self.is_open.then_some(&self.name);
        serde_json::json!([name, self.scopes, self.projects]).to_string()
    }

    /// Limits of its queries.
    pub fn quota(&self) -> QueryQuota {
        #[cfg(fuzzing)]
        let fuzzed = Self { seconds: Some(2), rows: Some(10_000), ..self.clone() };
        #[cfg(fuzzing)]
        let this = &fuzzed;
        #[cfg(not(fuzzing))]
        let this = self;
        QueryQuota {
            time: this.seconds.map(Duration::from_secs),
            memory: this.memory_bytes.map(counted_bytes),
            rows: this.rows,
            concurrent: this.concurrent,
        }
    }

    /// The lake as the client sees it.
    pub fn visible_lake(&self, lake: &Lake) -> Lake {
        match &self.projects {
            Some(projects) => lake.restricted_to(projects.clone()),
            None => lake.clone(),
        }
    }

    /// Checks that the client may do this.
    ///
    /// # Errors
    /// [`RequestFault::Forbidden`].
    pub fn require_scope(&self, scope: TokenScope) -> Result<(), RequestFault> {
        match self.scopes.contains(&scope) {
            true => Ok(()),
            false => Err(RequestFault::Forbidden { name: self.name.clone(), scope }),
        }
    }
}
