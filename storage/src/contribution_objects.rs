//! What users added to lakes of earlier versions of the program: numbered objects beside `tables/`, a JSON line per
//! annotation or a Parquet file of predictions. The first writer copies them into the tables; readers read both until
//! then. The objects stay, for earlier versions of the lake.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, StringArray, new_null_array};
use arrow::compute::concat_batches;
use arrow::datatypes::FieldRef;
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use echolake_schema::annotations::Annotation;
use echolake_schema::tables::Table;
use echolake_schema::{ProjectName, RunId};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use crate::contributions::annotation_rows;
use crate::{Error, Lake, LakeSnapshot, Result};

/// Objects that are read concurrently.
const CONCURRENT_READS: usize = 16;

fn object_extension(table: Table) -> &'static str {
    if table == Table::Annotations { "ndjson" } else { "parquet" }
}

fn object_path(table: Table, number: u64) -> Path {
    Path::from(table.name()).join(format!("{number:020}.{}", object_extension(table)))
}

/// Returns the highest number of a table's objects; 0 if there are none.
pub(crate) async fn last_object(store: &dyn ObjectStore, table: Table) -> Result<u64> {
    let folder = Path::from(table.name());
    let listed: Vec<_> =
        store.list(Some(&folder)).try_collect().await.map_err(|e| Error::store_failure("list", &folder, e))?;
    let numbers = listed.iter().filter_map(|meta| {
        let digits = meta.location.filename()?.strip_suffix(object_extension(table))?.strip_suffix('.')?;
        (digits.len() == 20).then(|| digits.parse().ok()).flatten()
    });
    Ok(numbers.max().unwrap_or(0))
}

impl Lake {
    /// Reads the objects after the first `numbers.start` up to number `numbers.end` as rows of their table; None if
    /// there are none. A snapshot tells surfaces and projects; of a restricted lake, rows of others are left out.
    pub(crate) async fn read_objects(
        &self,
        table: Table,
        numbers: Range<u64>,
        snapshot: &LakeSnapshot,
    ) -> Result<Option<RecordBatch>> {
        let store = self.store();
        let read = futures::stream::iter(numbers.map(|before| object_path(table, before + 1))).map(|path| {
            let store = store.clone();
            async move {
                match store.get(&path).await {
                    Ok(found) => {
                        let bytes = found.bytes().await.map_err(|e| Error::store_failure("read", &path, e))?;
                        Ok((path, bytes))
                    }
                    Err(e) => Err(Error::unread_file(&path, e)),
                }
            }
        });
        let objects: Vec<(Path, Bytes)> = read.buffered(CONCURRENT_READS).try_collect().await?;
        // A reader of some projects does not see who else has a surface of the same name.
        let whole = match self.is_restricted() && table == Table::Predictions {
            true => &LakeSnapshot::take_from(self.delta_log(), &[]).await?,
            false => snapshot,
        };
        let mut batches = Vec::new();
        for (path, bytes) in objects {
            let damaged = |reason: String| Error::DataFile { file: path.to_string(), source: reason.into() };
            // An empty file in the place of one that was lost gives it up.
            match table {
                _ if bytes.is_empty() => {}
                Table::Annotations => {
                    let all = parse_annotations(&bytes).map_err(damaged)?;
                    let is_visible = |a: &Annotation| !self.is_restricted() || snapshot.run(&a.run_id).is_some();
                    let mut visible: Vec<_> = all.into_iter().filter(is_visible).collect();
                    // How many versions others add is a matter of other projects.
                    visible.iter_mut().filter(|_| self.is_restricted()).for_each(|a| a.lake_version = None);
                    batches.push(annotation_rows(self, snapshot, &visible)?);
                }
                _ => batches.push(self.prediction_rows(bytes, whole, snapshot).map_err(damaged)?),
            }
        }
        let all = concat_batches(&table.schema(self.rig()), &batches);
        let all = all.map_err(|e| Error::Encode { table: table.name(), reason: e.to_string() })?;
        Ok(Some(all).filter(|rows| rows.num_rows() > 0))
    }

    // The objects tell no project. Rows on a surface that runs of two projects have are seen by readers of all projects
    // alone.
    fn prediction_rows(
        &self,
        bytes: Bytes,
        whole: &LakeSnapshot,
        snapshot: &LakeSnapshot,
    ) -> std::result::Result<RecordBatch, String> {
        let table = Table::Predictions;
        let schema = table.schema(self.rig());
        let mut anchors = BTreeMap::<&str, (&RunId, BTreeSet<Option<&ProjectName>>)>::new();
        for run in whole.runs() {
            let anchor = anchors.entry(run.surface.as_str()).or_insert((&run.run, BTreeSet::new()));
            anchor.0 = &run.run;
            anchor.1.insert(whole.project_of(&run.run));
        }
        let reader = ParquetRecordBatchReaderBuilder::try_new(bytes).map_err(|e| e.to_string())?;
        let batches = reader.build().and_then(|batches| Ok(batches.collect::<std::result::Result<Vec<_>, _>>()?));
        let batches = batches.map_err(|e| e.to_string())?;
        let mut rows = Vec::with_capacity(batches.len());
        for batch in batches {
            let surfaces = batch.column_by_name("surface_id").and_then(|c| c.as_string_opt::<i32>()).cloned();
            let surfaces = surfaces.ok_or("column `surface_id` is missing")?;
            let anchor = |surface: Option<&str>| anchors.get(surface?);
            let run = |surface: Option<&str>| anchor(surface).map_or("unknown", |(run, _)| run.as_str());
            let project = |surface: Option<&str>| match anchor(surface) {
                Some((_, projects)) if projects.len() == 1 => projects.first().copied().flatten().map(|p| p.as_str()),
                _ => None,
            };
            let column = |field: &FieldRef| -> ArrayRef {
                match (field.name().as_str(), batch.column_by_name(field.name())) {
                    ("run_id", _) => Arc::new(surfaces.iter().map(run).map(Some).collect::<StringArray>()),
                    ("project", _) => Arc::new(surfaces.iter().map(project).collect::<StringArray>()),
                    (_, Some(values)) => values.clone(),
                    (_, None) => new_null_array(field.data_type(), batch.num_rows()),
                }
            };
            let whole = RecordBatch::try_new(schema.clone(), schema.fields().iter().map(column).collect());
            let whole = whole.map_err(|e| e.to_string())?;
            let is_own = |(run, projects): &(&RunId, BTreeSet<_>)| projects.len() == 1 && snapshot.run(run).is_some();
            let visible = surfaces.iter().map(|surface| Some(!self.is_restricted() || is_own(anchor(surface)?)));
            let visible = arrow::compute::filter_record_batch(&whole, &visible.collect());
            rows.push(visible.map_err(|e| e.to_string())?);
        }
        concat_batches(&schema, &rows).map_err(|e| e.to_string())
    }
}

fn parse_annotations(bytes: &[u8]) -> std::result::Result<Vec<Annotation>, String> {
    let lines = bytes.split(|byte| *byte == b'\n').filter(|line| !line.is_empty()).enumerate();
    lines.map(|(i, line)| serde_json::from_slice(line).map_err(|e| format!("line {}: {e}", i + 1))).collect()
}
