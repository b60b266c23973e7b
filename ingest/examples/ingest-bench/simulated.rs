//! Runs of the simulated rig to ingest, and their ingest into a fresh lake.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::{Context as _, Result, ensure};
use echolake_acquisition::collection::{Member, collection};
use echolake_acquisition::controller::Keep;
use echolake_acquisition::simulate::{SimulatedRun, Specimen};
use echolake_ingest::{Ingest, Report as Told, complete, pending};
use echolake_lake::{Lake, References};
use echolake_schema::{Rig, Timestamp};

use crate::meter::{Cost, Meter, forget_peak, peak_mib};

/// 2026-01-05 08:00 UTC, and a run every eleven hours.
const FIRST_START: Timestamp = Timestamp(1_767_600_000_000_000_000);
const RUN_EVERY_SECS: f64 = 39_600.0;

/// Runs' files.
pub(crate) struct Runs {
    pub(crate) files: Vec<PathBuf>,
    pub(crate) attempts: u64,
    pub(crate) accepted: u64,
    pub(crate) bytes: u64,
}

/// Runs to be made.
pub(crate) struct Order<'a> {
    pub(crate) count: usize,
    pub(crate) keep: Keep,
    /// Pairs after which each run is stopped.
    pub(crate) pairs: usize,
    pub(crate) seed: u64,
    pub(crate) folder: &'a Path,
}

/// A lake that has just taken in runs.
pub(crate) struct Ingested {
    pub(crate) lake: Lake,
    pub(crate) folder: PathBuf,
    pub(crate) cost: Cost,
    pub(crate) peak_mib: f64,
}

impl Order<'_> {
    /// Makes them, on all cores.
    pub(crate) fn make(&self) -> Result<Runs> {
        std::fs::create_dir_all(self.folder)?;
        let members = collection(self.seed, self.count)?;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let next = AtomicUsize::new(0);
        let work = || -> Result<Vec<_>> {
            let mut made = Vec::new();
            loop {
                let number = next.fetch_add(1, Ordering::Relaxed);
                let Some(member) = members.get(number) else { return Ok(made) };
                made.push(self.run(number, member)?);
            }
        };
        let done: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
            threads.into_iter().map(|t| t.join().ok().context("a thread panicked").flatten()).collect::<Result<_>>()
        })?;
        let mut runs = Runs { files: Vec::new(), attempts: 0, accepted: 0, bytes: 0 };
        for (file, end) in done.into_iter().flatten() {
            runs.bytes += file.metadata()?.len();
            runs.files.push(file);
            runs.attempts += end.attempts;
            runs.accepted += end.accepted;
        }
        runs.files.sort();
        Ok(runs)
    }

    fn run(&self, number: usize, member: &Member) -> Result<(PathBuf, echolake_schema::manifest::RunEnd)> {
        let run = SimulatedRun {
            rig: &Rig::paper(),
            surface: member.surface.clone(),
            specimen: &Specimen::Relief(member.relief.clone()),
            flat: None,
            foam: None,
            start: FIRST_START.plus_secs(number as f64 * RUN_EVERY_SECS),
            seed: self.seed.wrapping_mul(1_000).wrapping_add(number as u64),
            keep: self.keep,
            folder: self.folder,
        };
        let stop = AtomicBool::new(false);
        let made = run.measure(&stop, &mut |done| stop.store(done >= self.pairs, Ordering::Relaxed));
        made.with_context(|| format!("surface {}", member.surface))
    }
}

impl Runs {
    /// Ingests them into a lake of its own, which takes the place of the one before.
    pub(crate) async fn ingest(&self, folder: &Path) -> Result<Ingested> {
        if folder.exists() {
            std::fs::remove_dir_all(folder)?;
        }
        let lake = Lake::open_or_create(&folder.display().to_string(), &Rig::paper(), &References::default()).await?;
        let inbox = folder.join("inbox");
        std::fs::create_dir_all(&inbox)?;
        for file in &self.files {
            // Ingest renames, so the file itself stays what it is.
            std::fs::hard_link(file, inbox.join(file.file_name().context("a run's file has a name")?))?;
        }
        let stop = Arc::new(AtomicBool::new(false));
        let (mut accepted, mut refused) = (0, Vec::new());
        let mut report = |told| match told {
            Told::Taken(taken) => accepted += taken.measurements as u64,
            other => refused.push(format!("{other:?}")),
        };
        forget_peak();
        let meter = Meter::start()?;
        Ingest::new(&lake, stop.clone()).take_in(pending(&lake).await?, &mut report).await?;
        complete(&lake, &stop, &mut |_| {}).await?;
        let cost = meter.stop()?;
        ensure!(refused.is_empty(), "refused: {}", refused.join("; "));
        ensure!(accepted == self.accepted, "{accepted} measurements ingested of {}", self.accepted);
        Ok(Ingested { lake, folder: folder.to_owned(), cost, peak_mib: peak_mib()? })
    }
}
