//! A run, from a specimen and a rig's devices to a closed MCAP file.

pub mod assessment;
pub mod controller;
pub mod live;
pub mod metrics;
pub mod objection;
pub mod plan;
pub mod preflight;
pub mod recorder;
pub mod recording_lock;
mod recording_mode;
pub mod session;
pub mod simulate;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use echolake_panel::{PanelGeometry, PanelSpecimen, PreparedPanel, mesh};
use echolake_schema::manifest::{Origin, RunManifest};
use echolake_schema::{ProjectName, Rig, RunId, SurfaceId, SurfaceRole, Timestamp};
use tracing::Span;

use crate::disk::folder_of;
use crate::recovery;
use crate::rig::RigDevices;
use crate::rig::devices::simulated::TAKE_SECS;
use crate::rig::devices::{DeviceRequest, open_devices};
use crate::rig::robots::Choreography;
use crate::run::controller::{RecordingMode, RunController};
use crate::run::plan::RunPlan;
use crate::run::preflight::PreflightFinding;
use crate::run::recorder::{Held, PairAttempts, Recorder, Relief as RecordedRelief, RunStart, Shape};
use crate::run::session::{MeasuredRun, PreflightMode, RunJob, RunSession, WhenStopped};

/// A run that is to be measured.
#[derive(Debug, Clone)]
pub struct RunRequest<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// Name of the surface.
    pub surface: SurfaceId,
    /// The panel to measure.
    pub specimen: &'a PanelSpecimen,
    /// The surface that normalises it, if it is not the lake's.
    pub flat: Option<SurfaceId>,
    /// The surface whose direct sound is subtracted from it, if it is not the lake's.
    pub foam: Option<SurfaceId>,
    /// The surface that has its large shape and nothing on it.
    pub macro_reference: Option<SurfaceId>,
    /// Its material, if it is not that of the specimen.
    pub material: Option<String>,
    /// Its part in the measurement of absorption.
    pub role: Option<SurfaceRole>,
    /// The project that it belongs to.
    pub project: Option<ProjectName>,
    /// Time of its begin.
    pub start: Timestamp,
    /// Seed of room and noise of simulated devices.
    pub seed: u64,
    /// Tag of the run's name.
    pub tag: u64,
    /// Messages to record.
    pub keep: RecordingMode,
    /// Folder of the run's file, which has the run's name.
    pub folder: &'a Path,
}

