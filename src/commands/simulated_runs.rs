//! Runs of the simulated rig for `demo` and `campaign`: surface after surface, one on each core.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use anyhow::Context as _;
use echolake_acquisition::run::RunRequest;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_acquisition::run::recorder::random_tag;
use echolake_acquisition::run::simulate::run_simulation;
use echolake_panel::PanelSpecimen;
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::{ProjectName, Rig, RunId, SurfaceId, Timestamp};

use crate::progress::{CommandProgress, TaskProgress};

/// 2026-01-05 08:00 UTC for seed 1, and eleven hours from run to run: a run takes ten.
const FIRST_START: Timestamp = Timestamp(1_767_600_000_000_000_000);
const RUN_EVERY_SECS: u32 = 39_600;

/// Returns the start of a run by its number. Runs of different seeds begin at different seconds (before they repeat
/// after 39,600 seeds), so that no run is taken for one of another seed.
pub(super) fn start_time(seed: u64, number: usize) -> Timestamp {
    let offset_secs = (seed % u64::from(RUN_EVERY_SECS)) as f64 - 1.0;
    FIRST_START.plus_secs(number as f64 * f64::from(RUN_EVERY_SECS) + offset_secs)
}

/// With more surfaces than this, progress counts surfaces.
const TOLD_EACH: usize = 20;

/// A run to simulate.
pub(super) struct PlannedRun {
    pub surface: SurfaceId,
    pub specimen: PanelSpecimen,
    /// The surface that has its large shape alone.
    pub macro_reference: Option<SurfaceId>,
    /// References, if they are not the lake's.
    pub flat: Option<SurfaceId>,
    pub foam: Option<SurfaceId>,
    pub project: Option<ProjectName>,
    /// Time of its begin: with the surface's name it tells whether the run is there already.
    pub start: Timestamp,
    pub seed: u64,
}

/// Runs to simulate.
pub(super) struct SimulationPlan {
    pub rig: Rig,
    /// In the order in which they are measured.
    pub runs: Vec<PlannedRun>,
    pub keep: RecordingMode,
    /// Folder of the recordings.
    pub folder: PathBuf,
    /// Names, without their tags, of the runs that are there already.
    pub known: HashSet<String>,
}

/// State shared by the threads of a simulation.
struct SimulationState<'a> {
    plan: &'a SimulationPlan,
    progress: &'a CommandProgress,
    stop: &'a AtomicBool,
    next: AtomicUsize,
    /// Progress over all surfaces, if they are not shown one by one.
    whole: Option<Mutex<(TaskProgress, u64)>>,
    made: Mutex<SimulationTotals>,
}

/// Totals of the new measurements, without those that were there before.
#[derive(Default)]
struct SimulationTotals {
    runs: u64,
    accepted: u64,
    attempts: u64,
    bytes: u64,
    failure: Option<anyhow::Error>,
}

impl SimulationPlan {
    /// Measures the surfaces that are missing. When `stop` becomes true, it ends after those that are being measured.
    pub fn measure_missing(mut self, stop: &AtomicBool, progress: &CommandProgress) -> anyhow::Result<()> {
        self.look_for_runs()?;
        let plan = &self;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let begun = Instant::now();
        let count = plan.runs.len();
        let whole =
            (count > TOLD_EACH).then(|| Mutex::new((progress.start_task("measure", count as u64, "surfaces"), 0)));
        let shared = SimulationState { plan, progress, stop, next: AtomicUsize::new(0), whole, made: Mutex::default() };
        std::thread::scope(|scope| {
            for _ in 0..cores.min(count) {
                scope.spawn(|| shared.measure_next_runs());
            }
        });
        let SimulationState { whole, made, .. } = shared;
        let SimulationTotals { runs, accepted, attempts, bytes, failure } =
            made.into_inner().unwrap_or_else(PoisonError::into_inner);
        if let Some(failure) = failure {
            return Err(failure);
        }
        if let Some(whole) = whole {
            let (task, _) = whole.into_inner().unwrap_or_else(PoisonError::into_inner);
            let rate = accepted as f64 / begun.elapsed().as_secs_f64();
            task.finish_with(format!(
                "{runs} of {count} surfaces made, {accepted} pairs in {attempts} attempts, {rate:.0} pairs a second, \
                    {:.0} MB",
                bytes as f64 / 1e6
            ));
        }
        Ok(())
    }

