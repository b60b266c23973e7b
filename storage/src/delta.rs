//! The commit log as Delta, reader version 1 and writer version 2, so that every Delta reader reads it.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use arrow::datatypes::{DataType as ArrowType, Field, SchemaRef};
use async_trait::async_trait;
use chrono::{DateTime, Utc};
use deltalake_core::kernel::transaction::{CommitBuilder, CommitConflictError, CommitProperties, TransactionError};
use deltalake_core::kernel::{Action, Add, ArrayType, DataType, MetadataValue, Remove, StructField, Transaction};
use deltalake_core::logstore::{LogStoreRef, StorageConfig, default_logstore};
use deltalake_core::operations::create::CreateBuilder;
use deltalake_core::protocol::{DeltaOperation, SaveMode};
use deltalake_core::{DeltaTable, DeltaTableError};
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use futures::TryStreamExt as _;
use object_store::ObjectStore;
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use serde_json::{Map, Value};
use tokio::sync::Mutex;
use url::Url;

use crate::{Commit, CommitLog, Committed, DataFile, Error, FileStats, Result};

/// Tries of one commit against other writers; each loses to a commit that went through.
const COMMIT_TRIES: usize = 50;

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

    async fn try_commit(&self, delta: &DeltaTable, commit: &Commit) -> std::result::Result<(), DeltaTableError> {
        let present: HashSet<_> = match commit.remove.is_empty() {
            true => HashSet::new(),
            false => {
                let state = delta.snapshot()?;
                state
                    .snapshot()
                    .file_views(delta.log_store().as_ref(), None)
                    .map_ok(|f| f.path().into_owned())
                    .try_collect()
                    .await?
            }
        };
        let now = Utc::now().timestamp_millis();
        let mut actions: Vec<_> = commit.add.iter().map(|f| Action::Add(add(f, now))).collect();
        let gone = commit.remove.iter().filter_map(Path::filename).filter(|n| present.contains(*n));
        actions.extend(gone.map(|name| Action::Remove(remove(name, now))));
        if actions.is_empty() && commit.transaction.is_none() {
            return Ok(());
        }
        let properties = match &commit.transaction {
            Some(id) => CommitProperties::default().with_application_transaction(Transaction::new(id, 1)),
            None => CommitProperties::default(),
        };
        // Without a predicate Delta would not compare our Removes with what others add.
        let predicate = (!commit.remove.is_empty()).then(|| "true".to_owned());
        let mode = if predicate.is_some() { SaveMode::Overwrite } else { SaveMode::Append };
        let operation = DeltaOperation::Write { mode, partition_by: None, predicate };
        CommitBuilder::from(properties)
            .with_actions(actions)
            .build(Some(delta.snapshot()?), delta.log_store(), operation)
            .await
            .map(drop)
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
        let Some(delta) = self.load(table).await? else { return Ok(Vec::new()) };
        let broken = |e| Error::log(table.name(), "read", e);
        let state = delta.snapshot().map_err(broken)?;
        let log_store = delta.log_store();
        let views = state.snapshot().file_views(log_store.as_ref(), None);
        let mut files: Vec<_> = views
            .map_ok(|view| DataFile {
                path: folder(table).join(view.path().as_ref()),
                bytes: u64::try_from(view.size()).unwrap_or(0),
                rows: view.num_records().unwrap_or(0) as u64,
                modified: view.modification_datetime().unwrap_or(DateTime::UNIX_EPOCH),
                stats: view.stats().as_deref().and_then(parse_stats),
            })
            .try_collect()
            .await
            .map_err(broken)?;
        files.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(files)
    }

    async fn has(&self, table: Table, transaction: &str) -> Result<bool> {
        let Some(delta) = self.load(table).await? else { return Ok(false) };
        let broken = |e| Error::log(table.name(), "read", e);
        let log_store = delta.log_store();
        let state = delta.snapshot().map_err(broken)?;
        Ok(state.transaction_version(log_store.as_ref(), transaction).await.map_err(broken)?.is_some())
    }

    async fn commit(&self, table: Table, commit: Commit) -> Result<Committed> {
        for _ in 0..COMMIT_TRIES {
            // The transaction id only records: whether it is there is ours to ask, before each try.
            if let Some(id) = &commit.transaction
                && self.has(table, id).await?
            {
                return Ok(Committed::Before);
            }
            let delta = self.require(table).await?;
            match self.try_commit(&delta, &commit).await {
                Ok(()) => return Ok(Committed::Now),
                Err(e) if is_conflict(&e) => {}
                Err(e) => return Err(Error::log(table.name(), "written", e)),
            }
        }
        let reason = format!("{COMMIT_TRIES} tries lost to other writers; hint: run the command again");
        Err(Error::Log { table: table.name(), action: "written", reason })
    }
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

fn add(file: &crate::NewFile, now_millis: i64) -> Add {
    Add {
        path: file.name.clone(),
        size: i64::try_from(file.bytes).unwrap_or(i64::MAX),
        modification_time: now_millis,
        data_change: true,
        stats: Some(file.stats.clone()),
        ..Add::default()
    }
}

fn remove(name: &str, now_millis: i64) -> Remove {
    Remove { path: name.to_owned(), data_change: true, deletion_timestamp: Some(now_millis), ..Remove::default() }
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
