//! Kills `echolake acquire` at random moments, many times, recovers and goes on, and compares what was acknowledged with
//! what is there: `cargo build --release && cargo run --release --example acquire-kills -- [kills] [seed] [power]`. With
//! `power`, a file system forgets at each kill what was not synced.

#[path = "../tests/acquire_kills.rs"]
mod acquire_kills;
#[path = "../tests/forgetful.rs"]
mod forgetful;

use std::io::Write as _;

/// A rig that measures in milliseconds.
const SMALL_RIG: &str = include_str!("../tests/fixtures/small_rig.toml");

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let kills = args.next().map_or(Ok(200), |a| a.parse())?;
    let seed = args.next().map_or(Ok(1), |a| a.parse())?;
    let power = args.next().is_some_and(|a| a == "power");
    let example = std::env::current_exe()?;
    let binary = example.ancestors().nth(2).ok_or("no folder")?.join("echolake");
    if !binary.exists() {
        return Err(format!("`{}` is missing; hint: cargo build --release", binary.display()).into());
    }
    let campaign = match power {
        true => acquire_kills::Campaign::with_power_cuts(&binary, seed),
        false => Some(acquire_kills::Campaign::new(&binary, seed)),
    };
    let mut campaign = campaign.ok_or("no file system can be mounted here")?;
    let outcome = campaign.kills(kills, &mut |so_far| {
        // Progress is not worth an error.
        let _ = writeln!(std::io::stderr(), "{} of {kills} kills, {} runs whole", so_far.killed, so_far.runs);
    });
    writeln!(
        std::io::stdout(),
        "{} {}, seed {seed}: {} before the file's head, {} runs brought to their end, {} attempts acknowledged; \
         0 lost, 0 doubled, every file whole",
        outcome.killed,
        if power { "power cuts" } else { "kills" },
        outcome.before_the_file,
        outcome.runs,
        outcome.acknowledged
    )?;
    Ok(())
}
