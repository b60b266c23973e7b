//! `echolake recover`: a recording that was cut off or damaged, rebuilt as far as it is proven whole.

use std::path::Path;

use anyhow::ensure;
use echolake_acquisition::recovery::{Report, beside, recover};

use crate::CommandOutcome;
use clap::Args;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(crate) struct RecoverArgs {
    /// The recording that was cut off or damaged; it is only read.
    pub(crate) file: PathBuf,
    /// Path of the rebuilt file; by default beside it, without `.partial`.
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: &RecoverArgs) -> anyhow::Result<CommandOutcome> {
    let to = args.output.clone().unwrap_or_else(|| beside(&args.file));
    let is_same = || matches!((args.file.canonicalize(), to.canonicalize()), (Ok(a), Ok(b)) if a == b);
    ensure!(!is_same(), "`{}` would be overwritten; hint: give another name with -o", args.file.display());
    let report = recover(&args.file, &to)?;
    match args.json {
        true => super::print(&serde_json::to_string_pretty(&report)?)?,
        false => tell(&report)?,
    }
    Ok(if report.lost_bytes() > 0 || report.defect.is_some() {
        CommandOutcome::WithLoss
    } else {
        CommandOutcome::Whole
    })
}

fn tell(report: &Report) -> anyhow::Result<()> {
    let from = report.from.display();
    let Some(to) = &report.to else {
        eprintln!("`{from}` is whole: every checksum is right, nothing to do");
        return Ok(());
    };
    super::print(&to.display().to_string())?;
    let of = |topic: &str| report.messages.get(topic).copied().unwrap_or(0);
    eprintln!(
        "kept: {} of {} bytes, {} verdicts, {} responses, {} sweeps; read back and compared",
        report.verified_bytes,
        report.bytes,
        of("/measurement"),
        of("/ir"),
        of("/sweep")
    );
    match &report.defect {
        Some(defect) => eprintln!("lost: {} bytes, because {defect}", report.lost_bytes()),
        None => eprintln!("lost: nothing; its summary was missing or damaged"),
    }
    if !report.has_end {
        eprintln!("note: it does not say how its run ended; ingest takes it for a partial run");
    }
    if is_partial(&report.from) {
        eprintln!("`{from}` is as it was; delete it when you need it no more, or go on with it: acquire --resume");
    }
    Ok(())
}

fn is_partial(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "partial")
}
