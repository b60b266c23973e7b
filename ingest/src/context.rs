//! State shared by all workers of an ingest: one snapshot of the lake, and the staging of a run's files.

use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use echolake_lake::{EncodedFile, FileName, Lake, LakeSnapshot, StagedFile, VisibleRun, encode_batches};
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::tables::Table;
use futures::future::{join_all, try_join};

use crate::error::Result;
use crate::pipeline::Cores;
use crate::references::{ReferenceFinder, SharedFinder};
use crate::rows::RunKeys;

/// The lake with one snapshot of it. Cheap to clone.
#[derive(Clone)]
pub(crate) struct IngestContext {
    pub lake: Lake,
    pub cores: Cores,
    pub snapshot: Arc<LakeSnapshot>,
    /// The verdicts of the snapshot: what is computed from several measurements leaves these out.
    pub rejected: Arc<RejectedMeasurements>,
    pub finder: SharedFinder,
}

impl IngestContext {
    /// Reads the snapshot's verdicts.
    pub async fn read_from(lake: &Lake, cores: &Cores, snapshot: Arc<LakeSnapshot>) -> Result<Self> {
        let rejected = Arc::new(lake.read_rejections(&snapshot).await?);
        let finder = ReferenceFinder::new_shared(lake, snapshot.clone(), rejected.clone());
        Ok(Self { lake: lake.clone(), cores: cores.clone(), snapshot, rejected, finder })
    }

    /// Stages a run's files of one derivation.
    pub async fn stage_rows(
        &self,
        keys: &RunKeys,
        derivation: &str,
        files: Vec<(Table, EncodedFile)>,
    ) -> Result<Vec<StagedFile>> {
        let RunKeys { surface, run } = keys.clone();
        let name = FileName::Rows { surface, run, derivation: derivation.to_owned() };
        // In parallel, because each file waits for the disk by itself.
        let staged = join_all(files.into_iter().map(|(table, file)| self.lake.stage_file(table, &name, file))).await;
        let staged = staged.into_iter().map(|file| Ok(file?.made_from(&self.snapshot)));
        staged.collect()
    }

    /// Stages the files that follow from a run's references, then in the list its row of `runs`, which replaces the
    /// rows in the snapshot. After its commit readers see the files that the row names, and nothing else of the run.
    pub async fn stage_derived(
        &self,
        run: VisibleRun,
        row: &[RecordBatch],
        files: Vec<(Table, EncodedFile)>,
    ) -> Result<Vec<StagedFile>> {
        let keys = RunKeys { surface: run.surface.clone(), run: run.run.clone() };
        // Without references there are no files.
        let derivation = run.reference_derivation.clone().unwrap_or_default();
        let pointer = self.stage_pointer(run, row);
        let (mut staged, pointer) = try_join(self.stage_rows(&keys, &derivation, files), pointer).await?;
        staged.push(pointer);
        Ok(staged)
    }

    async fn stage_pointer(&self, run: VisibleRun, row: &[RecordBatch]) -> Result<StagedFile> {
        let file = encode_batches(Table::Runs, &Table::Runs.schema(self.lake.rig()), row)?;
        let staged = self.lake.stage_file(Table::Runs, &FileName::Pointer(run.clone()), file).await?;
        Ok(staged.made_from(&self.snapshot).with_replaced_rows(&run, self.snapshot.files_of(Table::Runs, &run.run)))
    }
}
