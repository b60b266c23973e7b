//! The files of one table's `_delta_log`: a JSON file per version, and checkpoints.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::RangeInclusive;
use std::sync::Arc;

use chrono::{DateTime, TimeDelta, Utc};
use echolake_schema::ErrorCause;
use echolake_schema::tables::Table;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};
use serde_json::{Value, json};

use super::actions::LogLine;
use super::checkpoint::{decode_checkpoint, encode_checkpoint};
use super::commit_files::{commit_name, commit_number, list_versions};
use super::table_state::{TableState, is_own_commit};
use crate::error::rebuild_hint;
use crate::tables::file_name::table_folder;
use crate::tables::tags::has_tags;
use crate::{Error, Result, TableChange, TableVersion};

/// The newest version of the protocol that this reads.
const READER_VERSION: i32 = 1;
/// The newest version of the protocol that this writes.
const WRITER_VERSION: i32 = 2;
/// Versions from one checkpoint to the next.
const CHECKPOINT_INTERVAL: u64 = 20;
/// Time for which versions before a checkpoint are kept: Delta's default, 30 days.
const LOG_RETENTION: TimeDelta = TimeDelta::days(30);
/// Commits that are read at once.
const CONCURRENT_READS: usize = 16;
/// The field of a commit's `commitInfo` that holds the number of its lines: a file that lost some at its end says so.
const LINES: &str = "echolakeLines";
/// The file that names the newest checkpoint for readers.
const LAST_CHECKPOINT: &str = "_last_checkpoint";

/// One table's log folder.
pub(super) struct LogFolder<'a> {
    table: Table,
    path: Path,
    store: &'a dyn ObjectStore,
}

/// Outcome of an attempt to write a version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CommitAttempt {
    /// The version is ours.
    Written,
    /// Another writer has taken the number.
    Taken,
}

/// Contents of a log folder.
#[derive(Debug, Default)]
struct LogListing {
    commits: BTreeSet<u64>,
    /// The parts of each checkpoint, and how many there should be.
    checkpoints: BTreeMap<u64, CheckpointFiles>,
    modified: BTreeMap<Path, DateTime<Utc>>,
}

#[derive(Debug, Default)]
struct CheckpointFiles {
    files: BTreeSet<Path>,
    expected: usize,
}

impl<'a> LogFolder<'a> {
    pub fn new(table: Table, store: &'a dyn ObjectStore) -> Self {
        Self { table, path: table_folder(table).join("_delta_log"), store }
    }

    /// The table at its newest version, or at the given one; None if it has no log.
    pub async fn load_state(&self, at: Option<u64>) -> Result<Option<TableState>> {
        let listing = self.list_log().await?;
        let Some(newest) = listing.newest_version() else { return Ok(None) };
        let last = at.unwrap_or(newest).min(newest);
        let mut state = TableState::default();
        let next = match listing.checkpoint_before(last) {
            Some((version, checkpoint)) => {
                let next = self.apply_checkpoint(&mut state, version, checkpoint).await?;
                if self.table == Table::Runs && !state.is_own_checkpoint(version) {
                    self.look_at_authors(&mut state, &listing, version).await;
                }
                next
            }
            None => 0,
        };
        self.apply_commits(&mut state, next..=last, TableState::apply_commit).await?;
        self.check_readable(&state)?;
        Ok(Some(state))
    }

    /// The table at its newest version, with the files of all versions that the log still holds.
    pub async fn load_all_versions(&self) -> Result<Option<TableState>> {
        let listing = self.list_log().await?;
        let Some(newest) = listing.newest_version() else { return Ok(None) };
        let mut state = TableState::default();
        let next = match listing.checkpoints.first_key_value() {
            Some((version, checkpoint)) if !listing.commits.contains(&0) => {
                self.apply_checkpoint(&mut state, *version, checkpoint).await?
            }
            _ => 0,
        };
        self.apply_commits(&mut state, next..=newest, TableState::apply_additions).await?;
        self.check_readable(&state)?;
        Ok(Some(state))
    }

    // Another program's checkpoint does not say that it has removed files before. Commits that cannot be read are not
    // needed.
    async fn look_at_authors(&self, state: &mut TableState, listing: &LogListing, checkpoint: u64) {
        let first = checkpoint.saturating_sub(2 * CHECKPOINT_INTERVAL);
        for version in listing.commits.range(first..=checkpoint) {
            if let Ok(Some(lines)) = self.read_commit(*version).await {
                state.look_at_author(&lines);
            }
        }
    }

