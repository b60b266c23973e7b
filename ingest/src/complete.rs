//! Derives the rows that need references, for every run whose references exist and differ from those its rows used, or
//! on which a verdict came since.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use echolake_lake::{
    ClaimOutcome, CommitOutcome, DataFile, FileGroup, LakeSnapshot, ReferenceNames, VisibleRun, WorkClaims,
    verdict_mark,
};
use echolake_schema::tables::{Source, Table};
use echolake_schema::{RunId, SurfaceId};
use tracing::Instrument as _;

use crate::context::IngestContext;
use crate::derive::ReferenceDerivation;
use crate::error::{Error, Result};
use crate::ingest::{LOOK_EVERY, LakeIngest};
use crate::pipeline::{self, Cores, GROUP, ReadyJob};
use crate::read_back;
use crate::references::WantedReferences;
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
    /// Whether a verdict on the run or on a reference is the reason.
    pub by_verdicts: bool,
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
    /// The runs that should describe their surfaces instead of rejected ones, and whose files are refused.
    pub unrestored: Vec<(RunId, Error)>,
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
        let cores = Cores::all()?;
        let (changed, unrestored, snapshot) = self.complete_in_rounds(&cores, done).await?;
        self.lake.remove_superseded_in(&snapshot).await?;
        // The lake is whole without it, and whatever file is damaged is no file of this ingest.
        if let Err(error) = self.lake.merge_small_groups(&snapshot, GROUP, &self.stop).await {
            let error = &error as &dyn std::error::Error;
            tracing::warn!(error, "files of few runs are not merged");
        }
        let is_whole = snapshot.is_whole();
        let waiting = waiting_runs(&IngestContext::read_from(self.lake, &cores, snapshot).await?).await;
        Ok(CompletionSummary { changed, waiting, unrestored, is_whole })
    }

    // Returns the number of changed runs, those that are not restored, and the lake's snapshot thereafter.
    async fn complete_in_rounds(
        &self,
        cores: &Cores,
        done: &mut CompletionReport<'_>,
    ) -> Result<(usize, Vec<(RunId, Error)>, Arc<LakeSnapshot>)> {
        let mut count = 0;
        let mut rounds = 0;
        let mut unrestored = Vec::new();
        while rounds < ROUNDS {
            let mut round = do_round(self, cores, done).await?;
            count += round.changed;
            unrestored = std::mem::take(&mut round.unrestored);
            match round {
                CompletionRound { unchanged: Some(snapshot), .. } => return Ok((count, unrestored, snapshot)),
                CompletionRound { claimed: true, .. } if self.stop.load(Ordering::Relaxed) => {
                    return Err(Error::Stopped);
                }
                CompletionRound { claimed: true, .. } => tokio::time::sleep(LOOK_EVERY).await,
                CompletionRound { overtaken, turned, .. } if overtaken || turned => rounds += 1,
                _ => break,
            }
        }
        Ok((count, unrestored, Arc::new(self.lake.snapshot().await?)))
    }
}

async fn waiting_runs(context: &IngestContext) -> Vec<(RunId, String)> {
    let finder = context.finder.lock().await;
    let missing = |run: &VisibleRun| (run.run.clone(), finder.wanted_references(&run.surface).missing_names());
    context.snapshot.runs().map(missing).filter(|(_, missing)| !missing.is_empty()).collect()
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
    /// Other runs describe surfaces, whose references may be others.
    turned: bool,
    /// Runs that should describe their surfaces, and whose files are refused.
    unrestored: Vec<(RunId, Error)>,
    /// The snapshot, if nothing was to be done.
    unchanged: Option<Arc<LakeSnapshot>>,
}

/// A run whose derived rows, or the verdicts that they follow, are not as they should be.
#[derive(Clone)]
struct CompletionJob {
    run: VisibleRun,
    wanted: WantedReferences,
    /// Mark of the verdicts on the run.
    verdicts: Option<String>,
    by_verdicts: bool,
}

impl CompletionJob {
    // Returns whether another run may describe the surface thereafter.
    fn is_turn(&self) -> bool {
        self.run.is_rejected() != self.completed_run(None).is_rejected()
    }

