//! Errors that keep a server from starting or running. A failed request has a [`crate::fault::RequestFault`].

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

/// An error that keeps a server from starting or running.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The address is not to be had.
    #[error("cannot listen on {address}; hint: another port, or 0 for any that is free")]
    Bind {
        /// The requested address.
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
        /// The requested address.
        address: SocketAddr,
    },
    /// Tokens and rows would go over the network as they are.
    #[error(
        "{address} can be reached from other machines, and nothing would be encrypted; hint: --certificate FILE and \
         --key FILE, which `echolake certificate` makes, or --plain-text-behind-a-proxy"
    )]
    PlainText {
        /// The requested address.
        address: SocketAddr,
    },
    /// The lake cannot be read.
    #[error(transparent)]
    Lake(#[from] echolake_lake::Error),
    /// A certificate or its key cannot be read.
    #[error("cannot use the certificate or key in `{}`; hint: PEM files, as `echolake certificate` makes \
        them", path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A certificate cannot be made.
    #[error("cannot make a certificate for {names}; hint: names such as lake.example.org, or addresses")]
    SelfSigned {
        /// The names.
        names: String,
        /// The cause.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A file of tokens cannot be read.
    #[error("cannot read the tokens in `{}`", path.display())]
    ReadTokens {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// A file of tokens is not right.
    #[error("the tokens in `{}` are not right: {message}", path.display())]
    Tokens {
        /// The file.
        path: PathBuf,
        /// The defect in the file.
        message: String,
    },
    /// The system gives no random bytes.
    #[error("the system gives no random bytes")]
    Random(#[source] io::Error),
    /// There is no folder for temporary files.
    #[error("cannot make a folder for temporary files in `{}`; hint: --temp DIR", path.display())]
    Temp {
        /// The parent folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The address of the pages is not one.
    #[error("`{found}` is not the address of a server; hint: scheme, host and port alone, as http://localhost:8080")]
    Pages {
        /// The given address.
        found: String,
    },
    /// The system gives no threads or tasks to compute on, or takes a listener back.
    #[error("the server cannot go on")]
    System(#[source] io::Error),
    /// The gRPC server failed.
    #[error("Flight SQL cannot go on")]
    Transport(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The `pg_catalog` tables for Postgres clients cannot be built.
    #[error("the tables of `pg_catalog` cannot be made")]
    Catalog(#[from] datafusion::error::DataFusionError),
    /// A worker cannot be used or started so.
    #[error(transparent)]
    Worker(#[from] echolake_query::WorkerFault),
    /// The engine cannot be set up.
    #[error(transparent)]
    Query(#[from] echolake_query::Error),
}
