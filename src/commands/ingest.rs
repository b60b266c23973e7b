//! `echolake ingest`: runs become rows.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use echolake_ingest::{Ingest, Outcome, Source, Taken, complete, pending};
use echolake_lake::Lake;
use futures::TryStreamExt as _;
use object_store::ObjectStore as _;
use object_store::path::Path as ObjectPath;
use serde_json::json;

use crate::Done;
use crate::cli::IngestArgs;
use crate::progress::Progress;

pub(crate) async fn run(args: &IngestArgs, lake_url: &str) -> anyhow::Result<Done> {
    let lake = Lake::open(lake_url).await?;
    lake.ensure_tables().await?;
    let sources = match args.runs.as_slice() {
        [] => pending(&lake).await?,
        names => sources_of(&lake, names).await?,
    };
    let stop = super::stop_on_interrupt();
    let taken = take_in(&lake, &sources, &stop, &Progress::new()).await?;
    if args.json {
        let runs: Vec<_> = taken.iter().map(as_json).collect();
        super::print(&serde_json::to_string_pretty(&runs)?)?;
    }
    if sources.is_empty() && !args.json {
        eprintln!("nothing to ingest: every run of the lake is in its tables");
    }
    let lost = taken.iter().any(|t| !t.whole || !t.damaged.is_empty());
    Ok(if lost { Done::WithLoss } else { Done::Whole })
}

/// Takes in runs one after the other, then completes what waited for references.
pub(crate) async fn take_in(
    lake: &Lake,
    sources: &[Source],
    stop: &AtomicBool,
    progress: &Progress,
) -> anyhow::Result<Vec<Taken>> {
    let mut taken = Vec::new();
    let mut task = progress.task("ingest", sources.len() as u64, "runs");
    for source in sources {
        if stop.load(Ordering::Relaxed) {
            return Err(echolake_ingest::Error::Stopped.into());
        }
        let run = Ingest::new(lake).take_in(source).await?;
        say(progress, &run);
        taken.push(run);
        task.at(taken.len() as u64);
    }
    let measurements: usize = taken.iter().filter(|t| t.outcome == Outcome::Added).map(|t| t.measurements).sum();
    task.done(format!("{} runs, {measurements} new measurements", taken.len()));
    let mut task = progress.task("complete", lake.snapshot().await?.runs().count() as u64, "runs");
    let (mut rows, mut runs) = (0, 0);
    complete(lake, &mut |completed| {
        rows += completed.measurements;
        runs += 1;
        task.at(runs);
    })
    .await?;
    task.done(format!("{runs} runs, {rows} measurements derived"));
    Ok(taken)
}

fn say(progress: &Progress, taken: &Taken) {
    let Taken { run, measurements, .. } = taken;
    match taken.outcome {
        Outcome::Known => progress.say(format!("{run}: is in the lake already, nothing added")),
        Outcome::Added => progress.say(format!("{run}: {measurements} measurements")),
    }
    if !taken.missing.is_empty() {
        progress.say(format!("{run}: waits for reference {}; ingest a run of it, and it is completed", taken.missing));
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
