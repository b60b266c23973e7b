//! Kills `echolake ingest` at random moments, many times, and compares its tables with those of an undisturbed one:
//! `cargo build --release && cargo run --release --example kills -- [rounds] [seed]`. With a third argument `halves`,
//! two processes ingest 20 of 40 runs each at once, and one of them is killed in every second round.

#[path = "../tests/kills.rs"]
mod kills;

use std::io::Write as _;

/// A rig that measures in milliseconds.
const SMALL_RIG: &str = include_str!("../tests/fixtures/small_rig.toml");

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let rounds = args.next().map_or(Ok(200), |a| a.parse())?;
    let seed = args.next().map_or(Ok(1), |a| a.parse())?;
    let example = std::env::current_exe()?;
    let binary = example.ancestors().nth(2).ok_or("no folder")?.join("echolake");
    if !binary.exists() {
        return Err(format!("`{}` is missing; hint: cargo build --release", binary.display()).into());
    }
    let mut out = std::io::stdout();
    let mut tell = |round, so_far: &kills::Outcome| {
        if round % 10 == 0 {
            // Progress is not worth an error.
            let _ = writeln!(std::io::stderr(), "{round} of {rounds} rounds, {} killed", so_far.killed);
        }
    };
    let outcome = match args.next().as_deref() {
        None => kills::Campaign::new(&binary, seed).rounds(rounds, &mut tell),
        Some("halves") => kills::Campaign::of(&binary, seed, 40).halves(rounds, &mut tell),
        Some(other) => return Err(format!("`{other}`? hint: halves, or nothing").into()),
    };
    writeln!(
        out,
        "{rounds} rounds, seed {seed}: {} kills while ingest worked, {} after its end; all tables equal",
        outcome.killed, outcome.ended
    )?;
    Ok(())
}
