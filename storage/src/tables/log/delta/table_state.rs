//! A table's state in its log up to a version: the actions, reconciled.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use echolake_schema::tables::Table;
use serde_json::Value;

use super::actions::{AddFile, ApplicationTransaction, LogLine, ProtocolVersions, RemoveFile, TableMetadata};
use crate::contributions::{ShownVersion, ShownVersions};
use crate::{DataFile, Result};

/// Time for which a checkpoint keeps a removed file's tombstone: Delta's default, a week.
const TOMBSTONE_MILLIS: i64 = 7 * 24 * 3600 * 1000;

/// A table's state up to a version of its log. Files are keyed by their paths as the log spells them.
#[derive(Debug, Clone, Default)]
pub(super) struct TableState {
    /// The newest version that was applied.
    pub version: u64,
    pub protocol: Option<ProtocolVersions>,
    pub metadata: Option<TableMetadata>,
    pub files: BTreeMap<Arc<str>, Arc<TableFile>>,
    pub removed: BTreeMap<String, Arc<RemoveFile>>,
    transactions: BTreeMap<String, ApplicationTransaction>,
    /// Another program has added or removed files since this one last wrote the metadata.
    is_changed_by_others: bool,
}

/// A file of a table. Later states of the table share it, so that its statistics are decoded once.
#[derive(Debug)]
pub(super) struct TableFile {
    pub add: AddFile,
    decoded: OnceLock<Arc<DataFile>>,
}

impl TableFile {
    fn new(add: AddFile) -> Self {
        Self { add, decoded: OnceLock::new() }
    }

    /// Returns the file as readers see it, which `decode` makes of its action unless an earlier call did.
    pub fn decode_once(&self, decode: impl FnOnce(&AddFile) -> Result<DataFile>) -> Result<Arc<DataFile>> {
        if let Some(known) = self.decoded.get() {
            return Ok(known.clone());
        }
        let decoded = Arc::new(decode(&self.add)?);
        Ok(self.decoded.get_or_init(|| decoded).clone())
    }
}

/// The setting of a table's metadata that says that it is being made again, or that another program changed its files.
const REBUILD: &str = "echolake.rebuild";
/// The setting that this program's checkpoints have: their version. Those of others repeat an earlier one, or have
/// none.
const CHECKED: &str = "echolake.checkpoint";
/// The application of Delta's action `txn` in a table of users whose version is the highest number of an object of the
/// lake's earlier form that is in the table.
pub(super) const COPIED: &str = "echolake.copied";
/// The beginning of `engineInfo` in commits of this program.
pub(super) const ENGINE: &str = "echolake/";

/// The application of Delta's action `txn` in `runs` whose version is the table's version that readers see.
pub(super) fn shown_application(table: Table) -> String {
    format!("echolake.shown.{}", table.name())
}

/// The same of the highest number of an object of the lake's earlier form.
pub(super) fn objects_application(table: Table) -> String {
    format!("echolake.{}", table.name())
}

impl TableState {
    /// Applies the actions of a version, or of a checkpoint.
    pub fn apply_lines(&mut self, version: u64, lines: Vec<LogLine>) {
        self.version = version;
        for line in lines {
            self.apply_line(line);
        }
    }

    /// Applies the actions of a version, and looks at whose they are.
    pub fn apply_commit(&mut self, version: u64, lines: Vec<LogLine>) {
        self.look_at_author(&lines);
        self.apply_lines(version, lines);
    }

    /// Looks at whose a commit is that may have been applied with a checkpoint.
    pub fn look_at_author(&mut self, lines: &[LogLine]) {
        match is_own_commit(lines) {
            true if lines.iter().any(|line| line.meta_data.is_some()) => self.is_changed_by_others = false,
            false if lines.iter().any(|line| line.add.is_some() || line.remove.is_some()) => {
                self.is_changed_by_others = true;
            }
            _ => {}
        }
    }

