//! `echolake ingest`: runs become rows.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::Context as _;
use echolake_ingest::{Ingest, Outcome, Report, Source, Taken, adopt_cut_off, complete, pending, waiting};
use echolake_lake::Lake;
use futures::TryStreamExt as _;
use object_store::ObjectStoreExt as _;
use object_store::path::Path as ObjectPath;
use serde_json::json;

use crate::Done;
use crate::cli::IngestArgs;
use crate::progress::Progress;
use crate::signals::StopRequest;

/// Time between two looks at the inbox.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Time that a watch waits after an error.
const RETRY_AFTER: Duration = Duration::from_secs(10);

/// What became of all that was given.
#[derive(Default)]
pub(crate) struct Summary {
    pub(crate) taken: Vec<Taken>,
    /// Files that cannot be taken in: the file, why, and where it is now.
    refused: Vec<(String, String, Option<String>)>,
}

impl Summary {
    fn lost(&self) -> bool {
        !self.refused.is_empty() || self.taken.iter().any(|t| !t.whole || !t.damaged.is_empty())
    }

    fn as_json(&self) -> serde_json::Value {
        let refused = |(file, why, moved): &(String, String, Option<String>)| json!({ "file": file, "reason": why, "moved_to": moved });
        json!({
            "taken": self.taken.iter().map(as_json).collect::<Vec<_>>(),
            "refused": self.refused.iter().map(refused).collect::<Vec<_>>(),
        })
    }
}

pub(crate) async fn run(args: &IngestArgs, lake_url: &str) -> anyhow::Result<Done> {
    let stop = super::stop_request()?;
    let lake = Lake::open(lake_url).await?;
    lake.ensure_tables().await?;
    let progress = Progress::new();
    if args.watch {
        return watch(&lake, &stop, &progress).await;
    }
    let sources = match args.runs.as_slice() {
        [] => all_pending(&lake).await?,
        names => sources_of(&lake, names).await?,
    };
    let nothing = sources.is_empty();
    let summary = take_in(&lake, sources, stop.flag(), &progress).await?;
    if args.json {
        super::print(&serde_json::to_string_pretty(&summary.as_json())?)?;
    }
    if nothing && !args.json {
        eprintln!("nothing to ingest: every run of the lake is in its tables");
    }
    // Files that were named are the whole job; where none of them could be taken in, it failed.
    if !args.runs.is_empty() && summary.taken.is_empty() && !summary.refused.is_empty() {
        anyhow::bail!("nothing was taken in");
    }
    Ok(if summary.lost() { Done::WithLoss } else { Done::Whole })
}

// With the recordings that a dead recorder left.
async fn all_pending(lake: &Lake) -> anyhow::Result<Vec<Source>> {
    for path in adopt_cut_off(lake).await? {
        eprintln!("`{path}` was cut off; what was complete is taken in");
    }
    Ok(pending(lake).await?)
}

/// Takes in runs, then completes what waited for references.
pub(crate) async fn take_in(
    lake: &Lake,
    sources: Vec<Source>,
    stop: &Arc<AtomicBool>,
    progress: &Progress,
) -> anyhow::Result<Summary> {
    let mut summary = Summary::default();
    let mut task = progress.task("ingest", sources.len() as u64, "runs");
    let mut ended = 0;
    let mut report = |report: Report| {
        ended += 1;
        match report {
            Report::Taken(taken) => {
                say(progress, &taken);
                summary.taken.push(taken);
            }
            Report::Refused { source, why, moved } => {
                let whereto = moved.as_ref().map(|m| format!(" (now at `{m}`)")).unwrap_or_default();
                progress.say(format!("error: {why}{whereto}"));
                summary.refused.push((source.to_string(), why.to_string(), moved.map(|m| m.to_string())));
            }
            Report::Gone(source) => progress.say(format!("{source}: another ingest has taken it")),
        }
        task.at(ended);
    };
    let outcome = Ingest::new(lake, stop.clone()).take_in(sources, &mut report).await;
    let added = || summary.taken.iter().filter(|t| t.outcome == Outcome::Added);
    let measurements: usize = added().map(|t| t.measurements).sum();
    let derived: usize = added().filter(|t| t.derived).map(|t| t.measurements).sum();
    task.done(format!("{} runs, {measurements} new measurements, {derived} of them derived", summary.taken.len()));
    outcome?;
    let mut task = progress.task("complete", lake.snapshot().await?.runs().count() as u64, "runs");
    let (mut rows, mut runs) = (0, 0);
    complete(lake, stop, &mut |completed| {
        rows += completed.measurements;
        runs += 1;
        task.at(runs);
    })
    .await?;
    task.done(format!("{runs} runs, {rows} measurements derived"));
    for (run, missing) in waiting(lake).await? {
        if summary.taken.iter().any(|t| t.run == run) {
            progress.say(format!("{run}: waits for reference {missing}; ingest a run of it, and it is completed"));
        }
    }
    Ok(summary)
}

