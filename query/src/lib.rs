//! SQL over the lake's tables: read-only, one snapshot of the lake per query.
//!
//! ```no_run,standalone_crate
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

mod as_of;
mod catalog;
mod control;
mod engine;
mod error;
mod functions;
mod gate;
mod mcap;
mod opaque;
pub mod output;
mod predicate;
mod session;
mod small;
mod statement_bounds;
mod table;
mod views;

pub use control::threads::QueryThreads;
pub use engine::{EngineClient, EngineLimits, QueryEngine, QueryPermit, QueryQuota, SqlFunction};
pub use error::Error;
pub use functions::FunctionSet;
pub use mcap::{Attachment, Contents, Topic};
pub use opaque::OpaqueValue;
pub use predicate::PredicateForm;
pub use session::{CancelHandle, ContextExtension, PreparedQuery, QueryAnswer, Session};
pub use statement_bounds::check_statement_bounds;
