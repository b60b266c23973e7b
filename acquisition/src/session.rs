//! A run that somebody supervises: looked over before it begins, watched and stopped while it goes on, and gone on with
//! afterwards.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use echolake_schema::manifest::Origin;
use echolake_schema::{Pair, Rig, Timestamp};

use crate::controller::{self, Control, Event, Keep, Outcome, RunController, RunOptions, Work};
use crate::preflight::{self, Finding};
use crate::recorder::{Recorder, Shape, Tap, Tried};
use crate::robots::Choreography;

/// Pairs between two checkpoints of a simulated run; one that is lost is made again.
const SIMULATED_CHECKPOINT_EVERY: usize = 200;

/// Who supervises a run, and how.
pub struct Session<'a> {
    /// Stops it or lets it wait.
    pub control: &'a Control,
    /// Hears what happens.
    pub observe: &'a mut dyn FnMut(Event<'_>),
    /// Hears every message.
    pub tap: Option<Box<dyn Tap>>,
    /// Whether it is looked over first.
    pub preflight: Preflight,
    /// Pairs between two checkpoints; where nothing is said, 1 on a real rig, whose pairs take 12 s each, and 200 on the
    /// simulated one.
    pub checkpoint_every: Option<usize>,
    /// How long a take lasts where it is simulated.
    pub pace: Pace,
}

/// Whether a run is looked over before it begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Preflight {
    /// It is, and refused where something is not fit.
    Check,
    /// It is not.
    Skip,
}

/// How long a simulated take lasts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// As long as it takes to compute it.
    Fast,
    /// So many seconds at least.
    Secs(f64),
}

/// What a session left.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Measured {
    /// The run's file; its `.partial` where it was stopped.
    pub path: PathBuf,
    /// How it ended.
    pub outcome: Outcome,
}

/// What is to be done, apart from the recorder.
pub(crate) struct Job<'a> {
    pub(crate) rig: &'a Rig,
    pub(crate) folder: &'a Path,
    pub(crate) shape: Option<Shape<'a>>,
    pub(crate) keep: Keep,
    pub(crate) before: &'a BTreeMap<u32, Tried>,
    pub(crate) started: Timestamp,
    /// How the arms go about, where the rig's are known.
    pub(crate) arms: Option<Arc<Choreography>>,
    pub(crate) when_stopped: WhenStopped,
}

/// What becomes of a run's file when it is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WhenStopped {
    /// It is ended with what it has: nobody can go on with it.
    Ended,
    /// It stays open, to be gone on with.
    Open,
}

impl Job<'_> {
    /// What is not fit.
    pub(crate) fn look_over(&self, controller: &mut RunController<'_>, pairs: &[Pair]) -> Vec<Finding> {
        let todo: Vec<_> = pairs.iter().filter(|p| !self.before.get(&p.id.0).is_some_and(|t| t.accepted)).collect();
        let mut findings: Vec<_> = preflight::disk(self.folder, self.rig, self.keep, todo.len()).into_iter().collect();
        if let Some(first) = todo.first() {
            findings.extend(preflight::devices(controller, **first));
        }
        findings
    }

    /// Measures what is left to a file that is begun. Where it was stopped the file stays `.partial`.
    pub(crate) fn measure(
        &self,
        controller: &mut RunController<'_>,
        mut recorder: Recorder,
        session: Session<'_>,
    ) -> Result<Measured, controller::Error> {
        let origin = controller.origin();
        let mut pairs = self.rig.grid()?.pairs().to_vec();
        if let Some(arms) = &self.arms {
            recorder.arms(self.started, arms.cell(), name_of(origin))?;
            arms.sort(&mut pairs);
        }
        if let Some(tap) = session.tap {
            recorder.listen(tap, self.started, self.shape);
        }
        // The devices were tried there, if anywhere.
        let first = self.arms.as_ref().and_then(|arms| arms.standing(pairs.first()?.id).ok());
        if let Some(stand) = first {
            recorder.stand(self.started, &[stand.microphone, stand.speaker])?;
        }
        let checkpoint_every = session.checkpoint_every.unwrap_or_else(|| checkpoint_every(origin));
        let options = RunOptions { keep: self.keep, checkpoint_every };
        let work = Work { pairs: &pairs, before: self.before, options };
        let outcome = controller.run(&mut recorder, &work, session.control, session.observe)?;
        let path = match (outcome.left, self.when_stopped) {
            (0, _) | (_, WhenStopped::Ended) => recorder.finish(&outcome.end)?,
            (_, WhenStopped::Open) => recorder.partial().to_owned(),
        };
        Ok(Measured { path, outcome })
    }
}

// A measured pair is 12 s of a rig's time.
fn checkpoint_every(origin: Origin) -> usize {
    match origin {
        Origin::Simulated => SIMULATED_CHECKPOINT_EVERY,
        _ => 1,
    }
}

fn name_of(origin: Origin) -> &'static str {
    match origin {
        Origin::Simulated => "simulated_rig",
        _ => "rig",
    }
}
