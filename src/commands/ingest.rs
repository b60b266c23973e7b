//! `echolake ingest`: runs become rows.

use std::collections::HashMap;
use std::io::Read as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use echolake_acquisition::recovery::is_partial;
use echolake_ingest::{
    CompletedRun, FileReport, IngestOutcome, IngestedRun, LakeIngest, RunSource, SuspectFile, adopt_cut_off, arrivals,
    pending, rig_of_run,
};
use echolake_lake::{Error as LakeError, Lake, ReferenceSurfaces, remote_access};
use futures::TryStreamExt as _;
use object_store::path::Path as ObjectPath;
use object_store::{ObjectMeta, ObjectStoreExt as _};
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
    pub(crate) runs: Vec<String>,
    /// Keep running and take in new files of the lake's inbox, until Ctrl-C.
    #[arg(long, conflicts_with_all = ["runs", "json"])]
    pub(crate) watch: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
    /// Take in this file of the lake alone, for the ingest that started this one.
    #[arg(long, hide = true, value_name = "PATH", conflicts_with_all = ["runs", "watch", "json"])]
    pub(crate) suspect: Option<String>,
}

/// Time between two looks at the inbox.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Time that a watch waits after an error.
const RETRY_AFTER: Duration = Duration::from_secs(10);

/// Exit code of a process that panicked.
const PANICKED: i32 = 101;

/// The results of all files.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct IngestSummary {
    pub(crate) taken: Vec<IngestedRun>,
    refused: Vec<RefusedFile>,
    /// Number of files that other ingests took.
    #[serde(skip)]
    gone: usize,
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
    fn lost(&self) -> bool {
        !self.refused.is_empty() || self.taken.iter().any(|t| !(t.whole || t.stopped) || !t.damaged.is_empty())
    }

    fn add(&mut self, report: FileReport, progress: &CommandProgress) {
        match report {
            FileReport::Taken(taken) => {
                say(progress, &taken);
                self.taken.push(taken);
            }
            FileReport::Refused { source, why, moved } => {
                let whereto = moved.as_ref().map(|m| format!(" (now at `{m}`)")).unwrap_or_default();
                progress.say(format!("error: {why}{whereto}"));
                let (file, reason, moved_to) = (source.to_string(), why.to_string(), moved.map(|m| m.to_string()));
                self.refused.push(RefusedFile { file, reason, moved_to });
            }
            FileReport::Gone(source) => {
                progress.say(format!("{source}: another ingest has taken it"));
                self.gone += 1;
            }
            FileReport::Claimed(source) => {
                progress.say(format!("{source}: another ingest is at it; waiting for its end"))
            }
        }
    }
}