/// An error of measuring or resuming a run.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The mesh cannot be used.
    #[error(transparent)]
    Mesh(#[from] mesh::Error),
    /// A device cannot be used, or measuring failed.
    #[error(transparent)]
    Run(#[from] controller::Error),
    /// A name is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
    /// The run cannot be resumed.
    #[error(transparent)]
    Resume(#[from] recovery::Error),
    /// Another program records into the folder, or uses a device.
    #[error("{what} is in use: {holder}; hint: wait for the end of that run, or --force if both are meant")]
    InUse {
        /// The folder or device.
        what: String,
        /// The other program, as far as it is known.
        holder: String,
    },
    /// The preflight check found something, and nothing was begun.
    #[error("not fit to measure: {}", findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n  and: "))]
    Unfit {
        /// The failed checks.
        findings: Vec<PreflightFinding>,
    },
}

impl<'a> RunRequest<'a> {
    /// Makes a request that keeps sweeps, with seed and tag 1, without references of its own and without a project.
    pub fn new(
        rig: &'a Rig,
        surface: SurfaceId,
        specimen: &'a PanelSpecimen,
        start: Timestamp,
        folder: &'a Path,
    ) -> Self {
        Self {
            rig,
            surface,
            specimen,
            flat: None,
            foam: None,
            macro_reference: None,
            material: None,
            role: None,
            project: None,
            start,
            seed: 1,
            tag: 1,
            keep: RecordingMode::Sweeps,
            folder,
        }
    }

    /// Measures all pairs with the devices that the rig file names. A run that is stopped or interrupted can be
    /// resumed.
    ///
    /// # Errors
    /// [`Error`]; a run that was begun leaves its `.partial` file.
    pub fn measure_run(&self, session: RunSession<'_>) -> Result<MeasuredRun, Error> {
        let panel = PreparedPanel::new(self.specimen, self.rig)?;
        let arms = Choreography::for_rig(self.rig)?;
        let request =
            DeviceRequest { rig: self.rig, panel: &panel, start: self.start, seed: self.seed, arms: arms.clone() };
        let devices = open_devices(&request, session.pace).map_err(controller::Error::from)?;
        let plan = RunPlan { keep: self.keep, seed: self.seed, specimen: self.specimen.clone() };
        self.measure_with(devices, &panel, arms, session, Some(plan.to_metadata()))
    }

    /// Measures all pairs with these devices. Only a run with a plan can be resumed; without one it is closed when it
    /// is stopped.
    pub(crate) fn measure_with(
        &self,
        devices: RigDevices,
        panel: &PreparedPanel,
        arms: Option<Arc<Choreography>>,
        session: RunSession<'_>,
        plan: Option<BTreeMap<String, String>>,
    ) -> Result<MeasuredRun, Error> {
        let manifest = RunManifest {
            run_id: self.run_id()?,
            surface_id: self.surface.clone(),
            started: self.start,
            software: recorder::SOFTWARE.to_owned(),
            rig: self.rig.name.clone(),
            origin: devices.origin,
        };
        let _span = run_span(&manifest).entered();
        let mut surface = panel.record.clone();
        surface.flat_reference = self.flat.clone();
        surface.foam_reference = self.foam.clone();
        surface.macro_reference = self.macro_reference.clone();
        surface.material = self.material.clone().or(surface.material);
        surface.role = self.role;
        surface.project = self.project.clone();
        let relief = panel.geometry.as_ref().map(|PanelGeometry { heights, mesh, .. }| {
            let original = panel.original_file();
            RecordedRelief { heights, mesh, original }
        });
        let start = RunStart { manifest: &manifest, rig: self.rig, surface: &surface, relief, plan };
        let none = BTreeMap::new();
        let mut job = build_job(panel, self.rig, self.folder, self.keep, &none, self.start, arms);
        if start.plan.is_none() {
            job.when_stopped = WhenStopped::Ended;
        }
        // Requests that can be refused are refused before there is a file.
        let mut controller = RunController::new(self.rig, devices)?;
        check_fitness(&job, &mut controller, session.preflight)?;
        let recorder = Recorder::create(&self.path()?, &start).map_err(controller::Error::from)?;
        Ok(job.measure(&mut controller, recorder, session)?)
    }

    /// The run's file.
    ///
    /// # Errors
    /// [`Error::Schema`] if the surface's name is too long for a run's.
    pub fn path(&self) -> Result<PathBuf, Error> {
        Ok(self.folder.join(format!("{}.mcap", self.run_id()?)))
    }

    fn run_id(&self) -> Result<RunId, Error> {
        Ok(RunId::compose(self.start, &self.surface, self.tag)?)
    }
}

/// Resumes a run that was stopped or interrupted: measurements that are safe in its file are not repeated.
///
/// # Errors
/// [`Error::Resume`] if it cannot be resumed; the file is as it was.
pub fn resume_run(partial: &Path, session: RunSession<'_>) -> Result<MeasuredRun, Error> {
    let held = Held::from_file(partial)?;
    let _span = run_span(&held.manifest).entered();
    let no_plan = |text: String| recovery::Error::NoPlan { path: partial.to_owned(), source: text.into() };
    let plan = RunPlan::from_metadata(&held.plan).map_err(no_plan)?;
    let panel = PreparedPanel::new(&plan.specimen, &held.rig)?;
    let now = Timestamp::now();
    let start = match held.manifest.origin {
        // After everything recorded: the simulated clock runs ahead of ours.
        Origin::Simulated | Origin::Computed => now.max(held.last.plus_secs(TAKE_SECS)),
        _ if now < held.last => {
            let back_secs = (held.last.0 - now.0) as f64 / 1e9;
            return Err(controller::Error::Clock { before: held.last, now, back_secs }.into());
        }
        _ => now,
    };
    // A repeated seed would give the same noise again.
    let seed = plan.seed.wrapping_add(held.attempts.wrapping_add(1).wrapping_mul(0x9E37_79B9));
    let arms = Choreography::for_rig(&held.rig)?;
    let request = DeviceRequest { rig: &held.rig, panel: &panel, start, seed, arms: arms.clone() };
    let devices = open_devices(&request, session.pace).map_err(controller::Error::from)?;
    let job = build_job(&panel, &held.rig, folder_of(partial), plan.keep, &held.pairs, start, arms);
    let mut controller = RunController::new(&held.rig, devices)?;
    check_fitness(&job, &mut controller, session.preflight)?;
    let (recorder, _) = Recorder::resume_recording(partial)?;
    Ok(job.measure(&mut controller, recorder, session)?)
}

// All that is logged of a run, at the level of errors: no filter that lets a line through takes its span away.
fn run_span(manifest: &RunManifest) -> Span {
    tracing::error_span!("run", run = %manifest.run_id, surface = %manifest.surface_id)
}

fn check_fitness(job: &RunJob<'_>, controller: &mut RunController<'_>, preflight: PreflightMode) -> Result<(), Error> {
    if preflight == PreflightMode::Skip {
        return Ok(());
    }
    let findings = job.look_over(controller, job.rig.build_grid()?.pairs());
    if findings.is_empty() { Ok(()) } else { Err(Error::Unfit { findings }) }
}

fn build_job<'a>(
    panel: &'a PreparedPanel,
    rig: &'a Rig,
    folder: &'a Path,
    keep: RecordingMode,
    before: &'a BTreeMap<u32, PairAttempts>,
    started: Timestamp,
    arms: Option<Arc<Choreography>>,
) -> RunJob<'a> {
    let shape = panel.geometry.as_ref().map(|PanelGeometry { heights, mesh, .. }| Shape { heights, mesh });
    RunJob { rig, folder, shape, keep, before, started, arms, when_stopped: WhenStopped::Open }
}
