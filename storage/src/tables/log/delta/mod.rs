//! The commit log as Delta, reader version 1 and writer version 2, so that every Delta reader reads it.

mod actions;
mod checkpoint;
mod commit_files;
mod log_folder;
mod table_state;

use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use arrow::datatypes::{DataType as ArrowType, Field, SchemaRef};
use async_trait::async_trait;
use chrono::{DateTime, Utc};
use echolake_schema::Rig;
use echolake_schema::tables::{Source, Table};
use futures::TryStreamExt as _;
use object_store::ObjectStore;
use object_store::path::Path;
use percent_encoding::percent_decode_str;
use serde_json::{Map, Value, json};
use tokio::sync::Mutex;
use uuid::Uuid;

use self::actions::{AddFile, ApplicationTransaction, FileFormat, LogLine, TableMetadata};
use self::log_folder::{CommitAttempt, LogFolder, own_protocol};
use self::table_state::{COPIED, ENGINE, TableFile, TableState, mark_rebuild, objects_application, shown_application};
use crate::contribution_objects::last_object;
use crate::error::rebuild_hint;
use crate::location::LakeLocation;
use crate::remote::backoff_time;
use crate::tables::file_name::{FileName, run_prefix, table_folder};
use crate::tables::run_parts::{decode_parts, encode_parts};
use crate::{
    CommitEffect, CommitLog, CommitOutcome, DataFile, Error, FileHistory, FileStats, LoggedFile, NewFile,
    RemovalRecord, ReplacedFiles, Result, RunPart, RunRowCounts, TableChange, TableCommit, TableVersion, TableView,
};

/// Tries of one commit against other writers; each loses to a commit that went through.
const COMMIT_TRIES: usize = 50;
/// Time for which a log on an object store is taken to hold the version that was found there. A log forgets versions
/// after 30 days; tables that somebody deletes are missed only so much later.
const LOG_LASTS: Duration = Duration::from_secs(600);
/// The tag of the Add of a file of several runs that holds its parts.
const PARTS: &str = "echolake.parts";
/// The tag of an Add that holds the version of its commit: a checkpoint does not tell it.
const LOG_VERSION: &str = "echolake.version";
/// The tag of an Add that holds the version of `runs` that its author had seen.
const SEEN_RUNS: &str = "echolake.seenRuns";
/// The tag of an Add of `runs` that holds the numbers of the run's rows by table, of a merged file those of each part.
const ROWS: &str = "echolake.rows";
/// Folder of closed runs.
const RUNS: &str = "runs";

/// The tables' Delta logs under `tables/`.
#[derive(Debug)]
pub(crate) struct DeltaLog {
    store: Arc<dyn ObjectStore>,
    /// The log is on an object store, where a try takes long.
    is_remote: bool,
    rig: Rig,
    /// Loaded tables; a later look reads only what has come since.
    loaded: Mutex<HashMap<Table, LoadedTable>>,
}

#[derive(Debug, Clone)]
struct LoadedTable {
    state: Arc<TableState>,
    /// The tag of its version's commit.
    tag: Option<String>,
    /// The last look that found its version in the log.
    found: Instant,
}

impl DeltaLog {
    pub fn new(location: &LakeLocation, rig: Rig) -> Self {
        let is_remote = location.remote.is_some();
        Self { store: location.store.clone(), is_remote, rig, loaded: Mutex::default() }
    }

