//! What the lake asks of a commit log. Delta stands behind it; see `delta.rs`.

use async_trait::async_trait;
use chrono::{DateTime, Utc};
use echolake_schema::tables::Table;
use object_store::path::Path;
use serde_json::{Map, Value};

use crate::Result;

/// A Parquet file of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct DataFile {
    /// Path in the lake.
    pub path: Path,
    /// Size.
    pub bytes: u64,
    /// Rows.
    pub rows: u64,
    /// When it was made.
    pub modified: DateTime<Utc>,
    /// Least and greatest values, where the log has them.
    pub stats: Option<FileStats>,
}

/// Least and greatest values of a file's columns, by name, as in Delta's log.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FileStats {
    /// Least values.
    pub min: Map<String, Value>,
    /// Greatest values.
    pub max: Map<String, Value>,
}

/// A file about to be registered; its bytes are already in the store.
#[derive(Debug, Clone)]
pub struct NewFile {
    /// Name in the table's folder.
    pub name: String,
    /// Size.
    pub bytes: u64,
    /// Delta's statistics, JSON.
    pub stats: String,
}

/// One change of one table.
#[derive(Debug, Clone)]
pub struct Commit {
    /// The application transaction: a change with an id that is already in the log is not made again.
    /// None for a change that may be repeated without harm.
    pub transaction: Option<String>,
    /// Files that come.
    pub add: Vec<NewFile>,
    /// Files that go; one that is already gone is passed over.
    pub remove: Vec<Path>,
}

/// How a commit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Committed {
    /// It is in the log now.
    Now,
    /// It was there before.
    Before,
}

/// A log of each table's files, with atomic commits of one table.
#[async_trait]
pub trait CommitLog: Send + Sync + std::fmt::Debug {
    /// Makes the table where it is missing.
    async fn ensure(&self, table: Table) -> Result<()>;
    /// The table's files as of now; none where there is no table.
    async fn files(&self, table: Table) -> Result<Vec<DataFile>>;
    /// Whether a commit with this transaction id was made.
    async fn has(&self, table: Table, transaction: &str) -> Result<bool>;
    /// Makes a change, once.
    async fn commit(&self, table: Table, commit: Commit) -> Result<Committed>;
}
