//! Derives what needs references, for every run whose references are there and not yet used.

use echolake_lake::{Committed, FileName, Lake, Snapshot, VisibleRun};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};

use crate::CODE_VERSION;
use crate::derive::derive;
use crate::error::Result;
use crate::read_back;
use crate::references::{Finder, Wanted, digest};
use crate::rows::derived::Versions;
use crate::rows::{self, Keys};

/// A run whose derived rows are new.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Completed {
    /// The run.
    pub run: RunId,
    /// Its surface.
    pub surface: SurfaceId,
    /// Measurements that both references have.
    pub measurements: usize,
}

/// Brings every run's derived rows up to date; returns how many runs were changed. A run whose rows used the
/// current references is left alone.
///
/// # Errors
/// [`crate::Error`]; what was completed before stays, and the same call goes on.
pub async fn complete(lake: &Lake, done: &mut dyn FnMut(&Completed)) -> Result<usize> {
    let snapshot = lake.snapshot().await?;
    let mut finder = Finder::new(lake, &snapshot);
    let mut count = 0;
    let runs: Vec<_> = snapshot.runs().cloned().collect();
    for run in runs {
        let wanted = finder.wanted(&run.surface);
        if let Some(completed) = complete_run(lake, &snapshot, &mut finder, &run, &wanted).await? {
            done(&completed);
            count += 1;
        }
    }
    lake.remove_superseded().await?;
    Ok(count)
}

async fn complete_run(
    lake: &Lake,
    snapshot: &Snapshot,
    finder: &mut Finder<'_>,
    run: &VisibleRun,
    wanted: &Wanted,
) -> Result<Option<Completed>> {
    let (Some(flat), Some(foam)) = (wanted.flat_version(), wanted.foam.version.clone()) else { return Ok(None) };
    let derivation = digest(&[run.run_derivation.as_str(), &flat, &foam, CODE_VERSION]);
    if run.reference_derivation.as_ref() == Some(&derivation) {
        return Ok(None);
    }
    let Some((foam_means, flat_means)) = finder.load(wanted).await? else { return Ok(None) };
    let responses = read_back::responses(lake, snapshot, &run.run).await?;
    let derived = derive(lake.rig(), &responses, &foam_means, &flat_means, run.run.as_str())?;
    let (rig, grid) = (lake.rig(), lake.rig().grid().map_err(echolake_lake::Error::from)?);
    let keys = Keys { surface: run.surface.clone(), run: run.run.clone() };
    let of = Versions { flat: &flat, foam: &foam };
    for (table, rows) in [
        (Table::Nce, rows::derived::nce(rig, &grid, &keys, &derived, of)?),
        (Table::Tnce, rows::derived::tnce(rig, &grid, &keys, &derived, of)?),
        (Table::TnceD4, rows::derived::tnce_d4(rig, &grid, &keys, &derived, of)?),
        (Table::SurfaceStats, rows::stats::rows(rig, &keys, &derived, of)?),
    ] {
        let name =
            FileName::Rows { surface: run.surface.clone(), run: run.run.clone(), derivation: derivation.clone() };
        lake.append_rows(table, name, vec![rows]).await?;
    }
    let unpaired = responses.pairs.len() - derived.pairs.len();
    let references = rows::runs::References {
        missing: if unpaired == 0 { String::new() } else { format!("references of {unpaired} pairs") },
        derivation: Some(derivation.clone()),
        flat_version: Some(flat),
        foam_version: Some(foam),
    };
    let named = repoint(lake, snapshot, run, derivation, &references).await?;
    Ok((named == Committed::Now).then(|| Completed {
        run: run.run.clone(),
        surface: run.surface.clone(),
        measurements: derived.pairs.len(),
    }))
}

// The run's row names the new derivation: from this commit on readers see its rows, and no more the old ones.
async fn repoint(
    lake: &Lake,
    snapshot: &Snapshot,
    run: &VisibleRun,
    derivation: String,
    references: &rows::runs::References,
) -> Result<Committed> {
    let old: Vec<_> = snapshot.files_of(Table::Runs, &run.run).cloned().collect();
    let mut batches = Vec::new();
    for file in &old {
        batches.push(rows::runs::with_references(&read_back::run_row(lake, file).await?, references)?);
    }
    let pointer = FileName::Pointer(VisibleRun { reference_derivation: Some(derivation), ..run.clone() });
    Ok(lake.replace_rows(Table::Runs, pointer, batches, &old).await?)
}