    fn log_folder(&self, table: Table) -> LogFolder<'_> {
        LogFolder::new(table, self.store.as_ref())
    }

    // Writers that met once do not meet again at once. On a folder, the next try costs nothing.
    async fn wait_after_loss(&self, losses: usize) {
        if self.is_remote {
            tokio::time::sleep(backoff_time(u32::try_from(losses).unwrap_or(u32::MAX))).await;
        }
    }

    /// The table as of now, or None if it has no log.
    async fn load_table(&self, table: Table) -> Result<Option<Arc<TableState>>> {
        let log = self.log_folder(table);
        let known = self.loaded.lock().await.get(&table).cloned();
        let mut followed = None;
        if let Some(mut known) = known {
            // A log that was cleaned up beyond what is known, or made again, is loaded again. That costs a request.
            let is_in_doubt = !self.is_remote || known.found.elapsed() > LOG_LASTS;
            let mut is_same = true;
            if is_in_doubt {
                known.found = Instant::now();
                is_same = known.tag.is_some() && log.commit_tag(known.state.version).await? == known.tag;
            }
            if is_same {
                let version = known.state.version;
                known.state = log.advance_state(known.state).await?;
                if known.state.version != version {
                    known.tag = log.commit_tag(known.state.version).await?;
                }
                followed = Some(known);
            }
        }
        if followed.is_none()
            && let Some(state) = log.load_state(None).await?
        {
            let tag = log.commit_tag(state.version).await?;
            followed = Some(LoadedTable { state: Arc::new(state), tag, found: Instant::now() });
        }
        let state = followed.as_ref().map(|table| table.state.clone());
        let mut loaded = self.loaded.lock().await;
        match followed {
            Some(followed) => drop(loaded.insert(table, followed)),
            None => drop(loaded.remove(&table)),
        }
        Ok(state)
    }

    /// The id that a table was given when it was made.
    pub async fn table_id(&self, table: Table) -> Result<Option<String>> {
        Ok(self.load_table(table).await?.and_then(|state| Some(state.metadata.as_ref()?.id.clone())))
    }

    // The state of a recent look, where a look takes long; what is written against an older one than the newest fails.
    async fn known_state(&self, table: Table) -> Option<Arc<TableState>> {
        let known = self.loaded.lock().await.get(&table).cloned();
        known.filter(|known| self.is_remote && known.found.elapsed() <= LOG_LASTS).map(|known| known.state)
    }

    async fn require_table(&self, table: Table) -> Result<Arc<TableState>> {
        self.load_table(table).await?.ok_or_else(|| Error::Log {
            table: table.name(),
            action: "read",
            source: "it has no log; hint: `echolake ingest` makes it again from the runs".into(),
        })
    }

    /// Adds the columns that a table of an earlier version of the program lacks; its files have nulls there.
    async fn add_columns(&self, table: Table, mut state: Arc<TableState>) -> Result<()> {
        for losses in 1..=COMMIT_TRIES {
            let Some((mut metadata, added)) = grown_metadata(table, &state, &table.schema(&self.rig))? else {
                return Ok(());
            };
            let log = self.log_folder(table);
            log.check_writable(&state)?;
            mark_rebuild(&mut metadata, state.is_rebuilding());
            let info = commit_info("ADD COLUMNS", json!({ "columns": added }), Utc::now().timestamp_millis());
            let lines = [info, LogLine { meta_data: Some(metadata), ..LogLine::default() }];
            let attempt = log.write_commit(state.version + 1, &lines).await?;
            state = self.require_table(table).await?;
            if attempt == CommitAttempt::Written {
                return Ok(());
            }
            self.wait_after_loss(losses).await;
        }
        Err(lost_to_others(table))
    }

    /// The version of a table of users that readers see.
    async fn shown_version(&self, table: Table) -> Result<u64> {
        let runs = self.load_table(Table::Runs).await?;
        Ok(runs.map_or(0, |state| state.shown_versions().of_table(table).table))
    }

    /// Marks `runs` as being made again, or as whole.
    pub async fn set_rebuilding(&self, is_rebuilding: bool) -> Result<()> {
        let table = Table::Runs;
        for losses in 1..=COMMIT_TRIES {
            let Some(state) = self.load_table(table).await?.filter(|state| state.is_rebuilding() != is_rebuilding)
            else {
                return Ok(());
            };
            let log = self.log_folder(table);
            log.check_writable(&state)?;
            let info = commit_info("REBUILD", json!({ "done": !is_rebuilding }), Utc::now().timestamp_millis());
            let meta_data = state.metadata_marked(is_rebuilding);
            let lines = [info, LogLine { meta_data, ..LogLine::default() }];
            if log.write_commit(state.version + 1, &lines).await? == CommitAttempt::Written {
                return Ok(());
            }
            self.wait_after_loss(losses).await;
        }
        Err(lost_to_others(table))
    }

    /// Deletes a table's log.
    pub async fn delete_log(&self, table: Table) -> Result<()> {
        self.log_folder(table).delete_log().await?;
        self.loaded.lock().await.remove(&table);
        Ok(())
    }

    async fn create_table(&self, table: Table) -> Result<()> {
        let now_millis = Utc::now().timestamp_millis();
        let mut metadata = TableMetadata {
            id: Uuid::new_v4().to_string(),
            name: Some(table.name().to_owned()),
            description: None,
            format: FileFormat { provider: "parquet".to_owned(), options: actions::TextMap::new() },
            schema_string: delta_schema(&table.schema(&self.rig)).to_string(),
            partition_columns: Vec::new(),
            configuration: actions::TextMap::new(),
            created_time: Some(now_millis),
        };
        // The log is lost, unless this is the lake's first ingest: until its end, the table lacks runs.
        mark_rebuild(&mut metadata, table == Table::Runs && has_run_files(self.store.as_ref()).await?);
        let mut lines = vec![
            commit_info("CREATE TABLE", json!({ "mode": "ErrorIfExists" }), now_millis),
            LogLine { protocol: Some(own_protocol()), ..LogLine::default() },
            LogLine { meta_data: Some(metadata), ..LogLine::default() },
        ];
        if table == Table::Runs {
            for table in Table::OF_USERS {
                let objects = last_object(self.store.as_ref(), table).await?;
                let newest = self.load_table(table).await?.map_or(0, |state| state.version);
                let known = [(objects_application(table), objects), (shown_application(table), newest)];
                let known = known.into_iter().filter(|(_, number)| *number > 0);
                lines.extend(known.map(|(application, number)| transaction_line(application, number, now_millis)));
            }
        }
        // If the number is taken, another process made the table at the same moment.
        self.log_folder(table).write_commit(0, &lines).await.map(drop)
    }

    /// Begins the log of a table of users again, of which its readers see what is in it from then on: nothing.
    pub async fn begin_log_again(&self, table: Table) -> Result<()> {
        self.delete_log(table).await?;
        self.create_table(table).await?;
        self.write_shown(table, 0, |shown| shown == 0).await.map(drop)
    }

    /// Shows objects of the lake's earlier form, as earlier versions of the program did.
    #[cfg(test)]
    pub async fn show_objects(&self, table: Table, number: u64) -> Result<()> {
        let state = self.require_table(Table::Runs).await?;
        let now = Utc::now();
        let line = transaction_line(objects_application(table), number, now.timestamp_millis());
        let lines = vec![commit_info("ANNOTATE", json!({}), now.timestamp_millis()), line];
        self.write_version(Table::Runs, &state, lines, now).await.map(drop)
    }

    // Names the version of a table of users that readers see, unless the one that they see will do.
    async fn write_shown(&self, table: Table, version: u64, is_done: impl Fn(u64) -> bool) -> Result<u64> {
        for losses in 1..=COMMIT_TRIES {
            let state = self.require_table(Table::Runs).await?;
            if is_done(state.shown_versions().of_table(table).table) {
                return Ok(state.version);
            }
            let now = Utc::now();
            let operation = if table == Table::Annotations { "ANNOTATE" } else { "PREDICT" };
            let info = commit_info(operation, json!({ "version": version.to_string() }), now.timestamp_millis());
            let lines = vec![info, transaction_line(shown_application(table), version, now.timestamp_millis())];
            if self.write_version(Table::Runs, &state, lines, now).await? == CommitAttempt::Written {
                return Ok(state.version + 1);
            }
            self.wait_after_loss(losses).await;
        }
        Err(lost_to_others(Table::Runs))
    }

    pub async fn overdue_checkpoint(&self, table: Table) -> Result<Option<u64>> {
        self.log_folder(table).overdue_checkpoint().await
    }

    // Written against one version, so that it takes effect only if that is still the newest.
    async fn try_commit(
        &self,
        table: Table,
        state: &Arc<TableState>,
        change: &PendingChange<'_>,
    ) -> Result<CommitAttempt> {
        let now = Utc::now();
        self.write_version(table, state, change.log_lines(state, now.timestamp_millis()), now).await
    }

    async fn write_version(
        &self,
        table: Table,
        state: &Arc<TableState>,
        lines: Vec<LogLine>,
        now: DateTime<Utc>,
    ) -> Result<CommitAttempt> {
        let log = self.log_folder(table);
        log.check_writable(state)?;
        let attempt = log.write_commit(state.version + 1, &lines).await?;
        if attempt == CommitAttempt::Written {
            let mut state = TableState::clone(state);
            state.apply_commit(state.version + 1, lines);
            // The commit is done; a checkpoint only spares readers some work, and the next one makes up for it.
            if let Err(error) = log.maintain_log(&state, now).await {
                let table = table.name();
                let error = &error as &dyn std::error::Error;
                tracing::warn!(table, error, "the log's checkpoint cannot be written, or old versions not be deleted");
            }
            // Without it, the next look loads the table again.
            let tag = log.commit_tag(state.version).await.unwrap_or_default();
            let written = LoadedTable { state: Arc::new(state), tag, found: Instant::now() };
            self.loaded.lock().await.insert(table, written);
        }
        Ok(attempt)
    }
}

