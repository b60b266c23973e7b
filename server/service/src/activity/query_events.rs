//! The start and the end of a query, as its engine reports them.

use serde::{Deserialize, Serialize};

use crate::fault::FaultCode;
use crate::server_protocol::ServerProtocol;

/// The start of a query.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryStart {
    /// Number, counted by its engine.
    pub number: u64,
    /// Name of its client.
    pub client: String,
    /// Its protocol.
    pub protocol: ServerProtocol,
    /// Its text, or the beginning of a long one.
    pub statement: String,
    /// Microseconds since 1970.
    pub started: i64,
}

/// The end of a query.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryEnd {
    /// Number, counted by its engine.
    pub number: u64,
    /// The failure; None if it was answered.
    pub failure: Option<FaultCode>,
    /// Seconds until it was planned.
    pub plan_seconds: Option<f64>,
    /// Seconds until it had its first rows.
    pub first_row_seconds: Option<f64>,
    /// Seconds until its last row was sent.
    pub seconds: f64,
    /// Rows of its answer.
    pub rows: u64,
    /// Bytes of its rows in memory, before they are encoded.
    pub bytes: u64,
    /// The most that its operators held, bytes.
    pub memory: u64,
}
