//! What users add to a lake: annotations and predictions, in tables of their own, to which rows are only added.
//!
//! 1. A writer puts a file of rows into the store and adds it to the table as the version after the one that it looked
//!    at. Of several writers of a version one succeeds; the others look again.
//! 2. A commit of `runs` names the table's version that readers see, as Delta's action `txn`. So one number names the
//!    state of everything.
//!
//! Rows whose second commit is missing, because their writer ended between the two, are seen with the next one.

use std::ops::Range;
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, Int32Builder, Int64Array, ListArray, ListBuilder, StringArray,
    TimestampMicrosecondArray, UInt32Array,
};
use arrow::compute::{SortColumn, lexsort_to_indices, partition, take_record_batch};
use arrow::datatypes::{DataType, Field, Int32Type};
use arrow::record_batch::RecordBatch;
use chrono::DateTime;
use echolake_schema::annotations::{Annotation, AnnotationKind};
use echolake_schema::tables::{LIST_CHILD, Table};
use echolake_schema::{RunId, SurfaceId};
use futures::TryStreamExt as _;
use object_store::PutPayload;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::contribution_objects::last_object;
use crate::{
    BatchBuilder, DataFile, EncodedFile, Error, FileName, Lake, LakeSnapshot, NewFile, Result, RunPart, encode_batches,
};

/// Derivation in the names of parts: nothing else has such rows.
const ADDED: &str = "added";
/// Hex digits that a file's name keeps of its digest.
const DIGEST_DIGITS: usize = 32;
/// Tries to copy objects beside other writers.
const COPY_TRIES: usize = 50;

/// What a version of `runs` shows of the tables of users.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ShownVersions {
    pub(crate) annotations: ShownVersion,
    pub(crate) predictions: ShownVersion,
}

/// What a version of `runs` shows of one table of users.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct ShownVersion {
    /// The version of the table.
    pub table: u64,
    /// The highest number of an object of the lake's earlier form; 0 if there are none.
    pub objects: u64,
}

impl ShownVersions {
    /// What it shows of a table; nothing of tables that users do not add to.
    pub(crate) fn of_table(self, table: Table) -> ShownVersion {
        match table {
            Table::Annotations => self.annotations,
            Table::Predictions => self.predictions,
            _ => ShownVersion::default(),
        }
    }
}

/// A file of rows that a user adds, of runs of one project.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContributedFile {
    /// Its parts, in the order of its rows.
    pub parts: Vec<ContributedPart>,
    /// Delta's statistics, JSON.
    pub stats: String,
    /// Its Parquet, which is sent apart.
    #[serde(skip)]
    pub bytes: bytes::Bytes,
}

/// The rows of one run in a file that a user adds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContributedPart {
    /// The run's surface.
    pub surface: SurfaceId,
    /// The run that is meant; of predictions the surface's newest.
    pub run: RunId,
    /// Number of its rows.
    pub rows: u64,
}

impl ContributedFile {
    /// Makes files of rows of a table of users: one for each project, with the rows of each run side by side, otherwise
    /// in their order.
    ///
    /// # Errors
    /// [`Error::Encode`] if the rows are not the table's.
    pub fn encode_rows(lake: &Lake, table: Table, rows: &RecordBatch) -> Result<Vec<Self>> {
        let schema = table.schema(lake.rig());
        let failed = |reason: String| Error::Encode { table: table.name(), reason };
        if *rows.schema_ref() != schema {
            return Err(failed("its columns are not the table's".to_owned()));
        }
        let numbers = UInt32Array::from_iter_values(0..rows.num_rows() as u32);
        let keys = ["project", "surface_id", "run_id"].map(|name| rows[name].clone()).into_iter();
        let keys = keys.chain([Arc::new(numbers) as ArrayRef]).map(|values| SortColumn { values, options: None });
        let order = lexsort_to_indices(&keys.collect::<Vec<_>>(), None);
        let sorted = order.and_then(|order| take_record_batch(rows, &order));
        let rows = sorted.map_err(|e| failed(e.to_string()))?;
        let equal_ranges = |columns: &[ArrayRef]| match partition(columns) {
            Ok(partitions) => Ok(partitions.ranges()),
            Err(e) => Err(failed(e.to_string())),
        };
        let mut files = Vec::new();
        for range in equal_ranges(&[rows["project"].clone()])? {
            let rows = rows.slice(range.start, range.len());
            let [surfaces, runs] = [&rows["surface_id"], &rows["run_id"]];
            let mut parts = Vec::new();
            for range in equal_ranges(&[surfaces.clone(), runs.clone()])? {
                let [surface, run] = [surfaces, runs].map(|ids| ids.as_string::<i32>().value(range.start));
                parts.push(ContributedPart {
                    surface: surface.parse().map_err(|e| failed(format!("{e}")))?,
                    run: run.parse().map_err(|e| failed(format!("{e}")))?,
                    rows: range.len() as u64,
                });
            }
            let EncodedFile { blocks, stats, .. } = encode_batches(table, &schema, &[rows])?;
            let bytes = PutPayload::from_iter(blocks).into();
            files.push(Self { parts, stats, bytes });
        }
        Ok(files)
    }

