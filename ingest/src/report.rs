//! What an ingest reports of each file.

use echolake_schema::{RunId, SurfaceId};
use object_store::path::Path;
use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::inbox::RunSource;

/// Result of the ingest of one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IngestedRun {
    /// The run.
    #[serde(rename = "run_id")]
    pub run: RunId,
    /// Its surface.
    #[serde(rename = "surface_id")]
    pub surface: SurfaceId,
    /// Measurements in the table.
    pub measurements: usize,
    /// True if its derived rows are in the lake, too.
    pub derived: bool,
    /// Missing references, separated by commas; empty if none is missing.
    pub missing: String,
    /// Its outcome; in JSON the boolean `added`.
    #[serde(rename = "added")]
    pub outcome: IngestOutcome,
    /// Descriptions of what could not be read.
    pub damaged: Vec<String>,
    /// True if the file was closed and records how the run ended.
    pub whole: bool,
    /// True if the run was stopped before its end and nothing that was recorded is lost.
    pub stopped: bool,
    /// True if the lake had a shorter file of the run, with the same beginning and without an end, or a damaged one.
    #[serde(default)]
    pub replaced: bool,
    /// True if it was in the lake before and rows of it were missing, which are derived again.
    #[serde(default)]
    pub mended: bool,
}

/// Outcome of an ingest: the run is new, or was in the lake before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "bool", into = "bool")]
pub enum IngestOutcome {
    /// It is in the lake now.
    Added,
    /// It was in the lake before; nothing was added.
    Known,
}

impl From<bool> for IngestOutcome {
    fn from(is_added: bool) -> Self {
        if is_added { Self::Added } else { Self::Known }
    }
}

impl From<IngestOutcome> for bool {
    fn from(outcome: IngestOutcome) -> Self {
        outcome == IngestOutcome::Added
    }
}

/// Report on one file.
#[derive(Debug)]
pub enum FileReport {
    /// It is in the tables.
    Ingested(IngestedRun),
    /// It cannot be ingested, now or later.
    Refused {
        /// The file.
        source: RunSource,
        /// The cause.
        why: Error,
        /// Its new path, if it was moved.
        moved: Option<Path>,
    },
    /// Another ingest has moved it meanwhile.
    Gone(RunSource),
    /// Another ingest is at it; this one waits for its end. Another report follows.
    Claimed(RunSource),
}
