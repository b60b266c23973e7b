//! The lake: its location, its configuration, its commit log, and the part of it that a reader may see.
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

mod config;
mod durable;
mod error;
mod lake;
mod location;
#[cfg(feature = "tables")]
mod tables;

pub use config::{LAKE_FORMAT, LakeConfig, References};
pub use error::{Error, StoreError};
pub use lake::Lake;
#[cfg(feature = "tables")]
pub use tables::{
    Commit, CommitLog, Committed, DataFile, Deletion, Effect, EncodedFile, FileEncoder, FileName, FileStats, Freed,
    History, KEEP_HOURS, Merging, Moment, NewFile, NoMoment, Optimized, Part, Replaces, Snapshot, Staged, TARGET_BYTES,
    TableOptimized, TableVersion, Vacuumed, VisibleRun, encode,
};

/// The result of what a lake does.
pub type Result<T> = std::result::Result<T, Error>;
