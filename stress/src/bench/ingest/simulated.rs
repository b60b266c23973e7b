//! Runs of the simulated rig to ingest, and their ingest into a fresh lake.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::{Context as _, Result, ensure};
use echolake_acquisition::run::RunRequest;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_acquisition::run::simulate::run_simulation;
use echolake_ingest::{FileReport, LakeIngest, pending_runs};
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_panel::PanelSpecimen;
use echolake_panel::collection::{CollectionSurface, collection_surfaces};
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::{Rig, Timestamp};

use super::super::meter::{CostMeter, MeasuredCost, forget_peak, peak_mib};

/// 2026-01-05 08:00 UTC, and a run every eleven hours.
const FIRST_START: Timestamp = Timestamp(1_767_600_000_000_000_000);
const RUN_EVERY_SECS: f64 = 39_600.0;

/// The first surfaces of a collection, Flat and Foam: their rows are derived in a second pass, because the references
/// are not there when they are taken in.
pub(crate) const REFERENCES: usize = 2;

/// Runs' files.
pub(crate) struct SimulatedRuns {
    /// In the collection's order.
    pub files: Vec<PathBuf>,
    /// All of them.
    pub all: RunCounts,
    /// Those that are no references.
    pub panels: RunCounts,
}

/// Attempts, accepted measurements and bytes of some runs.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RunCounts {
    pub attempts: u64,
    pub accepted: u64,
    pub bytes: u64,
}

/// Runs to be made.
pub(crate) struct SimulationOrder<'a> {
    pub count: usize,
    pub keep: RecordingMode,
    /// Pairs after which each run is stopped.
    pub pairs: usize,
    pub seed: u64,
    pub folder: &'a Path,
}

/// A lake that has just taken in runs.
pub(crate) struct IngestedLake {
    pub lake: Lake,
    /// Of all runs.
    pub whole: MeasuredCost,
    /// Of those that are no references, with the references there.
    pub panels: MeasuredCost,
    pub peak_mib: f64,
}

impl SimulationOrder<'_> {
    /// Makes them, on all cores.
    pub fn make(&self) -> Result<SimulatedRuns> {
        std::fs::create_dir_all(self.folder)?;
        let members = collection_surfaces(self.seed, self.count)?;
        let next = AtomicUsize::new(0);
        let work = || -> Result<Vec<_>> {
            let mut made = Vec::new();
            loop {
                let number = next.fetch_add(1, Ordering::Relaxed);
                let Some(member) = members.get(number) else { return Ok(made) };
                made.push(self.run(number, member)?);
            }
        };
        let mut done: Vec<_> = super::super::run_on_cores(work)?.into_iter().flatten().collect();
        // Their names begin with the time of their start.
        done.sort_by(|a, b| a.0.cmp(&b.0));
        let mut runs = SimulatedRuns { files: Vec::new(), all: RunCounts::default(), panels: RunCounts::default() };
        for (number, (file, end)) in done.into_iter().enumerate() {
            let bytes = file.metadata()?.len();
            runs.all.add(&end, bytes);
            if number >= REFERENCES {
                runs.panels.add(&end, bytes);
            }
            runs.files.push(file);
        }
        Ok(runs)
    }

    fn run(&self, number: usize, member: &CollectionSurface) -> Result<(PathBuf, RunEnd)> {
        let rig = Rig::paper();
        let specimen = PanelSpecimen::Relief(member.relief.clone());
        let start = FIRST_START.plus_secs(number as f64 * RUN_EVERY_SECS);
        let run = RunRequest {
            seed: self.seed.wrapping_mul(1_000).wrapping_add(number as u64),
            tag: number as u64,
            keep: self.keep,
            ..RunRequest::new(&rig, member.surface.clone(), &specimen, start, self.folder)
        };
        let stop = AtomicBool::new(false);
        let made = run_simulation(&run, Origin::Simulated, &stop, &mut |done| {
            stop.store(done >= self.pairs, Ordering::Relaxed)
        });
        made.with_context(|| format!("surface {}", member.surface))
    }
}

impl SimulatedRuns {
    /// Ingests them into a lake of its own, which replaces the one before.
    pub async fn ingest(&self, folder: &Path) -> Result<IngestedLake> {
        if folder.exists() {
            std::fs::remove_dir_all(folder)?;
        }
        let lake =
            Lake::open_or_create(&folder.display().to_string(), &Rig::paper(), &ReferenceSurfaces::default()).await?;
        let ingest = LakeIngest::new(&lake, Arc::default());
        let mut accepted = 0;
        let mut refused = Vec::new();
        let mut report = |report| match report {
            FileReport::Ingested(run) => accepted += run.measurements as u64,
            other => refused.push(format!("{other:?}")),
        };
        forget_peak();
        let mut costs = [MeasuredCost::NONE; 2];
        let (references, panels) = self.files.split_at(REFERENCES);
        for (files, cost) in [references, panels].into_iter().zip(&mut costs) {
            put_into_inbox(files, folder)?;
            let meter = CostMeter::start()?;
            ingest.ingest_runs(pending_runs(&lake).await?, &mut report).await?;
            ingest.complete_runs(&mut |_, _| {}).await?;
            *cost = meter.stop()?;
        }
        ensure!(refused.is_empty(), "refused: {}", refused.join("; "));
        ensure!(accepted == self.all.accepted, "{accepted} measurements ingested of {}", self.all.accepted);
        let [references, panels] = costs;
        let whole = references.plus(panels);
        Ok(IngestedLake { lake, whole, panels, peak_mib: peak_mib()? })
    }
}

impl RunCounts {
    fn add(&mut self, end: &RunEnd, bytes: u64) {
        self.attempts += end.attempts;
        self.accepted += end.accepted;
        self.bytes += bytes;
    }
}

pub(crate) fn put_into_inbox(files: &[PathBuf], lake: &Path) -> Result<()> {
    let inbox = lake.join("inbox");
    std::fs::create_dir_all(&inbox)?;
    for file in files {
        // Ingest renames, so the file itself stays what it is.
        std::fs::hard_link(file, inbox.join(file.file_name().context("a run's file has a name")?))?;
    }
    Ok(())
}
