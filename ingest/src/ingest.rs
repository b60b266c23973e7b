//! Turns run files into rows: reads, measures, derives, stages, and commits in groups.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use echolake_dsp::air::AirState;
use echolake_lake::{
    ClaimOutcome, ClaimTimes, CommitOutcome, EncodedRows, FileGroup, Lake, ReferenceNames, RunRowCounts, VisibleRun,
    WorkClaims, encode_run_rows, object_sha256, verdict_mark,
};
use echolake_schema::RunId;
use echolake_schema::messages::Measurement;
use echolake_schema::tables::{Source, Table};
use tracing::{Instrument as _, Span, field};

use crate::CODE_VERSION;
use crate::context::IngestContext;
use crate::derive::ReferenceDerivation;
use crate::derived_values::RunResponses;
use crate::error::{Error, Result};
use crate::inbox::{self, FileVersion, OpenedRun, ReadFile, ReadingMark, RunSource};
use crate::pipeline::{self, Cores, ReadyJob};
use crate::read_back;
use crate::reading::{Measurer, Response, RunContent, RunHead, check_filled};
use crate::references::digest_parts;
use crate::report::{FileReport, IngestOutcome, IngestedRun};
use crate::rows::runs::RunReferences;
use crate::rows::surfaces::FarFieldCache;
use crate::rows::{self, RunKeys};

/// Revision of the rows that follow from a run alone, responses among them: those of another one are derived again.
/// `revision_tests.rs` fails if the numbers change and it does not.
pub(crate) const RESPONSES_REVISION: &str = "9";

/// Time between two looks at other ingests' claims.
pub(crate) const LOOK_EVERY: Duration = Duration::from_secs(2);

/// Ingests runs into a lake.
#[derive(Debug, Clone)]
pub struct LakeIngest<'a> {
    pub(crate) lake: &'a Lake,
    pub(crate) stop: Arc<AtomicBool>,
    /// Claims, if several ingests share the work.
    pub(crate) claims: Option<Arc<WorkClaims>>,
    /// Rows of runs that are in the lake are written again, if the log lacks their files.
    again: bool,
}

/// State shared by the workers.
#[derive(Clone)]
struct IngestWork {
    again: bool,
    context: IngestContext,
    measurer: Arc<Measurer>,
    far_fields: Arc<FarFieldCache>,
    shared: Option<SharedWork>,
}

/// The parts of an ingest that shares its work with others.
#[derive(Clone)]
struct SharedWork {
    claims: Arc<WorkClaims>,
    /// Runs that were in the tables before the first file was ingested: whoever wants them ingested wants them again.
    known: Arc<BTreeSet<RunId>>,
}

impl<'a> LakeIngest<'a> {
    /// Creates an ingest into this lake. Once `stop` is set, no run is started; runs in progress are completed. On an
    /// object store it shares the work with other ingests, for which it needs a Tokio runtime.
    pub fn new(lake: &'a Lake, stop: Arc<AtomicBool>) -> Self {
        let claims = lake.is_remote().then(|| Arc::new(WorkClaims::start(lake, ClaimTimes::default())));
        Self { lake, stop, claims, again: false }
    }

    /// Writes the rows of runs that are in the lake again, too, if the log lacks their files.
    #[must_use]
    pub(crate) fn writing_again(self) -> Self {
        Self { again: true, ..self }
    }

    /// Shares the work with other ingests on whatever store the lake is.
    #[cfg(test)]
    pub(crate) fn with_claims(self, times: ClaimTimes) -> Self {
        Self { claims: Some(Arc::new(WorkClaims::start(self.lake, times))), ..self }
    }

    /// Waits until all claims are given back: whoever waits for them need not wait until they are dead.
    pub async fn release_claims(self) {
        if let Some(claims) = self.claims.and_then(Arc::into_inner) {
            claims.release_all().await;
        }
    }

