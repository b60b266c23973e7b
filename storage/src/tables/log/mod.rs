//! The log of each table's commits.

mod commit_log;
mod delta;
mod project_log;

pub use commit_log::{
    CommitEffect, CommitLog, CommitOutcome, DataFile, FileHistory, FileStats, LoggedFile, NewFile, RemovalRecord,
    ReplacedFiles, RunPart, RunRowCounts, TableChange, TableCommit, TableVersion, TableView,
};
pub(crate) use delta::{DeltaLog, has_run_files};
pub(crate) use project_log::ProjectLog;
