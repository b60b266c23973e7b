//! `echolake recover`: a recording that was stopped, cut off or damaged, made a run as far as it is proven whole.

use anyhow::ensure;
use echolake_acquisition::recovery::{Report, beside, is_partial, recover};
use echolake_acquisition::run::recorder::Held;

use crate::CommandOutcome;
use clap::Args;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(crate) struct RecoverArgs {
    /// The recording that was stopped, cut off or damaged; it is only read.
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
    // Recordings that are none of a rig's, as imports, have no plan of pairs.
    if let Some((measured, planned)) = Held::read(to).ok().and_then(|held| count_pairs(&held)) {
        eprintln!("made a run of {measured} of {planned} pairs");
    }
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
        None => eprintln!("lost: nothing"),
    }
    if !report.has_end {
        eprintln!("note: its run was not finished; ingest marks it as partial");
    }
    if is_partial(&report.from) {
        let to = to.display();
        eprintln!(
            "`{from}` is unchanged; delete it when you no longer need it, or delete `{to}` and resume the recording"
        );
    }
    Ok(())
}

// Pairs with an accepted measurement, and all pairs of the rig.
fn count_pairs(held: &Held) -> Option<(usize, usize)> {
    Some((held.accepted(), held.rig.grid().ok()?.pairs().len()))
}
