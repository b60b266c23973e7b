//! The lake over HTTP, Arrow Flight SQL and Postgres wire, reading only. A server is a door, which clients reach, and an
//! engine process for each client, which parses and runs what it asks.
//!
//! ```no_run,standalone_crate
//! # async fn example(settings: echolake_server::ServerSettings) -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let server = echolake_server::LakeServer::bind(&lake, settings)?;
//! for address in server.addresses() {
//!     eprintln!("{address}");
//! }
//! server.run(std::future::pending()).await?;
//! # Ok(())
//! # }
//! ```

mod activity;
mod catalogue_pages;
pub mod certificate;
mod client_identity;
mod door;
pub mod engine;
mod engine_socket;
mod error;
mod fault;
mod flight;
#[cfg(fuzzing)]
pub mod fuzzing;
mod http;
mod metrics;
mod postgres;
mod random_id;
mod request_span;
#[cfg(feature = "otlp")]
mod request_trace;
mod running;
mod scram_verifier;
mod server_protocol;
mod service;
mod sessions;
mod stop_signal;
mod token_access;
mod token_scope;
pub mod tokens;

pub use catalogue_pages::CataloguePages;
pub use door::{AgentDoor, CertificateFiles, EngineSettings, LakeServer, ServerSettings};
pub use error::Error;
