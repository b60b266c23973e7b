//! `echolake ingest`: runs become rows.

use std::collections::{HashMap, HashSet};
use std::io::Read as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use echolake_acquisition::recovery::is_partial;
use echolake_ingest::Error as IngestError;
use echolake_ingest::{
    CompletedRun, FileReport, IngestOutcome, IngestedRun, LakeIngest, PendingFiles, RecordingState, RunSource,
    SuspectFile, UnfinishedRecording, find_runs, has_end, list_arrivals, list_pending, pending_runs, rig_of_run,
};
use echolake_lake::{Error as LakeError, Lake, ReferenceSurfaces, remote_access};
use object_store::path::Path as ObjectPath;
use serde::{Deserialize, Serialize};

use crate::CommandOutcome;
use crate::error_text::describe_error;
use crate::logging::child_variable;
use crate::progress::CommandProgress;
use crate::signals::StopRequest;
use clap::Args;

#[derive(Debug, Args)]
pub(crate) struct IngestArgs {
    /// Run files, or names of runs in the lake; by default all that are not in the tables yet.
    pub runs: Vec<String>,
    /// Keep running and ingest new files of the lake's inbox, until Ctrl-C.
    #[arg(long, conflicts_with_all = ["runs", "json"])]
    pub watch: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
    /// Take in this file of the lake alone, for the ingest that started this one.
    #[arg(long, hide = true, value_name = "PATH", conflicts_with_all = ["runs", "watch", "json"])]
    pub suspect: Option<String>,
}

/// Time between two looks at the inbox.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Time for which a file without its end is taken for a copy that is still being made.
const COPY_STALLS_AFTER: Duration = Duration::from_secs(60);
/// Time that a watch waits after an error.
const RETRY_AFTER: Duration = Duration::from_secs(10);

/// Exit code of a process that panicked.
const PANICKED: i32 = 101;

/// The results of all files.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct IngestSummary {
    pub taken: Vec<IngestedRun>,
    refused: Vec<RefusedFile>,
    /// Number of files that other ingests took.
    #[serde(skip)]
    gone: usize,
    /// Tables lack rows, or may.
    #[serde(skip)]
    lacks_rows: bool,
    /// Runs were ingested whose references are missing.
    #[serde(skip)]
    has_waiting: bool,
}

/// A file that cannot be taken in.
#[derive(Serialize, Deserialize)]
struct RefusedFile {
    file: String,
    reason: String,
    /// Its new path, if it was moved.
    moved_to: Option<String>,
}

impl IngestSummary {
    fn has_loss(&self) -> bool {
        !self.refused.is_empty() || self.taken.iter().any(|t| !(t.whole || t.stopped) || !t.damaged.is_empty())
    }

    fn add_refused(&mut self, file: String, why: &IngestError, moved_to: Option<String>) {
        self.refused.push(RefusedFile { file, reason: why.to_string(), moved_to });
    }

    // Names what is passed over.
    fn pass_over(&mut self, pending: &PendingFiles, progress: &CommandProgress) {
        for (path, why) in passed_over(pending) {
            progress.print_message(format!("error: {why}"));
            self.add_refused(path, &why, None);
        }
    }

    fn add_report(&mut self, report: FileReport, progress: &CommandProgress) {
        match report {
            FileReport::Ingested(run) => {
                print_ingested(progress, &run);
                self.taken.push(run);
            }
            FileReport::Refused { source, why, moved } => {
                let whereto = moved.as_ref().map(|m| format!(" (now at `{m}`)")).unwrap_or_default();
                progress.print_message(format!("error: {why}{whereto}"));
                self.add_refused(source.to_string(), &why, moved.map(|m| m.to_string()));
            }
            FileReport::Gone(source) => {
                progress.print_message(format!("{source}: another ingest has taken it, or somebody deleted it"));
                self.gone += 1;
            }
            FileReport::Claimed(source) => {
                progress.print_message(format!("{source}: another ingest is at it; waiting for its end"))
            }
        }
    }
}