/// A file that a version of a table holds.
#[derive(Debug, Clone)]
struct KnownFile {
    log_version: u64,
    seen_runs: u64,
    /// Of a file of several rows of `runs`: the place of each, and the version that added it.
    rows: Vec<(String, u64)>,
}

impl KnownFile {
    /// The version that added the row in a place; None if it has no row there.
    fn row_version(&self, name: &str, place: &str) -> Option<u64> {
        let of_parts = self.rows.iter().find(|(of, _)| of == place).map(|(_, version)| *version);
        of_parts.or_else(|| name.starts_with(place).then_some(self.log_version))
    }
}

/// The rest of a commit that one version of a table still lacks.
struct PendingChange<'a> {
    outcomes: Vec<CommitOutcome>,
    add: Vec<&'a NewFile>,
    remove: BTreeSet<String>,
    effect: CommitEffect,
    removal: Option<&'a RemovalRecord>,
}

impl<'a> PendingChange<'a> {
    fn from_commit(commit: &'a TableCommit, mut known: HashMap<String, KnownFile>) -> Self {
        let gone = commit.remove.iter().filter(|file| is_known(file, &known));
        let remove = gone.map(|file| file.name.clone()).collect();
        let effect = commit.effect;
        let removal = commit.removal.as_ref();
        let mut change = Self { outcomes: Vec::new(), add: Vec::new(), remove, effect, removal };
        for file in &commit.add {
            let outcome = change.decide_outcome(file, &known);
            if outcome == CommitOutcome::Now {
                for replaced in file.replaces.iter().flat_map(ReplacedFiles::removed_files) {
                    known.remove(&replaced.name);
                    change.remove.insert(replaced.name.clone());
                }
                // Its version is not known before the commit, and no file of the same commit names it.
                let log_version = u64::MAX;
                let rows = file.replaces.iter().filter_map(|place| Some((place.prefix.clone()?, log_version)));
                let added = KnownFile { log_version, seen_runs: file.seen_runs, rows: rows.collect() };
                known.insert(file.name.clone(), added);
                change.remove.remove(&file.name);
                change.add.push(file);
            }
            change.outcomes.push(outcome);
        }
        change
    }