    /// Ingests runs, references first so that the others are derived with them at once. It is idempotent: runs that are
    /// in the lake add nothing. `report` is called for each file when it is finished. Tables that are missing are made.
    ///
    /// # Errors
    /// [`Error::Stopped`], or an error of the lake. Readers do not see files that are not reported yet; the same call
    /// resumes with them.
    pub async fn ingest_runs(
        &self,
        sources: Vec<RunSource>,
        report: &mut (dyn FnMut(FileReport) + Send),
    ) -> Result<()> {
        let mut first = Some(self.lake.ensure_tables().await?);
        let mut known: Option<Arc<BTreeSet<RunId>>> = None;
        // Runs that are references, perhaps, and lack their own rows.
        let is_lacking = |run: &RunId| first.as_ref().is_some_and(|before| before.lacks_rows(run, Source::Run));
        let (lacking, sources): (Vec<_>, Vec<_>) =
            sources.into_iter().partition(|source| source.run_in_place().is_some_and(|run| is_lacking(&run)));
        let (references, others) = self.order_sources(sources).await?;
        let cores = Cores::all()?;
        let measurer = Arc::new(Measurer::new(self.lake));
        let far_fields = Arc::new(FarFieldCache::default());
        for sources in [lacking, references, others] {
            let mut claimed: Vec<RunSource> = Vec::new();
            let mut free = sources;
            while !free.is_empty() {
                let snapshot = match first.take() {
                    Some(first) => first,
                    None => self.lake.snapshot().await?,
                };
                let context = IngestContext::read_from(self.lake, &cores, Arc::new(snapshot)).await?;
                let runs = || Arc::new(context.snapshot.runs().map(|run| run.run.clone()).collect());
                let known = known.get_or_insert_with(runs).clone();
                let shared = self.claims.clone().map(|claims| SharedWork { claims, known });
                let measurer = measurer.clone();
                let far_fields = far_fields.clone();
                let work = IngestWork { again: self.again, context, measurer, far_fields, shared };
                for source in self.ingest_group(work, free, report).await? {
                    if !claimed.contains(&source) {
                        report(FileReport::Claimed(source.clone()));
                        claimed.push(source);
                    }
                }
                free = self.wait_for_claims(&mut claimed).await?;
            }
        }
        Ok(())
    }

    /// Ingests a file as versions before this one did, whether it has an end or not.
    #[cfg(test)]
    pub(crate) async fn ingest_without_end(&self, source: &RunSource) -> Result<IngestedRun> {
        let snapshot = Arc::new(self.lake.ensure_tables().await?);
        let context = IngestContext::read_from(self.lake, &Cores::all()?, snapshot).await?;
        let measurer = Arc::new(Measurer::new(self.lake));
        let work = IngestWork { again: false, context, measurer, far_fields: Arc::default(), shared: None };
        let job = work.read_and_stage(source).await?;
        self.lake.commit_rows(job.staged).await?;
        Ok(job.report)
    }

