//! Runs of a campaign on a rig with real devices: one after the other, each when somebody has put its panel in place.

use std::io::BufRead as _;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use echolake_acquisition::run::controller::{RecordingMode, RunControl, RunEvent};
use echolake_acquisition::run::metrics::RunMetrics;
use echolake_acquisition::run::recorder::{Held, random_tag};
use echolake_acquisition::run::session::{MeasuredRun, PreflightMode, RunSession, TakePace};
use echolake_acquisition::run::{self, RunRequest};
use echolake_schema::{Rig, SurfaceId, Timestamp};

use crate::CommandOutcome;
use crate::commands::acquire::unfinished_recordings;
use crate::commands::acquire::watch::RunWatcher;
use crate::commands::simulated_runs::PlannedRun;
use crate::progress::CommandProgress;

/// Runs that are measured with the devices of the rig file.
pub(super) struct RealRuns {
    pub rig: Rig,
    /// In the order in which they are measured.
    pub runs: Vec<PlannedRun>,
    pub keep: RecordingMode,
    /// Folder of the recordings.
    pub folder: PathBuf,
}

impl RealRuns {
    /// Measures all runs; those that were stopped or cut off are resumed. When `stop` becomes true, it ends after the
    /// current pair.
    pub fn measure_all(&self, stop: &AtomicBool, progress: &CommandProgress) -> anyhow::Result<CommandOutcome> {
        let mut outcome = CommandOutcome::Whole;
        let mut in_place: Option<&SurfaceId> = None;
        for planned in &self.runs {
            if in_place != Some(&planned.surface) {
                confirm_panel(&planned.surface, progress)?;
                in_place = Some(&planned.surface);
            }
            if stop.load(Ordering::Relaxed) {
                break;
            }
            let measured = self.measure_run(planned, stop, progress);
            let MeasuredRun { path, outcome: run } = measured.with_context(|| {
                format!("surface `{}`; hint: the same command again resumes the campaign", planned.surface)
            })?;
            if run.left > 0 {
                progress.print_message(format!("stopped with {} pairs left in `{}`", run.left, path.display()));
                break;
            }
            if run.end.rejected > 0 {
                outcome = CommandOutcome::WithLoss;
            }
        }
        Ok(outcome)
    }

    fn measure_run(
        &self,
        planned: &PlannedRun,
        stop: &AtomicBool,
        progress: &CommandProgress,
    ) -> anyhow::Result<MeasuredRun> {
        let surface = planned.surface.as_str();
        let pairs = self.rig.build_grid()?.pairs().len() as u64;
        let begun = unfinished_recordings(&self.folder, surface).into_iter().max();
        let accepted =
            begun.as_deref().map(Held::from_file).transpose()?.map_or(0, |held| held.accepted_count() as u64);
        let metrics = RunMetrics::new(surface, pairs, accepted);
        let mut watcher = RunWatcher::new(progress, surface, pairs, accepted, metrics, self.folder.clone());
        let control = RunControl::default();
        let mut observe = |event: RunEvent<'_>| {
            control.stop.store(stop.load(Ordering::Relaxed), Ordering::Relaxed);
            watcher.observe_event(&event);
        };
        let session = RunSession {
            control: &control,
            observe: &mut observe,
            tap: None,
            preflight: PreflightMode::Check,
            checkpoint_every: None,
            pace: TakePace::Fast,
        };
        let measured = match &begun {
            Some(partial) => run::resume_run(partial, session),
            None => self.run_request(planned).measure_run(session),
        };
        watcher.report_end(measured.as_ref().ok().map(|measured| measured.outcome.end));
        Ok(measured?)
    }

    // Begins now: the time of a planned run is that of a simulation.
    fn run_request<'a>(&'a self, planned: &'a PlannedRun) -> RunRequest<'a> {
        RunRequest {
            rig: &self.rig,
            surface: planned.surface.clone(),
            specimen: &planned.specimen,
            flat: planned.flat.clone(),
            foam: planned.foam.clone(),
            macro_reference: planned.macro_reference.clone(),
            material: None,
            role: None,
            project: planned.project.clone(),
            start: Timestamp::now(),
            seed: planned.seed,
            tag: random_tag(),
            keep: self.keep,
            folder: &self.folder,
        }
    }
}

// A panel that is not the surface's would be measured under its name.
fn confirm_panel(surface: &SurfaceId, progress: &CommandProgress) -> anyhow::Result<()> {
    progress.print_message(format!("put surface `{surface}` in place, then press Enter"));
    let read = std::io::stdin().lock().read_line(&mut String::new()).context("cannot read stdin")?;
    anyhow::ensure!(
        read > 0,
        "nobody confirmed that surface `{surface}` is in place: stdin has ended; hint: run the command on a terminal"
    );
    Ok(())
}
