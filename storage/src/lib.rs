//! The lake: its location, its configuration, its commit log, and the part of it that a reader may see.
//!
//! ```
//! use echolake_lake::{Lake, ReferenceSurfaces};
//! use echolake_schema::{Rig, tables::Table};
//!
//! # let folder = tempfile::tempdir()?;
//! # let url = folder.path().join("lake").display().to_string();
//! # tokio::runtime::Runtime::new()?.block_on(async {
//! let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await?;
//! let snapshot = lake.snapshot().await?;
//! assert_eq!(snapshot.files(Table::Pairs)[0].rows, 2951);
//! assert!(snapshot.files(Table::Runs).is_empty());
//! # Ok::<(), echolake_lake::Error>(())
//! # })?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod config;
#[cfg(feature = "tables")]
mod contribution_objects;
#[cfg(feature = "tables")]
mod contributions;
mod durable;
mod error;
mod folder_listing;
mod lake;
mod location;
mod location_text;
#[cfg(feature = "tables")]
mod locks;
#[cfg(feature = "remote")]
mod remote;
#[cfg(feature = "remote")]
mod run_digest;
#[cfg(feature = "tables")]
mod tables;
mod unused;
#[cfg(feature = "remote")]
mod upload;

pub use config::{DirectSound, LAKE_FORMAT, LakeConfig, ReferenceSurfaces, SamplePrecision};
#[cfg(feature = "tables")]
pub use contributions::{ContributedFile, ContributedPart, annotation_rows};
pub use error::{Error, StoreError};
pub use folder_listing::{FolderListing, UnusableEntry};
pub use lake::Lake;
#[cfg(feature = "tables")]
pub use locks::{ClaimOutcome, ClaimTimes, WorkClaims};
#[cfg(feature = "tables")]
pub use remote::{CACHE_MEMORY_BYTES, CacheCounters, CacheCounts, CacheFolder, ObjectFolder};
#[cfg(feature = "remote")]
pub use remote::{RemoteAccess, remote_access};
#[cfg(feature = "remote")]
pub use run_digest::{digest_record, digest_record_path, file_sha256, object_sha256, read_digest_record};
#[cfg(feature = "tables")]
pub use tables::{
    BatchBuilder, CommitEffect, CommitLog, CommitOutcome, DataFile, DeletedFile, DeletionMode, EncodedFile,
    EncodedRows, FileEncoder, FileGroup, FileHistory, FileName, FileStats, GivenUpRows, KEEP_HOURS, LackingRows,
    LakeMoment, LakeSnapshot, LakeTag, LoggedFile, MergeProgress, NewFile, NoMoment, OptimizeReport, ReferenceNames,
    RemovalRecord, ReplacedFiles, RunPart, RunRowCounts, StagedFile, StagedRows, SurfaceReferences, TARGET_BYTES,
    TableChange, TableCommit, TableOptimizeReport, TableVersion, TableView, TagName, VacuumReport, VisibleRun,
    add_missing_columns, encode_batches, encode_run_rows, reader_metadata, verdict_mark, wanted_schema,
};
#[cfg(feature = "remote")]
pub use upload::{RunUpload, UploadOutcome, UploadStep};

/// The result of what a lake does.
pub type Result<T> = std::result::Result<T, Error>;
