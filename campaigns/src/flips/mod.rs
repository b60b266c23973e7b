//! A campaign against ingest's reader: damages run files in memory, 10,000 times or as often as wished, and checks
//! that nothing panics, that what is damaged is reported, and that all else is kept bit for bit.
//!
//! A round that fails is printed with what repeats it alone.

mod campaign;

use std::io::Write as _;
use std::time::Instant;

use anyhow::{Result, ensure};
use campaign::{FlipSettings, FlipSummary, OutcomeTally};

#[derive(Debug, clap::Args)]
pub(crate) struct FlipsArgs {
    /// Rounds.
    #[arg(long, default_value_t = 10_000)]
    count: u64,
    /// Seed of all rounds.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The first round; with `--count 1` it alone.
    #[arg(long, default_value_t = 0)]
    first: u64,
}

pub(crate) async fn run(args: &FlipsArgs) -> Result<()> {
    let FlipsArgs { count, seed, first } = *args;
    let begun = Instant::now();
    let mut before = None;
    let summary = campaign::run(FlipSettings { count, seed, first }, &mut |_| {
        before.get_or_insert_with(memory);
    })
    .await?;
    let mut out = std::io::stdout().lock();
    print(&summary, &mut out)?;
    let peak = memory();
    writeln!(out, "{count} rounds in {:.0?}, slowest {:.0?}", begun.elapsed(), summary.slowest)?;
    if let (Some(Some(before)), Some(peak)) = (before, peak) {
        writeln!(out, "peak memory {} MiB; after the first round {} MiB", peak >> 10, before >> 10)?;
    }
    ensure!(summary.failures.is_empty(), "{} rounds failed", summary.failures.len());
    Ok(())
}

fn print(summary: &FlipSummary, out: &mut impl std::io::Write) -> Result<()> {
    for (name, bytes, chunks, measurements) in &summary.specimens {
        writeln!(out, "specimen `{name}`: {bytes} bytes, {chunks} chunks, {measurements} measurements")?;
    }
    writeln!(
        out,
        "{:<20} {:>7} {:>9} {:>9} {:>8} {:>9} {:>9} {:>10} {:>8} {:>9}",
        "kind", "rounds", "complete", "partial", "refused", "kept", "reported", "undefined", "unnamed", "unnoticed"
    )?;
    let mut all = OutcomeTally::default();
    for (kind, tally) in &summary.by_kind {
        row(kind, tally, out)?;
        all = sum(all, *tally);
    }
    row("all", &all, out)?;
    for failure in &summary.failures {
        writeln!(out, "FAILED {failure}")?;
    }
    Ok(())
}

fn row(kind: &str, t: &OutcomeTally, out: &mut impl std::io::Write) -> Result<()> {
    writeln!(
        out,
        "{kind:<20} {:>7} {:>9} {:>9} {:>8} {:>9} {:>9} {:>10} {:>8} {:>9}",
        t.rounds, t.complete, t.partial, t.refused, t.kept, t.lost, t.undefined, t.unnamed, t.unnoticed
    )?;
    Ok(())
}

fn sum(a: OutcomeTally, b: OutcomeTally) -> OutcomeTally {
    OutcomeTally {
        rounds: a.rounds + b.rounds,
        complete: a.complete + b.complete,
        partial: a.partial + b.partial,
        refused: a.refused + b.refused,
        kept: a.kept + b.kept,
        lost: a.lost + b.lost,
        undefined: a.undefined + b.undefined,
        unnamed: a.unnamed + b.unnamed,
        unnoticed: a.unnoticed + b.unnoticed,
    }
}

/// The peak memory of this process, KiB, if the system reports it.
fn memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().trim_end_matches("kB").trim().parse().ok()
}
