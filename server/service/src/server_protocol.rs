//! The protocols of the server.

use serde::{Deserialize, Serialize};

/// The protocol of a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ServerProtocol {
    /// HTTP.
    Http,
    /// Arrow Flight SQL.
    FlightSql,
    /// Postgres' wire protocol.
    Postgres,
    /// The Model Context Protocol.
    Mcp,
}

impl ServerProtocol {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Http, Self::FlightSql, Self::Postgres, Self::Mcp];

    /// As metrics and the log have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Http => "http",
            Self::FlightSql => "flight_sql",
            Self::Postgres => "postgres",
            Self::Mcp => "mcp",
        }
    }
}