    // Returns the version behind the checkpoint.
    async fn apply_checkpoint(
        &self,
        state: &mut TableState,
        version: u64,
        checkpoint: &CheckpointFiles,
    ) -> Result<u64> {
        for file in &checkpoint.files {
            state.apply_lines(version, self.read_checkpoint(file).await?);
        }
        Ok(version + 1)
    }

    async fn apply_commits(
        &self,
        state: &mut TableState,
        versions: RangeInclusive<u64>,
        apply: impl Fn(&mut TableState, u64, Vec<LogLine>),
    ) -> Result<()> {
        let commits = futures::stream::iter(versions).map(|version| async move {
            let lines = self.read_commit(version).await?;
            let missing = || self.damage_error(&format!("version {version} is missing, `{}`", commit_name(version)));
            Ok::<_, Error>((version, lines.ok_or_else(missing)?))
        });
        let mut commits = commits.buffered(CONCURRENT_READS);
        while let Some((version, lines)) = commits.try_next().await? {
            apply(state, version, lines);
        }
        Ok(())
    }

    /// Brings a state of this log up to the newest version.
    pub async fn advance_state(&self, mut state: Arc<TableState>) -> Result<Arc<TableState>> {
        while let Some(lines) = self.read_commit(state.version + 1).await? {
            let next = state.version + 1;
            Arc::make_mut(&mut state).apply_commit(next, lines);
        }
        self.check_readable(&state)?;
        Ok(state)
    }

    /// Lists its versions, oldest first.
    pub async fn list_versions(&self) -> Result<Vec<TableVersion>> {
        list_versions(self.store, &self.path).await
    }

    /// Lists its versions with what they changed, oldest first.
    pub async fn list_changes(&self) -> Result<Vec<TableChange>> {
        let versions = self.list_versions().await?;
        let commits = futures::stream::iter(versions)
            .map(|version| async move { Ok::<_, Error>((version, self.read_commit(version.version).await?)) });
        let mut commits = commits.buffered(CONCURRENT_READS);
        let mut changes = Vec::new();
        let mut rows = HashMap::new();
        while let Some((version, lines)) = commits.try_next().await? {
            // One that is gone by now was cleaned up.
            changes.extend(lines.map(|lines| table_change(version, lines, &mut rows)));
        }
        Ok(changes)
    }

    pub async fn has_version(&self, version: u64) -> Result<bool> {
        Ok(self.commit_tag(version).await?.is_some())
    }

    /// Returns what tells a version's commit from that of another log with this number; None if it is not there.
    pub async fn commit_tag(&self, version: u64) -> Result<Option<String>> {
        let path = self.path.clone().join(commit_name(version));
        match self.store.head(&path).await {
            Ok(found) => Ok(Some(found.e_tag.unwrap_or_else(|| found.last_modified.to_string()))),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(e) => Err(Error::store_failure("read", path, e)),
        }
    }

    /// Writes a version, unless another writer has taken its number.
    pub async fn write_commit(&self, version: u64, lines: &[LogLine]) -> Result<CommitAttempt> {
        let mut text = Vec::new();
        for line in lines {
            let mut line = line.clone();
            if let Some(Value::Object(info)) = &mut line.commit_info {
                info.insert(LINES.to_owned(), lines.len().into());
            }
            serde_json::to_writer(&mut text, &line).map_err(|e| self.log_error("written", e))?;
            text.push(b'\n');
        }
        let path = self.path.clone().join(commit_name(version));
        match self.store.put_opts(&path, text.into(), PutMode::Create.into()).await {
            Ok(_) => Ok(CommitAttempt::Written),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(CommitAttempt::Taken),
            Err(e) => Err(Error::store_failure("write", path, e)),
        }
    }

    /// Writes a checkpoint and deletes what is older than the log's retention, if this version is due for it.
    pub async fn maintain_log(&self, state: &TableState, now: DateTime<Utc>) -> Result<()> {
        if !state.version.is_multiple_of(CHECKPOINT_INTERVAL) || state.version == 0 {
            return Ok(());
        }
        self.write_checkpoint(state, now).await?;
        self.delete_expired(now).await
    }

