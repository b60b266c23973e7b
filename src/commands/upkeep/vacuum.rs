//! `echolake vacuum`: files that are in no table any more are deleted.

use chrono::TimeDelta;
use echolake_lake::{DeletionMode, Lake};

use crate::CommandOutcome;
use crate::progress::CommandProgress;
use clap::Args;
use echolake_lake::KEEP_HOURS;

#[derive(Debug, Args)]
pub(crate) struct VacuumArgs {
    /// Keep files that were removed from their table less than this many hours ago; must exceed the longest query. At
    /// most 168: table logs drop the time of removal after a week.
    #[arg(
        long, value_name = "HOURS", default_value_t = KEEP_HOURS,
        value_parser = clap::value_parser!(u32).range(0..=KEEP_HOURS as i64)
    )]
    pub keep_hours: u32,
    /// List what would be deleted, and delete nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
}

pub(crate) async fn run_vacuum(args: &VacuumArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    let deletion = if args.dry_run { DeletionMode::Pretended } else { DeletionMode::Real };
    let progress = CommandProgress::new();
    let mut task = None;
    let report = lake
        .vacuum(TimeDelta::hours(args.keep_hours.into()), deletion, &mut |done, total| {
            task.get_or_insert_with(|| progress.start_task("vacuum", total as u64, "files")).set_done(done as u64);
        })
        .await?;
    if let Some(task) = task {
        task.finish_with(format!("{} files", report.files.len()));
    }
    if args.json {
        crate::commands::print_line(&serde_json::to_string_pretty(&report)?)?;
        return Ok(CommandOutcome::Whole);
    }
    if args.dry_run {
        for file in &report.files {
            crate::commands::print_line(&format!("{} ({})", file.path, crate::commands::format_size(file.bytes)))?;
        }
    }
    let would = if args.dry_run { "would be " } else { "" };
    crate::commands::print_line(&format!(
        "{} files, {} {would}freed",
        report.files.len(),
        crate::commands::format_size(report.bytes)
    ))?;
    Ok(CommandOutcome::Whole)
}
