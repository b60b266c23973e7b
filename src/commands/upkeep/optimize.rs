//! `echolake optimize`: small files of a table become large ones.

use echolake_lake::{Lake, TableOptimizeReport};

use crate::CommandOutcome;
use crate::progress::CommandProgress;
use clap::Args;
use echolake_lake::TARGET_BYTES;

#[derive(Debug, Args)]
pub(crate) struct OptimizeArgs {
    /// Size of the merged files in MB; files of half of it and more are left alone.
    #[arg(
        long, value_name = "MB", default_value_t = TARGET_BYTES >> 20,
        value_parser = clap::value_parser!(u64).range(1..=1024)
    )]
    pub target_mb: u64,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
}

pub(crate) async fn run_optimize(args: &OptimizeArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = crate::commands::stop_request()?;
    let lake = Lake::open(lake_url).await?;
    let progress = CommandProgress::new();
    let mut task = None;
    let done = lake
        .optimize(args.target_mb << 20, stop.flag(), &mut |at| {
            task.get_or_insert_with(|| progress.start_task("optimize", at.total as u64, "files"))
                .set_done(at.done as u64);
        })
        .await;
    let report = done?;
    let merged: usize = report.tables.iter().map(|t| t.merged).sum();
    let files: usize = report.tables.iter().map(|t| t.files).sum();
    if let Some(task) = task {
        task.finish_with(format!("{merged} files became {files}"));
    }
    match args.json {
        true => crate::commands::print_line(&serde_json::to_string_pretty(&report)?)?,
        false if report.tables.is_empty() => eprintln!("nothing to merge: no table has two small files"),
        false => crate::commands::print_line(&report_text(&report.tables))?,
    }
    if report.stopped {
        anyhow::bail!("stopped; what was merged stays merged; hint: run the same command again to resume");
    }
    Ok(CommandOutcome::Whole)
}

fn report_text(tables: &[TableOptimizeReport]) -> String {
    let head = format!("{:<14} {:>7} {:>10} {:>7} {:>10}", "table", "merged", "size", "into", "size");
    let line = |t: &TableOptimizeReport| {
        let (before, after) =
            (crate::commands::format_size(t.bytes_before), crate::commands::format_size(t.bytes_after));
        let outdated = match t.outdated {
            0 => String::new(),
            count => format!("  {count} merges dropped, ingest was faster"),
        };
        format!("{:<14} {:>7} {before:>10} {:>7} {after:>10}{outdated}", t.table, t.merged, t.files)
    };
    std::iter::once(head).chain(tables.iter().map(line)).collect::<Vec<_>>().join("\n")
}
