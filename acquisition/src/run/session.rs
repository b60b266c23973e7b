//! A supervised run: preflight checks, monitoring, stop, and resume.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use echolake_schema::manifest::Origin;
use echolake_schema::{Pair, Rig, Timestamp};

use crate::rig::robots::Choreography;
use crate::run::controller::{
    self, RecordingMode, RunControl, RunController, RunEvent, RunOptions, RunOutcome, RunWorkload,
};
use crate::run::preflight::{self, PreflightFinding};
use crate::run::recorder::{PairAttempts, Recorder, Shape, Tap};

/// Pairs between two checkpoints of a simulated run; one that is lost is made again.
const SIMULATED_CHECKPOINT_EVERY: usize = 200;

/// Supervision of a run: its control, its observers and its settings.
pub struct RunSession<'a> {
    /// Stops or pauses it.
    pub control: &'a RunControl,
    /// Gets its events.
    pub observe: &'a mut dyn FnMut(RunEvent<'_>),
    /// Gets every message.
    pub tap: Option<Box<dyn Tap>>,
    /// Choice to run the preflight checks first.
    pub preflight: PreflightMode,
    /// Pairs between two checkpoints; by default 1 on a real rig, whose pairs take 12 s each, and 200 on the simulated
    /// one.
    pub checkpoint_every: Option<usize>,
    /// Duration of a simulated take.
    pub pace: TakePace,
}

/// Choice to run preflight checks before a run begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PreflightMode {
    /// They are run, and the run is refused if one fails.
    Check,
    /// They are skipped.
    Skip,
}

/// Duration of a simulated take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TakePace {
    /// Time of its computation, without a wait.
    Fast,
    /// At least this many seconds.
    Secs(f64),
}

/// Result of a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MeasuredRun {
    /// The run's file; its `.partial` if it was stopped.
    pub path: PathBuf,
    /// Counts, and the pairs that are left.
    pub outcome: RunOutcome,
}

/// A run to measure, apart from its recorder.
pub(crate) struct RunJob<'a> {
    pub rig: &'a Rig,
    pub folder: &'a Path,
    pub shape: Option<Shape<'a>>,
    pub keep: RecordingMode,
    pub before: &'a BTreeMap<u32, PairAttempts>,
    pub started: Timestamp,
    /// Joints of the arms at each pair, if the arms are known.
    pub arms: Option<Arc<Choreography>>,
    pub when_stopped: WhenStopped,
}

/// Treatment of a run's file when the run is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WhenStopped {
    /// It is ended with the pairs that it has, and cannot be resumed.
    Ended,
    /// It stays open, to be resumed.
    Open,
}

impl RunJob<'_> {
    /// Runs the preflight checks; returns those that failed.
    pub fn look_over(&self, controller: &mut RunController<'_>, pairs: &[Pair]) -> Vec<PreflightFinding> {
        let todo: Vec<_> = pairs.iter().filter(|p| !self.before.get(&p.id.0).is_some_and(|t| t.accepted)).collect();
        let mut findings: Vec<_> =
            preflight::check_disk(self.folder, self.rig, self.keep, todo.len()).into_iter().collect();
        if let Some(finding) = preflight::quiet_part(self.rig) {
            // Takes would be refused for the same reason.
            findings.push(finding);
        } else if let Some(first) = todo.first() {
            findings.extend(preflight::check_devices(controller, **first));
        }
        findings
    }

    /// Measures the pairs that are left, with a recorder that has begun. If it is stopped the file stays `.partial`.
    pub fn measure(
        &self,
        controller: &mut RunController<'_>,
        mut recorder: Recorder,
        session: RunSession<'_>,
    ) -> Result<MeasuredRun, controller::Error> {
        let origin = controller.origin();
        let mut pairs = self.rig.build_grid()?.pairs().to_vec();
        if let Some(arms) = &self.arms {
            recorder.record_arms(self.started, arms.cell(), name_of(origin))?;
            arms.sort_pairs(&mut pairs);
        }
        if let Some(tap) = session.tap {
            recorder.listen(tap, self.started, self.shape);
        }
        // The preflight check moved the arms to the first pair, if it ran.
        let first = self.arms.as_ref().and_then(|arms| arms.pose_at(pairs.first()?.id).ok());
        if let Some(stand) = first {
            recorder.record_arm_frames(self.started, &[stand.microphone, stand.speaker])?;
        }
        let checkpoint_every = session.checkpoint_every.unwrap_or_else(|| checkpoint_every(origin));
        let options = RunOptions { keep: self.keep, checkpoint_every };
        let work = RunWorkload { pairs: &pairs, before: self.before, options };
        let outcome = controller.run(&mut recorder, &work, session.control, session.observe)?;
        let path = match (outcome.left, self.when_stopped) {
            (0, _) | (_, WhenStopped::Ended) => recorder.finish(&outcome.end)?,
            (_, WhenStopped::Open) => recorder.partial().to_owned(),
        };
        Ok(MeasuredRun { path, outcome })
    }
}

// A measured pair is 12 s of a rig's time.
fn checkpoint_every(origin: Origin) -> usize {
    match origin {
        Origin::Simulated | Origin::Computed => SIMULATED_CHECKPOINT_EVERY,
        _ => 1,
    }
}

fn name_of(origin: Origin) -> &'static str {
    match origin {
        Origin::Simulated | Origin::Computed => "simulated_rig",
        _ => "rig",
    }
}
