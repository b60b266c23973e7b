//! `echolake vacuum`: files that are in no table any more are deleted.

use chrono::TimeDelta;
use echolake_lake::{DeletionMode, Lake};

use crate::CommandOutcome;
use crate::cli::VacuumArgs;
use crate::progress::CommandProgress;

pub(crate) async fn run(args: &VacuumArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    let deletion = if args.dry_run { DeletionMode::Pretended } else { DeletionMode::Real };
    let progress = CommandProgress::new();
    let mut task = None;
    let report = lake
        .vacuum(TimeDelta::hours(args.keep_hours.into()), deletion, &mut |done, total| {
            task.get_or_insert_with(|| progress.task("vacuum", total as u64, "files")).at(done as u64);
        })
        .await?;
    if let Some(task) = task {
        task.done(format!("{} files", report.files.len()));
    }
    if args.json {
        super::print(&serde_json::to_string_pretty(&report)?)?;
        return Ok(CommandOutcome::Whole);
    }
    if args.dry_run {
        for file in &report.files {
            super::print(&format!("{} ({})", file.path, super::size(file.bytes)))?;
        }
    }
    let would = if args.dry_run { "would be " } else { "" };
    super::print(&format!("{} files, {} {would}freed", report.files.len(), super::size(report.bytes)))?;
    Ok(CommandOutcome::Whole)
}