    async fn write_checkpoint(&self, state: &TableState, now: DateTime<Utc>) -> Result<()> {
        let lines = state.checkpoint_lines(now.timestamp_millis());
        let file = encode_checkpoint(&lines).map_err(|e| self.log_error("written", e))?;
        let hint = json!({ "version": state.version, "size": lines.len(), "sizeInBytes": file.len(),
            "numOfAddFiles": state.files.len() });
        let path = self.path.clone().join(checkpoint_name(state.version));
        self.store.put(&path, file.into()).await.map_err(|e| Error::store_failure("write", path, e))?;
        let path = self.path.clone().join(LAST_CHECKPOINT);
        self.store.put(&path, hint.to_string().into()).await.map_err(|e| Error::store_failure("write", path, e))?;
        Ok(())
    }

    // Deletes everything before the newest checkpoint that is itself older than the retention, if no tag may need it.
    async fn delete_expired(&self, now: DateTime<Utc>) -> Result<()> {
        if has_tags(self.store).await? {
            return Ok(());
        }
        let listing = self.list_log().await?;
        let is_old = |version: &&u64| {
            let path = self.path.clone().join(checkpoint_name(**version));
            listing.modified.get(&path).is_some_and(|modified| now - *modified > LOG_RETENTION)
        };
        let Some(first_kept) = listing.checkpoints.keys().rev().find(is_old).copied() else { return Ok(()) };
        let commits = listing.commits.range(..first_kept).map(|v| self.path.clone().join(commit_name(*v)));
        let checkpoints = listing.checkpoints.range(..first_kept).flat_map(|(_, c)| c.files.iter().cloned());
        for path in commits.chain(checkpoints) {
            match self.store.delete(&path).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
                Err(e) => return Err(Error::store_failure("delete", path, e)),
            }
        }
        Ok(())
    }

    /// Returns the versions since the newest checkpoint, if another one was due long ago.
    pub async fn overdue_checkpoint(&self) -> Result<Option<u64>> {
        let listing = self.list_log().await?;
        let since =
            listing.newest_version().unwrap_or(0) - listing.checkpoints.keys().next_back().copied().unwrap_or(0);
        Ok((since >= 2 * CHECKPOINT_INTERVAL).then_some(since))
    }

    /// Deletes the log.
    pub async fn delete_log(&self) -> Result<()> {
        let listed: Vec<_> = self
            .store
            .list(Some(&self.path))
            .try_collect()
            .await
            .map_err(|e| Error::store_failure("list", &self.path, e))?;
        for object in listed {
            self.store
                .delete(&object.location)
                .await
                .map_err(|e| Error::store_failure("delete", object.location, e))?;
        }
        Ok(())
    }

    async fn list_log(&self) -> Result<LogListing> {
        let there = self.store.list_with_delimiter(Some(&self.path)).await;
        let there = there.map_err(|e| Error::store_failure("list", &self.path, e))?;
        let mut listing = LogListing::default();
        for object in there.objects {
            if let Some(version) = commit_number(&object.location) {
                listing.commits.insert(version);
            } else if let Some((version, expected)) = checkpoint_number(&object.location) {
                let checkpoint = listing.checkpoints.entry(version).or_default();
                checkpoint.expected = expected;
                checkpoint.files.insert(object.location.clone());
            }
            listing.modified.insert(object.location, object.last_modified);
        }
        listing.checkpoints.retain(|_, checkpoint| checkpoint.files.len() == checkpoint.expected);
        Ok(listing)
    }

    async fn read_commit(&self, version: u64) -> Result<Option<Vec<LogLine>>> {
        let path = self.path.clone().join(commit_name(version));
        let Some(bytes) = self.read_object(&path).await? else { return Ok(None) };
        let mut lines = Vec::new();
        for (number, line) in bytes.split(|b| *b == b'\n').enumerate().filter(|(_, line)| !line.trim_ascii().is_empty())
        {
            let line = serde_json::from_slice(line).map_err(|e| {
                let told = e.to_string();
                let place = format!("line {}, column {}", number + 1, e.column());
                // serde counts lines within this one.
                let reason = told.split(" at line ").next().unwrap_or_default();
                self.damage_error(&format!("`{}` {place}: expected an action, {reason}", commit_name(version)))
            })?;
            lines.push(line);
        }
        self.check_lines(version, &lines)?;
        Ok(Some(lines))
    }

    // A file that is cut at the end of a line, or emptied, has nothing else that is wrong.
    fn check_lines(&self, version: u64, lines: &[LogLine]) -> Result<()> {
        let written = lines.iter().find_map(|line| line.commit_info.as_ref()?.get(LINES)?.as_u64());
        let expected = match written {
            Some(count) if count == lines.len() as u64 => return Ok(()),
            Some(count) => format!("{count} lines"),
            // Others write commits that change nothing.
            None if lines.is_empty() || lines.len() == 1 && is_own_commit(lines) => "actions".to_owned(),
            None => return Ok(()),
        };
        let found = if lines.is_empty() { "none".to_owned() } else { lines.len().to_string() };
        Err(self.damage_error(&format!("`{}`: expected {expected}, found {found}", commit_name(version))))
    }

    async fn read_checkpoint(&self, path: &Path) -> Result<Vec<LogLine>> {
        let name = path.filename().unwrap_or_default();
        let bytes = self.read_object(path).await?.ok_or_else(|| self.damage_error(&format!("`{name}` is gone")))?;
        decode_checkpoint(bytes).map_err(|e| self.damage_error(&format!("`{name}`: {e}")))
    }

    async fn read_object(&self, path: &Path) -> Result<Option<bytes::Bytes>> {
        let read = async { self.store.get(path).await?.bytes().await };
        match read.await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(e) => Err(Error::store_failure("read", path, e)),
        }
    }

    fn check_readable(&self, state: &TableState) -> Result<()> {
        let Some(protocol) = &state.protocol else {
            return Err(self.damage_error("it names no version of the protocol"));
        };
        self.check_protocol("read", "reader", "reads", protocol.min_reader_version, READER_VERSION)
    }

    /// Refuses a table whose other writers rely on features that this one does not implement.
    pub fn check_writable(&self, state: &TableState) -> Result<()> {
        let needed = state.protocol.as_ref().map_or(0, |p| p.min_writer_version);
        self.check_protocol("written", "writer", "writes", needed, WRITER_VERSION)
    }

    fn check_protocol(&self, action: &'static str, role: &str, verb: &str, needed: i32, supported: i32) -> Result<()> {
        if needed <= supported {
            return Ok(());
        }
        let reason = format!(
            "another program has raised it to Delta's {role} version {needed}, echolake {verb} version {supported}; {}",
            rebuild_hint(self.table.name())
        );
        Err(self.log_error(action, reason))
    }

    fn damage_error(&self, what: &str) -> Error {
        self.log_error("read", format!("{what}; {}", rebuild_hint(self.table.name())))
    }

    fn log_error(&self, action: &'static str, source: impl Into<ErrorCause>) -> Error {
        Error::Log { table: self.table.name(), action, source: source.into() }
    }
}