    /// Returns whether this program wrote the checkpoint of this version, which is all that was applied.
    pub fn is_own_checkpoint(&self, version: u64) -> bool {
        let checked = self.metadata.as_ref().and_then(|metadata| metadata.configuration.get(CHECKED)?.as_ref());
        checked.is_some_and(|checked| *checked == version.to_string())
    }

    /// Of `runs`: what readers see of the tables of users.
    pub fn shown_versions(&self) -> ShownVersions {
        let shown = |table: Table| ShownVersion {
            table: self.transaction(&shown_application(table)),
            objects: self.transaction(&objects_application(table)),
        };
        ShownVersions { annotations: shown(Table::Annotations), predictions: shown(Table::Predictions) }
    }

    /// Of a table of users: the highest number of an object of the lake's earlier form that is in it.
    pub fn copied_objects(&self) -> u64 {
        self.transaction(COPIED)
    }

    fn transaction(&self, application: &str) -> u64 {
        let known = self.transactions.get(application);
        known.and_then(|transaction| u64::try_from(transaction.version).ok()).unwrap_or(0)
    }

    /// Returns whether rows may be missing: the table is being made again, or another program has changed its files.
    pub fn is_rebuilding(&self) -> bool {
        let is_marked = |metadata: &TableMetadata| metadata.configuration.contains_key(REBUILD);
        self.is_changed_by_others || self.metadata.as_ref().is_some_and(is_marked)
    }

    /// The metadata with or without the mark of a rebuild.
    pub fn metadata_marked(&self, is_rebuilding: bool) -> Option<TableMetadata> {
        let mut metadata = self.metadata.clone()?;
        mark_rebuild(&mut metadata, is_rebuilding);
        Some(metadata)
    }

    /// Applies the actions of a version but for removals.
    pub fn apply_additions(&mut self, version: u64, lines: Vec<LogLine>) {
        self.apply_lines(version, lines.into_iter().map(|line| LogLine { remove: None, ..line }).collect());
    }

    fn apply_line(&mut self, line: LogLine) {
        if let Some(add) = line.add {
            self.removed.remove(&add.path);
            self.files.insert(add.path.as_str().into(), Arc::new(TableFile::new(add)));
        }
        if let Some(remove) = line.remove {
            self.files.remove(remove.path.as_str());
            self.removed.insert(remove.path.clone(), Arc::new(remove));
        }
        if let Some(transaction) = line.txn {
            self.transactions.insert(transaction.app_id.clone(), transaction);
        }
        self.protocol = line.protocol.or(self.protocol.take());
        self.metadata = line.meta_data.or(self.metadata.take());
    }

    /// The rows of a checkpoint of this version.
    pub fn checkpoint_lines(&self, now_millis: i64) -> Vec<LogLine> {
        let line = LogLine::default;
        let mut meta_data = self.metadata_marked(self.is_rebuilding());
        if let Some(metadata) = &mut meta_data {
            metadata.configuration.insert(CHECKED.to_owned(), Some(self.version.to_string()));
        }
        let header = [LogLine { protocol: self.protocol.clone(), ..line() }, LogLine { meta_data, ..line() }];
        let transactions = self.transactions.values().map(|txn| LogLine { txn: Some(txn.clone()), ..line() });
        let added = self.files.values().map(|file| {
            let add = AddFile { data_change: false, ..file.add.clone() };
            LogLine { add: Some(add), ..line() }
        });
        let kept = self
            .removed
            .values()
            .filter(|r| r.deletion_timestamp.is_some_and(|at| now_millis.saturating_sub(at) < TOMBSTONE_MILLIS));
        let removed = kept.map(|remove| {
            let remove = RemoveFile { data_change: false, ..remove.as_ref().clone() };
            LogLine { remove: Some(remove), ..line() }
        });
        header.into_iter().chain(transactions).chain(added).chain(removed).collect()
    }
}

/// Returns whether this program wrote the commit.
pub(super) fn is_own_commit(lines: &[LogLine]) -> bool {
    let engine = |info: &Value| info.get("engineInfo").and_then(Value::as_str).is_some_and(|by| by.starts_with(ENGINE));
    lines.iter().any(|line| line.commit_info.as_ref().is_some_and(engine))
}

