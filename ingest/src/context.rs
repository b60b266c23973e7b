//! State shared by all workers of an ingest: one snapshot of the lake, and the staging of a run's rows.

use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use echolake_lake::{EncodedRows, FileGroup, Lake, LakeSnapshot, StagedRows, VisibleRun, encode_run_rows};
use echolake_schema::RunId;
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::tables::Table;

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

    /// Returns whether readers see all rows of a run in a table.
    pub fn has_rows(&self, table: Table, run: &RunId) -> bool {
        let is_lacking = self.snapshot.lacking_rows(table).iter().any(|lacking| lacking.run == *run);
        !is_lacking && self.snapshot.files_of(table, run).next().is_some()
    }

    /// Stages a run's rows of one derivation, for files that it may share with the other runs of `group`.
    pub fn stage_rows(
        &self,
        RunKeys { surface, run }: &RunKeys,
        group: &FileGroup,
        derivation: &str,
        rows: Vec<(Table, EncodedRows)>,
    ) -> Vec<StagedRows> {
        let staged = rows.into_iter().map(|(table, rows)| {
            let keys = (surface.clone(), run.clone());
            StagedRows::new(table, keys, derivation.to_owned(), rows, group).made_from(&self.snapshot)
        });
        staged.collect()
    }

    /// Stages the rows that follow from a run's references, then in the list its row of `runs`, which replaces the
    /// rows in the snapshot. After its commit readers see the rows that it names, and nothing else of the run.
    pub fn stage_derived(
        &self,
        run: &VisibleRun,
        group: &FileGroup,
        row: &[RecordBatch],
        rows: Vec<(Table, EncodedRows)>,
    ) -> Result<Vec<StagedRows>> {
        let keys = RunKeys { surface: run.surface.clone(), run: run.run.clone() };
        // Without references there are no rows.
        let derivation = run.reference_derivation.as_deref().unwrap_or_default();
        let mut staged = self.stage_rows(&keys, group, derivation, rows);
        let row = encode_run_rows(Table::Runs, &Table::Runs.schema(self.lake.rig()), row)?;
        let pointer = StagedRows::of_pointer(run, row, group).made_from(&self.snapshot);
        staged.push(pointer.with_replaced_rows(run, self.snapshot.files_of(Table::Runs, &run.run)));
        Ok(staged)
    }
}