    fn is_all_of(&self, commit: &TableCommit) -> bool {
        self.outcomes.iter().all(|outcome| *outcome == CommitOutcome::Now)
            && commit.remove.iter().all(|file| self.remove.contains(&file.name))
    }

    /// The commit's lines, against the version whose state is given.
    fn log_lines(&self, state: &TableState, now_millis: i64) -> Vec<LogLine> {
        let data_change = self.effect == CommitEffect::Rows;
        let largest = self.add.iter().map(|f| f.bytes).max().unwrap_or(0);
        let (operation, parameters) = match (self.removal, self.effect) {
            (Some(removal), _) => ("DELETE", removal_parameters(removal)),
            (None, CommitEffect::Rows) if self.remove.is_empty() => ("WRITE", json!({ "mode": "Append" })),
            (None, CommitEffect::Rows) => ("WRITE", json!({ "mode": "Overwrite" })),
            (None, CommitEffect::Layout) => ("OPTIMIZE", json!({ "targetSize": largest.to_string() })),
        };
        let removed =
            state.files.values().map(|file| &file.add).filter(|add| self.remove.contains(&file_name(&add.path)));
        let removed =
            removed.map(|add| LogLine { remove: Some(add.removed_at(now_millis, data_change)), ..LogLine::default() });
        let added = self.add.iter().map(|f| {
            let add = add_file(f, state.version + 1, now_millis, data_change);
            LogLine { add: Some(add), ..LogLine::default() }
        });
        std::iter::once(commit_info(operation, parameters, now_millis)).chain(added).chain(removed).collect()
    }

    // An Add whose author had not seen the row of the run that this one will replace may be cleaned up at any moment;
    // it is added again.
    //
    // A file of several rows of `runs` may be there with rows that others have replaced since: the places of its rows
    // alone decide.
    fn decide_outcome(&self, file: &NewFile, known: &HashMap<String, KnownFile>) -> CommitOutcome {
        let has_places = file.parts.len() > 1 && file.replaces.iter().any(|replaced| replaced.prefix.is_some());
        if !has_places && known.get(&file.name).is_some_and(|known| known.seen_runs >= file.run_version) {
            return CommitOutcome::Before;
        }
        match file.replaces.iter().all(|replaced| is_in_place(replaced, known)) {
            true => CommitOutcome::Now,
            false => CommitOutcome::Outdated,
        }
    }
}

// Returns whether the files that are expected in a place are there, and none with a newer row, or a row as new.
fn is_in_place(replaced: &ReplacedFiles, known: &HashMap<String, KnownFile>) -> bool {
    if !replaced.files.iter().all(|file| is_known(file, known)) {
        return false;
    }
    let Some(place) = &replaced.prefix else { return true };
    let is_expected = |name: &str| replaced.files.iter().any(|file| file.name == name);
    let rows = known.iter().filter_map(|(name, file)| Some((is_expected(name), file.row_version(name, place)?)));
    let (expected, others): (Vec<_>, Vec<_>) = rows.partition(|(is_expected, _)| *is_expected);
    let newest = expected.into_iter().map(|(_, version)| version).max();
    others.into_iter().all(|(_, version)| newest.is_some_and(|newest| version < newest))
}

fn is_known(file: &LoggedFile, known: &HashMap<String, KnownFile>) -> bool {
    known.get(&file.name).is_some_and(|known| known.log_version == file.log_version)
}

/// Returns whether the lake has closed runs.
pub(crate) async fn has_run_files(store: &dyn ObjectStore) -> Result<bool> {
    let folder = Path::from(RUNS);
    let is_run = |path: &Path| path.extension() == Some("mcap");
    let mut listed = store.list(Some(&folder));
    while let Some(object) = listed.try_next().await.map_err(|e| Error::store_failure("list", &folder, e))? {
        if is_run(&object.location) {
            return Ok(true);
        }
    }
    Ok(false)
}

#[async_trait]
impl CommitLog for DeltaLog {
    async fn ensure_table(&self, table: Table) -> Result<()> {
        let known = match self.known_state(table).await {
            Some(state) => Some(state),
            None => self.load_table(table).await?,
        };
        if let Some(state) = known {
            return self.add_columns(table, state).await;
        }
        // Rows of users that are lost stay a fault until somebody gives them up.
        if table.source() == Source::Users && self.shown_version(table).await? > 0 {
            return Ok(());
        }
        self.create_table(table).await
    }

    async fn view_table(&self, table: Table) -> Result<Option<TableView>> {
        let Some(state) = self.load_table(table).await? else { return Ok(None) };
        table_view(table, &state).map(Some)
    }

    async fn known_version(&self, table: Table) -> Option<u64> {
        self.loaded.lock().await.get(&table).map(|known| known.state.version)
    }

