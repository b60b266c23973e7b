//! The lake: where it is, what it is configured for, its commit log, and what a reader may see of it.
//!
//! ```
//! use echolake_lake::{Lake, References};
//! use echolake_schema::{Rig, tables::Table};
//!
//! # let folder = tempfile::tempdir()?;
//! # let url = folder.path().join("lake").display().to_string();
//! # tokio::runtime::Runtime::new()?.block_on(async {
//! let lake = Lake::open_or_create(&url, &Rig::paper(), &References::default()).await?;
//! let snapshot = lake.snapshot().await?;
//! assert_eq!(snapshot.files(Table::Pairs)[0].rows, 2951);
//! assert!(snapshot.files(Table::Runs).is_empty());
//! # Ok::<(), echolake_lake::Error>(())
//! # })?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod commit_log;
mod config;
mod data_file;
mod delta;
mod durable;
mod error;
mod lake;
mod lease;
mod location;
mod optimize;
mod rig_tables;
mod rows;
mod snapshot;
mod vacuum;
mod versions;

pub use commit_log::{Commit, CommitLog, Committed, DataFile, Effect, FileStats, History, NewFile, Part, Replaces};
pub use config::{LAKE_FORMAT, LakeConfig, References};
pub use data_file::{EncodedFile, FileEncoder, encode};
pub use error::{Error, StoreError};
pub use lake::{Lake, Staged};
pub use optimize::{Merging, Optimized, TARGET_BYTES, TableOptimized};
pub use snapshot::{FileName, Snapshot, VisibleRun};
pub use vacuum::{Deletion, Freed, KEEP_HOURS, Vacuumed};
pub use versions::{Moment, NoMoment, TableVersion};

/// The result of what a lake does.
pub type Result<T> = std::result::Result<T, Error>;
