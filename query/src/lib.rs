//! SQL over the lake's tables: reading only, one frozen view of the lake a query.
//!
//! ```no_run
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let session = echolake_query::Session::new(&lake)?;
//! let mut answer = session.query("select surface_id, state from runs").await?;
//! println!("{} columns", answer.schema.fields().len());
//! while let Some(batch) = answer.next().await? {
//!     println!("{} rows more", batch.num_rows());
//! }
//! # Ok(())
//! # }
//! ```

mod catalog;
mod engine;
mod error;
mod gate;
mod mcap;
pub mod output;
mod session;
mod table;

pub use engine::{Client, Engine, Quota};
pub use error::Error;
pub use session::{Answer, Extend, Prepared, Session};