    async fn newest_version(&self, table: Table) -> Result<Option<u64>> {
        Ok(self.load_table(table).await?.map(|state| state.version))
    }

    async fn has_after(&self, table: Table, version: u64) -> Result<bool> {
        self.log_folder(table).has_version(version + 1).await
    }

    async fn commit_tag(&self, table: Table, version: u64) -> Result<Option<String>> {
        self.log_folder(table).commit_tag(version).await
    }

    async fn list_versions(&self, table: Table) -> Result<Vec<TableVersion>> {
        self.log_folder(table).list_versions().await
    }

    async fn list_changes(&self, table: Table) -> Result<Vec<TableChange>> {
        self.log_folder(table).list_changes().await
    }

    async fn view_at(&self, table: Table, version: u64) -> Result<Option<TableView>> {
        let state = self.log_folder(table).load_state(Some(version)).await?;
        state.map(|state| table_view(table, &state)).transpose()
    }

    async fn files_of_all_versions(&self, table: Table) -> Result<Vec<Arc<DataFile>>> {
        match self.log_folder(table).load_all_versions().await? {
            Some(state) => data_files(table, &state),
            None => Ok(Vec::new()),
        }
    }

    async fn has_file(&self, table: Table, name: &str) -> Result<bool> {
        // Names of ours are spelled in the log as they are.
        let has = |state: &TableState| {
            state.files.contains_key(name) || state.files.keys().any(|path| decoded_name(path) == name)
        };
        if self.known_state(table).await.is_some_and(|state| has(&state)) {
            return Ok(true);
        }
        Ok(self.load_table(table).await?.is_some_and(|state| has(&state)))
    }

    async fn file_history(&self, table: Table) -> Result<Option<FileHistory>> {
        let Some(state) = self.load_table(table).await? else { return Ok(None) };
        let removed = state.removed.values().map(|remove| {
            let at = remove.deletion_timestamp.and_then(DateTime::from_timestamp_millis);
            (file_name(&remove.path), at.unwrap_or_default())
        });
        let current = state.files.keys().map(|path| file_name(path)).collect();
        Ok(Some(FileHistory { current, removed: removed.collect() }))
    }

    async fn append_files(&self, table: Table, seen: u64, files: &[NewFile], copied: Option<u64>) -> Result<bool> {
        let state = self.require_table(table).await?;
        if state.version != seen {
            return Ok(false);
        }
        let commit = TableCommit { add: files.to_vec(), ..TableCommit::default() };
        let change = PendingChange::from_commit(&commit, known_files(table, &state)?);
        let now = Utc::now();
        let mut lines = change.log_lines(&state, now.timestamp_millis());
        lines.extend(copied.map(|number| transaction_line(COPIED.to_owned(), number, now.timestamp_millis())));
        Ok(self.write_version(table, &state, lines, now).await? == CommitAttempt::Written)
    }

    async fn show_version(&self, table: Table, version: u64) -> Result<u64> {
        self.write_shown(table, version, |shown| shown >= version).await
    }

    async fn commit_change(&self, table: Table, commit: &TableCommit) -> Result<Vec<CommitOutcome>> {
        let mut known = self.known_state(table).await;
        for losses in 1..=COMMIT_TRIES {
            let (state, is_newest) = match known.take() {
                Some(state) => (state, false),
                None => (self.require_table(table).await?, true),
            };
            let change = PendingChange::from_commit(commit, known_files(table, &state)?);
            // Only the newest version tells what is not to be written.
            if !is_newest && !change.is_all_of(commit) {
                continue;
            }
            if change.add.is_empty() && change.remove.is_empty() {
                return Ok(change.outcomes);
            }
            if self.try_commit(table, &state, &change).await? == CommitAttempt::Written {
                return Ok(change.outcomes);
            }
            self.wait_after_loss(losses).await;
        }
        Err(lost_to_others(table))
    }
}

fn transaction_line(app_id: String, number: u64, now_millis: i64) -> LogLine {
    let version = i64::try_from(number).unwrap_or(i64::MAX);
    let txn = ApplicationTransaction { app_id, version, last_updated: Some(now_millis) };
    LogLine { txn: Some(txn), ..LogLine::default() }
}

fn lost_to_others(table: Table) -> Error {
    let source = format!("{COMMIT_TRIES} tries lost to other writers; hint: run the command again").into();
    Error::Log { table: table.name(), action: "written", source }
}

