//! Derives the rows that need references, for every run whose references exist and differ from those its rows used.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use echolake_lake::{CommitOutcome, Lake, VisibleRun};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use tracing::Instrument as _;

use crate::context::IngestContext;
use crate::derive::ReferenceDerivation;
use crate::error::Result;
use crate::pipeline::{self, Cores, ReadyJob};
use crate::read_back;
use crate::references::{ReferenceFinder, WantedReferences};
use crate::rows::{self, RunKeys};

/// Maximum number of retries with a new snapshot after another ingest committed first.
const ROUNDS: usize = 20;

/// A run with new derived rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CompletedRun {
    /// The run.
    pub run: RunId,
    /// Its surface.
    pub surface: SurfaceId,
    /// Measurements of the run.
    pub measurements: usize,
}

/// Brings every run's derived rows up to date; returns the number of changed runs. A run whose rows used the current
/// references is left alone.
///
/// # Errors
/// [`crate::Error`]; runs completed before stay so, and the same call resumes with the rest.
pub async fn complete(lake: &Lake, stop: &AtomicBool, done: &mut (dyn FnMut(&CompletedRun) + Send)) -> Result<usize> {
    let (cores, mut count) = (Cores::all()?, 0);
    for _ in 0..ROUNDS {
        let (changed, overtaken) = round(lake, &cores, stop, done).await?;
        count += changed;
        if !overtaken {
            break;
        }
    }
    lake.remove_superseded().await?;
    Ok(count)
}

/// Lists the runs that wait for references, with the names of the missing references.
///
/// # Errors
/// [`crate::Error::Lake`] if the lake cannot be read.
pub async fn waiting(lake: &Lake) -> Result<Vec<(RunId, String)>> {
    let snapshot = Arc::new(lake.snapshot().await?);
    let finder = ReferenceFinder::new(lake, snapshot.clone());
    let missing = |run: &VisibleRun| (run.run.clone(), finder.wanted(&run.surface).missing());
    Ok(snapshot.runs().map(missing).filter(|(_, missing)| !missing.is_empty()).collect())
}

// Returns the number of changed runs, and whether another ingest changed one of them meanwhile.
async fn round(
    lake: &Lake,
    cores: &Cores,
    stop: &AtomicBool,
    done: &mut (dyn FnMut(&CompletedRun) + Send),
) -> Result<(usize, bool)> {
    let context = IngestContext::now(lake, cores).await?;
    let mut jobs = Vec::new();
    for run in context.snapshot.runs() {
        let wanted = context.finder.lock().await.wanted(&run.surface);
        if wanted.derivation(&run.run_derivation).is_some_and(|d| run.reference_derivation.as_ref() != Some(&d)) {
            jobs.push((run.clone(), wanted));
        }
    }
    let (mut count, mut overtaken) = (0, false);
    let do_one = move |(run, wanted): (VisibleRun, WantedReferences)| {
        let context = context.clone();
        let span = tracing::error_span!("complete", run = %run.run, surface = %run.surface);
        async move { complete_run(&context, &run, &wanted).await }.instrument(span)
    };
    let ended = &mut |(_, result): pipeline::JobOutcome<_, CompletedRun>| {
        let (completed, outcome) = result?;
        if outcome == Some(CommitOutcome::Now) {
            count += 1;
            done(&completed);
        }
        overtaken |= outcome == Some(CommitOutcome::Outdated);
        Ok(())
    };
    pipeline::run(lake, cores, jobs, stop, do_one, ended).await?;
    Ok((count, overtaken))
}

async fn complete_run(
    context: &IngestContext,
    run: &VisibleRun,
    wanted: &WantedReferences,
) -> Result<ReadyJob<CompletedRun>> {
    let (lake, keys) = (&context.lake, RunKeys { surface: run.surface.clone(), run: run.run.clone() });
    let responses = read_back::responses(lake, &context.snapshot, &run.run).await?;
    let report =
        CompletedRun { run: run.run.clone(), surface: run.surface.clone(), measurements: responses.pairs.len() };
    let Some(derivation) = ReferenceDerivation::new(&run.run_derivation, wanted, &context.finder).await? else {
        return Ok(ReadyJob { staged: Vec::new(), report });
    };
    let (mut staged, references) = derivation.stage(context, &keys, responses).await?;
    let mut row = Vec::new();
    for file in context.snapshot.files_of(Table::Runs, &run.run) {
        let before = read_back::run_row(lake, file).await?;
        row.push(rows::runs::with_references(lake.rig(), &keys, &before, &references)?);
    }
    let pointer = VisibleRun { reference_derivation: references.derivation.clone(), ..run.clone() };
    staged.push(context.stage_pointer(pointer, &row).await?);
    Ok(ReadyJob { staged, report })
}
