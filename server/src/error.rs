//! Why a server cannot start or go on. What a request fails with is a [`crate::fault::Fault`].

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Why a server cannot start or go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The address is not to be had.
    #[error("cannot listen on {address}; hint: another port, or 0 for any that is free")]
    Bind {
        /// Where.
        address: SocketAddr,
        /// The system's refusal.
        source: io::Error,
    },
    /// Others could reach the server, and it would let everybody in.
    #[error(
        "{address} can be reached from other machines, and no tokens are set; \
         hint: --tokens FILE, which `echolake token NAME` helps to write, or an address of 127.0.0.1"
    )]
    Open {
        /// Where it would listen.
        address: SocketAddr,
    },
    /// A file of tokens cannot be read.
    #[error("cannot read the tokens in `{}`", path.display())]
    ReadTokens {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A file of tokens is not right.
    #[error("the tokens in `{}` are not right: {message}", path.display())]
    Tokens {
        /// The file.
        path: PathBuf,
        /// What is wrong in it.
        message: String,
    },
    /// The system gives no random bytes.
    #[error("the system gives no random bytes")]
    Random(#[source] io::Error),
    /// There is no folder for temporary files.
    #[error("cannot make a folder for temporary files in `{}`; hint: --temp DIR", path.display())]
    Temp {
        /// Where.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The system gives no threads or tasks to compute on, or takes a listener back.
    #[error("the server cannot go on")]
    System(#[source] io::Error),
    /// gRPC cannot go on.
    #[error("Flight SQL cannot go on")]
    Transport(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// What Postgres' clients ask about cannot be made.
    #[error("the tables of `pg_catalog` cannot be made")]
    Catalog(#[from] datafusion::error::DataFusionError),
    /// The engine cannot be set up.
    #[error(transparent)]
    Query(#[from] echolake_query::Error),
}
