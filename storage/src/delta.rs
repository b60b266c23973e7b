//! The commit log as Delta, reader version 1 and writer version 2, so that every Delta reader reads it.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use arrow::datatypes::{DataType as ArrowType, Field, SchemaRef};
use async_trait::async_trait;
use chrono::{DateTime, Utc};
use deltalake_core::kernel::transaction::{CommitBuilder, CommitConflictError, CommitProperties, TransactionError};
use deltalake_core::kernel::{
    Action, Add, ArrayType, DataType, LogicalFileView, MetadataValue, Remove, StructField, Transaction,
};
use deltalake_core::logstore::{LogStoreRef, StorageConfig, default_logstore};
use deltalake_core::operations::create::CreateBuilder;
use deltalake_core::protocol::{DeltaOperation, SaveMode};
use deltalake_core::{DeltaTable, DeltaTableError};
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::{ObjectStore, ObjectStoreExt as _};
use serde_json::{Map, Value};
use tokio::sync::Mutex;
use url::Url;

use crate::snapshot::{decode_parts, encode_parts, is_merged};
use crate::versions::{self, commit_name};
use crate::{
    Commit, CommitLog, Committed, DataFile, Effect, Error, FileStats, History, NewFile, Part, Result, TableVersion,
};

/// Tries of one commit against other writers; each loses to a commit that went through.
const COMMIT_TRIES: usize = 50;
/// The tag of a merged file's Add that holds its parts.
const PARTS: &str = "echolake.parts";
/// The application of all commits that take files away. Delta does not compare Removes that change no data with
/// those of others, so that two merges at once would double rows; of two commits of one application it tells.
const REMOVALS: &str = "echolake.removals";

/// The tables' Delta logs under `tables/`.
#[derive(Debug)]
pub(crate) struct DeltaLog {
    url: Url,
    root: Arc<dyn ObjectStore>,
    store: Arc<dyn ObjectStore>,
    rig: Rig,
    /// Loaded tables; a later look reads only what has come since.
    loaded: Mutex<HashMap<Table, DeltaTable>>,
}

impl DeltaLog {
    pub(crate) fn new(url: Url, root: Arc<dyn ObjectStore>, store: Arc<dyn ObjectStore>, rig: Rig) -> Self {
        Self { url, root, store, rig, loaded: Mutex::default() }
    }

    fn log_store(&self, table: Table) -> Result<LogStoreRef> {
        let folder = folder(table);
        let url = self
            .url
            .join(&format!("{folder}/"))
            .map_err(|e| Error::Location { location: self.url.to_string(), reason: e.to_string() })?;
        let prefixed = Arc::new(PrefixStore::new(self.store.clone(), folder));
        Ok(default_logstore(prefixed, self.root.clone(), &url, &StorageConfig::default()))
    }

    /// The table as of now, or None where there is none.
    async fn load(&self, table: Table) -> Result<Option<DeltaTable>> {
        let mut loaded = self.loaded.lock().await;
        let known = loaded.remove(&table);
        let mut delta = match known {
            Some(delta) => delta,
            None => DeltaTable::new(self.log_store(table)?),
        };
        match delta.update_state().await {
            Ok(()) => {
                loaded.insert(table, delta.clone());
                Ok(Some(delta))
            }
            Err(DeltaTableError::NotATable(_) | DeltaTableError::InvalidVersion(_)) => Ok(None),
            Err(e) if self.is_absent(&delta).await => {
                drop(e);
                Ok(None)
            }
            Err(e) => Err(Error::log(table.name(), "read", e)),
        }
    }

    async fn is_absent(&self, delta: &DeltaTable) -> bool {
        matches!(delta.verify_deltatable_existence().await, Ok(false))
    }

    async fn require(&self, table: Table) -> Result<DeltaTable> {
        self.load(table).await?.ok_or_else(|| Error::Log {
            table: table.name(),
            action: "read",
            reason: "it has no log; hint: `echolake ingest` makes it anew from the runs".into(),
        })
    }

    async fn names(&self, table: Table, delta: &DeltaTable) -> Result<HashSet<String>> {
        let broken = |e| Error::log(table.name(), "read", e);
        let log_store = delta.log_store();
        let views = delta.snapshot().map_err(broken)?.snapshot().file_views(log_store.as_ref(), None);
        views.map_ok(|f| f.path().into_owned()).try_collect().await.map_err(broken)
    }

