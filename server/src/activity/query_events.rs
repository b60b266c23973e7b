//! The start and the end of a query, as its engine reports them.

use serde::{Deserialize, Serialize};

use crate::fault::FaultCode;
use crate::server_protocol::ServerProtocol;

/// The start of a query.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct QueryStart {
    /// Number, counted by its engine.
    pub(crate) number: u64,
    pub(crate) protocol: ServerProtocol,
    /// Its text, or the beginning of a long one.
    pub(crate) statement: String,
    /// Microseconds since 1970.
    pub(crate) started: i64,
}

/// The end of a query.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct QueryEnd {
    pub(crate) number: u64,
    /// The failure; None if it was answered.
    pub(crate) failure: Option<FaultCode>,
    /// Seconds until it was planned, until it had its first rows, and until its last row was sent.
    pub(crate) plan_seconds: Option<f64>,
    pub(crate) first_row_seconds: Option<f64>,
    pub(crate) seconds: f64,
    pub(crate) rows: u64,
    /// Bytes of its rows in memory, before they are encoded.
    pub(crate) bytes: u64,
    /// The most that its operators held, bytes.
    pub(crate) memory: u64,
}
