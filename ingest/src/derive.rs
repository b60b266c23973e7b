//! Derives the rows that follow from a run's impulse responses and references, and encodes them.

use std::sync::Arc;

use echolake_lake::{EncodedRows, FileEncoder, Lake, encode_run_rows, verdict_mark};
use echolake_schema::RunId;
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::tables::Table;

use crate::context::IngestContext;
use crate::derived_values::RunResponses;
use crate::error::{Error, Result};
use crate::references::{LoadedReferences, WantedReferences};
use crate::rows::derived::ReferenceVersions;
use crate::rows::runs::RunReferences;
use crate::rows::{self, RunKeys};
use crate::run_derivation::RunDerivation;

/// Number of measurements derived and encoded at a time: it bounds memory independently of the run's length.
const SLICE: usize = 256;

/// Rows by table, and the numbers of pairs that a reference lacks, and of those of inverted polarity.
type DerivedTables = (Vec<(Table, EncodedRows)>, usize, usize);

/// Loaded references, and the name of the derivation with them.
pub(crate) struct ReferenceDerivation {
    pub name: String,
    flat_version: String,
    foam_version: String,
    references: Arc<LoadedReferences>,
    /// Measurements that have rows, and that statistics leave out.
    rejected: Arc<RejectedMeasurements>,
}

impl ReferenceDerivation {
    /// Loads the references wanted for a run; None if one is missing.
    pub async fn new(
        context: &IngestContext,
        run: &RunId,
        run_derivation: &str,
        wanted: &WantedReferences,
    ) -> Result<Option<Self>> {
        let mark = verdict_mark(&context.rejected, run);
        let (Some((flat_version, foam_version)), Some(name)) =
            (wanted.version_pair(), wanted.derivation_name(run_derivation, mark.as_deref()))
        else {
            return Ok(None);
        };
        let Some(references) = context.finder.lock().await.load_references(wanted, &context.cores).await? else {
            return Ok(None);
        };
        let rejected = context.rejected.clone();
        Ok(Some(Self { name, flat_version, foam_version, references, rejected }))
    }

    /// Derives every pair that both references have. Returns the rows, and the run row's references.
    pub async fn derive_run(
        self,
        context: &IngestContext,
        keys: &RunKeys,
        responses: RunResponses,
    ) -> Result<(Vec<(Table, EncodedRows)>, RunReferences)> {
        let this = Arc::new(self);
        let for_rows = keys.clone();
        let lake = context.lake.clone();
        let derivation = this.clone();
        let (rows, unpaired, inverted) =
            context.cores.compute_on_core(move || derivation.encode_tables(&lake, &for_rows, &responses)).await?;
        let counts = [("references of", unpaired), ("levels of inverted polarity:", inverted)];
        let missing = counts.into_iter().filter(|(_, pairs)| *pairs > 0);
        let missing: Vec<_> = missing.map(|(what, pairs)| format!("{what} {pairs} pairs")).collect();
        let references = RunReferences {
            missing: missing.join(", "),
            derivation: Some(this.name.clone()),
            flat_version: Some(this.flat_version.clone()),
            foam_version: Some(this.foam_version.clone()),
        };
        Ok((rows, references))
    }

    fn encode_tables(&self, lake: &Lake, keys: &RunKeys, responses: &RunResponses) -> Result<DerivedTables> {
        let rig = lake.rig();
        let grid = lake.grid();
        let failed = |cause| Error::Kernel { file: keys.run.to_string(), cause };
        let of = ReferenceVersions { flat: &self.flat_version, foam: &self.foam_version };
        let [mut nce, mut tnce, mut tnce_d4] =
            [Table::Nce, Table::Tnce, Table::TnceD4].map(|table| FileEncoder::new(table, table.schema(rig)));
        let mut run = RunDerivation::new(lake, &self.references).map_err(failed)?;
        let mut encode_lists = |lists| {
            let rows = rows::derived::nce_rows(rig, grid, keys, lists, of)?;
            Ok::<_, Error>(nce.write_batch(&rows)?)
        };
        let mut waiting = None;
        for part in (0..responses.pairs.len()).step_by(SLICE) {
            let part = part..responses.pairs.len().min(part + SLICE);
            // Lists take most of the time; an idle core can encode those of the part before meanwhile.
            let (derived, encoded) = rayon::join(
                || run.derive_part(responses, part, |pair| self.is_counted(keys, pair)).map_err(failed),
                || waiting.take().map_or(Ok(()), &mut encode_lists),
            );
            encoded?;
            waiting = Some(derived?);
        }
        waiting.map_or(Ok(()), encode_lists)?;
        let inverted = run.inverted;
        let is_flat = self.references.only_flat.as_ref() == Some(&keys.surface);
        let (columns, levels) = run.finish(is_flat).map_err(failed)?;
        let paired = columns.pairs.len();
        let parts = || (0..paired).step_by(SLICE).map(|part| part..paired.min(part + SLICE));
        let (first, second) = rayon::join(
            || {
                parts().try_for_each(|part| {
                    let rows = rows::derived::tnce_rows(rig, grid, keys, &columns, part, of)?;
                    Ok::<_, Error>(tnce.write_batch(&rows)?)
                })
            },
            || {
                let moved = rows::derived::SymmetryPairs::from_grid(grid);
                parts().try_for_each(|part| {
                    let rows = rows::derived::tnce_d4(rig, grid, &moved, keys, &columns, part, of)?;
                    Ok::<_, Error>(tnce_d4.write_batch(&rows)?)
                })
            },
        );
        first.and(second)?;
        let mut rows = Vec::with_capacity(4);
        for (table, encoder) in [(Table::Nce, nce), (Table::Tnce, tnce), (Table::TnceD4, tnce_d4)] {
            rows.push((table, encoder.finish_run()?));
        }
        // Of a rejected run there are none: they would be those of the surface's newest run.
        let mut stats = Vec::new();
        if !self.rejected.is_run_rejected(keys.run.as_str()) {
            stats.push(rows::stats::stats_rows(rig, keys, &levels, of)?);
        }
        let schema = Table::SurfaceStats.schema(rig);
        rows.push((Table::SurfaceStats, encode_run_rows(Table::SurfaceStats, &schema, &stats)?));
        Ok((rows, responses.pairs.len() - paired - inverted, inverted))
    }

    // Returns whether a run's statistics count a pair.
    fn is_counted(&self, keys: &RunKeys, pair: u32) -> bool {
        !self.rejected.is_rejected(keys.run.as_str(), pair)
    }
}