    async fn try_commit(&self, delta: &DeltaTable, change: &Change<'_>) -> std::result::Result<(), DeltaTableError> {
        let now = Utc::now().timestamp_millis();
        let effect = change.effect;
        let mut actions: Vec<_> = change.add.iter().map(|f| Action::Add(add(f, now, effect))).collect();
        actions.extend(change.remove.iter().map(|name| Action::Remove(remove(name, now, effect))));
        // The ids only record. They make Delta tell of a conflict with a commit of the same ones; what is in the log
        // already is ours to see before each try.
        let mut properties = CommitProperties::default();
        for file in &change.add {
            properties = properties.with_application_transaction(Transaction::new(&file.name, 1));
            if let Some(prefix) = file.replaces.as_ref().and_then(|r| r.prefix.as_ref()) {
                properties = properties.with_application_transaction(Transaction::new(prefix, 1));
            }
        }
        if !change.remove.is_empty() {
            properties = properties.with_application_transaction(Transaction::new(REMOVALS, 1));
        }
        // Without a predicate Delta would not compare our Removes with what others add.
        let predicate = (!change.remove.is_empty()).then(|| "true".to_owned());
        let mode = if predicate.is_some() { SaveMode::Overwrite } else { SaveMode::Append };
        let operation = match effect {
            Effect::Rows => DeltaOperation::Write { mode, partition_by: None, predicate },
            Effect::Layout => {
                let bytes = change.add.iter().map(|f| f.bytes).max().unwrap_or(0);
                DeltaOperation::Optimize { predicate: None, target_size: i64::try_from(bytes).unwrap_or(i64::MAX) }
            }
        };
        CommitBuilder::from(properties)
            .with_actions(actions)
            .build(Some(delta.snapshot()?), delta.log_store(), operation)
            .await
            .map(drop)
    }
}

/// What is left to do of a commit in one version of a table.
struct Change<'a> {
    outcomes: Vec<Committed>,
    add: Vec<&'a NewFile>,
    remove: BTreeSet<String>,
    effect: Effect,
}

impl<'a> Change<'a> {
    fn of(commit: &'a Commit, mut names: HashSet<String>) -> Self {
        let gone = commit.remove.iter().filter_map(Path::filename).filter(|n| names.contains(*n));
        let remove = gone.map(str::to_owned).collect();
        let mut change = Self { outcomes: Vec::new(), add: Vec::new(), remove, effect: commit.effect };
        for file in &commit.add {
            let outcome = change.outcome(file, &names);
            if outcome == Committed::Now {
                if let Some(replaces) = &file.replaces {
                    names.retain(|name| !replaces.names.contains(name));
                    change.remove.extend(replaces.names.iter().cloned());
                }
                names.insert(file.name.clone());
                change.remove.remove(&file.name);
                change.add.push(file);
            }
            change.outcomes.push(outcome);
        }
        change
    }

    fn outcome(&self, file: &NewFile, names: &HashSet<String>) -> Committed {
        if names.contains(&file.name) {
            return Committed::Before;
        }
        let Some(replaces) = &file.replaces else { return Committed::Now };
        let expected = replaces.names.iter().all(|n| names.contains(n));
        let alone = replaces
            .prefix
            .as_ref()
            .is_none_or(|prefix| names.iter().filter(|n| n.starts_with(prefix)).count() == replaces.names.len());
        if expected && alone { Committed::Now } else { Committed::Outdated }
    }
}

/// A table's folder in the lake.
pub(crate) fn folder(table: Table) -> Path {
    Path::from(format!("tables/{}", table.name()))
}

#[async_trait]
impl CommitLog for DeltaLog {
    async fn ensure(&self, table: Table) -> Result<()> {
        if self.load(table).await?.is_some() {
            return Ok(());
        }
        let made = CreateBuilder::new()
            .with_log_store(self.log_store(table)?)
            .with_table_name(table.name())
            .with_columns(delta_columns(&table.schema(&self.rig)))
            .with_save_mode(SaveMode::Ignore)
            .await;
        match made {
            Ok(_) => Ok(()),
            // Somebody else made it at the same moment.
            Err(_) if self.load(table).await?.is_some() => Ok(()),
            Err(e) => Err(Error::log(table.name(), "written", e)),
        }
    }

    async fn files(&self, table: Table) -> Result<Vec<DataFile>> {
        match self.load(table).await? {
            Some(delta) => files_of(table, &delta).await,
            None => Ok(Vec::new()),
        }
    }

    async fn version(&self, table: Table) -> Result<Option<u64>> {
        Ok(self.load(table).await?.and_then(|delta| delta.version()))
    }

    async fn has_after(&self, table: Table, version: u64) -> Result<bool> {
        let next = folder(table).join("_delta_log").join(commit_name(version + 1));
        match self.store.head(&next).await {
            Ok(_) => Ok(true),
            Err(object_store::Error::NotFound { .. }) => Ok(false),
            Err(e) => Err(Error::store("read", next, e)),
        }
    }

