//! SQL over the lake's tables: reading only, one frozen view of the lake a query.
//!
//! ```no_run
//! use futures::TryStreamExt as _;
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let session = echolake_query::Session::new(&lake)?;
//! let rows = session.query("select surface_id, state from runs").await?;
//! println!("{} columns", rows.schema.fields().len());
//! let batches: Vec<_> = rows.batches.try_collect().await?;
//! # Ok(())
//! # }
//! ```

mod error;
pub mod output;
mod session;
mod table;

pub use error::Error;
pub use session::{Answer, Session};
