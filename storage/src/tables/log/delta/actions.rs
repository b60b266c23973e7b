//! The actions of Delta's log, as the protocol names them: a line of a commit, or a row of a checkpoint, holds one.
//!
//! Source: "Delta Transaction Log Protocol", sections Actions and Checkpoint Schema,
//! github.com/delta-io/delta/blob/master/PROTOCOL.md.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Text by text; the protocol allows null values.
pub(super) type TextMap = BTreeMap<String, Option<String>>;

/// One line of a commit, or one row of a checkpoint: the one action that is there.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct LogLine {
    /// Provenance; readers take the time from it. A commit's first line, and in no checkpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub commit_info: Option<Value>,
    /// Versions of the protocol that the table needs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub protocol: Option<ProtocolVersions>,
    /// Schema and settings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub meta_data: Option<TableMetadata>,
    /// An application's progress: the number of a log of contributions, or that of another program.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub txn: Option<ApplicationTransaction>,
    /// A file that comes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub add: Option<AddFile>,
    /// A file that goes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remove: Option<RemoveFile>,
}

/// The protocol that a table needs of those who read and of those who write it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct ProtocolVersions {
    pub min_reader_version: i32,
    pub min_writer_version: i32,
}

/// A table's schema and settings.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct TableMetadata {
    pub id: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
    pub format: FileFormat,
    /// The schema, JSON in a string.
    pub schema_string: String,
    #[serde(default)]
    pub partition_columns: Vec<String>,
    #[serde(default)]
    pub configuration: TextMap,
    /// Milliseconds since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub created_time: Option<i64>,
}

/// The format of a table's files: Parquet.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct FileFormat {
    pub provider: String,
    #[serde(default)]
    pub options: TextMap,
}

/// Progress that an application records of itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct ApplicationTransaction {
    pub app_id: String,
    pub version: i64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_updated: Option<i64>,
}

/// A file that comes into the table.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct AddFile {
    /// Its place below the table's folder, percent-encoded.
    pub path: String,
    #[serde(default)]
    pub partition_values: TextMap,
    /// Bytes.
    pub size: i64,
    /// Milliseconds since 1970.
    pub modification_time: i64,
    pub data_change: bool,
    /// JSON in a string.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stats: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tags: Option<TextMap>,
}

/// A file that goes out of the table; its bytes stay for readers of older versions.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct RemoveFile {
    pub path: String,
    /// Milliseconds since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deletion_timestamp: Option<i64>,
    pub data_change: bool,
    /// True if the two fields below are given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub extended_file_metadata: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub partition_values: Option<TextMap>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<i64>,
}

impl AddFile {
    /// The removal of this file at a time in milliseconds since 1970.
    pub fn removed_at(&self, now_millis: i64, data_change: bool) -> RemoveFile {
        RemoveFile {
            path: self.path.clone(),
            deletion_timestamp: Some(now_millis),
            data_change,
            extended_file_metadata: Some(true),
            partition_values: Some(self.partition_values.clone()),
            size: Some(self.size),
        }
    }
}
