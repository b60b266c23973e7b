//! The sockets between the door and an engine.

use std::path::{Path, PathBuf};

use tokio::net::UnixListener;

use crate::Error;

/// A protocol, as an engine's sockets are named.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EngineSocket {
    /// HTTP.
    Http,
    /// Arrow Flight SQL.
    FlightSql,
    /// Postgres' wire protocol.
    Postgres,
}

impl EngineSocket {
    /// The path of this socket in an engine's folder.
    pub fn path_in(self, folder: &Path) -> PathBuf {
        folder.join(match self {
            Self::Http => "http",
            Self::FlightSql => "flight",
            Self::Postgres => "postgres",
        })
    }

    /// Listens on it.
    pub fn listen_in(self, folder: &Path) -> Result<UnixListener, Error> {
        UnixListener::bind(self.path_in(folder)).map_err(Error::System)
    }
}