    fn name(&self) -> FileName {
        let digest = hex::encode(Sha256::digest(&self.bytes));
        FileName::Merged { digest: digest[..DIGEST_DIGITS].to_owned() }
    }

    fn rows(&self) -> u64 {
        self.parts.iter().map(|part| part.rows).sum()
    }
}

impl Lake {
    /// Makes a table of users ready for [`Lake::add_contribution`]: it is made if it is missing, what the lake's
    /// earlier form has of it is copied into it, and all that is in it is shown to readers.
    ///
    /// # Errors
    /// [`Error::Incomplete`] or [`Error::Log`] if rows of it are lost, or what the store says.
    pub async fn prepare_contributions(&self, table: Table) -> Result<()> {
        self.ensure_exclusive().await?;
        self.commit_log().ensure_table(table).await?;
        self.copy_objects(table).await?;
        let newest = self.commit_log().newest_version(table).await?.unwrap_or(0);
        let snapshot = self.snapshot_of(&[table]).await?;
        snapshot.check_table(table)?;
        if snapshot.shown_versions().of_table(table).table < newest {
            self.commit_log().show_version(table, newest).await?;
        }
        Ok(())
    }

    /// Adds files to a table of users as the version after `seen`, and shows them to readers; returns the lake's
    /// version. None if another writer has added to the table since, or `seen` is no version of it.
    ///
    /// # Errors
    /// What the store says. Files that were added before are seen with the next commit.
    pub async fn add_contribution(&self, table: Table, seen: u64, files: Vec<ContributedFile>) -> Result<Option<u64>> {
        if self.commit_log().newest_version(table).await? != Some(seen) {
            return Ok(None);
        }
        let staged = self.stage_contribution(table, files).await?;
        match self.commit_log().append_files(table, seen, &staged, None).await? {
            true => self.commit_log().show_version(table, seen + 1).await.map(Some),
            false => Ok(None),
        }
    }

    async fn stage_contribution(&self, table: Table, files: Vec<ContributedFile>) -> Result<Vec<NewFile>> {
        let mut staged = Vec::with_capacity(files.len());
        for contributed in files {
            let name = contributed.name();
            let rows = contributed.rows();
            let part = |part: ContributedPart| {
                let ContributedPart { surface, run, rows } = part;
                RunPart { surface, run, derivation: ADDED.to_owned(), rows, row_version: None, row_counts: None }
            };
            let file = EncodedFile { blocks: vec![contributed.bytes], stats: contributed.stats, rows };
            let mut one = self.stage_file(table, &name, file).await?;
            one.file.parts = contributed.parts.into_iter().map(part).collect();
            staged.push(one.file);
        }
        Ok(staged)
    }

    // By idempotent commits: the commit that adds the rows tells, by Delta's action `txn`, which objects they are from.
    async fn copy_objects(&self, table: Table) -> Result<()> {
        for _ in 0..COPY_TRIES {
            let Some(view) = self.commit_log().view_table(table).await? else { return Ok(()) };
            let shown = self.commit_log().view_table(Table::Runs).await?.unwrap_or_default().shown;
            // A new table's objects are listed, those that no version shows yet among them.
            if view.version > 0 && shown.of_table(table).objects <= view.copied {
                return Ok(());
            }
            let last = last_object(self.store().as_ref(), table).await?;
            if last <= view.copied {
                return Ok(());
            }
            let snapshot = self.snapshot_of(&[]).await?;
            let rows = self.read_objects(table, view.copied..last, &snapshot).await?;
            let files = rows.map(|rows| ContributedFile::encode_rows(self, table, &rows)).transpose()?;
            let staged = self.stage_contribution(table, files.unwrap_or_default()).await?;
            if self.commit_log().append_files(table, view.version, &staged, Some(last)).await? {
                return Ok(());
            }
        }
        let source = format!("{COPY_TRIES} tries lost to other writers; hint: run the command again").into();
        Err(Error::Log { table: table.name(), action: "written", source })
    }