    fn completed_run(&self, reference_derivation: Option<String>) -> VisibleRun {
        VisibleRun { reference_derivation, verdicts: self.verdicts.clone(), ..self.run.clone() }
    }
}

// The runs that are to be completed, apart from those that lack rows: which others are.
async fn find_jobs(context: &IngestContext, lacking: &BTreeSet<RunId>) -> Vec<CompletionJob> {
    let snapshot = &context.snapshot;
    let changed: BTreeSet<_> = snapshot.unfollowed_runs(&context.rejected).map(|run| &run.surface).collect();
    let mut jobs = Vec::new();
    for run in snapshot.runs() {
        let wanted = context.finder.lock().await.wanted_references(&run.surface);
        let verdicts = verdict_mark(&context.rejected, &run.run);
        // Without its references, a run has no rows that follow from them.
        let derivation = wanted.derivation_name(&run.run_derivation, verdicts.as_deref());
        if derivation != run.reference_derivation || verdicts != run.verdicts || lacking.contains(&run.run) {
            let of_references = wanted.surfaces().into_iter().any(|surface| changed.contains(surface));
            let by_verdicts = of_references || verdicts != run.verdicts;
            jobs.push(CompletionJob { run: run.clone(), wanted, verdicts, by_verdicts });
        }
    }
    jobs
}