    async fn versions(&self, table: Table) -> Result<Vec<TableVersion>> {
        versions::listed(self.store.as_ref(), table).await
    }

    async fn files_at(&self, table: Table, version: u64) -> Result<Vec<DataFile>> {
        let mut delta = DeltaTable::new(self.log_store(table)?);
        delta.load_version(version).await.map_err(|e| Error::log(table.name(), "read", e))?;
        files_of(table, &delta).await
    }

    async fn has(&self, table: Table, name: &str) -> Result<bool> {
        match self.load(table).await? {
            Some(delta) => Ok(self.names(table, &delta).await?.contains(name)),
            None => Ok(false),
        }
    }

    async fn history(&self, table: Table) -> Result<Option<History>> {
        let Some(delta) = self.load(table).await? else { return Ok(None) };
        let mut history = History { current: self.names(table, &delta).await?, ..History::default() };
        let broken = |e| Error::log(table.name(), "read", e);
        let log_store = delta.log_store();
        let mut gone = delta.snapshot().map_err(broken)?.all_tombstones(log_store.as_ref());
        while let Some(tombstone) = gone.try_next().await.map_err(broken)? {
            let at = tombstone.deletion_timestamp().and_then(DateTime::from_timestamp_millis);
            let known = history.removed.entry(tombstone.path().into_owned()).or_default();
            *known = at.unwrap_or_default().max(*known);
        }
        Ok(Some(history))
    }

    async fn commit(&self, table: Table, commit: &Commit) -> Result<Vec<Committed>> {
        for _ in 0..COMMIT_TRIES {
            let delta = self.require(table).await?;
            let change = Change::of(commit, self.names(table, &delta).await?);
            if change.add.is_empty() && change.remove.is_empty() {
                return Ok(change.outcomes);
            }
            match self.try_commit(&delta, &change).await {
                Ok(()) => return Ok(change.outcomes),
                Err(e) if is_conflict(&e) => {}
                Err(e) => return Err(Error::log(table.name(), "written", e)),
            }
        }
        let reason = format!("{COMMIT_TRIES} tries lost to other writers; hint: run the command again");
        Err(Error::Log { table: table.name(), action: "written", reason })
    }
}

async fn files_of(table: Table, delta: &DeltaTable) -> Result<Vec<DataFile>> {
    let broken = |e| Error::log(table.name(), "read", e);
    let state = delta.snapshot().map_err(broken)?;
    let log_store = delta.log_store();
    let views = state.snapshot().file_views(log_store.as_ref(), None);
    let views: Vec<_> = views.try_collect().await.map_err(broken)?;
    let mut files = Vec::with_capacity(views.len());
    for view in views {
        files.push(DataFile {
            path: folder(table).join(view.path().as_ref()),
            bytes: u64::try_from(view.size()).unwrap_or(0),
            rows: view.num_records().unwrap_or(0) as u64,
            modified: view.modification_datetime().unwrap_or(DateTime::UNIX_EPOCH),
            stats: view.stats().as_deref().and_then(parse_stats),
            parts: if is_merged(&view.path()) { parts(table, &view)? } else { Vec::new() },
            hidden: Vec::new(),
        });
    }
    files.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(files)
}

fn is_conflict(error: &DeltaTableError) -> bool {
    match error {
        DeltaTableError::VersionAlreadyExists(_) => true,
        DeltaTableError::Transaction { source } => match source {
            TransactionError::CommitConflict(conflict) => matches!(
                conflict,
                CommitConflictError::ConcurrentAppend
                    | CommitConflictError::ConcurrentDeleteRead
                    | CommitConflictError::ConcurrentDeleteDelete
                    | CommitConflictError::ConcurrentTransaction
            ),
            TransactionError::VersionAlreadyExists(_) | TransactionError::MaxCommitAttempts(_) => true,
            _ => false,
        },
        _ => false,
    }
}

// The view has no other way to a file's tags.
#[expect(deprecated)]
fn parts(table: Table, view: &LogicalFileView) -> Result<Vec<Part>> {
    let tags = view.add_action().tags.unwrap_or_default();
    let text = tags.get(PARTS).cloned().flatten();
    text.and_then(|text| decode_parts(&text)).ok_or_else(|| {
        let reason = format!(
            "`{}` has lost the list of its parts; hint: delete the table's folder, `echolake ingest` makes it anew",
            view.path()
        );
        Error::Log { table: table.name(), action: "read", reason }
    })
}

fn add(file: &NewFile, now_millis: i64, effect: Effect) -> Add {
    let parts = (!file.parts.is_empty()).then(|| encode_parts(&file.parts));
    Add {
        path: file.name.clone(),
        size: i64::try_from(file.bytes).unwrap_or(i64::MAX),
        modification_time: now_millis,
        data_change: effect == Effect::Rows,
        stats: Some(file.stats.clone()),
        tags: parts.map(|parts| HashMap::from([(PARTS.to_owned(), Some(parts))])),
        ..Add::default()
    }
}

