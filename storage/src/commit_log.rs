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

/// A file about to be registered; its bytes are already in the store. Its name is its application transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewFile {
    /// Name in the table's folder.
    pub name: String,
    /// Size.
    pub bytes: u64,
    /// Delta's statistics, JSON.
    pub stats: String,
    /// What it takes the place of, where it does.
    pub replaces: Option<Replaces>,
}

/// The files that a new one takes the place of. Where others stand there by now, it is not added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replaces {
    /// What the names of all files in that place begin with.
    pub prefix: String,
    /// The names that are expected there; they go with the same commit.
    pub names: Vec<String>,
}

/// One change of one table: all of it or nothing.
#[derive(Debug, Clone, Default)]
pub struct Commit {
    /// Files that come.
    pub add: Vec<NewFile>,
    /// Files that go; one that is already gone is passed over.
    pub remove: Vec<Path>,
}

/// What became of a new file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Committed {
    /// It is in the log now.
    Now,
    /// It was there before.
    Before,
    /// It was to replace what is no longer there, and is not in the log.
    Outdated,
}

/// A log of each table's files, with atomic commits of one table.
#[async_trait]
pub trait CommitLog: Send + Sync + std::fmt::Debug {
    /// Makes the table where it is missing.
    async fn ensure(&self, table: Table) -> Result<()>;
    /// The table's files as of now; none where there is no table.
    async fn files(&self, table: Table) -> Result<Vec<DataFile>>;
    /// Whether a file of this name is in the log.
    async fn has(&self, table: Table, name: &str) -> Result<bool>;
    /// Makes a change; says for each new file, in order, what became of it. The same change again adds nothing.
    async fn commit(&self, table: Table, commit: &Commit) -> Result<Vec<Committed>>;
}
