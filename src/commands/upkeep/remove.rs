//! `echolake remove`: runs leave the lake, with their rows and their files.

use std::os::unix::fs::MetadataExt as _;

use clap::Args;
use echolake_ingest::{LakeIngest, RemovedFile, RunRemoval, find_removals, find_removed};
use echolake_lake::Lake;

use crate::CommandOutcome;
use crate::progress::CommandProgress;

#[derive(Debug, Args)]
pub(crate) struct RemoveArgs {
    /// Names of the runs.
    #[arg(required = true)]
    pub runs: Vec<String>,
    /// Delete the runs' files instead of moving them to `quarantine/`.
    #[arg(long)]
    pub delete: bool,
    /// List what would be removed, and remove nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
}

pub(crate) async fn run_remove(args: &RemoveArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = crate::commands::stop_request()?;
    let lake = Lake::open(lake_url).await?;
    let progress = CommandProgress::new();
    let mut names = Vec::new();
    for name in &args.runs {
        // A removal that is repeated has nothing to do.
        match find_removals(&lake, std::slice::from_ref(name)).await {
            Err(absent @ echolake_ingest::Error::NoRun { .. }) => match find_removed(&lake, name).await {
                Some(path) => progress.print_message(format!("{name}: is not in the lake; its file is at `{path}`")),
                None => return Err(absent.into()),
            },
            found => found.map(|_| names.push(name.clone()))?,
        }
    }
    let mut removals = find_removals(&lake, &names).await?;
    if !args.dry_run && !removals.is_empty() {
        let ingest = LakeIngest::new(&lake, stop.flag().clone());
        let removed = remove_runs(&ingest, &mut removals, args, &progress).await;
        ingest.release_claims().await;
        removed?;
    }
    if args.json {
        crate::commands::print_line(&serde_json::to_string_pretty(&removals)?)?;
        return Ok(CommandOutcome::Whole);
    }
    for removal in &removals {
        crate::commands::print_line(&describe_removal(removal, args))?;
    }
    Ok(CommandOutcome::Whole)
}

async fn remove_runs(
    ingest: &LakeIngest<'_>,
    removals: &mut [RunRemoval],
    args: &RemoveArgs,
    progress: &CommandProgress,
) -> anyhow::Result<()> {
    let file = if args.delete { RemovedFile::Deleted } else { RemovedFile::Kept };
    ingest.remove_runs(removals, file, &user_name()).await?;
    // Rows that were derived with them.
    let mut rows = 0;
    let completion = ingest.complete_runs(&mut |completed, _| rows += completed.measurements).await?;
    if completion.changed > 0 {
        progress.print_message(format!(
            "{} runs have other references now, {rows} measurements derived",
            completion.changed
        ));
    }
    Ok(())
}

// Services have no name of a user; the system's own files of this process belong to who runs it.
fn user_name() -> String {
    let name = ["USER", "LOGNAME"].iter().find_map(|name| std::env::var(name).ok());
    let id =
        || std::fs::metadata("/proc/self").map_or_else(|_| "of unknown id".to_owned(), |own| own.uid().to_string());
    name.unwrap_or_else(|| format!("user {}", id()))
}

fn describe_removal(removal: &RunRemoval, args: &RemoveArgs) -> String {
    let RunRemoval { run, measurements, bytes, .. } = removal;
    let would = if args.dry_run { "would be " } else { "" };
    let file = match (&removal.file, &removal.moved_to) {
        (None, _) => "its file was gone".to_owned(),
        (Some(file), _) if args.delete => format!("`{file}` ({}) {would}deleted", crate::commands::format_size(*bytes)),
        (Some(_), Some(to)) => format!("its file is at `{to}`"),
        (Some(file), None) => {
            format!("`{file}` ({}) {would}moved to quarantine/", crate::commands::format_size(*bytes))
        }
    };
    format!("{run}: {measurements} measurements {would}removed; {file}")
}
