//! Derives the rows that need references, for every run whose references exist and differ from those its rows used.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use echolake_lake::{ClaimOutcome, CommitOutcome, DataFile, Lake, LakeSnapshot, VisibleRun, WorkClaims};
use echolake_schema::tables::{Source, Table};
use echolake_schema::{RunId, SurfaceId};
use tracing::Instrument as _;

use crate::context::IngestContext;
use crate::derive::ReferenceDerivation;
use crate::error::{Error, Result};
use crate::ingest::{LOOK_EVERY, LakeIngest};
use crate::pipeline::{self, Cores, ReadyJob};
use crate::read_back;
use crate::references::{ReferenceFinder, WantedReferences};
use crate::rows::runs::RunReferences;
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

/// A completion, as long as it goes on: a run, and the number of runs to complete.
pub type CompletionReport<'a> = dyn FnMut(&CompletedRun, usize) + Send + 'a;

/// Result of a completion.
#[derive(Debug)]
pub struct CompletionSummary {
    /// Number of changed runs.
    pub changed: usize,
    /// The runs that wait for references, with the names of the missing references.
    pub waiting: Vec<(RunId, String)>,
    /// True if no table lacked rows before superseded ones were removed.
    pub is_whole: bool,
}

impl LakeIngest<'_> {
    /// Brings every run's derived rows up to date, and removes superseded rows. A run whose rows used the current
    /// references is left alone.
    ///
    /// # Errors
    /// [`crate::Error`]; runs completed before stay so, and the same call resumes with the rest.
    pub async fn complete_runs(&self, done: &mut CompletionReport<'_>) -> Result<CompletionSummary> {
        let (changed, snapshot) = self.complete_in_rounds(done).await?;
        self.lake.remove_superseded_in(&snapshot).await?;
        let is_whole = snapshot.is_whole();
        Ok(CompletionSummary { changed, waiting: waiting_runs(self.lake, snapshot), is_whole })
    }

    // Returns the number of changed runs, and the lake's snapshot thereafter.
    async fn complete_in_rounds(&self, done: &mut CompletionReport<'_>) -> Result<(usize, Arc<LakeSnapshot>)> {
        let cores = Cores::all()?;
        let mut count = 0;
        let mut rounds = 0;
        while rounds < ROUNDS {
            let round = do_round(self, &cores, done).await?;
            count += round.changed;
            match round {
                CompletionRound { unchanged: Some(snapshot), .. } => return Ok((count, snapshot)),
                CompletionRound { claimed: true, .. } if self.stop.load(Ordering::Relaxed) => {
                    return Err(Error::Stopped);
                }
                CompletionRound { claimed: true, .. } => tokio::time::sleep(LOOK_EVERY).await,
                CompletionRound { overtaken: true, .. } => rounds += 1,
                _ => break,
            }
        }
        Ok((count, Arc::new(self.lake.snapshot().await?)))
    }
}

fn waiting_runs(lake: &Lake, snapshot: Arc<LakeSnapshot>) -> Vec<(RunId, String)> {
    let finder = ReferenceFinder::new(lake, snapshot.clone());
    let missing = |run: &VisibleRun| (run.run.clone(), finder.wanted_references(&run.surface).missing_names());
    snapshot.runs().map(missing).filter(|(_, missing)| !missing.is_empty()).collect()
}

/// Result of a look at all runs.
#[derive(Default)]
struct CompletionRound {
    /// Number of changed runs.
    changed: usize,
    /// Another ingest changed one of them meanwhile.
    overtaken: bool,
    /// Another ingest is completing one of them.
    claimed: bool,
    /// The snapshot, if nothing was to be done.
    unchanged: Option<Arc<LakeSnapshot>>,
}

