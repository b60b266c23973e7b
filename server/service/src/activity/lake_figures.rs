//! Figures of the lake, for `/metrics`. An engine that waits for a client reads them: the door decodes no log.

use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::tables::Table;
use serde::{Deserialize, Serialize};

/// Figures of the lake.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LakeFigures {
    /// Version of the lake, which is that of `runs`.
    pub version: u64,
    /// Surfaces.
    pub surfaces: u64,
    /// Runs.
    pub runs: u64,
    /// Runs with messages that `ingest` could not read.
    pub damaged_runs: u64,
    /// Bytes of the tables' files.
    pub table_bytes: u64,
    /// Run files that wait for ingest.
    pub inbox: FolderFigures,
    /// Run files that were refused.
    pub quarantine: FolderFigures,
}

/// Run files of a folder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FolderFigures {
    /// Number of files.
    pub files: u64,
    /// Bytes of these files.
    pub bytes: u64,
}

impl LakeFigures {
    /// Counts what a snapshot and the two folders hold, besides the damaged runs, which a query has counted.
    ///
    /// # Errors
    /// The store does not list a folder.
    pub async fn from_lake(lake: &Lake, snapshot: &LakeSnapshot, damaged_runs: u64) -> echolake_lake::Result<Self> {
        let bytes = |table: Table| snapshot.files(table).iter().map(|file| file.bytes).sum::<u64>();
        Ok(Self {
            version: snapshot.log_version(Table::Runs).unwrap_or(0),
            surfaces: snapshot.files(Table::Surfaces).iter().map(|file| file.visible_rows()).sum(),
            runs: snapshot.runs().count() as u64,
            damaged_runs,
            table_bytes: Table::ALL.into_iter().map(bytes).sum(),
            inbox: FolderFigures::from_folder(lake, "inbox").await?,
            quarantine: FolderFigures::from_folder(lake, "quarantine").await?,
        })
    }
}

impl FolderFigures {
    async fn from_folder(lake: &Lake, folder: &str) -> echolake_lake::Result<Self> {
        let listing = lake.list_folder(folder).await?;
        let runs = listing.files.iter().filter(|object| object.location.as_ref().ends_with(".mcap"));
        Ok(runs.fold(Self::default(), |sum, object| Self { files: sum.files + 1, bytes: sum.bytes + object.size }))
    }
}
