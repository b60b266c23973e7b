//! Errors of replays.

use std::net::SocketAddr;
use std::path::PathBuf;

/// An error that prevents a replay.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The system refused.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file has no messages that can be replayed.
    #[error("`{}` cannot be replayed: {reason}", path.display())]
    Unplayable {
        /// The file.
        path: PathBuf,
        /// The reason, with a hint.
        reason: String,
    },
    /// There is nothing to replay.
    #[error("nothing to replay: {reason}")]
    Nothing {
        /// The reason.
        reason: &'static str,
    },
    /// The address cannot be listened on.
    #[error("cannot replay at {address}; hint: is the port taken?")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
}