// The table's metadata with the columns that it lacks behind its own, and these as JSON; None if it lacks none.
fn grown_metadata(table: Table, state: &TableState, schema: &SchemaRef) -> Result<Option<(TableMetadata, String)>> {
    let damaged = |source: String| Error::Log { table: table.name(), action: "read", source: source.into() };
    let mut metadata =
        state.metadata.clone().ok_or_else(|| damaged(format!("it has no metadata; {}", rebuild_hint(table.name()))))?;
    let mut known: Value = serde_json::from_str(&metadata.schema_string)
        .map_err(|e| damaged(format!("its schema is no JSON: {e}; {}", rebuild_hint(table.name()))))?;
    let Some(fields) = known.get_mut("fields").and_then(Value::as_array_mut) else {
        return Err(damaged(format!("its schema has no fields; {}", rebuild_hint(table.name()))));
    };
    let has = |field: &&Arc<Field>| fields.iter().any(|column| column["name"].as_str() == Some(field.name().as_str()));
    let lacking: Vec<_> = schema.fields().iter().filter(|field| !has(field)).map(|f| delta_column(f)).collect();
    if lacking.is_empty() {
        return Ok(None);
    }
    let added = Value::from(lacking.clone()).to_string();
    fields.extend(lacking);
    metadata.schema_string = known.to_string();
    Ok(Some((metadata, added)))
}

fn table_view(table: Table, state: &TableState) -> Result<TableView> {
    let files = data_files(table, state)?;
    let is_rebuilding = table == Table::Runs && state.is_rebuilding();
    let shown = state.shown_versions();
    let copied = state.copied_objects();
    let id = state.metadata.as_ref().map(|metadata| metadata.id.clone()).unwrap_or_default();
    Ok(TableView { version: state.version, id, files, shown, copied, is_rebuilding })
}

fn data_files(table: Table, state: &TableState) -> Result<Vec<Arc<DataFile>>> {
    let decoded = |file: &Arc<TableFile>| file.decode_once(|add| data_file(table, add));
    let mut files = state.files.values().map(decoded).collect::<Result<Vec<_>>>()?;
    files.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(files)
}

fn data_file(table: Table, add: &AddFile) -> Result<DataFile> {
    let path = table_folder(table).join(file_name(&add.path));
    let name = FileName::parse(&path);
    let stats = add.stats.as_deref().and_then(|json| serde_json::from_str::<Map<String, Value>>(json).ok());
    let rows = stats.as_ref().and_then(|stats| stats.get("numRecords")?.as_u64());
    Ok(DataFile {
        bytes: u64::try_from(add.size).unwrap_or(0),
        rows: rows.unwrap_or(0),
        log_version: number_tag(add, LOG_VERSION),
        seen_runs: number_tag(add, SEEN_RUNS),
        stats: stats.map(file_stats),
        row_counts: find_tag(add, ROWS).and_then(|text| serde_json::from_str(text).ok()),
        parts: match name {
            Some(FileName::Merged { .. }) => parts_of_file(table, add)?,
            _ => Vec::new(),
        },
        hidden: Vec::new(),
        name,
        path,
    })
}

fn known_files(table: Table, state: &TableState) -> Result<HashMap<String, KnownFile>> {
    let known = |(path, file): (&Arc<str>, &Arc<TableFile>)| {
        let mut rows = Vec::new();
        if table == Table::Runs {
            let parts = file.decode_once(|add| data_file(table, add))?;
            rows.extend(
                parts.parts.iter().filter_map(|part| Some((run_prefix(&part.surface, &part.run), part.row_version?))),
            );
        }
        let (log_version, seen_runs) = (number_tag(&file.add, LOG_VERSION), number_tag(&file.add, SEEN_RUNS));
        Ok::<_, Error>((file_name(path), KnownFile { log_version, seen_runs, rows }))
    };
    state.files.iter().map(known).collect()
}

/// A file's name of its path in the log.
fn file_name(path: &str) -> String {
    decoded_name(path).into_owned()
}

fn decoded_name(path: &str) -> Cow<'_, str> {
    percent_decode_str(path).decode_utf8_lossy()
}

fn find_tag<'a>(add: &'a AddFile, name: &str) -> Option<&'a str> {
    add.tags.as_ref()?.get(name)?.as_deref()
}

// Adds of earlier versions of the program have no such tags.
fn number_tag(add: &AddFile, name: &str) -> u64 {
    find_tag(add, name).and_then(|text| text.parse().ok()).unwrap_or(0)
}

fn parts_of_file(table: Table, add: &AddFile) -> Result<Vec<RunPart>> {
    let counts = find_tag(add, ROWS).and_then(|text| serde_json::from_str::<Vec<Option<RunRowCounts>>>(text).ok());
    let mut counts = counts.unwrap_or_default().into_iter();
    let counted = |part| RunPart { row_counts: counts.next().flatten(), ..part };
    // Rows of users that were not merged yet came with their file.
    let own_version = (table.source() == Source::Users).then(|| number_tag(add, LOG_VERSION));
    let versioned = |part: RunPart| RunPart { row_version: part.row_version.or(own_version), ..part };
    let parts = find_tag(add, PARTS).and_then(decode_parts);
    let parts = parts.map(|parts| parts.into_iter().map(counted).map(versioned).collect());
    parts.ok_or_else(|| {
        let source = format!("`{}` has lost the list of its parts; {}", add.path, rebuild_hint(table.name())).into();
        Error::Log { table: table.name(), action: "read", source }
    })
}