async fn do_round(ingest: &LakeIngest<'_>, cores: &Cores, done: &mut CompletionReport<'_>) -> Result<CompletionRound> {
    let LakeIngest { lake, stop, claims, .. } = ingest;
    let context = IngestContext::read_from(lake, cores, Arc::new(lake.snapshot().await?)).await?;
    let derived = Table::ALL.into_iter().filter(|table| table.source() == Source::References);
    let lacking: BTreeSet<_> =
        derived.flat_map(|table| context.snapshot.lacking_rows(table)).map(|lacking| lacking.run.clone()).collect();
    let (turns, jobs): (Vec<_>, Vec<_>) =
        find_jobs(&context, &lacking).await.into_iter().partition(CompletionJob::is_turn);
    let total = jobs.len() + turns.len();
    if total == 0 {
        return Ok(CompletionRound { unchanged: Some(context.snapshot), ..CompletionRound::default() });
    }
    let mut round = CompletionRound::default();
    let shared = claims.clone();
    let do_one = move |job: CompletionJob| {
        let context = context.clone();
        let claims = shared.clone();
        let span = tracing::error_span!("complete", run = %job.run.run, surface = %job.run.surface);
        let work = async move {
            if let Some(claims) = &claims {
                claim_run(&context, claims, &job.run).await?;
            }
            complete_run(&context, &job).await
        };
        work.instrument(span)
    };
    let ended = &mut |(CompletionJob { run, .. }, result): pipeline::JobOutcome<CompletionJob, CompletedRun>| {
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
    if !turns.is_empty() && !round.claimed {
        turn_surfaces(ingest, cores, total, &mut round, done).await?;
    }
    Ok(round)
}

// Follows verdicts that reject runs as a whole, or accept them again. Other runs describe their surfaces from then on:
// the rows of these are written first, and one commit of `runs` names all of them, so that no reader misses a row.
async fn turn_surfaces(
    ingest: &LakeIngest<'_>,
    cores: &Cores,
    total: usize,
    round: &mut CompletionRound,
    done: &mut CompletionReport<'_>,
) -> Result<()> {
    let lake = ingest.lake;
    // Derivations have changed meanwhile.
    let context = IngestContext::read_from(lake, cores, Arc::new(lake.snapshot().await?)).await?;
    let mut blocked = BTreeSet::new();
    for run in context.snapshot.succeeding_runs(&context.rejected) {
        let Some(run) = context.snapshot.run(&run) else { continue };
        match ingest.restore_rows(&context.snapshot, &BTreeSet::from([run.run.clone()])).await {
            Err(why) if why.is_refusal() => {
                blocked.insert(run.surface.clone());
                round.unrestored.push((run.run.clone(), why));
            }
            restored => restored?,
        }
    }
    let mut staged = Vec::new();
    let mut pointers = Vec::new();
    let mut completed = Vec::new();
    for job in find_jobs(&context, &BTreeSet::new()).await {
        if !job.is_turn() || blocked.contains(&job.run.surface) {
            continue;
        }
        if let Some(claims) = &ingest.claims {
            match claim_run(&context, claims, &job.run).await {
                Err(Error::Claimed { .. }) => {
                    round.claimed = true;
                    continue;
                }
                Err(Error::Gone { .. }) => {
                    round.overtaken = true;
                    continue;
                }
                claimed => claimed?,
            }
        }
        let mut ready = complete_run(&context, &job).await?;
        pointers.extend(ready.staged.extract_if(.., |rows| rows.table() == Table::Runs));
        staged.extend(ready.staged);
        completed.push((job.run, ready.report));
        // Nobody sees them yet, and they wait in the store rather than in memory.
        if completed.len().is_multiple_of(GROUP) {
            lake.commit_rows(std::mem::take(&mut staged)).await?;
        }
    }
    lake.commit_rows(staged).await?;
    let outcomes = lake.commit_rows(pointers).await?;
    round.turned = outcomes.contains(&CommitOutcome::Now);
    round.overtaken |= outcomes.contains(&CommitOutcome::Outdated);
    for (run, report) in completed {
        round.changed += 1;
        done(&report, total);
        ingest.claims.iter().for_each(|claims| claims.release_work(&work_name(&run)));
    }
    Ok(())
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
    let is_there =
        |row: &DataFile| rows.iter().any(|there| there.path == row.path && there.log_version == row.log_version);
    match context.snapshot.files_of(Table::Runs, &run.run).all(is_there) {
        true => Ok(()),
        false => Err(Error::Gone { file }),
    }
}

async fn complete_run(context: &IngestContext, job: &CompletionJob) -> Result<ReadyJob<CompletedRun>> {
    let CompletionJob { run, wanted, by_verdicts, .. } = job;
    let lake = &context.lake;
    let keys = RunKeys { surface: run.surface.clone(), run: run.run.clone() };
    let by_verdicts = *by_verdicts;
    let mut report = CompletedRun { run: run.run.clone(), surface: run.surface.clone(), measurements: 0, by_verdicts };
    let (rows, references) = match ReferenceDerivation::new(context, &run.run, &run.run_derivation, wanted).await? {
        Some(derivation) => {
            let responses = read_back::read_responses(lake, &context.snapshot, &run.run).await?;
            report.measurements = responses.pairs.len();
            derivation.derive_run(context, &keys, responses).await?
        }
        // A reference was removed or rejected, or never there.
        None if wanted.version_pair().is_none() => {
            (Vec::new(), RunReferences { missing: wanted.missing_names(), ..RunReferences::default() })
        }
        None => return Ok(ReadyJob { staged: Vec::new(), report, mark: None }),
    };
    let mut row = Vec::new();
    for file in context.snapshot.files_of(Table::Runs, &run.run) {
        let before = read_back::run_row(lake, file, &run.run).await?;
        row.push(rows::runs::with_references(lake.rig(), &keys, &before, &references)?);
    }
    let pointer = job.completed_run(references.derivation.clone());
    let names = ReferenceNames { flat: wanted.flat.surface.clone(), foam: wanted.foam.surface.clone() };
    let project = context.snapshot.project_of(&run.run);
    let group = FileGroup::new(&run.surface, project, names, &lake.config().references);
    let mut staged = context.stage_derived(&pointer, &group, &row, rows)?;
    if pointer == *run {
        // Some tables lack its rows; the others keep them in the files where they are.
        staged.retain(|rows| rows.table() == Table::Runs || !context.has_rows(rows.table(), &run.run));
    }
    // A row of an earlier version of the program does not count the others.
    if let Some(counts) = context.snapshot.row_counts(&run.run).cloned()
        && let Some(row) = staged.pop()
    {
        let row = row.with_row_counts(counts, &staged);
        staged.push(row);
    }
    Ok(ReadyJob { staged, report, mark: None })
}