/// The versions of the protocol that a table of ours needs.
pub(super) fn own_protocol() -> super::actions::ProtocolVersions {
    super::actions::ProtocolVersions { min_reader_version: READER_VERSION, min_writer_version: WRITER_VERSION }
}

impl LogListing {
    fn newest_version(&self) -> Option<u64> {
        self.commits.last().copied().max(self.checkpoints.last_key_value().map(|(version, _)| *version))
    }

    fn checkpoint_before(&self, version: u64) -> Option<(u64, &CheckpointFiles)> {
        self.checkpoints.range(..=version).next_back().map(|(version, files)| (*version, files))
    }
}

fn checkpoint_name(version: u64) -> String {
    format!("{version:020}.checkpoint.parquet")
}

/// The version of a checkpoint's file, and how many files the checkpoint has.
fn checkpoint_number(path: &Path) -> Option<(u64, usize)> {
    let (version, rest) = path.filename()?.split_once(".checkpoint.")?;
    let version = (version.len() == 20).then(|| version.parse().ok()).flatten()?;
    match rest.split('.').collect::<Vec<_>>()[..] {
        ["parquet"] => Some((version, 1)),
        [_, parts, "parquet"] => Some((version, parts.parse().ok()?)),
        _ => None,
    }
}

// `rows` are those of each file that came so far.
fn table_change(version: TableVersion, lines: Vec<LogLine>, rows: &mut HashMap<String, Option<u64>>) -> TableChange {
    let mut change = TableChange {
        version,
        operation: None,
        files_added: 0,
        files_removed: 0,
        rows_added: Some(0),
        rows_removed: Some(0),
    };
    let sum = |total: Option<u64>, more: Option<u64>| Some(total? + more?);
    for line in lines {
        if let Some(info) = line.commit_info {
            change.operation = info.get("operation").and_then(|name| name.as_str()).map(str::to_owned);
        }
        if let Some(add) = line.add {
            let stats = add.stats.and_then(|stats| serde_json::from_str::<serde_json::Value>(&stats).ok());
            let of_file = stats.and_then(|stats| stats.get("numRecords")?.as_u64());
            change.files_added += 1;
            change.rows_added = sum(change.rows_added, of_file);
            rows.insert(add.path, of_file);
        }
        if let Some(remove) = line.remove {
            change.files_removed += 1;
            change.rows_removed = sum(change.rows_removed, rows.remove(&remove.path).flatten());
        }
    }
    change
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;

    use super::*;

    const PROTOCOL: &str = r#"{"protocol":{"minReaderVersion":1,"minWriterVersion":2}}"#;

    fn add(name: &str) -> LogLine {
        let json = format!(
            r#"{{"add":{{"path":"{name}","partitionValues":{{}},"size":1,"modificationTime":1,"dataChange":true}}}}"#
        );
        serde_json::from_str(&json).expect("a line")
    }

    fn path(name: &str) -> Path {
        table_folder(Table::Nce).join("_delta_log").join(name)
    }

    async fn put(store: &InMemory, name: &str, text: impl Into<Vec<u8>>) {
        store.put(&path(name), text.into().into()).await.expect("written");
    }

    /// A log of `versions` versions with a file each, written as ingest does, checkpoints included.
    async fn write_log(store: &InMemory, versions: u64) -> TableState {
        let log = LogFolder::new(Table::Nce, store);
        let mut state = TableState::default();
        for version in 0..versions {
            let mut lines = vec![add(&version.to_string())];
            if version == 0 {
                lines.push(serde_json::from_str(PROTOCOL).expect("a line"));
            }
            assert_eq!(log.write_commit(version, &lines).await.expect("written"), CommitAttempt::Written);
            state.apply_lines(version, lines);
            log.maintain_log(&state, Utc::now()).await.expect("maintained");
        }
        state
    }

    async fn load_error(store: &InMemory) -> String {
        LogFolder::new(Table::Nce, store).load_state(None).await.expect_err("refused").to_string()
    }

    #[tokio::test]
    async fn every_version_is_read_with_and_without_a_checkpoint() {
        let store = InMemory::new();
        assert!(LogFolder::new(Table::Nce, &store).load_state(None).await.expect("read").is_none(), "no log yet");
        write_log(&store, 205).await;
        let log = LogFolder::new(Table::Nce, &store);
        for version in [0, 1, 99, 100, 101, 150, 200, 204] {
            let state = log.load_state(Some(version)).await.expect("read").expect("a table");
            assert_eq!((state.version, state.files.len() as u64), (version, version + 1));
        }
        // Before a checkpoint, commits may be cleaned up.
        for version in 0..150 {
            store.delete(&path(&commit_name(version))).await.expect("deleted");
        }
        assert_eq!(log.load_state(None).await.expect("read").expect("a table").files.len(), 205);
        store.delete(&path(&commit_name(202))).await.expect("deleted");
        let error = load_error(&store).await;
        assert!(error.contains("version 202 is missing") && error.contains("hint"), "{error}");
    }

    #[tokio::test]
    async fn a_number_is_written_once_and_a_state_follows_the_log() {
        let store = InMemory::new();
        let state = Arc::new(write_log(&store, 3).await);
        let log = LogFolder::new(Table::Nce, &store);
        assert_eq!(log.write_commit(2, &[add("late")]).await.expect("tried"), CommitAttempt::Taken);
        log.write_commit(3, &[add("new")]).await.expect("written");
        let advanced = log.advance_state(state).await.expect("read");
        assert_eq!((advanced.version, advanced.files.len()), (3, 4));
        let tag = log.commit_tag(3).await.expect("looked").expect("it is there");
        store.delete(&path(&commit_name(3))).await.expect("deleted");
        assert_eq!(log.commit_tag(3).await.expect("looked"), None);
        log.write_commit(3, &[add("new")]).await.expect("written");
        assert_ne!(log.commit_tag(3).await.expect("looked").expect("it is there"), tag, "equal, but another");
    }

    #[tokio::test]
    async fn only_old_versions_before_an_old_checkpoint_are_deleted() {
        let store = InMemory::new();
        let state = write_log(&store, 205).await;
        let log = LogFolder::new(Table::Nce, &store);
        log.delete_expired(Utc::now() + LOG_RETENTION - TimeDelta::minutes(1)).await.expect("nothing is old");
        assert!(log.has_version(0).await.expect("looked"));
        log.delete_expired(Utc::now() + LOG_RETENTION + TimeDelta::minutes(1)).await.expect("deleted");
        assert!(!log.has_version(199).await.expect("looked") && log.has_version(200).await.expect("looked"));
        assert!(store.head(&path(&checkpoint_name(100))).await.is_err());
        let loaded = log.load_state(None).await.expect("read").expect("a table");
        assert!(loaded.files.keys().eq(state.files.keys()));
    }

    #[tokio::test]
    async fn a_commit_that_lost_lines_is_refused_and_older_ones_and_those_of_others_are_read() {
        let store = InMemory::new();
        put(&store, &commit_name(0), PROTOCOL).await;
        let log = LogFolder::new(Table::Nce, &store);
        let info = |by: &str| LogLine { commit_info: Some(json!({ "engineInfo": by })), ..LogLine::default() };
        log.write_commit(1, &[info("echolake/1.0.0"), add("a"), add("b")]).await.expect("written");
        let whole = store.get(&path(&commit_name(1))).await.expect("read").bytes().await.expect("bytes");
        let whole = String::from_utf8(whole.to_vec()).expect("text");
        let lines: Vec<_> = whole.lines().collect();
        for (kept, said) in [(0, "expected actions, found none"), (1, "expected 3 lines, found 1"), (2, "found 2")] {
            put(&store, &commit_name(1), lines[..kept].iter().map(|line| format!("{line}\n")).collect::<String>())
                .await;
            let error = load_error(&store).await;
            assert!(error.contains(said) && error.contains("`echolake rebuild nce`"), "{kept}: {error}");
        }
        put(&store, &commit_name(1), whole).await;
        assert_eq!(log.load_state(None).await.expect("read").expect("a table").files.len(), 2);
        let text = |line: LogLine| serde_json::to_string(&line).expect("text");
        for (number, readable) in [(text(info("echolake/0.9.0")), false), (text(info("delta-rs:1.5.0")), true)] {
            put(&store, &commit_name(2), number.clone()).await;
            assert_eq!(log.load_state(None).await.is_ok(), readable, "{number}");
        }
        put(&store, &commit_name(2), format!("{}\n{}", text(info("echolake/0.9.0")), text(add("c")))).await;
        assert_eq!(log.load_state(None).await.expect("read").expect("a table").files.len(), 3);
    }

    #[tokio::test]
    async fn damage_and_newer_protocols_are_refused_with_their_place() {
        let store = InMemory::new();
        put(&store, &commit_name(0), format!("{PROTOCOL}\n{{\"add\": 3}}\n")).await;
        let error = load_error(&store).await;
        assert!(error.contains("`00000000000000000000.json` line 2, column ") && error.contains("hint"), "{error}");
        assert!(!error.contains("line 1"), "{error}");
        put(&store, &commit_name(0), r#"{"protocol":{"minReaderVersion":3,"minWriterVersion":7}}"#).await;
        let error = load_error(&store).await;
        assert!(error.contains("reader version 3") && error.contains("hint"), "{error}");
        put(&store, &commit_name(0), PROTOCOL).await;
        put(&store, &checkpoint_name(0), "PAR1, but cut off").await;
        assert!(load_error(&store).await.contains("checkpoint.parquet`"));
        // Of a checkpoint in parts one is missing: it does not count.
        store.delete(&path(&checkpoint_name(0))).await.expect("deleted");
        let part = format!("{:020}.checkpoint.0000000001.0000000002.parquet", 0);
        put(&store, &part, "one of two").await;
        let log = LogFolder::new(Table::Nce, &store);
        let state = log.load_state(None).await.expect("read").expect("a table");
        log.check_writable(&state).expect("ours");
        put(&store, &commit_name(1), r#"{"protocol":{"minReaderVersion":1,"minWriterVersion":7}}"#).await;
        let state = log.load_state(None).await.expect("read").expect("a table");
        assert!(log.check_writable(&state).expect_err("newer").to_string().contains("writer version 7"));
    }
}