// Readers of a commit's time take it from its first line.
fn commit_info(operation: &str, parameters: Value, now_millis: i64) -> LogLine {
    let info = json!({
        "timestamp": now_millis,
        "operation": operation,
        "operationParameters": parameters,
        "engineInfo": format!("{ENGINE}{}", env!("CARGO_PKG_VERSION")),
        // Makes each commit unlike all others: a store whose answer is lost is asked if it holds this one.
        "txnId": Uuid::new_v4().to_string(),
    });
    LogLine { commit_info: Some(info), ..LogLine::default() }
}

// As Delta writes a deletion, with the one who asked for it.
fn removal_parameters(removal: &RemovalRecord) -> Value {
    let names: Vec<_> = removal.runs.iter().map(|run| format!("'{run}'")).collect();
    let predicate = json!([format!("run_id IN ({})", names.join(", "))]).to_string();
    json!({ "predicate": predicate, "by": removal.by })
}

// Names of ours have no character that Delta would percent-encode.
fn add_file(file: &NewFile, log_version: u64, now_millis: i64, data_change: bool) -> AddFile {
    let mut parts = file.parts.clone();
    // A row of `runs` that was in no file before is of this version.
    for part in parts.iter_mut().filter(|part| part.is_pointer()) {
        part.row_version = part.row_version.or(Some(log_version));
    }
    let parts = (!parts.is_empty()).then(|| (PARTS, encode_parts(&parts)));
    let seen_runs = (file.seen_runs > 0).then(|| (SEEN_RUNS, file.seen_runs.to_string()));
    let of_parts: Vec<_> = file.parts.iter().map(|part| &part.row_counts).collect();
    let rows = match &file.row_counts {
        Some(counts) => serde_json::to_string(counts).ok(),
        None if of_parts.iter().any(|counts| counts.is_some()) => serde_json::to_string(&of_parts).ok(),
        None => None,
    };
    let rows = rows.map(|text| (ROWS, text));
    let tags = [Some((LOG_VERSION, log_version.to_string())), seen_runs, parts, rows].into_iter().flatten();
    AddFile {
        path: file.name.clone(),
        partition_values: actions::TextMap::new(),
        size: i64::try_from(file.bytes).unwrap_or(i64::MAX),
        modification_time: now_millis,
        data_change,
        stats: Some(file.stats.clone()),
        tags: Some(tags.map(|(name, text)| (name.to_owned(), Some(text))).collect()),
    }
}

fn file_stats(mut stats: Map<String, Value>) -> FileStats {
    let mut take = |key| match stats.remove(key) {
        Some(Value::Object(values)) => values,
        _ => Map::new(),
    };
    FileStats { min: take("minValues"), max: take("maxValues") }
}

/// Returns a schema as Delta's log has it.
fn delta_schema(schema: &SchemaRef) -> Value {
    let fields: Vec<_> = schema.fields().iter().map(|f| delta_column(f)).collect();
    json!({ "type": "struct", "fields": fields })
}

fn delta_column(field: &Field) -> Value {
    json!({
        "name": field.name(),
        "type": delta_type(field.data_type()),
        "nullable": field.is_nullable(),
        "metadata": field.metadata(),
    })
}