pub(crate) async fn run_ingest(args: &IngestArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = super::stop_request()?;
    let lake = open_or_make(lake_url, &args.runs).await?;
    let progress = CommandProgress::new();
    if let Some(path) = &args.suspect {
        return ingest_suspect(&lake, path, stop.flag(), &progress).await;
    }
    if args.watch {
        // Later errors are waited out; this one is the store's nature.
        lake.ensure_tables().await?;
        return watch_inbox(&lake, &stop, &progress).await;
    }
    let pending = if args.runs.is_empty() { list_pending(&lake).await? } else { PendingFiles::default() };
    let sources = if args.runs.is_empty() { pending.run_sources() } else { sources_of(&lake, &args.runs).await? };
    let nothing = sources.is_empty();
    let mut summary = ingest_runs(&lake, sources, stop.flag(), &progress).await?;
    if args.runs.is_empty() {
        summary.pass_over(&pending, &progress);
        pending.recordings.iter().for_each(|recording| note_recording(recording, &progress));
        finish_for_others(&lake, &mut summary, stop.flag(), &progress).await?;
        finish_tables(&lake, &summary).await?;
    }
    if args.json {
        super::print_line(&serde_json::to_string_pretty(&summary)?)?;
    }
    if nothing && !args.json {
        let unfinished = match pending.recordings.len() {
            0 => String::new(),
            count => format!("; {count} recordings in the inbox are not finished"),
        };
        eprintln!("nothing to ingest: every closed run of the lake is in its tables{unfinished}");
    }
    if summary.has_waiting && !args.json {
        eprintln!("next: echolake --lake {lake_url} serve, which shows the responses");
    }
    // Files that were named are the whole job; if none of them could be taken in, it failed.
    if !args.runs.is_empty() && summary.taken.is_empty() && !summary.refused.is_empty() {
        anyhow::bail!("nothing was taken in");
    }
    Ok(if summary.has_loss() { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
}

// What makes a lake in a folder also records into it. On an object store, the first run that is taken in makes it.
async fn open_or_make(lake_url: &str, runs: &[String]) -> anyhow::Result<Lake> {
    let missing = match Lake::open(lake_url).await {
        Err(e @ LakeError::NoLake { .. }) if remote_access(lake_url).is_some() => e,
        opened => return Ok(opened?),
    };
    let Some(first) = runs.first().map(Path::new).filter(|run| run.is_file()) else { return Err(missing.into()) };
    let rig = rig_of_run(first).await?;
    let rig = rig.with_context(|| format!("no lake at `{lake_url}`, and `{}` has no rig for one", first.display()))?;
    Ok(Lake::open_or_create(lake_url, &rig, &ReferenceSurfaces::default()).await?)
}

// What is no run now and will not become one by itself, by its path, and why.
fn passed_over(pending: &PendingFiles) -> Vec<(String, IngestError)> {
    let unusable = pending.unusable.iter().map(|entry| {
        let path = entry.path.clone();
        let reason = entry.reason.clone();
        (path.clone(), IngestError::Unusable { path, reason })
    });
    let cut_off = pending.recordings.iter().filter(|recording| recording.state == RecordingState::CutOff);
    let cut_off = cut_off.map(|recording| {
        let file = recording.path.to_string();
        (file.clone(), IngestError::CutOff { file, bytes: recording.bytes })
    });
    unusable.chain(cut_off).collect()
}

fn note_recording(UnfinishedRecording { path, bytes, state }: &UnfinishedRecording, progress: &CommandProgress) {
    let what = match state {
        RecordingState::Running => "is being recorded",
        RecordingState::Resumable => {
            "is not finished; hint: `echolake acquire --resume` resumes it, `echolake recover` makes a run of what it \
                holds"
        }
        RecordingState::Import => "is part of an import that was cut off; hint: repeat the import",
        RecordingState::CutOff => return,
    };
    progress.print_message(format!("note: `{path}` ({}) {what}", super::format_size(*bytes)));
}

// What another ingest took on an object store and did not finish, because it died, is in `runs/` and in no table.
async fn finish_for_others(
    lake: &Lake,
    summary: &mut IngestSummary,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<()> {
    while lake.is_remote() && std::mem::take(&mut summary.gone) > 0 {
        let mut left = pending_runs(lake).await?;
        left.retain(|source| summary.refused.iter().all(|refused| refused.file != source.to_string()));
        if left.is_empty() {
            break;
        }
        let mut more = ingest_runs(lake, left, stop, progress).await?;
        summary.taken.append(&mut more.taken);
        summary.refused.append(&mut more.refused);
        summary.gone = more.gone;
        summary.lacks_rows = more.lacks_rows;
    }
    Ok(())
}

// All run files are in the tables, or refused. One of `runs/` that is refused may have been in them before.
async fn finish_tables(lake: &Lake, summary: &IngestSummary) -> anyhow::Result<()> {
    if !summary.lacks_rows {
        return Ok(());
    }
    if !summary.refused.iter().any(|refused| refused.moved_to.is_none()) {
        lake.finish_rebuild().await?;
    }
    lake.whole_snapshot().await.map(drop).context("rows of the lake are still missing")
}

/// Ingests runs, then completes rows that waited for references.
pub(crate) async fn ingest_runs(
    lake: &Lake,
    sources: Vec<RunSource>,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<IngestSummary> {
    let ingest = LakeIngest::new(lake, stop.clone());
    let taken = ingest_and_complete(&ingest, lake, sources, stop, progress).await;
    ingest.release_claims().await;
    taken
}

async fn ingest_and_complete(
    ingest: &LakeIngest<'_>,
    lake: &Lake,
    sources: Vec<RunSource>,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<IngestSummary> {
    let mut summary = IngestSummary::default();
    let count = sources.len();
    let mut task = progress.start_task("ingest", count as u64, "runs");
    let mut ended = 0;
    let (suspects, sources): (Vec<_>, Vec<_>) =
        sources.into_iter().partition(|source| SuspectFile::from_source(lake, source).is_some());
    let mut report = |report: FileReport| {
        ended += u64::from(!matches!(report, FileReport::Claimed(_)));
        summary.add_report(report, progress);
        task.set_done(ended);
    };
    let mut outcome = ingest.ingest_runs(sources, &mut report).await.map_err(anyhow::Error::from);
    // All others first: these may end the process of which this one is a part.
    for mut suspect in suspects.iter().filter_map(|source| SuspectFile::from_source(lake, source)) {
        if outcome.is_ok() {
            outcome = watch_suspect(lake, &mut suspect, stop, &mut summary, progress).await;
        }
    }
    let added = || summary.taken.iter().filter(|t| t.outcome == IngestOutcome::Added);
    let measurements: usize = added().map(|t| t.measurements).sum();
    let derived: usize = added().filter(|t| t.derived).map(|t| t.measurements).sum();
    match count {
        0 => task.dismiss(),
        _ => task.finish_with(format!(
            "{} runs, {measurements} new measurements, {derived} of them derived",
            summary.taken.len()
        )),
    }
    outcome?;
    let mut task = None;
    let mut rows = 0;
    let mut runs = 0;
    let mut judged_surfaces = HashSet::new();
    let mut judged_rows = 0;
    let completed = &mut |completed: &CompletedRun, total: usize| {
        rows += completed.measurements;
        runs += 1;
        if completed.by_verdicts {
            judged_surfaces.insert(completed.surface.clone());
            judged_rows += completed.measurements;
        }
        task.get_or_insert_with(|| progress.start_task("complete", total as u64, "runs")).set_done(runs);
    };
    let completion = ingest.complete_runs(completed).await?;
    if let Some(task) = task {
        task.finish_with(format!("{runs} runs, {rows} measurements derived"));
    }
    if !judged_surfaces.is_empty() {
        progress.print_message(format!(
            "verdicts: {} surfaces with {judged_rows} measurements were derived again, because verdicts on their runs \
             or references came since the last ingest",
            judged_surfaces.len()
        ));
    }
    for (run, why) in completion.unrestored {
        progress.print_message(format!(
            "warning: the verdict on a newer run of its surface is not followed, because run `{run}`, which is to \
             describe the surface instead, cannot be read: {why}"
        ));
    }
    summary.lacks_rows = !completion.is_whole;
    for (run, missing) in completion.waiting {
        if summary.taken.iter().any(|t| t.run == run) {
            summary.has_waiting = true;
            progress.print_message(format!(
                "{run}: waits for reference {missing}, which levels need; ingest a run of it, and it is completed. Its \
                 responses are in the tables"
            ));
        }
    }
    Ok(summary)
}

// Has a file that an ingest was reading when it died taken in by a process of its own. If that ends as well, again and
// again, it is the file's fault.
async fn watch_suspect(
    lake: &Lake,
    suspect: &mut SuspectFile,
    stop: &AtomicBool,
    summary: &mut IngestSummary,
    progress: &CommandProgress,
) -> anyhow::Result<()> {
    loop {
        let file = suspect.source().clone();
        let RunSource::Lake(path) = &file else { return Ok(()) };
        if let Some(report) = suspect.refuse_if_deadly(lake).await? {
            summary.add_report(report, progress);
            return Ok(());
        }
        if stop.load(Ordering::Relaxed) {
            return Err(echolake_ingest::Error::Stopped.into());
        }
        progress.print_message(format!("{file}: an ingest died while it read this; a process of its own takes it in"));
        let before = SuspectFile::find_pending(lake).await?;
        let mut command = Command::new(std::env::current_exe().context("this program has no path")?);
        command.args(["--lake", lake.location(), "ingest", "--suspect", path.as_ref()]);
        let (name, value) = child_variable();
        command.env(name, value);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let run = move || {
            let mut child = command.spawn()?;
            // It ends when this pipe does, which is at the latest when this process ends.
            let _pipe = child.stdin.take();
            child.wait_with_output()
        };
        let output = tokio::task::spawn_blocking(run).await?.context("cannot start a process")?;
        match output.status.code() {
            Some(0) => {
                let mut theirs: IngestSummary =
                    serde_json::from_slice(&output.stdout).context("a process said no JSON")?;
                summary.taken.append(&mut theirs.taken);
                summary.refused.append(&mut theirs.refused);
                return Ok(());
            }
            _ if stop.load(Ordering::Relaxed) => return Err(echolake_ingest::Error::Stopped.into()),
            None | Some(PANICKED) => suspect.add_death(lake, &output.status.to_string(), &before).await?,
            Some(code) => anyhow::bail!("the process that took in `{file}` failed with exit code {code}"),
        }
    }
}

// Takes in one file for the ingest that started this process, and ends with it.
async fn ingest_suspect(
    lake: &Lake,
    path: &str,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<CommandOutcome> {
    let (ended, parent) = tokio::sync::oneshot::channel();
    std::thread::spawn(|| {
        let _ = std::io::stdin().read(&mut [0]);
        // Nobody listens once the work is done.
        let _ = ended.send(());
    });
    let mut summary = IngestSummary::default();
    let source = RunSource::Lake(ObjectPath::parse(path)?);
    let ingest = LakeIngest::new(lake, stop.clone());
    let mut report = |report| summary.add_report(report, progress);
    tokio::select! {
        taken = ingest.ingest_runs(vec![source], &mut report) => taken?,
        _ = parent => anyhow::bail!("the ingest that started this process has ended"),
    }
    ingest.release_claims().await;
    super::print_line(&serde_json::to_string(&summary)?)?;
    Ok(CommandOutcome::Whole)
}

/// Size and time of change of a file.
type WatchedState = (u64, chrono::DateTime<chrono::Utc>);

/// What a watch knows of the inbox.
#[derive(Default)]
struct WatchedInbox {
    /// Files that are not ingested yet, and since when they are as they are.
    seen: HashMap<ObjectPath, (WatchedState, Instant)>,
    /// Refused files that are still where they were.
    given_up: HashMap<String, WatchedState>,
    /// Entries that were named as passed over.
    named: HashSet<String>,
}

impl WatchedInbox {
    // The files that can be ingested now. One that is being copied grows between two looks; one that does not end as a
    // closed file is still being copied, until it has not grown for a while.
    async fn list_settled(&mut self, lake: &Lake, pending: &PendingFiles) -> HashMap<String, WatchedState> {
        let mut settled = HashMap::new();
        let mut seen = HashMap::new();
        for meta in &pending.runs {
            let path = &meta.location;
            let state = (meta.size, meta.last_modified);
            if self.given_up.get(path.as_ref()) == Some(&state) {
                continue;
            }
            let since = self.seen.get(path).filter(|(before, _)| *before == state).map(|(_, since)| *since);
            // Object stores show no file before it is whole.
            let is_settled = lake.is_remote()
                || match since {
                    None => false,
                    Some(since) if since.elapsed() >= COPY_STALLS_AFTER => true,
                    // What cannot be read is reported.
                    Some(_) => has_end(lake, path).await.unwrap_or(true),
                };
            if is_settled {
                settled.insert(path.to_string(), state);
            } else {
                seen.insert(path.clone(), (state, since.unwrap_or_else(Instant::now)));
            }
        }
        self.seen = seen;
        settled
    }

    // Those that were not passed over before.
    fn name_passed_over(&mut self, mut pending: PendingFiles, summary: &mut IngestSummary, progress: &CommandProgress) {
        pending.unusable.retain(|entry| self.named.insert(entry.path.clone()));
        pending.recordings.retain(|r| r.state == RecordingState::CutOff && self.named.insert(r.path.to_string()));
        summary.pass_over(&pending, progress);
    }
}

// Ingests new files of the inbox, until Ctrl-C.
async fn watch_inbox(lake: &Lake, stop: &StopRequest, progress: &CommandProgress) -> anyhow::Result<CommandOutcome> {
    eprintln!("watching `{}/inbox`; Ctrl-C ends it", lake.location());
    let mut inbox = WatchedInbox::default();
    let mut lost = false;
    let mut is_first = true;
    // All that tables have lost is there again.
    let mut is_finished = false;
    while !stop.is_made() {
        // On an object store the inbox alone is listed, but for the first time.
        let found = match lake.is_remote() && !is_first {
            true => list_arrivals(lake).await,
            false => list_pending(lake).await,
        };
        let found = match found {
            Err(e) if lake.is_remote() => {
                wait_after(&e.into(), stop).await;
                continue;
            }
            found => found?,
        };
        is_first = false;
        let mut settled = inbox.list_settled(lake, &found).await;
        let mut passed_over = IngestSummary::default();
        let sources: Vec<_> =
            found.run_sources().into_iter().filter(|s| settled.contains_key(&s.to_string())).collect();
        inbox.name_passed_over(found, &mut passed_over, progress);
        lost |= passed_over.has_loss();
        if sources.is_empty() && inbox.seen.is_empty() && inbox.given_up.is_empty() && !is_finished {
            match ingest_runs(lake, Vec::new(), stop.flag(), progress).await {
                Ok(summary) => {
                    finish_tables(lake, &summary).await?;
                    is_finished = true;
                }
                Err(e) => wait_after(&e, stop).await,
            }
        }
        if sources.is_empty() {
            sleep_or_stop(LOOK_EVERY, stop).await;
            continue;
        }
        match ingest_runs(lake, sources, stop.flag(), progress).await {
            Ok(summary) => {
                lost |= summary.has_loss();
                // They are looked for in `runs/`, in case that ingest died.
                is_first |= summary.gone > 0;
                let stay = summary.refused.iter().filter(|refused| refused.moved_to.is_none());
                inbox.given_up.extend(stay.filter_map(|refused| settled.remove_entry(&refused.file)));
            }
            Err(e) if stop.is_made() => drop(e),
            // A full disk or an absent store passes; the files are still there.
            Err(e) => wait_after(&e, stop).await,
        }
    }
    Ok(if lost { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
}

async fn wait_after(error: &anyhow::Error, stop: &StopRequest) {
    eprintln!("error: {}; trying again in {} s", describe_error(error), RETRY_AFTER.as_secs());
    sleep_or_stop(RETRY_AFTER, stop).await;
}

// Ends early if a stop is requested.
async fn sleep_or_stop(time: Duration, stop: &StopRequest) {
    let _ = tokio::time::timeout(time, stop.wait_until_made()).await;
}

fn print_ingested(progress: &CommandProgress, taken: &IngestedRun) {
    let IngestedRun { run, measurements, .. } = taken;
    match taken.outcome {
        _ if taken.mended => progress.print_message(format!("{run}: rows were missing, and are derived again")),
        IngestOutcome::Known => progress.print_message(format!("{run}: is in the lake already, nothing added")),
        IngestOutcome::Added => progress.print_message(format!("{run}: {measurements} measurements")),
    }
    if taken.stopped {
        progress.print_message(format!(
            "{run}: its recording was stopped before its end; all that it holds is in the tables"
        ));
    } else if !taken.whole {
        progress.print_message(format!("{run}: warning: its recording was cut off; what it holds is in the tables"));
    }
    for damage in &taken.damaged {
        progress.print_message(format!("{run}: warning: {damage}"));
    }
}

// A name of an existing file is that file; any other is looked up in the lake.
async fn sources_of(lake: &Lake, names: &[String]) -> anyhow::Result<Vec<RunSource>> {
    for name in names {
        anyhow::ensure!(
            !is_partial(Path::new(name)),
            "`{name}` is an unfinished recording, expected a run (.mcap); hint: `echolake acquire --resume {name}` \
             resumes it, `echolake recover {name}` makes a run of what it holds"
        );
    }
    let named: Vec<_> = names.iter().map(String::as_str).filter(|name| !Path::new(name).is_file()).collect();
    let mut found = find_runs(lake, &named).await?.into_iter();
    let mut sources = Vec::with_capacity(names.len());
    for name in names {
        let file = Path::new(name);
        sources.push(match named.contains(&name.as_str()) {
            false => in_lake(lake, file).unwrap_or_else(|| RunSource::File(file.into())),
            true => {
                let found = found.next().flatten();
                RunSource::Lake(found.ok_or_else(|| IngestError::NoRun { given: name.clone() })?)
            }
        });
    }
    Ok(sources)
}

// A file under the lake's own inbox/ or runs/ is not copied.
fn in_lake(lake: &Lake, file: &Path) -> Option<RunSource> {
    let folder = lake.folder()?.canonicalize().ok()?;
    let inside = file.canonicalize().ok()?.strip_prefix(folder).ok()?.to_owned();
    let path = ObjectPath::parse(inside.to_str()?).ok()?;
    let first = path.parts().next()?;
    matches!(first.as_ref(), "inbox" | "runs").then_some(RunSource::Lake(path))
}