    // Adds the runs in the folder to those that are known, and removes what a simulation that was killed left behind.
    fn look_for_runs(&mut self) -> anyhow::Result<()> {
        let ours = self.runs.iter().map(|run| Ok(run.run_id(0)?.untagged_name().to_owned()));
        let ours: HashSet<String> = ours.collect::<anyhow::Result<_>>()?;
        let unread = || format!("cannot read `{}`", self.folder.display());
        for entry in std::fs::read_dir(&self.folder).with_context(unread)? {
            let path = entry.with_context(unread)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let Some((name, ending)) = name.split_once('.') else { continue };
            let Some(untagged) = name.parse::<RunId>().ok().map(|run| run.untagged_name().to_owned()) else { continue };
            match ending {
                "mcap" => _ = self.known.insert(untagged),
                "mcap.partial" if ours.contains(&untagged) => {
                    std::fs::remove_file(&path).with_context(|| format!("cannot remove `{}`", path.display()))?;
                }
                _ => {}
            }
        }
        Ok(())
    }
}

impl PlannedRun {
    fn run_id(&self, tag: u64) -> Result<RunId, echolake_schema::Error> {
        RunId::compose(self.start, &self.surface, tag)
    }
}

impl SimulationState<'_> {
    fn measure_next_runs(&self) {
        while !self.stop.load(Ordering::Relaxed) {
            let number = self.next.fetch_add(1, Ordering::Relaxed);
            let Some(planned) = self.plan.runs.get(number) else { return };
            let outcome = self.measure_planned(planned);
            let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
            match outcome {
                Ok(None) => {}
                Ok(Some((end, bytes))) => {
                    made.runs += 1;
                    made.accepted += end.accepted;
                    made.attempts += end.attempts;
                    made.bytes += bytes;
                }
                Err(error) => {
                    made.failure.get_or_insert(error);
                    self.stop.store(true, Ordering::Relaxed);
                }
            }
            drop(made);
            self.show_progress();
        }
    }

    fn show_progress(&self) {
        if let Some(whole) = &self.whole {
            let mut whole = whole.lock().unwrap_or_else(PoisonError::into_inner);
            let (task, done) = &mut *whole;
            *done += 1;
            task.set_done(*done);
        }
    }

    // Returns how the run ended and its size; nothing if it was measured before.
    fn measure_planned(&self, planned: &PlannedRun) -> anyhow::Result<Option<(RunEnd, u64)>> {
        let SimulationPlan { rig, keep, folder, known, .. } = self.plan;
        let PlannedRun { surface, specimen, macro_reference, flat, foam, project, start, seed } = planned;
        let tag = random_tag();
        if known.contains(planned.run_id(tag)?.untagged_name()) {
            if self.whole.is_none() {
                self.progress.print_message(format!("{surface}: measured before"));
            }
            return Ok(None);
        }
        let run = RunRequest {
            rig,
            surface: surface.clone(),
            specimen,
            flat: flat.clone(),
            foam: foam.clone(),
            macro_reference: macro_reference.clone(),
            material: None,
            role: None,
            project: project.clone(),
            start: *start,
            seed: *seed,
            tag,
            keep: *keep,
            folder,
        };
        let pairs = rig.build_grid()?.pairs().len();
        let mut task =
            self.whole.is_none().then(|| self.progress.start_task(surface.to_string(), pairs as u64, "pairs"));
        let begun = Instant::now();
        // A simulated run takes seconds and is always completed: a stop only keeps the next one from beginning.
        let measured = run_simulation(&run, Origin::Simulated, &AtomicBool::new(false), &mut |done| {
            if let Some(task) = &mut task {
                task.set_done(done as u64);
            }
        });
        let (path, end) = measured.with_context(|| format!("surface {surface}"))?;
        if let Some(task) = task {
            let rate = end.attempts as f64 / begun.elapsed().as_secs_f64();
            task.finish_with(format!("{} pairs in {} attempts, {rate:.0} a second", end.accepted, end.attempts));
        }
        let bytes = path.metadata().with_context(|| format!("cannot read `{}`", path.display()))?.len();
        Ok(Some((end, bytes)))
    }
}