pub(crate) async fn run(args: &IngestArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = super::stop_request()?;
    let lake = open_or_make(lake_url, &args.runs).await?;
    let progress = CommandProgress::new();
    if let Some(path) = &args.suspect {
        return take_in_suspect(&lake, path, stop.flag(), &progress).await;
    }
    if args.watch {
        // Later errors are waited out; this one is the store's nature.
        lake.ensure_tables().await?;
        return watch(&lake, &stop, &progress).await;
    }
    let sources = match args.runs.as_slice() {
        [] => all_pending(&lake).await?,
        names => sources_of(&lake, names).await?,
    };
    let nothing = sources.is_empty();
    let mut summary = take_in(&lake, sources, stop.flag(), &progress).await?;
    if args.runs.is_empty() {
        finish_for_others(&lake, &mut summary, stop.flag(), &progress).await?;
    }
    if args.json {
        super::print(&serde_json::to_string_pretty(&summary)?)?;
    }
    if nothing && !args.json {
        eprintln!("nothing to ingest: every run of the lake is in its tables");
    }
    // Files that were named are the whole job; if none of them could be taken in, it failed.
    if !args.runs.is_empty() && summary.taken.is_empty() && !summary.refused.is_empty() {
        anyhow::bail!("nothing was taken in");
    }
    Ok(if summary.lost() { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
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

// All pending files, with the recordings that a crashed recorder left.
async fn all_pending(lake: &Lake) -> anyhow::Result<Vec<RunSource>> {
    for path in adopt_cut_off(lake).await? {
        eprintln!("`{path}` was cut off; what was complete is taken in");
    }
    Ok(pending(lake).await?)
}

// What another ingest took on an object store and did not finish, because it died, is in `runs/` and in no table.
async fn finish_for_others(
    lake: &Lake,
    summary: &mut IngestSummary,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<()> {
    while lake.is_remote() && std::mem::take(&mut summary.gone) > 0 {
        let mut left = pending(lake).await?;
        left.retain(|source| summary.refused.iter().all(|refused| refused.file != source.to_string()));
        if left.is_empty() {
            break;
        }
        let mut more = take_in(lake, left, stop, progress).await?;
        summary.taken.append(&mut more.taken);
        summary.refused.append(&mut more.refused);
        summary.gone = more.gone;
    }
    Ok(())
}

/// Ingests runs, then completes rows that waited for references.
pub(crate) async fn take_in(
    lake: &Lake,
    sources: Vec<RunSource>,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<IngestSummary> {
    let ingest = LakeIngest::new(lake, stop.clone());
    let taken = take_in_and_complete(&ingest, lake, sources, stop, progress).await;
    ingest.close().await;
    taken
}

async fn take_in_and_complete(
    ingest: &LakeIngest<'_>,
    lake: &Lake,
    sources: Vec<RunSource>,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<IngestSummary> {
    let mut summary = IngestSummary::default();
    let count = sources.len();
    let mut task = progress.task("ingest", count as u64, "runs");
    let mut ended = 0;
    let (suspects, sources): (Vec<_>, Vec<_>) =
        sources.into_iter().partition(|source| SuspectFile::from_source(lake, source).is_some());
    let mut report = |report: FileReport| {
        ended += u64::from(!matches!(report, FileReport::Claimed(_)));
        summary.add(report, progress);
        task.at(ended);
    };
    let mut outcome = ingest.take_in(sources, &mut report).await.map_err(anyhow::Error::from);
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
        _ => task
            .done(format!("{} runs, {measurements} new measurements, {derived} of them derived", summary.taken.len())),
    }
    outcome?;
    let (mut task, mut rows, mut runs) = (None, 0, 0);
    let completed = &mut |completed: &CompletedRun, total: usize| {
        rows += completed.measurements;
        runs += 1;
        task.get_or_insert_with(|| progress.task("complete", total as u64, "runs")).at(runs);
    };
    let completion = ingest.complete(completed).await?;
    if let Some(task) = task {
        task.done(format!("{runs} runs, {rows} measurements derived"));
    }
    for (run, missing) in completion.waiting {
        if summary.taken.iter().any(|t| t.run == run) {
            progress.say(format!("{run}: waits for reference {missing}; ingest a run of it, and it is completed"));
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
        if let Some(report) = suspect.refuse(lake).await? {
            summary.add(report, progress);
            return Ok(());
        }
        if stop.load(Ordering::Relaxed) {
            return Err(echolake_ingest::Error::Stopped.into());
        }
        progress.say(format!("{file}: an ingest died while it read this; a process of its own takes it in"));
        let before = SuspectFile::pending(lake).await?;
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
async fn take_in_suspect(
    lake: &Lake,
    path: &str,
    stop: &Arc<AtomicBool>,
    progress: &CommandProgress,
) -> anyhow::Result<CommandOutcome> {
    std::thread::spawn(|| {
        let _ = std::io::stdin().read(&mut [0]);
        std::process::exit(1);
    });
    let mut summary = IngestSummary::default();
    let source = RunSource::Lake(ObjectPath::parse(path)?);
    let ingest = LakeIngest::new(lake, stop.clone());
    ingest.take_in(vec![source], &mut |report| summary.add(report, progress)).await?;
    ingest.close().await;
    super::print(&serde_json::to_string(&summary)?)?;
    Ok(CommandOutcome::Whole)
}

// Takes in new files of the inbox, until Ctrl-C. A file that is being copied there grows between two looks; one that is
// as it was at the last look is whole.
async fn watch(lake: &Lake, stop: &StopRequest, progress: &CommandProgress) -> anyhow::Result<CommandOutcome> {
    eprintln!("watching `{}/inbox`; Ctrl-C ends it", lake.location());
    let mut before: HashMap<ObjectPath, (u64, chrono::DateTime<chrono::Utc>)> = HashMap::new();
    // Refused files that are still where they were.
    let mut given_up = HashMap::new();
    let mut lost = false;
    let mut is_first = true;
    while !stop.is_made() {
        let mut settled = Vec::new();
        let mut now = HashMap::new();
        let mut states = HashMap::new();
        let found = match look(lake, is_first).await {
            Err(e) if lake.is_remote() => {
                wait_after(&e, stop).await;
                continue;
            }
            found => found?,
        };
        for meta in found {
            let (path, state) = (meta.location, (meta.size, meta.last_modified));
            if given_up.get(path.as_ref()) == Some(&state) {
                continue;
            }
            states.insert(path.to_string(), state);
            // Object stores show no file before it is whole.
            if lake.is_remote() || before.get(&path) == Some(&state) {
                settled.push(RunSource::Lake(path));
            } else {
                now.insert(path, state);
            }
        }
        is_first = false;
        before = now;
        if settled.is_empty() {
            pause(LOOK_EVERY, stop).await;
            continue;
        }
        match take_in(lake, settled, stop.flag(), progress).await {
            Ok(summary) => {
                lost |= summary.lost();
                // They are looked for in `runs/`, in case that ingest died.
                is_first |= summary.gone > 0;
                let stay = summary.refused.iter().filter(|refused| refused.moved_to.is_none());
                given_up.extend(stay.filter_map(|refused| states.remove_entry(&refused.file)));
            }
            Err(e) if stop.is_made() => drop(e),
            // A full disk or an absent store passes; the files are still there.
            Err(e) => wait_after(&e, stop).await,
        }
    }
    Ok(if lost { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
}

// The pending files. On an object store the inbox alone is listed, but for the first time.
async fn look(lake: &Lake, is_first: bool) -> anyhow::Result<Vec<ObjectMeta>> {
    if lake.is_remote() && !is_first {
        return Ok(arrivals(lake).await?);
    }
    let mut found = Vec::new();
    for source in all_pending(lake).await? {
        let RunSource::Lake(path) = &source else { continue };
        // It may be gone again. A folder's store tells the place of a file on the disk.
        found.extend(lake.store().head(path).await.ok().map(|meta| ObjectMeta { location: path.clone(), ..meta }));
    }
    Ok(found)
}

async fn wait_after(error: &anyhow::Error, stop: &StopRequest) {
    eprintln!("error: {}; trying again in {} s", describe_error(error), RETRY_AFTER.as_secs());
    pause(RETRY_AFTER, stop).await;
}

// Ends early if a stop is requested.
async fn pause(time: Duration, stop: &StopRequest) {
    let _ = tokio::time::timeout(time, stop.wait()).await;
}

fn say(progress: &CommandProgress, taken: &IngestedRun) {
    let IngestedRun { run, measurements, .. } = taken;
    match taken.outcome {
        IngestOutcome::Known => progress.say(format!("{run}: is in the lake already, nothing added")),
        IngestOutcome::Added => progress.say(format!("{run}: {measurements} measurements")),
    }
    if taken.stopped {
        progress.say(format!("{run}: its recording was stopped before its end; all that it holds is in the tables"));
    } else if !taken.whole {
        progress.say(format!("{run}: warning: its recording was cut off; what it holds is in the tables"));
    }
    for damage in &taken.damaged {
        progress.say(format!("{run}: warning: {damage}"));
    }
}

// A name of an existing file is that file; any other is looked up in the lake.
async fn sources_of(lake: &Lake, names: &[String]) -> anyhow::Result<Vec<RunSource>> {
    let mut sources = Vec::new();
    for name in names {
        anyhow::ensure!(
            !is_partial(Path::new(name)),
            "`{name}` is an unfinished recording, expected a run (.mcap); hint: `echolake acquire --resume {name}` resumes \
             it, `echolake recover {name}` makes a run of what it holds"
        );
        if Path::new(name).is_file() {
            sources.push(in_lake(lake, Path::new(name)).unwrap_or_else(|| RunSource::File(name.into())));
            continue;
        }
        let file = if name.ends_with(".mcap") { name.clone() } else { format!("{name}.mcap") };
        let listed: Vec<_> = lake.store().list(None).try_collect().await.context("cannot list the lake")?;
        let found = listed.into_iter().map(|m| m.location).find(|p| {
            let folder = p.parts().next().is_some_and(|f| matches!(f.as_ref(), "inbox" | "runs"));
            folder && (p.filename() == Some(file.as_str()) || p.as_ref() == file)
        });
        sources.push(RunSource::Lake(found.ok_or(echolake_ingest::Error::NoRun { given: name.clone() })?));
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