/// Marks a table as being made again, or takes the mark away.
pub(super) fn mark_rebuild(metadata: &mut TableMetadata, is_rebuilding: bool) {
    match is_rebuilding {
        true => drop(metadata.configuration.insert(REBUILD.to_owned(), Some("true".to_owned()))),
        false => drop(metadata.configuration.remove(REBUILD)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(json: &str) -> LogLine {
        serde_json::from_str(json).expect("a line")
    }

    #[test]
    fn changes_by_others_are_remembered_until_the_metadata_say_that_they_are_mended() {
        let own = r#"{"commitInfo":{"engineInfo":"echolake/1.0.0"}}"#;
        let other = r#"{"commitInfo":{"engineInfo":"delta-rs:py-1.5.0","operation":"DELETE"}}"#;
        let metadata = r#"{"metaData":{"id":"x","format":{"provider":"parquet","options":{}},"schemaString":"{}"}}"#;
        let add = r#"{"add":{"path":"a","partitionValues":{},"size":1,"modificationTime":1,"dataChange":true}}"#;
        let remove = r#"{"remove":{"path":"a","deletionTimestamp":1000,"dataChange":true}}"#;
        let mut state = TableState::default();
        let mut check = |lines: &[&str], expected: bool| {
            state.apply_commit(state.version + 1, lines.iter().map(|json| line(json)).collect());
            assert_eq!(state.is_rebuilding(), expected, "{lines:?}");
            let mut from_checkpoint = TableState::default();
            from_checkpoint.apply_lines(state.version, state.checkpoint_lines(0));
            assert_eq!(from_checkpoint.is_rebuilding(), expected, "{lines:?}, from a checkpoint");
        };
        check(&[own, metadata, add], false);
        check(&[other], false);
        check(&[other, remove], true);
        check(&[own, add], true);
        check(&[own, metadata], false);
    }

    #[test]
    fn later_actions_win_and_a_checkpoint_says_the_same() {
        let mut state = TableState::default();
        state.apply_lines(
            0,
            vec![
                line(r#"{"commitInfo":{"timestamp":1}}"#),
                line(r#"{"protocol":{"minReaderVersion":1,"minWriterVersion":2}}"#),
                line(r#"{"metaData":{"id":"x","format":{"provider":"parquet","options":{}},"schemaString":"{}"}}"#),
                line(r#"{"add":{"path":"a","partitionValues":{},"size":1,"modificationTime":1,"dataChange":true}}"#),
                line(r#"{"add":{"path":"b","partitionValues":{},"size":2,"modificationTime":1,"dataChange":true}}"#),
            ],
        );
        state.apply_lines(
            1,
            vec![
                line(r#"{"remove":{"path":"a","deletionTimestamp":1000,"dataChange":true}}"#),
                line(r#"{"remove":{"path":"b","deletionTimestamp":1000,"dataChange":true}}"#),
                line(r#"{"txn":{"appId":"spark","version":7}}"#),
                line(r#"{"unknown":{"to":"this version"}}"#),
            ],
        );
        let again = r#"{"add":{"path":"b","partitionValues":{},"size":3,"modificationTime":2,"dataChange":true}}"#;
        state.apply_lines(2, vec![line(again)]);
        let check = |state: &TableState, removed: &[&str]| {
            assert_eq!(state.files.values().map(|f| (f.add.path.as_str(), f.add.size)).collect::<Vec<_>>(), [("b", 3)]);
            assert_eq!(state.removed.keys().map(String::as_str).collect::<Vec<_>>(), removed);
            assert_eq!(state.transactions["spark"].version, 7);
            assert!(state.protocol.is_some() && state.metadata.is_some());
        };
        check(&state, &["a"]);
        for (now, removed) in [(1000 + TOMBSTONE_MILLIS - 1, &["a"][..]), (1000 + TOMBSTONE_MILLIS, &[])] {
            let mut from_checkpoint = TableState::default();
            from_checkpoint.apply_lines(2, state.checkpoint_lines(now));
            check(&from_checkpoint, removed);
        }
    }
}