// The types that `echolake_schema::tables` uses; all others would be text to a reader.
fn delta_type(data_type: &ArrowType) -> Value {
    match data_type {
        ArrowType::Boolean => json!("boolean"),
        ArrowType::Int32 => json!("integer"),
        ArrowType::Int64 => json!("long"),
        ArrowType::Float32 => json!("float"),
        ArrowType::Float64 => json!("double"),
        ArrowType::Timestamp(..) => json!("timestamp"),
        ArrowType::List(child) => json!({
            "type": "array",
            "elementType": delta_type(child.data_type()),
            "containsNull": child.is_nullable(),
        }),
        _ => json!("string"),
    }
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;

    use super::*;

    /// What the log says of a file is decoded once, whatever versions come after it; a version that is read by itself
    /// has equal files.
    #[tokio::test]
    async fn a_commit_decodes_its_own_files_alone() {
        let store = Arc::new(InMemory::new());
        let open = || DeltaLog { store: store.clone(), is_remote: false, rig: Rig::paper(), loaded: Mutex::default() };
        let (log, reader) = (open(), open());
        log.create_table(Table::Nce).await.expect("made");
        let mut seen = Vec::<Arc<DataFile>>::new();
        // A checkpoint is among these versions.
        for number in 0..25 {
            let stats = json!({ "numRecords": number, "minValues": { "pair_id": 1 }, "maxValues": { "pair_id": 7 } });
            let name = format!("flat.r{number:02}.ab.parquet");
            let new = NewFile { stats: stats.to_string(), ..file(&name, None) };
            let commit = TableCommit { add: vec![new], ..TableCommit::default() };
            log.commit_change(Table::Nce, &commit).await.expect("committed");
            let view = reader.view_table(Table::Nce).await.expect("read").expect("a table");
            let kept = seen.iter().filter(|known| view.files.iter().any(|file| Arc::ptr_eq(file, known)));
            assert_eq!((kept.count(), view.files.len()), (number, number + 1));
            seen = view.files;
        }
        let alone = log.view_at(Table::Nce, 25).await.expect("read").expect("a table").files;
        assert_eq!(alone, seen);
        assert!(!Arc::ptr_eq(&alone[3], &seen[3]));
        assert_eq!((seen[3].rows, &seen[3].name), (3, &FileName::parse(&seen[3].path)));
        assert!(log.has_file(Table::Nce, "flat.r03.ab.parquet").await.expect("looked"));
        assert!(!log.has_file(Table::Nce, "flat.r33.ab.parquet").await.expect("looked"));
    }

    fn file(name: &str, replaces: Option<(&str, &[&str])>) -> NewFile {
        let replaced = |(prefix, names): (&str, &[&str])| ReplacedFiles {
            prefix: Some(prefix.to_owned()).filter(|p| !p.is_empty()),
            files: names.iter().map(|name| logged(name, 3)).collect(),
        };
        let replaces = replaces.map(replaced).into_iter().collect();
        let (stats, parts, row_counts) = ("{}".into(), Vec::new(), None);
        NewFile { name: name.into(), bytes: 1, stats, replaces, parts, seen_runs: 0, run_version: 0, row_counts }
    }

    fn logged(name: &str, log_version: u64) -> LoggedFile {
        LoggedFile { name: name.to_owned(), log_version }
    }

    /// Files that version 3 of the log added, and whose authors had seen version 5 of `runs`.
    fn names(names: &[&str]) -> HashMap<String, KnownFile> {
        let known = || KnownFile { log_version: 3, seen_runs: 5, rows: Vec::new() };
        names.iter().map(|name| ((*name).to_owned(), known())).collect()
    }

    #[test]
    fn what_is_there_is_not_added_again_and_what_is_gone_not_removed() {
        let commit = TableCommit {
            add: vec![file("a", None), file("b", None), file("b", None)],
            remove: vec![logged("c", 3), logged("d", 3), logged("e", 2)],
            ..TableCommit::default()
        };
        let change = PendingChange::from_commit(&commit, names(&["a", "c", "e"]));
        assert_eq!(change.outcomes, [CommitOutcome::Before, CommitOutcome::Now, CommitOutcome::Before]);
        assert_eq!(change.add.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["b"]);
        assert_eq!(change.remove.iter().collect::<Vec<_>>(), ["c"]);
    }

    #[test]
    fn a_file_whose_author_missed_the_runs_present_row_is_added_again() {
        let outcome = |run_version| {
            let commit =
                TableCommit { add: vec![NewFile { run_version, ..file("a", None) }], ..TableCommit::default() };
            PendingChange::from_commit(&commit, names(&["a"])).outcomes[0]
        };
        assert_eq!([0, 5, 6].map(outcome), [CommitOutcome::Before, CommitOutcome::Before, CommitOutcome::Now]);
    }

    #[test]
    fn a_file_takes_the_place_of_what_it_expects_there_and_of_nothing_else() {
        let outcomes = |add: Vec<NewFile>, there: &[&str]| {
            let commit = TableCommit { add, ..TableCommit::default() };
            let change = PendingChange::from_commit(&commit, names(there));
            (change.outcomes.clone(), change.remove.into_iter().collect::<Vec<_>>())
        };
        let new = || file("x.2", Some(("x.", &["x.1"])));
        assert_eq!(outcomes(vec![new()], &["x.1", "y.1"]), (vec![CommitOutcome::Now], vec!["x.1".to_owned()]));
        assert_eq!(outcomes(vec![new()], &["x.3"]), (vec![CommitOutcome::Outdated], vec![]));
        assert_eq!(outcomes(vec![new()], &["x.1", "x.3"]), (vec![CommitOutcome::Outdated], vec![]));
        assert_eq!(outcomes(vec![new()], &["x.2"]), (vec![CommitOutcome::Before], vec![]));
        let merged = || file("m", Some(("", &["x.1", "y.1"])));
        let gone = vec!["x.1".to_owned(), "y.1".to_owned()];
        assert_eq!(outcomes(vec![merged()], &["x.1", "y.1", "x.2"]), (vec![CommitOutcome::Now], gone));
        assert_eq!(outcomes(vec![merged()], &["x.1", "y.2"]), (vec![CommitOutcome::Outdated], vec![]));
        // Of a merged file one row is replaced, and the file stays.
        let of_merged = || file("x.2", Some(("x.", &["m"])));
        assert_eq!(outcomes(vec![of_merged()], &["m", "y.1"]), (vec![CommitOutcome::Now], vec![]));
        assert_eq!(outcomes(vec![of_merged()], &["m", "x.3"]), (vec![CommitOutcome::Outdated], vec![]));
        assert_eq!(outcomes(vec![of_merged()], &["y.1"]), (vec![CommitOutcome::Outdated], vec![]), "merged anew");
        let mut older = new();
        older.replaces[0].files[0].log_version = 2;
        assert_eq!(outcomes(vec![older], &["x.1"]), (vec![CommitOutcome::Outdated], vec![]), "it was added again");
        let first = |name| file(name, Some(("x.", &[])));
        assert_eq!(
            outcomes(vec![first("x.1"), first("x.2")], &[]),
            (vec![CommitOutcome::Now, CommitOutcome::Outdated], vec![])
        );
    }
}
