//! Whose statement it is.

use std::sync::{Arc, OnceLock};

/// Whose statement, or other work of a request, something is to be blamed on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StatementBlame {
    /// Name of the client.
    pub client: String,
    /// Number of its request, if its session has one.
    pub request: Option<u64>,
    /// The text of the statement; None for other work, and before it is planned.
    pub statement: Option<String>,
}

/// The client and the request of a statement.
#[derive(Debug)]
pub(crate) struct StatementOwner {
    pub client: Arc<str>,
    request: Option<u64>,
    statement: OnceLock<String>,
}

impl StatementOwner {
    pub fn new(client: Arc<str>, request: Option<u64>) -> Self {
        Self { client, request, statement: OnceLock::new() }
    }

    /// Sets the text, once.
    pub fn set_statement(&self, sql: &str) {
        let _ = self.statement.set(sql.to_owned());
    }

    /// Returns whom to blame.
    pub fn blame(&self) -> StatementBlame {
        StatementBlame {
            client: self.client.to_string(),
            request: self.request,
            statement: self.statement.get().cloned(),
        }
    }
}
