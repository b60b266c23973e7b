//! Why recordings are not replayed.

use std::net::SocketAddr;
use std::path::PathBuf;

/// Why recordings are not replayed.
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
    /// There is nothing to replay in it.
    #[error("`{}` cannot be replayed: {reason}", path.display())]
    Unplayable {
        /// The file.
        path: PathBuf,
        /// Why, and what would help.
        reason: String,
    },
    /// There is nothing to replay.
    #[error("nothing to replay: {reason}")]
    Nothing {
        /// Why.
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
