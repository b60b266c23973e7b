//! `echolake doctor`: the lake examined, every run file to its last CRC.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context as _;
use echolake_ingest::doctor::{FindingSeverity, LakeFinding, LakeReport, examine_lake};
use echolake_lake::Lake;

use super::DoctorArgs;
use crate::CommandOutcome;
use crate::commands::{format_size, print_line};
use crate::progress::CommandProgress;

pub(super) async fn report_lake(args: &DoctorArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    let progress = CommandProgress::new();
    let mut task = None;
    let report = examine_lake(&lake, &mut |step| {
        task.get_or_insert_with(|| progress.start_task("check", step.total as u64, "files")).set_done(step.done as u64);
    })
    .await?;
    if let Some(task) = task {
        task.finish_with(format!("{} runs", report.runs));
    }
    if let Some(file) = &args.prometheus {
        write_metrics(&report, file)?;
    }
    match args.json {
        true => print_line(&serde_json::to_string_pretty(&report)?)?,
        false => print_line(&report_text(&lake, &report))?,
    }
    Ok(if report.is_damaged() { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
}

fn report_text(lake: &Lake, report: &LakeReport) -> String {
    let rig = lake.rig();
    let division = lake.rig().impulse_response.division.name();
    let direct = lake.config().references.direct_sound.name();
    let mut out = format!("lake {}, rig {}, {division} division, direct sound: {direct}\n", lake.location(), rig.name);
    let _ = writeln!(out, "{} runs, {} in run files\n", report.runs, format_size(report.run_bytes));
    let _ = writeln!(out, "{:<14} {:>6} {:>10} {:>10}", "table", "files", "rows", "size");
    for t in &report.tables {
        let _ = writeln!(out, "{:<14} {:>6} {:>10} {:>10}", t.table, t.files, t.rows, format_size(t.bytes));
    }
    for LakeFinding { severity, subject, what } in &report.findings {
        let _ = write!(out, "\n{}: {subject}: {what}", severity_word(*severity));
    }
    if report.findings.is_empty() {
        let _ = write!(out, "\nnothing is missing or damaged");
    }
    out
}

fn severity_word(severity: FindingSeverity) -> &'static str {
    match severity {
        FindingSeverity::Damaged => "damaged",
        FindingSeverity::Missing => "missing",
        FindingSeverity::Note => "note",
    }
}

// Under another name first: the collector may read at any time.
fn write_metrics(report: &LakeReport, file: &Path) -> anyhow::Result<()> {
    let mut text = "# HELP echolake_doctor_findings Findings of the last check.\n\
                    # TYPE echolake_doctor_findings gauge\n"
        .to_owned();
    for severity in [FindingSeverity::Damaged, FindingSeverity::Missing, FindingSeverity::Note] {
        let findings = report.findings.iter().filter(|finding| finding.severity == severity).count();
        let _ = writeln!(text, "echolake_doctor_findings{{severity=\"{}\"}} {findings}", severity_word(severity));
    }
    let _ = writeln!(
        text,
        "# HELP echolake_doctor_time_seconds End of the last check, since 1970.\n\
         # TYPE echolake_doctor_time_seconds gauge\necholake_doctor_time_seconds {}",
        chrono::Utc::now().timestamp()
    );
    let partial = file.with_extension("partial");
    let written = std::fs::write(&partial, text).and_then(|()| std::fs::rename(&partial, file));
    written.with_context(|| format!("cannot write `{}`", file.display()))
}