// What comes into the inbox, until Ctrl-C. A file that somebody copies there grows while we look; one that is as it
// was at the last look is whole.
async fn watch(lake: &Lake, stop: &StopRequest, progress: &Progress) -> anyhow::Result<Done> {
    eprintln!("watching `{}/inbox`; Ctrl-C ends it", lake.location());
    let mut before: HashMap<ObjectPath, (u64, chrono::DateTime<chrono::Utc>)> = HashMap::new();
    let mut lost = false;
    while !stop.is_made() {
        let mut settled = Vec::new();
        let mut now = HashMap::new();
        for source in all_pending(lake).await? {
            let Source::Lake(path) = &source else { continue };
            // It may be gone again.
            let Ok(meta) = lake.store().head(path).await else { continue };
            let state = (meta.size, meta.last_modified);
            if before.get(path) == Some(&state) {
                settled.push(source);
            } else {
                now.insert(path.clone(), state);
            }
        }
        before = now;
        if settled.is_empty() {
            pause(LOOK_EVERY, stop).await;
            continue;
        }
        match take_in(lake, settled, stop.flag(), progress).await {
            Ok(summary) => lost |= summary.lost(),
            Err(e) if stop.is_made() => drop(e),
            // A full disk or an absent store passes; the files are still there.
            Err(e) => {
                eprintln!("error: {e:#}; trying again in {} s", RETRY_AFTER.as_secs());
                pause(RETRY_AFTER, stop).await;
            }
        }
    }
    Ok(if lost { Done::WithLoss } else { Done::Whole })
}

// Ends early if a stop is requested.
async fn pause(time: Duration, stop: &StopRequest) {
    let _ = tokio::time::timeout(time, stop.wait()).await;
}

fn say(progress: &Progress, taken: &Taken) {
    let Taken { run, measurements, .. } = taken;
    match taken.outcome {
        Outcome::Known => progress.say(format!("{run}: is in the lake already, nothing added")),
        Outcome::Added => progress.say(format!("{run}: {measurements} measurements")),
    }
    if !taken.whole {
        progress.say(format!("{run}: warning: the file was cut off; what was complete is in the tables"));
    }
    for damage in &taken.damaged {
        progress.say(format!("{run}: warning: {damage}"));
    }
}

fn as_json(taken: &Taken) -> serde_json::Value {
    json!({
        "run_id": taken.run,
        "surface_id": taken.surface,
        "measurements": taken.measurements,
        "added": taken.outcome == Outcome::Added,
        "missing": taken.missing,
        "whole": taken.whole,
        "damaged": taken.damaged,
    })
}

// A name that is a file is one; else it is looked for in the lake.
async fn sources_of(lake: &Lake, names: &[String]) -> anyhow::Result<Vec<Source>> {
    let mut sources = Vec::new();
    for name in names {
        if Path::new(name).is_file() {
            sources.push(in_lake(lake, Path::new(name)).unwrap_or_else(|| Source::File(name.into())));
            continue;
        }
        let file = if name.ends_with(".mcap") { name.clone() } else { format!("{name}.mcap") };
        let listed: Vec<_> = lake.store().list(None).try_collect().await.context("cannot list the lake")?;
        let found = listed.into_iter().map(|m| m.location).find(|p| {
            let folder = p.parts().next().is_some_and(|f| matches!(f.as_ref(), "inbox" | "runs"));
            folder && (p.filename() == Some(file.as_str()) || p.as_ref() == file)
        });
        sources.push(Source::Lake(found.ok_or(echolake_ingest::Error::NoRun { given: name.clone() })?));
    }
    Ok(sources)
}

// A file under the lake's own inbox/ or runs/ is not copied.
fn in_lake(lake: &Lake, file: &Path) -> Option<Source> {
    let folder = lake.folder()?.canonicalize().ok()?;
    let inside = file.canonicalize().ok()?.strip_prefix(folder).ok()?.to_owned();
    let path = ObjectPath::parse(inside.to_str()?).ok()?;
    let first = path.parts().next()?;
    matches!(first.as_ref(), "inbox" | "runs").then_some(Source::Lake(path))
}