fn remove(name: &str, now_millis: i64, effect: Effect) -> Remove {
    let data_change = effect == Effect::Rows;
    Remove { path: name.to_owned(), data_change, deletion_timestamp: Some(now_millis), ..Remove::default() }
}

fn parse_stats(json: &str) -> Option<FileStats> {
    let mut stats: Map<String, Value> = serde_json::from_str(json).ok()?;
    let mut take = |key| match stats.remove(key) {
        Some(Value::Object(values)) => values,
        _ => Map::new(),
    };
    Some(FileStats { min: take("minValues"), max: take("maxValues") })
}

fn delta_columns(schema: &SchemaRef) -> Vec<StructField> {
    schema.fields().iter().map(|f| delta_column(f)).collect()
}

fn delta_column(field: &Field) -> StructField {
    let metadata = field.metadata().iter().map(|(k, v)| (k.clone(), MetadataValue::String(v.clone())));
    StructField::new(field.name().clone(), delta_type(field.data_type()), field.is_nullable()).with_metadata(metadata)
}

// The types that `echolake_schema::tables` uses; all others would be text to a reader.
fn delta_type(data_type: &ArrowType) -> DataType {
    match data_type {
        ArrowType::Boolean => DataType::BOOLEAN,
        ArrowType::Int32 => DataType::INTEGER,
        ArrowType::Int64 => DataType::LONG,
        ArrowType::Float32 => DataType::FLOAT,
        ArrowType::Float64 => DataType::DOUBLE,
        ArrowType::Timestamp(..) => DataType::TIMESTAMP,
        ArrowType::List(child) => ArrayType::new(delta_type(child.data_type()), child.is_nullable()).into(),
        _ => DataType::STRING,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Replaces;

    fn file(name: &str, replaces: Option<(&str, &[&str])>) -> NewFile {
        let replaces = replaces.map(|(prefix, names)| Replaces {
            prefix: Some(prefix.to_owned()).filter(|p| !p.is_empty()),
            names: names.iter().map(|n| (*n).to_owned()).collect(),
        });
        NewFile { name: name.into(), bytes: 1, stats: "{}".into(), replaces, parts: Vec::new() }
    }

    fn names(names: &[&str]) -> HashSet<String> {
        names.iter().map(|n| (*n).to_owned()).collect()
    }

    #[test]
    fn what_is_there_is_not_added_again_and_what_is_gone_not_removed() {
        let commit = Commit {
            add: vec![file("a", None), file("b", None), file("b", None)],
            remove: vec![Path::from("tables/runs/c"), Path::from("tables/runs/d")],
            effect: Effect::Rows,
        };
        let change = Change::of(&commit, names(&["a", "c"]));
        assert_eq!(change.outcomes, [Committed::Before, Committed::Now, Committed::Before]);
        assert_eq!(change.add.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["b"]);
        assert_eq!(change.remove.iter().collect::<Vec<_>>(), ["c"]);
    }

    #[test]
    fn a_file_takes_the_place_of_what_it_expects_there_and_of_nothing_else() {
        let outcomes = |add: Vec<NewFile>, there: &[&str]| {
            let commit = Commit { add, ..Commit::default() };
            let change = Change::of(&commit, names(there));
            (change.outcomes.clone(), change.remove.into_iter().collect::<Vec<_>>())
        };
        let new = || file("x.2", Some(("x.", &["x.1"])));
        assert_eq!(outcomes(vec![new()], &["x.1", "y.1"]), (vec![Committed::Now], vec!["x.1".to_owned()]));
        assert_eq!(outcomes(vec![new()], &["x.3"]), (vec![Committed::Outdated], vec![]));
        assert_eq!(outcomes(vec![new()], &["x.1", "x.3"]), (vec![Committed::Outdated], vec![]));
        assert_eq!(outcomes(vec![new()], &["x.2"]), (vec![Committed::Before], vec![]));
        let merged = || file("m", Some(("", &["x.1", "y.1"])));
        let gone = vec!["x.1".to_owned(), "y.1".to_owned()];
        assert_eq!(outcomes(vec![merged()], &["x.1", "y.1", "x.2"]), (vec![Committed::Now], gone));
        assert_eq!(outcomes(vec![merged()], &["x.1", "y.2"]), (vec![Committed::Outdated], vec![]));
        let first = |name| file(name, Some(("x.", &[])));
        assert_eq!(
            outcomes(vec![first("x.1"), first("x.2")], &[]),
            (vec![Committed::Now, Committed::Outdated], vec![])
        );
    }
}
