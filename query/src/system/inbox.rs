//! `system.inbox`: run files of the lake's folder that are in no table yet: waiting, being recorded, or refused.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{Int64Array, StringArray, TimestampMicrosecondArray};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::{DataFusionError, Result};
use echolake_lake::Lake;
use futures::{StreamExt as _, TryStreamExt as _, stream};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt as _};

use super::{SystemRows, batch, column, schema, time};

/// End of the name of a reason beside a refused file.
const REASON: &str = ".reason.txt";
/// Bytes of a reason that are read.
const LONGEST_REASON: u64 = 4096;
/// Reasons that are read at once.
const READS_AT_ONCE: usize = 16;

#[derive(Debug)]
pub(super) struct LakeInbox {
    pub(super) lake: Lake,
}

/// A run file, and the object with its reason.
struct InboxFile {
    state: &'static str,
    object: ObjectMeta,
    reason: Option<ObjectMeta>,
}

/// The columns of the table.
pub(super) fn columns() -> SchemaRef {
    schema([
        column("state", DataType::Utf8, false, "", "waiting (for ingest), recording (not closed), or refused"),
        column("path", DataType::Utf8, false, "", "Path of the file in the lake"),
        column("bytes", DataType::Int64, false, "B", "Size"),
        column("changed", time(), false, "", "Time of its last change, UTC"),
        column("reason", DataType::Utf8, true, "", "Why ingest refused it, the first 4096 bytes; null if it did not"),
    ])
}

#[async_trait]
impl SystemRows for LakeInbox {
    fn schema(&self) -> SchemaRef {
        columns()
    }

    async fn rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        let files = self.files().await.map_err(store_failed)?;
        let reasons: Vec<_> = files.iter().map(|file| file.reason.clone()).collect();
        let reasons = stream::iter(reasons).map(|reason| self.text(reason)).buffered(READS_AT_ONCE);
        let reasons: Vec<Option<String>> = reasons.try_collect().await.map_err(store_failed)?;
        let state = StringArray::from_iter_values(files.iter().map(|file| file.state));
        let path = StringArray::from_iter_values(files.iter().map(|file| file.object.location.as_ref()));
        let bytes = Int64Array::from_iter_values(files.iter().map(|file| file.object.size as i64));
        let changed = files.iter().map(|file| file.object.last_modified.timestamp_micros());
        batch(
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
    async fn files(&self) -> object_store::Result<Vec<InboxFile>> {
        if self.lake.is_restricted() {
            return Ok(Vec::new());
        }
        let (inbox, refused) = futures::try_join!(self.objects("inbox"), self.objects("quarantine"))?;
        let mut reasons: HashMap<Path, ObjectMeta> =
            refused.iter().filter(|o| is_reason(o)).map(|o| (o.location.clone(), o.clone())).collect();
        let waiting = inbox.into_iter().filter_map(|object| {
            let state = waiting_state(&object)?;
            Some(InboxFile { state, object, reason: None })
        });
        let refused = refused.into_iter().filter(is_run_file).map(|object| {
            let reason = reasons.remove(&Path::from(format!("{}{REASON}", object.location)));
            InboxFile { state: "refused", object, reason }
        });
        Ok(waiting.chain(refused).collect())
    }

    async fn objects(&self, folder: &str) -> object_store::Result<Vec<ObjectMeta>> {
        let mut all: Vec<_> = self.lake.store().list(Some(&Path::from(folder))).try_collect().await?;
        all.sort_by(|a: &ObjectMeta, b| a.location.cmp(&b.location));
        Ok(all)
    }

    async fn text(&self, reason: Option<ObjectMeta>) -> object_store::Result<Option<String>> {
        let Some(reason) = reason.filter(|reason| reason.size > 0) else { return Ok(None) };
        match self.lake.store().get_range(&reason.location, 0..reason.size.min(LONGEST_REASON)).await {
            Ok(bytes) => Ok(Some(String::from_utf8_lossy(&bytes).trim_end().to_owned())),
            // Somebody has just cleaned up.
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(failed) => Err(failed),
        }
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
        return Some("waiting");
    }
    object.location.as_ref().ends_with(".mcap.partial").then_some("recording")
}

fn store_failed(failed: object_store::Error) -> DataFusionError {
    DataFusionError::External(Box::new(failed))
}
