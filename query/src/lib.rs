//! SQL over the lake's tables: read-only, one snapshot of the lake per query.
//!
//! ```
//! use echolake_lake::{Lake, ReferenceSurfaces};
//! use echolake_query::Session;
//! use echolake_query::output::{AnswerFormat, AnswerWriter};
//! use echolake_schema::Rig;
//!
//! # tokio::runtime::Runtime::new()?.block_on(async {
//! let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
//! let session = Session::new(&lake)?;
//! let mut answer = session.query("select pair_id, direct_mm from pairs order by pair_id limit 2").await?;
//! let mut csv = Vec::new();
//! let mut writer = AnswerWriter::new(AnswerFormat::Csv, &answer.schema, &mut csv)?;
//! while let Some(batch) = answer.next().await? {
//!     writer.write(&batch)?;
//! }
//! assert_eq!(writer.finish()?, 2);
//! assert_eq!(csv, b"pair_id,direct_mm\n0,75.0\n1,150.0\n");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! # })?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod catalog;
mod client;
mod contributions;
mod control;
mod engine;
mod error;
pub mod figure_rows;
mod listed_verdicts;
mod literal_batches;
mod opaque;
pub mod output;
mod overlay_schema;
mod plan_transport;
mod request_memory;
mod session;
mod sorted_join;
mod spread;
mod statement;
mod system;
mod views;

pub use client::{EngineClient, QueryPermit, QueryQuota};
pub use control::blame::StatementBlame;
pub use control::continue_request;
pub use control::threads::{QueryThreads, stack_bytes};
pub use echolake_lake_tables::RowReading;
pub use echolake_mcap_tables::{Attachment, Contents, Topic};
pub use engine::{EngineLimits, QueryEngine, SqlFunction};
pub use error::{Error, OUT_OF_RANGE, QueryPlace};
pub use opaque::OpaqueValue;
pub use plan_transport::check_transport;
pub use request_memory::RequestMemory;
pub use session::{CancelHandle, ContextExtension, PreparedQuery, QueryAnswer, Session};
pub use spread::{
    ClusterSettings, SpreadCounts, WorkerCluster, WorkerFault, WorkerFigures, WorkerLink, WorkerService, WorkerState,
    WorkerToken,
};
pub use statement::{
    PredicateForm, check_statement_bounds, is_blank_statement, split_statement, walk_expr, walk_statement,
};
pub use system::{SYSTEM_SCHEMA, SystemSource};
pub use views::table_meaning;