async fn do_round(ingest: &LakeIngest<'_>, cores: &Cores, done: &mut CompletionReport<'_>) -> Result<CompletionRound> {
    let LakeIngest { lake, stop, claims, .. } = ingest;
    let context = IngestContext::new(lake, cores, lake.snapshot().await?);
    let mut jobs = Vec::new();
    let derived = Table::ALL.into_iter().filter(|table| table.source() == Source::References);
    let lacking: BTreeSet<_> =
        derived.flat_map(|table| context.snapshot.lacking_rows(table)).map(|lacking| lacking.run.clone()).collect();
    for run in context.snapshot.runs() {
        let wanted = context.finder.lock().await.wanted_references(&run.surface);
        let derivation = wanted.derivation_name(&run.run_derivation);
        // Without its references, a run has no rows that follow from them.
        if derivation != run.reference_derivation || lacking.contains(&run.run) {
            jobs.push((run.clone(), wanted));
        }
    }
    if jobs.is_empty() {
        return Ok(CompletionRound { unchanged: Some(context.snapshot), ..CompletionRound::default() });
    }
    let total = jobs.len();
    let mut round = CompletionRound::default();
    let shared = claims.clone();
    let do_one = move |(run, wanted): (VisibleRun, WantedReferences)| {
        let context = context.clone();
        let claims = shared.clone();
        let span = tracing::error_span!("complete", run = %run.run, surface = %run.surface);
        let work = async move {
            if let Some(claims) = &claims {
                claim_run(&context, claims, &run).await?;
            }
            complete_run(&context, &run, &wanted).await
        };
        work.instrument(span)
    };
    let ended = &mut |((run, _), result): pipeline::JobOutcome<(VisibleRun, WantedReferences), CompletedRun>| {
        match result {
            Err(Error::Claimed { .. }) => {
                round.claimed = true;
                return Ok(());
            }
            Err(Error::Gone { .. }) if claims.is_some() => round.overtaken = true,
            Err(error) => return Err(error),
            Ok((completed, outcome)) => {
                if outcome == Some(CommitOutcome::Now) || lacking.contains(&run.run) {
                    round.changed += 1;
                    done(&completed, total);
                }
                round.overtaken |= outcome == Some(CommitOutcome::Outdated);
            }
        }
        claims.iter().for_each(|claims| claims.release_work(&work_name(&run)));
        Ok(())
    };
    pipeline::run_jobs(lake, cores, jobs, stop, do_one, ended).await?;
    Ok(round)
}

fn work_name(run: &VisibleRun) -> String {
    format!("complete {}", run.run)
}

// Claims a run; another ingest may have completed it since the snapshot.
async fn claim_run(context: &IngestContext, claims: &WorkClaims, run: &VisibleRun) -> Result<()> {
    let file = run.run.to_string();
    if claims.claim_work(&work_name(run)).await == ClaimOutcome::Denied {
        return Err(Error::Claimed { file });
    }
    let rows = context.lake.commit_log().list_files(Table::Runs).await?;
    let is_there = |row: &DataFile| rows.iter().any(|there| there.logged_file() == row.logged_file());
    match context.snapshot.files_of(Table::Runs, &run.run).all(is_there) {
        true => Ok(()),
        false => Err(Error::Gone { file }),
    }
}

async fn complete_run(
    context: &IngestContext,
    run: &VisibleRun,
    wanted: &WantedReferences,
) -> Result<ReadyJob<CompletedRun>> {
    let lake = &context.lake;
    let keys = RunKeys { surface: run.surface.clone(), run: run.run.clone() };
    let mut report = CompletedRun { run: run.run.clone(), surface: run.surface.clone(), measurements: 0 };
    let (files, references) = match ReferenceDerivation::new(context, &run.run_derivation, wanted).await? {
        Some(derivation) => {
            let responses = read_back::read_responses(lake, &context.snapshot, &run.run).await?;
            report.measurements = responses.pairs.len();
            derivation.derive_run(context, &keys, responses).await?
        }
        // A reference was removed.
        None if wanted.derivation_name(&run.run_derivation).is_none() => {
            (Vec::new(), RunReferences { missing: wanted.missing_names(), ..RunReferences::default() })
        }
        None => return Ok(ReadyJob { staged: Vec::new(), report }),
    };
    let mut row = Vec::new();
    for file in context.snapshot.files_of(Table::Runs, &run.run) {
        let before = read_back::run_row(lake, file, &run.run).await?;
        row.push(rows::runs::with_references(lake.rig(), &keys, &before, &references)?);
    }
    let pointer = VisibleRun { reference_derivation: references.derivation.clone(), ..run.clone() };
    let mut staged = context.stage_derived(pointer, &row, files).await?;
    // A row of an earlier version of the program does not count the others.
    if let Some(counts) = context.snapshot.row_counts(&run.run).cloned()
        && let Some(row) = staged.pop()
    {
        let row = row.with_row_counts(counts, &staged);
        staged.push(row);
    }
    Ok(ReadyJob { staged, report })
}
