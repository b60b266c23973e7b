//! `echolake recover`: a recording that was stopped, cut off or damaged, made a run of all that is proven whole.

use anyhow::ensure;
use echolake_acquisition::recovery::{Report, beside, is_partial, recover};
use echolake_acquisition::run::recorder::Held;

use crate::CommandOutcome;
use clap::Args;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(crate) struct RecoverArgs {
    /// The recording that was stopped, cut off or damaged; it is only read.
    pub file: PathBuf,
    /// Path of the rebuilt file; by default beside it, without `.partial`.
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
}

pub(crate) fn run_recover(args: &RecoverArgs) -> anyhow::Result<CommandOutcome> {
    let to = args.output.clone().unwrap_or_else(|| beside(&args.file));
    let is_same = || matches!((args.file.canonicalize(), to.canonicalize()), (Ok(a), Ok(b)) if a == b);
    ensure!(!is_same(), "`{}` would be overwritten; hint: give another name with -o", args.file.display());
    let report = recover(&args.file, &to)?;
    match args.json {
        true => super::print_line(&serde_json::to_string_pretty(&report)?)?,
        false => tell_report(&report)?,
    }
    Ok(if report.is_whole() { CommandOutcome::Whole } else { CommandOutcome::WithLoss })
}

fn tell_report(report: &Report) -> anyhow::Result<()> {
    let from = report.from.display();
    let Some(to) = &report.to else {
        eprintln!("`{from}` is whole: every checksum is right, nothing to do");
        return Ok(());
    };
    super::print_line(&to.display().to_string())?;
    // Recordings that are none of a rig's, as imports, have no plan of pairs.
    if let Some((measured, planned)) = Held::from_file(to).ok().and_then(|held| count_pairs(&held)) {
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
    match report.is_whole() {
        true => eprintln!("lost: nothing"),
        false => eprintln!("lost: {} bytes{}", report.lost_bytes(), lost_places(report)),
    }
    for line in &report.damage {
        eprintln!("damage: {line}");
    }
    if !report.has_end {
        eprintln!("note: its run was not finished; ingest marks it as partial");
    }
    let or_resume = match is_partial(&report.from) {
        true => format!(", or delete `{}` and resume the recording", to.display()),
        false => String::new(),
    };
    eprintln!("`{from}` is unchanged; delete it when you no longer need it{or_resume}");
    Ok(())
}

// Where in the recording the lost bytes are.
fn lost_places(report: &Report) -> String {
    let places: Vec<_> = report.lost.iter().map(|range| format!("{}..{}", range.start, range.end)).collect();
    if places.is_empty() { String::new() } else { format!(", at {}", places.join(", ")) }
}

// Pairs with an accepted measurement, and all pairs of the rig.
fn count_pairs(held: &Held) -> Option<(usize, usize)> {
    Some((held.accepted_count(), held.rig.build_grid().ok()?.pairs().len()))
}
