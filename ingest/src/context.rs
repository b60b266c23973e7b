//! What all workers of an ingest share: the lake as it was at the beginning, and how a run's files are staged in it.

use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use echolake_lake::{EncodedFile, FileName, Lake, LakeSnapshot, StagedFile, VisibleRun, encode};
use echolake_schema::tables::Table;
use futures::future::join_all;

use crate::error::Result;
use crate::pipeline::Cores;
use crate::references::{Finder, SharedFinder};
use crate::rows::Keys;

/// The lake in one view of it. Cheap to clone.
#[derive(Clone)]
pub(crate) struct Context {
    pub(crate) lake: Lake,
    pub(crate) cores: Cores,
    pub(crate) snapshot: Arc<LakeSnapshot>,
    pub(crate) finder: SharedFinder,
}

impl Context {
    /// The lake as of now.
    pub(crate) async fn now(lake: &Lake, cores: &Cores) -> Result<Self> {
        let snapshot = Arc::new(lake.snapshot().await?);
        let finder = Finder::shared(lake, snapshot.clone());
        Ok(Self { lake: lake.clone(), cores: cores.clone(), snapshot, finder })
    }

    /// Stages a run's files of one derivation.
    pub(crate) async fn stage_rows(
        &self,
        keys: &Keys,
        derivation: &str,
        files: Vec<(Table, EncodedFile)>,
    ) -> Result<Vec<StagedFile>> {
        let Keys { surface, run } = keys.clone();
        let name = FileName::Rows { surface, run, derivation: derivation.to_owned() };
        // Each waits for the disk by itself.
        let staged = join_all(files.into_iter().map(|(table, file)| self.lake.stage(table, &name, file))).await;
        Ok(staged.into_iter().collect::<std::result::Result<_, _>>()?)
    }

    /// Stages a run's row of `runs`, in place of those that the view has. From its commit on readers see what it names,
    /// and nothing else of the run.
    pub(crate) async fn stage_pointer(&self, run: VisibleRun, row: &[RecordBatch]) -> Result<StagedFile> {
        let file = encode(Table::Runs, &Table::Runs.schema(self.lake.rig()), row)?;
        let staged = self.lake.stage(Table::Runs, &FileName::Pointer(run.clone()), file).await?;
        Ok(staged.replacing(&run, self.snapshot.files_of(Table::Runs, &run.run)))
    }
}
