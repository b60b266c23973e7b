//! `echolake demo`: the main job end to end, on the simulated rig: measure, record, ingest, ask.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use anyhow::Context as _;
use echolake_acquisition::controller::Keep;
use echolake_acquisition::relief::Relief;
use echolake_acquisition::simulate::{SimulatedRun, Specimen};
use echolake_ingest::pending;
use echolake_lake::{Lake, References};
use echolake_query::Session;
use echolake_schema::{Rig, Timestamp};

use crate::Done;
use crate::cli::DemoArgs;
use crate::progress::Progress;

/// The surfaces, in the order in which they are measured: name and relief.
const SURFACES: [(&str, &str); 6] =
    [("flat", "flat"), ("foam", "foam"), ("wood", "wood"), ("prd", "prd"), ("brick", "brick"), ("wavy", "wavy")];
/// The surface that the second table compares with Flat.
const COMPARED: &str = "brick";
/// Sweeps of 0.05 s instead of the paper's rig's 0.5 s: they fit a laptop's disk.
const SWEEP_SECS: f64 = 0.05;
/// 2026-01-05 08:00 UTC, and eleven hours from run to run: a run takes ten.
const FIRST_START: Timestamp = Timestamp(1_767_600_000_000_000_000);
const RUN_EVERY_SECS: f64 = 39_600.0;

pub(crate) async fn run(args: &DemoArgs, lake_url: &str) -> anyhow::Result<Done> {
    let begun = Instant::now();
    let mut rig = Rig::paper();
    rig.sweep.duration_secs = SWEEP_SECS;
    let lake = Lake::open_or_create(lake_url, &rig, &References::default()).await?;
    let folder = super::inbox(&lake)?;
    let progress = Progress::new();
    progress.say("simulated rig: nothing here is measured");
    let stop = super::stop_on_interrupt();
    let known: Vec<_> = lake.snapshot().await?.runs().map(|r| r.run.to_string()).collect();
    let seed = args.seed;
    let measuring = stop.clone();
    let failed = tokio::task::spawn_blocking(move || measure_all(&rig, &folder, seed, &known, &measuring, &progress));
    failed.await??;
    if stop.load(Ordering::Relaxed) {
        anyhow::bail!("stopped; hint: the same command goes on where this one ended");
    }
    let sources = pending(&lake).await?;
    super::ingest::take_in(&lake, sources, &stop, &Progress::new()).await?;
    print_tables(&lake).await?;
    eprintln!("\ndone in {:.0} s. Next:", begun.elapsed().as_secs_f64());
    let flag = if lake_url == "lake" { String::new() } else { format!("--lake {lake_url} ") };
    for next in [
        "sql \"select surface_id, p90_mean_db, spread_db from surface_stats where band = 'total'\"",
        "sql \"select pair_id, snr_db, array_max(ir) from measurements where surface_id = 'brick' limit 5\"",
        "acquire --surface foam_2 --panel foam --seed 2",
        "ingest",
        "doctor",
    ] {
        eprintln!("  cargo run --release -- {flag}{next}");
    }
    Ok(Done::Whole)
}

// Two runs side by side: each is one thread's work.
fn measure_all(
    rig: &Rig,
    folder: &Path,
    seed: u64,
    known: &[String],
    stop: &AtomicBool,
    progress: &Progress,
) -> anyhow::Result<()> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let next = AtomicUsize::new(0);
    let failure = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..cores.min(SURFACES.len()) {
            scope.spawn(|| {
                while let Some(&(surface, relief)) = SURFACES.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let number = SURFACES.iter().position(|s| s.0 == surface).unwrap_or(0);
                    if let Err(error) = measure(rig, folder, seed, (number, surface, relief), known, stop, progress) {
                        failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                        stop.store(true, Ordering::Relaxed);
                    }
                    if stop.load(Ordering::Relaxed) {
                        return;
                    }
                }
            });
        }
    });
    failure.into_inner().unwrap_or_else(PoisonError::into_inner).map_or(Ok(()), Err)
}

fn measure(
    rig: &Rig,
    folder: &Path,
    seed: u64,
    (number, surface, relief): (usize, &str, &str),
    known: &[String],
    stop: &AtomicBool,
    progress: &Progress,
) -> anyhow::Result<()> {
    let specimen = Specimen::Relief(Relief::by_name(relief)?);
    let run = SimulatedRun {
        rig,
        surface: surface.parse()?,
        specimen: &specimen,
        flat: None,
        foam: None,
        start: FIRST_START.plus_secs(number as f64 * RUN_EVERY_SECS),
        seed: seed.wrapping_mul(1_000).wrapping_add(number as u64),
        keep: Keep::Sweeps,
        folder,
    };
    let path = run.path()?;
    let name = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    if path.exists() || known.contains(&name) {
        progress.say(format!("{surface}: measured before"));
        return Ok(());
    }
    remove_partial(&path)?;
    let pairs = rig.grid()?.pairs().len();
    let mut task = progress.task(surface, pairs as u64, "pairs");
    let begun = Instant::now();
    let measured = run.measure(stop, &mut |done| task.at(done as u64));
    if stop.load(Ordering::Relaxed) {
        // A demo's run is whole or made again.
        if let Ok((path, _)) = &measured {
            std::fs::remove_file(path).with_context(|| format!("cannot remove `{}`", path.display()))?;
        }
        measured?;
        return Ok(());
    }
    let (_, end) = measured?;
    let rate = end.attempts as f64 / begun.elapsed().as_secs_f64();
    task.done(format!("{} pairs in {} attempts, {rate:.0} a second", end.accepted, end.attempts));
    Ok(())
}

// What a demo that was killed left behind.
fn remove_partial(path: &Path) -> anyhow::Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let partial = PathBuf::from(partial);
    match partial.exists() {
        true => std::fs::remove_file(&partial).with_context(|| format!("cannot remove `{}`", partial.display())),
        false => Ok(()),
    }
}

async fn print_tables(lake: &Lake) -> anyhow::Result<()> {
    let session = Session::new(lake)?;
    let bands = lake.rig().band_names();
    let column = |band: &str, name: &str| {
        format!("round(max(p90_mean_db) filter (where band = '{band}'), 1) + 0.0 as \"{name}\"")
    };
    let columns: Vec<_> =
        bands.iter().map(|b| column(b, &format!("{b} Hz"))).chain([column("total", "total")]).collect();
    super::print("\nMean TNCE of the values up to the 90th percentile, dB re Flat (simulated)")?;
    let sql = format!(
        "select surface_id as surface, {} from surface_stats group by surface_id order by surface_id",
        columns.join(", ")
    );
    super::sql::print_table(&session, &sql).await?;
    super::print(&format!("\nNCE totals of {COMPARED} against Flat, mean over the pairs (simulated)"))?;
    let row = |band: &str| {
        format!(
            "select '{band}' as band, avg(tnce_{band}) filter (where surface_id = 'flat') as flat, \
             avg(tnce_{band}) filter (where surface_id = '{COMPARED}') as panel from tnce"
        )
    };
    let rows: Vec<_> = bands.iter().map(String::as_str).chain(["total"]).map(row).collect();
    let sql = format!(
        "select band, round(flat, 3) as flat, round(panel, 3) as {COMPARED}, round(100 * (panel / flat - 1), 1) as \"difference %\" \
         from ({}) order by band = 'total', length(band), band",
        rows.join(" union all ")
    );
    super::sql::print_table(&session, &sql).await
}
