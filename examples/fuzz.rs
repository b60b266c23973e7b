//! Throws changed SQL, changed bytes of each protocol, or changed run files at `echolake serve`, and ends with an error
//! at the first that harms it:
//! `cargo build --release && cargo run --release --example fuzz -- sql|wire|mcap [seconds] [seed]`.

#[path = "../tests/fuzz/mod.rs"]
mod fuzz;
#[allow(dead_code, reason = "the tests' clients, of which this wants a part")]
#[path = "../tests/serve"]
mod serve {
    pub(crate) mod http;
    pub(crate) mod server;
}

use std::io::Write as _;
use std::time::{Duration, Instant};

/// A rig that measures in milliseconds.
const SMALL_RIG: &str = include_str!("../tests/fixtures/small_rig.toml");
/// Between two lines about how far it is.
const TELL: Duration = Duration::from_secs(30);

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let name = args.next().unwrap_or_default();
    let target = fuzz::Target::ALL.into_iter().find(|t| t.name() == name).ok_or("what? hint: sql, wire or mcap")?;
    let seconds = args.next().map_or(Ok(60), |a| a.parse())?;
    let seed = args.next().map_or(Ok(1), |a| a.parse())?;
    let example = std::env::current_exe()?;
    let binary = example.ancestors().nth(2).ok_or("no folder")?.join("echolake");
    if !binary.exists() {
        return Err(format!("`{}` is missing; hint: cargo build --release", binary.display()).into());
    }
    let (begun, mut told) = (Instant::now(), Instant::now());
    let outcome = fuzz::Campaign::new(&binary, seed).throw(target, &mut |so_far| {
        if told.elapsed() > TELL {
            told = Instant::now();
            // Progress is not worth an error.
            let _ = writeln!(std::io::stderr(), "{} rounds in {:.0?}", so_far.rounds, begun.elapsed());
        }
        begun.elapsed() < Duration::from_secs(seconds)
    });
    writeln!(
        std::io::stdout(),
        "{name}, seed {seed}: {} rounds in {:.0?}, {} answered, {} broke their own connection's decoder, at most {} MiB; the \
         server is well",
        outcome.rounds,
        begun.elapsed(),
        outcome.answered,
        outcome.broken,
        outcome.resident_kib >> 10
    )?;
    Ok(())
}