    /// Brings the tables of users to one state: what is in them is shown to readers, and what the lake's earlier form
    /// has is in them. A table with a fault is left as it is.
    ///
    /// # Errors
    /// What the store says.
    pub async fn settle_contributions(&self) -> Result<()> {
        for table in Table::OF_USERS {
            self.prepare_contributions(table).await.or_else(pass_table_fault)?;
        }
        Ok(())
    }

    /// The annotations on the runs that a snapshot shows, in the order in which they were added. While `runs` is made
    /// again, these are not all runs.
    ///
    /// # Errors
    /// [`Error::Incomplete`] or [`Error::Log`] if their table has a fault of its own; [`Error::DataFile`], or what the
    /// store says.
    pub async fn read_annotations(&self, snapshot: &LakeSnapshot) -> Result<Vec<Annotation>> {
        snapshot.check_own_fault(Table::Annotations)?;
        let mut all = Vec::new();
        for file in snapshot.files(Table::Annotations) {
            all.extend(self.read_annotation_file(file).await?);
        }
        all.sort_by_key(|(version, _)| *version);
        let mut annotations: Vec<_> = all.into_iter().map(|(_, annotation)| annotation).collect();
        annotations.extend(self.pending_annotations(snapshot).await?);
        Ok(annotations)
    }

    /// The annotations of a file on the runs that it shows, each with the version that added it.
    ///
    /// # Errors
    /// [`Error::DataFile`], or what the store says.
    pub async fn read_annotation_file(&self, file: &DataFile) -> Result<Vec<(u64, Annotation)>> {
        let mut annotations = Vec::new();
        for (part, rows) in file.visible_parts() {
            let mut batches = self.read_rows(Table::Annotations, file, &[], rows).await?;
            while let Some(batch) = batches.try_next().await? {
                let decoded = decode_annotations(&batch)
                    .map_err(|reason| Error::DataFile { file: file.path.to_string(), source: reason.into() })?;
                let version = part.row_version.unwrap_or(file.log_version);
                annotations.extend(decoded.into_iter().map(|annotation| (version, annotation)));
            }
        }
        Ok(annotations)
    }

    /// Those annotations that are still objects of the lake's earlier form, on the runs that a snapshot shows.
    ///
    /// # Errors
    /// As [`Lake::read_pending_rows`].
    pub async fn pending_annotations(&self, snapshot: &LakeSnapshot) -> Result<Vec<Annotation>> {
        let rows = self.read_pending_rows(snapshot, Table::Annotations).await?;
        let damaged =
            |reason: String| Error::DataFile { file: Table::Annotations.name().to_owned(), source: reason.into() };
        rows.map_or(Ok(Vec::new()), |rows| decode_annotations(&rows).map_err(damaged))
    }

    /// Rows of a table of users that a snapshot shows and that are still objects of the lake's earlier form; None if
    /// there are none.
    ///
    /// # Errors
    /// [`Error::DataFile`] if an object is missing or damaged, or what the store says.
    pub async fn read_pending_rows(&self, snapshot: &LakeSnapshot, table: Table) -> Result<Option<RecordBatch>> {
        let objects = snapshot.pending_objects(table);
        if objects.is_empty() {
            return Ok(None);
        }
        self.read_objects(table, objects, snapshot).await
    }
}

impl LakeSnapshot {
    /// The objects of the lake's earlier form that are not in their table yet: those after the first `start`, up to
    /// number `end`.
    pub fn pending_objects(&self, table: Table) -> Range<u64> {
        let copied = self.copied_objects(table);
        copied..self.shown_versions().of_table(table).objects.max(copied)
    }

    /// The version of the lake that the author of a row on a run saw, as all its readers may know it: in a lake with
    /// projects the one that added the run's row, because how many came since is a matter of other projects.
    pub fn seen_version(&self, run: &RunId) -> Option<u64> {
        match self.runs().any(|run| self.project_of(&run.run).is_some()) || self.is_restricted() {
            true => self.row_version(run),
            false => self.lake_version(),
        }
    }
}

