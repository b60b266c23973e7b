//! The lake over HTTP, Arrow Flight SQL and Postgres wire: three doors to one query engine, which only reads.
//!
//! ```no_run,standalone_crate
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let server = echolake_server::Server::bind(&lake, echolake_server::Settings::default()).await?;
//! for address in server.addresses() {
//!     eprintln!("{address}");
//! }
//! server.run(std::future::pending()).await?;
//! # Ok(())
//! # }
//! ```

mod catalogue_pages;
mod error;
mod fault;
mod flight;
mod http;
mod metrics;
mod places;
mod postgres;
mod random;
mod running;
mod serve;
mod service;
mod sessions;
pub mod tokens;

pub use catalogue_pages::CataloguePages;
pub use error::Error;
pub use serve::{Server, Settings};
