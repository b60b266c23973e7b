//! The lake over HTTP, Arrow Flight SQL and Postgres wire, reading only. A server is a door, which clients reach, and
//! two engine processes, which parse and run what clients ask. Heavy queries may run on workers of other machines.
//!
//! ```no_run,standalone_crate
//! # async fn example(settings: echolake_server::ServerSettings) -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let server = echolake_server::LakeServer::bind(&lake, settings)?;
//! for address in server.listening_urls() {
//!     eprintln!("{address}");
//! }
//! server.serve_until(std::future::pending()).await?;
//! # Ok(())
//! # }
//! ```

mod catalogue_pages;
pub mod certificate;
mod door;
pub mod engine;
#[cfg(all(fuzzing, feature = "postgres"))]
pub mod fuzzing;
mod metrics;
mod process_memory;
mod random_id;
mod worker;

pub use catalogue_pages::CataloguePages;
pub use door::{AgentDoor, CertificateFiles, EngineSettings, LakeServer, ServerSettings};
pub use echolake_access::tokens;
pub use echolake_service::{EngineRole, Error};
pub use worker::{LakeWorker, WorkerSettings, program_build};