/// Passes over a table's fault, which readers of the table meet, but no others.
pub(crate) fn pass_table_fault(error: Error) -> Result<()> {
    if error.is_table_fault() { Ok(()) } else { Err(error) }
}

/// Makes rows of table `annotations`. Surface and project are those of the run in the snapshot.
///
/// # Errors
/// [`Error::Encode`], which is a mistake in this crate.
pub fn annotation_rows(lake: &Lake, snapshot: &LakeSnapshot, annotations: &[Annotation]) -> Result<RecordBatch> {
    let mut pairs = ListBuilder::new(Int32Builder::new()).with_field(Field::new(LIST_CHILD, DataType::Int32, false));
    for annotation in annotations {
        if let Some(ids) = &annotation.pair_ids {
            ids.iter().for_each(|id| pairs.values().append_value(*id as i32));
        }
        pairs.append(annotation.pair_ids.is_some());
    }
    let surface = |a: &Annotation| match snapshot.run(&a.run_id) {
        Some(run) => run.surface.to_string(),
        None => a.run_id.surface_name().to_owned(),
    };
    let project = |a: &Annotation| snapshot.project_of(&a.run_id).map(|project| project.as_str());
    let times = TimestampMicrosecondArray::from_iter_values(annotations.iter().map(|a| a.time.timestamp_micros()));
    BatchBuilder::new(Table::Annotations, lake.rig(), annotations.len())
        .push_texts("surface_id", annotations.iter().map(surface))
        .push_texts("run_id", annotations.iter().map(|a| a.run_id.as_str()))
        .push_column("project", Arc::new(annotations.iter().map(project).collect::<StringArray>()))
        .push_column("pair_ids", Arc::new(pairs.finish()))
        .push_texts("kind", annotations.iter().map(|a| a.kind.name()))
        .push_texts("value", annotations.iter().map(|a| &a.value))
        .push_texts("comment", annotations.iter().map(|a| &a.comment))
        .push_texts("author", annotations.iter().map(|a| &a.author))
        .push_column("annotated", Arc::new(times.with_timezone("UTC")))
        .push_longs("lake_version", annotations.iter().map(|a| a.lake_version.map(|version| version as i64)))
        .push_texts("annotation_id", annotations.iter().map(|a| &a.annotation_id))
        .finish()
}

// The annotations of rows of table `annotations`.
fn decode_annotations(rows: &RecordBatch) -> std::result::Result<Vec<Annotation>, String> {
    let text = |name| typed_column::<StringArray>(rows, name);
    let [runs, kinds, values, comments, authors, ids] =
        [text("run_id")?, text("kind")?, text("value")?, text("comment")?, text("author")?, text("annotation_id")?];
    let pairs = typed_column::<ListArray>(rows, "pair_ids")?;
    let times = typed_column::<TimestampMicrosecondArray>(rows, "annotated")?;
    let versions = typed_column::<Int64Array>(rows, "lake_version")?;
    let one = |row: usize| {
        let pair_ids = pairs.is_valid(row).then(|| {
            let list = pairs.value(row);
            list.as_primitive_opt::<Int32Type>().map(|ids| ids.values().iter().map(|id| *id as u32).collect())
        });
        let kind = kinds.value(row);
        Ok(Annotation {
            annotation_id: ids.value(row).to_owned(),
            run_id: runs.value(row).parse().map_err(|e| format!("row {row}: {e}"))?,
            pair_ids: pair_ids.flatten(),
            kind: AnnotationKind::by_name(kind)
                .ok_or_else(|| format!("row {row}: `{kind}` is no kind of annotation"))?,
            value: values.value(row).to_owned(),
            comment: comments.value(row).to_owned(),
            author: authors.value(row).to_owned(),
            time: DateTime::from_timestamp_micros(times.value(row)).unwrap_or_default(),
            lake_version: versions.is_valid(row).then(|| versions.value(row) as u64),
        })
    };
    (0..rows.num_rows()).map(one).collect()
}

fn typed_column<'a, A: 'static>(rows: &'a RecordBatch, name: &str) -> std::result::Result<&'a A, String> {
    let column = rows.column_by_name(name).ok_or_else(|| format!("column `{name}` is missing"))?;
    column.as_any().downcast_ref().ok_or_else(|| format!("column `{name}` has another type than the table's"))
}

#[cfg(test)]
mod tests;
