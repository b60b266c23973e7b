//! The columns that all rows of a run have.

use echolake_lake::BatchBuilder;
use echolake_schema::tables::Table;
use echolake_schema::{Rig, RunId, SurfaceId};

use crate::CODE_VERSION;

/// Key columns of every row of a run.
#[derive(Debug, Clone)]
pub(crate) struct RunKeys {
    pub surface: SurfaceId,
    pub run: RunId,
}

impl RunKeys {
    /// Returns a builder that has the run's keys and the code version.
    pub fn begin_rows(&self, table: Table, rig: &Rig, rows: usize) -> BatchBuilder {
        let mut columns = BatchBuilder::new(table, rig, rows);
        columns
            .fill_text("surface_id", self.surface.as_str())
            .fill_text("run_id", self.run.as_str())
            .fill_text("code_version", CODE_VERSION);
        columns
    }
}