    // Waits until nobody alive works on some of the claimed files; takes them out of `claimed`.
    async fn wait_for_claims(&self, claimed: &mut Vec<RunSource>) -> Result<Vec<RunSource>> {
        let Some(claims) = &self.claims else { return Ok(Vec::new()) };
        while !claimed.is_empty() {
            if self.stop.load(Ordering::Relaxed) {
                return Err(Error::Stopped);
            }
            claims.refresh_claims().await;
            let all = std::mem::take(claimed).into_iter();
            let (free, held): (Vec<_>, Vec<_>) = all.partition(|source| claims.is_free(source.work_name()));
            *claimed = held;
            if !free.is_empty() {
                return Ok(free);
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
        Ok(Vec::new())
    }

    // Returns the files that other ingests have claimed.
    async fn ingest_group(
        &self,
        work: IngestWork,
        sources: Vec<RunSource>,
        report: &mut (dyn FnMut(FileReport) + Send),
    ) -> Result<Vec<RunSource>> {
        let (cores, claims) = (work.context.cores.clone(), work.shared.as_ref().map(|shared| shared.claims.clone()));
        let release = |source: &RunSource| claims.iter().for_each(|claims| claims.release_work(source.work_name()));
        let mut refused = Vec::new();
        let mut claimed = Vec::new();
        let mut replaced = Vec::new();
        let ended = &mut |(source, done): pipeline::JobOutcome<RunSource, IngestedRun>| match done {
            Ok((taken, outcome)) => {
                if taken.replaced && outcome != Some(CommitOutcome::Outdated) {
                    replaced.push((source.clone(), Lake::run_path(&taken.surface, &taken.run)));
                }
                let outcome = IngestOutcome::from(outcome == Some(CommitOutcome::Now));
                release(&source);
                report(FileReport::Ingested(IngestedRun { outcome, ..taken }));
                Ok(())
            }
            Err(Error::Claimed { .. }) => {
                claimed.push(source);
                Ok(())
            }
            Err(why) if why.is_refusal() => {
                refused.push((source, why));
                Ok(())
            }
            Err(why) => Err(why),
        };
        let do_one = move |source| {
            let work = work.clone();
            let span = tracing::error_span!("ingest", file = %source, run = field::Empty, surface = field::Empty);
            async move { work.ingest_run(&source).await }.instrument(span)
        };
        let done = pipeline::run_jobs(self.lake, &cores, sources, &self.stop, do_one, ended).await;
        for (source, place) in replaced {
            inbox::replace_partial(self.lake, &source, &place).await?;
        }
        for (source, why) in refused {
            let name = source.work_name().to_owned();
            report(match why {
                Error::Gone { .. } => FileReport::Gone(source),
                why => {
                    FileReport::Refused { moved: inbox::quarantine_file(self.lake, &source, &why).await?, source, why }
                }
            });
            claims.iter().for_each(|claims| claims.release_work(&name));
        }
        done.map(|()| claimed)
    }

    // Runs of surfaces that others name as references, and the rest. The order only saves time: rows are derived again
    // if their references change.
    async fn order_sources(&self, sources: Vec<RunSource>) -> Result<(Vec<RunSource>, Vec<RunSource>)> {
        let defaults = &self.lake.config().references;
        let mut names = BTreeSet::from([defaults.flat.clone(), defaults.foam.clone()]);
        let mut heads = Vec::with_capacity(sources.len());
        for source in sources {
            let _mark = ReadingMark::new(self.lake, &source);
            let head = match source.open_run(self.lake) {
                Ok(opened) => RunHead::read_from(&opened).await,
                Err(_) => None,
            };
            names.extend(head.iter().flat_map(|h| h.references.clone()));
            heads.push((source, head));
        }
        let is_reference = |head: &Option<RunHead>| head.as_ref().is_some_and(|h| names.contains(&h.surface));
        let (references, others): (Vec<_>, Vec<_>) = heads.into_iter().partition(|(_, head)| is_reference(head));
        let sources = |of: Vec<(RunSource, _)>| of.into_iter().map(|(source, _)| source).collect();
        Ok((sources(references), sources(others)))
    }
}

impl IngestWork {
    async fn ingest_run(&self, source: &RunSource) -> Result<ReadyJob<IngestedRun>> {
        self.claim_source(source).await?;
        inbox::check_end(&source.open_run(&self.context.lake)?).await?;
        self.read_and_stage(source).await
    }

    async fn read_and_stage(&self, source: &RunSource) -> Result<ReadyJob<IngestedRun>> {
        let IngestContext { lake, cores, snapshot, rejected, finder } = &self.context;
        let mark = ReadingMark::new(lake, source);
        let opened = source.open_run(lake)?;
        let version = FileVersion::from_source(lake, source).await?;
        let read = RunContent::read_from(lake, &self.measurer, cores, &opened).await;
        if source.may_be_copied(lake) {
            check_filled(&opened, &read).await?;
        }
        let content = Arc::new(read?);
        let keys = RunKeys { surface: content.manifest.surface_id.clone(), run: content.manifest.run_id.clone() };
        let span = Span::current();
        span.record("run", field::display(&keys.run)).record("surface", field::display(&keys.surface));
        tracing::debug!(measurements = content.accepted.len(), damages = content.damaged.len(), "the file is read");
        let derivation = digest_parts(&[
            content.integrity.sha256.as_str(),
            CODE_VERSION,
            RESPONSES_REVISION,
            lake.config().samples.name(),
        ]);
        let known = snapshot.run(&keys.run);
        let replaced = match known {
            Some(known) => self.has_lesser_file(known, &content, &opened).await?,
            None => false,
        };
        let place = Lake::run_path(&keys.surface, &keys.run);
        let file = ReadFile::check_digest(lake, source, version, &content.integrity).await?;
        let kept = async {
            // The lesser file keeps its place until the rows of this one are committed.
            if replaced {
                inbox::check_unchanged(lake, source, &file)?;
                return Ok(mark);
            }
            let there = RunSource::Lake(place.clone());
            // Both names are marked while it moves: what is computed meanwhile may end the process.
            let next_mark = if *source == there { None } else { ReadingMark::new(lake, &there) };
            inbox::move_to_place(lake, source, &place, &file, known.is_some()).await?;
            Ok(next_mark.or(mark))
        };
        let defaults = &lake.config().references;
        let names = ReferenceNames::from_surface(&content.surface, defaults);
        let group = FileGroup::new(&keys.surface, content.surface.project.as_ref(), names.clone(), defaults);
        let wanted = finder.lock().await.wanted_by(names);
        let mut taken = IngestedRun {
            run: keys.run.clone(),
            surface: keys.surface.clone(),
            measurements: content.accepted.len(),
            derived: false,
            missing: wanted.missing_names(),
            outcome: IngestOutcome::Added,
            damaged: content.damaged.clone(),
            whole: content.is_whole(),
            stopped: content.is_stopped(),
            replaced,
            mended: false,
        };
        let is_current = known.is_some_and(|k| k.run_derivation == derivation);
        if !self.again && is_current && !snapshot.lacks_rows(&keys.run, Source::Run) {
            kept.await?;
            return Ok(ReadyJob { staged: Vec::new(), report: taken, mark: None });
        }
        let its_lake = lake.clone();
        let for_rows = keys.clone();
        let its_content = content.clone();
        let far_fields = self.far_fields.clone();
        let of_the_run = async {
            let encode = move || encode_run(&its_lake, &for_rows, &its_content, &far_fields);
            let rows = cores.compute_on_core(encode).await?;
            Ok::<_, Error>(self.context.stage_rows(&keys, &group, &derivation, rows))
        };
        if is_current {
            // Its row of `runs` names the missing rows. Those that need references follow when all of these are there.
            let (mut staged, mark) = tokio::try_join!(of_the_run, kept)?;
            staged.retain(|rows| !self.context.has_rows(rows.table(), &keys.run));
            taken.mended = true;
            return Ok(ReadyJob { staged, report: taken, mark });
        }
        let of_references = async {
            let (rows, references) =
                match ReferenceDerivation::new(&self.context, &keys.run, &derivation, &wanted).await? {
                    Some(derived) => derived.derive_run(&self.context, &keys, content.run_responses()).await?,
                    None => (Vec::new(), RunReferences { missing: wanted.missing_names(), ..RunReferences::default() }),
                };
            // Which run describes the surface is left to the completion: it writes the rows of the other one first.
            let is_rejected = rejected.is_run_rejected(keys.run.as_str());
            let verdicts = match known.filter(|known| known.is_rejected() != is_rejected) {
                Some(known) => known.verdicts.clone(),
                None => verdict_mark(rejected, &keys.run),
            };
            let run = VisibleRun {
                surface: keys.surface.clone(),
                run: keys.run.clone(),
                run_derivation: derivation.clone(),
                reference_derivation: references.derivation.clone(),
                verdicts,
            };
            let row = rows::runs::new_run_row(lake, &keys, &content, &derivation, &references)?;
            Ok((self.context.stage_derived(&run, &group, &[row], rows)?, references))
        };
        // The file comes to its place meanwhile.
        let (mut staged, (derived, references), mark) = tokio::try_join!(of_the_run, of_references, kept)?;
        // The row of `runs` is the last one.
        staged.extend(derived);
        if let Some(row) = staged.pop() {
            let row = row.with_row_counts(RunRowCounts::default(), &staged);
            staged.push(row);
        }
        taken.derived = references.derivation.is_some();
        taken.missing = references.missing;
        tracing::debug!(tables = staged.len(), missing = taken.missing, "the rows are encoded and not committed yet");
        Ok(ReadyJob { staged, report: taken, mark })
    }

    // Claims a file, if several ingests share the work.
    async fn claim_source(&self, source: &RunSource) -> Result<()> {
        let Some(SharedWork { claims, known }) = &self.shared else { return Ok(()) };
        let file = source.to_string();
        if claims.claim_work(source.work_name()).await == ClaimOutcome::Denied {
            return Err(Error::Claimed { file });
        }
        // Another ingest may have finished it meanwhile. In the inbox it would be gone.
        let Some(run) = source.run_in_place().filter(|run| !known.contains(run)) else { return Ok(()) };
        let rows = self.context.lake.commit_log().list_files(Table::Runs).await?;
        if rows.iter().any(|row| row.shown_runs().contains(&run)) { Err(Error::Gone { file }) } else { Ok(()) }
    }

    // Returns whether the lake has no more than the beginning of this file, as of a copy that was cut off, or a damaged
    // one, and this one is whole.
    async fn has_lesser_file(&self, known: &VisibleRun, content: &RunContent, opened: &OpenedRun) -> Result<bool> {
        let Some(row) = self.context.snapshot.files_of(Table::Runs, &known.run).next() else { return Ok(false) };
        let row = read_back::run_row(&self.context.lake, row, &known.run).await?;
        let there = rows::runs::text_of(&row, "file_sha256").unwrap_or_default();
        if there == content.integrity.sha256 {
            return Ok(false);
        }
        let is_damaged = rows::runs::number_of(&row, "damaged").is_some_and(|count| count > 0);
        if is_damaged && content.is_whole() && content.damaged.is_empty() {
            return Ok(true);
        }
        let shorter = rows::runs::number_of(&row, "file_bytes").and_then(|bytes| u64::try_from(bytes).ok());
        if let Some(bytes) = shorter.filter(|bytes| (1..content.integrity.bytes).contains(bytes)) {
            let store = opened.store.as_ref();
            let path = &opened.path;
            let failed = |e: object_store::Error| Error::read_failure(&opened.name, e);
            if !inbox::has_end_at(store, path, bytes).await.map_err(failed)?
                && object_sha256(store, path, bytes, &mut |_| {}).await.map_err(failed)? == there
            {
                return Ok(true);
            }
        }
        let given = content.integrity.sha256.clone();
        Err(Error::OtherContent { run: known.run.to_string(), file: opened.name.clone(), given, there })
    }
}

// The rows that do not depend on references.
fn encode_run(
    lake: &Lake,
    keys: &RunKeys,
    content: &RunContent,
    far_fields: &FarFieldCache,
) -> Result<Vec<(Table, EncodedRows)>> {
    let rig = lake.rig();
    let origin = content.manifest.origin.label();
    let references = &lake.config().references;
    let heights_mm = &content.heights_mm;
    let surface = rows::surfaces::surface_row(rig, keys, &content.surface, references, origin, heights_mm, far_fields)?;
    let heights = rows::heightmaps::heightmap_rows(rig, keys, heights_mm)?;
    let mut tables = vec![
        (Table::Surfaces, vec![surface]),
        (Table::Environment, vec![rows::logs::environment_rows(rig, keys, &content.readings)?]),
        (Table::Events, vec![rows::logs::event_rows(rig, keys, &content.events)?]),
    ];
    tables.extend(heights.map(|batch| (Table::Heightmaps, vec![batch])));
    let mut encoded = Vec::with_capacity(tables.len() + 1);
    for (table, batches) in tables {
        encoded.push((table, encode_run_rows(table, &table.schema(rig), &batches)?));
    }
    encoded.push((
        Table::Measurements,
        rows::measurements::encode_measurements(rig, lake.grid(), keys, &content.accepted)?,
    ));
    Ok(encoded)
}

// As `measurements` has it.
fn measured_air(measurement: &Measurement, response: &Response) -> AirState {
    let Measurement { humidity_pct, pressure_hpa, .. } = measurement;
    AirState::with_known(response.air.temperature_c, Some(*humidity_pct), Some(*pressure_hpa))
}

impl RunContent {
    /// Returns the responses alone, sorted by pair.
    fn run_responses(&self) -> RunResponses {
        RunResponses {
            pairs: self.accepted.iter().map(|(m, _)| m.pair_id).collect(),
            irs: rows::measurements::join_responses(&self.accepted),
            airs: self.accepted.iter().map(|(m, r)| measured_air(m, r)).collect(),
        }
    }
}
