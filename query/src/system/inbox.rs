//! `system.inbox`: run files of the lake's folder that are in no table yet: waiting, being recorded or copied, or
//! refused; and entries of the inbox that nothing opens.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{Int64Array, StringArray, TimestampMicrosecondArray};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::{DataFusionError, Result};
use echolake_lake::{Lake, UnusableEntry};
use echolake_recording::{FILE_END_BYTES, has_file_end};
use futures::{StreamExt as _, TryStreamExt as _, stream};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt as _};

use super::{SystemRows, build_batch, build_schema, column_field, time_type};

/// End of the name of a reason beside a refused file.
const REASON: &str = ".reason.txt";
/// Bytes of a reason that are read.
const LONGEST_REASON: u64 = 4096;
/// Reasons that are read at once.
const READS_AT_ONCE: usize = 16;

/// State of a closed file that the next ingest reads.
const WAITING: &str = "waiting";
/// State of a run file without its end.
const INCOMPLETE: &str = "incomplete";

#[derive(Debug)]
pub(super) struct LakeInbox {
    pub lake: Lake,
}

/// A run file or another entry, and why it is not ingested.
struct InboxFile {
    state: &'static str,
    path: String,
    bytes: u64,
    changed_micros: i64,
    reason: InboxReason,
}

/// The reason why a file is not ingested.
enum InboxReason {
    None,
    Text(String),
    /// It is in this object.
    Object(ObjectMeta),
}

/// The columns of the table.
pub(super) fn table_schema() -> SchemaRef {
    build_schema([
        column_field(
            "state",
            DataType::Utf8,
            false,
            "",
            "waiting (for ingest), recording (not closed), incomplete (no end yet), refused, or unusable (never \
                opened)",
        ),
        column_field("path", DataType::Utf8, false, "", "Path of the file in the lake"),
        column_field("bytes", DataType::Int64, false, "B", "Size"),
        column_field("changed", time_type(), false, "", "Time of its last change, UTC"),
        column_field(
            "reason",
            DataType::Utf8,
            true,
            "",
            "Why ingest refuses it, the first 4096 bytes; null if it does not",
        ),
    ])
}

#[async_trait]
impl SystemRows for LakeInbox {
    fn schema(&self) -> SchemaRef {
        table_schema()
    }

    async fn read_rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        let mut files = self.list_files().await?;
        let reasons: Vec<_> =
            files.iter_mut().map(|file| std::mem::replace(&mut file.reason, InboxReason::None)).collect();
        let reasons = stream::iter(reasons).map(|reason| self.read_reason(reason)).buffered(READS_AT_ONCE);
        let reasons: Vec<Option<String>> = reasons.try_collect().await.map_err(store_failed)?;
        let state = StringArray::from_iter_values(files.iter().map(|file| file.state));
        let path = StringArray::from_iter_values(files.iter().map(|file| file.path.as_str()));
        let bytes = Int64Array::from_iter_values(files.iter().map(|file| file.bytes as i64));
        let changed = files.iter().map(|file| file.changed_micros);
        build_batch(
            self.schema(),
            vec![
                Arc::new(state),
                Arc::new(path),
                Arc::new(bytes),
                Arc::new(TimestampMicrosecondArray::from_iter_values(changed).with_timezone("UTC")),
                Arc::new(reasons.into_iter().collect::<StringArray>()),
            ],
        )
    }
}

impl LakeInbox {
    // None for readers of some projects: a file's project is not known before it is ingested.
    async fn list_files(&self) -> Result<Vec<InboxFile>> {
        if self.lake.is_restricted() {
            return Ok(Vec::new());
        }
        let listed = futures::try_join!(self.lake.list_folder("inbox"), self.lake.list_folder("quarantine"));
        let (inbox, quarantine) = listed.map_err(|e| DataFusionError::External(Box::new(e)))?;
        let mut files = Vec::new();
        for object in inbox.files {
            match waiting_state(&object) {
                Some(WAITING) if !self.has_end(&object).await => files.push(InboxFile::from_object(INCOMPLETE, object)),
                Some(state) => files.push(InboxFile::from_object(state, object)),
                None => {}
            }
        }
        files.extend(inbox.unusable.into_iter().map(|UnusableEntry { path, reason, bytes, changed }| {
            let changed_micros = changed.timestamp_micros();
            InboxFile { state: "unusable", path, bytes, changed_micros, reason: InboxReason::Text(reason) }
        }));
        let mut reasons: HashMap<Path, ObjectMeta> =
            quarantine.files.iter().filter(|o| is_reason(o)).map(|o| (o.location.clone(), o.clone())).collect();
        for object in quarantine.files.into_iter().filter(is_run_file) {
            let reason =
                Path::parse(format!("{}{REASON}", object.location)).ok().and_then(|path| reasons.remove(&path));
            let reason = reason.map_or(InboxReason::None, InboxReason::Object);
            files.push(InboxFile { reason, ..InboxFile::from_object("refused", object) });
        }
        Ok(files)
    }

    // An object store shows no object before it is whole. What cannot be read waits for ingest to say so.
    async fn has_end(&self, object: &ObjectMeta) -> bool {
        let range = object.size.saturating_sub(FILE_END_BYTES)..object.size;
        if self.lake.is_remote() || range.is_empty() {
            return self.lake.is_remote();
        }
        let tail = self.lake.store().get_range(&object.location, range).await;
        tail.map_or(true, |tail| has_file_end(&tail))
    }

    async fn read_reason(&self, reason: InboxReason) -> object_store::Result<Option<String>> {
        let reason = match reason {
            InboxReason::Object(reason) if reason.size > 0 => reason,
            InboxReason::Text(text) => return Ok(Some(text)),
            InboxReason::Object(_) | InboxReason::None => return Ok(None),
        };
        match self.lake.store().get_range(&reason.location, 0..reason.size.min(LONGEST_REASON)).await {
            Ok(bytes) => Ok(Some(String::from_utf8_lossy(&bytes).trim_end().to_owned())),
            // Somebody has just cleaned up.
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(failed) => Err(failed),
        }
    }
}

impl InboxFile {
    fn from_object(state: &'static str, object: ObjectMeta) -> Self {
        let ObjectMeta { location, size, last_modified, .. } = object;
        let changed_micros = last_modified.timestamp_micros();
        Self { state, path: location.to_string(), bytes: size, changed_micros, reason: InboxReason::None }
    }
}

fn is_reason(object: &ObjectMeta) -> bool {
    object.location.as_ref().ends_with(REASON)
}

fn is_run_file(object: &ObjectMeta) -> bool {
    object.location.as_ref().ends_with(".mcap")
}

fn waiting_state(object: &ObjectMeta) -> Option<&'static str> {
    if is_run_file(object) {
        return Some(WAITING);
    }
    object.location.as_ref().ends_with(".mcap.partial").then_some("recording")
}

fn store_failed(failed: object_store::Error) -> DataFusionError {
    DataFusionError::External(Box::new(failed))
}
