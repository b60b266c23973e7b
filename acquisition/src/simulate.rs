//! One run of the simulated rig, from a relief or a mesh to a closed MCAP file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use echolake_schema::manifest::{MeshFacts, Origin, RunEnd, RunManifest};
use echolake_schema::messages::Verdict;
use echolake_schema::{Rig, RunId, SurfaceId, SurfaceRecord, Timestamp};

use crate::controller::{self, Control, Event, Keep, RunController};
use crate::drivers;
use crate::mesh::{self, Format, Mesh, Side};
use crate::plan::RunPlan;
pub use crate::plan::Specimen;
use crate::preflight::Finding;
use crate::recorder::{Held, OriginalFile, Recorder, Relief as RecordedRelief, RunStart, folder_of};
use crate::recovery;
use crate::relief::{HeightField, Relief};
use crate::rig::Devices;
use crate::rigs::paced::paced;
use crate::rigs::simulated::{FACETS, Simulation, TAKE_SECS, devices};
use crate::robots::Choreography;
use crate::session::{Job, Measured, Pace, Preflight, Session, Shape, WhenStopped};

/// Cells along each side of the recorded panel mesh.
pub(crate) const MESH_CELLS: usize = 117;
/// The back of a generated panel, mm.
pub(crate) const BACK_MM: f32 = -30.0;
/// Pairs between two checkpoints; a simulated run that is lost is made again.
pub(crate) const CHECKPOINT_EVERY: usize = 200;

/// A run to be simulated.
#[derive(Debug, Clone)]
pub struct SimulatedRun<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// Name of the surface.
    pub surface: SurfaceId,
    /// What is measured.
    pub specimen: &'a Specimen,
    /// The surface that normalises it, where it is not the lake's.
    pub flat: Option<SurfaceId>,
    /// The surface whose direct sound is subtracted from it, where it is not the lake's.
    pub foam: Option<SurfaceId>,
    /// When it begins.
    pub start: Timestamp,
    /// Seed of room and noise.
    pub seed: u64,
    /// Tag of the run's name.
    pub tag: u64,
    /// What is recorded.
    pub keep: Keep,
    /// Folder of the run's file, which has the run's name.
    pub folder: &'a Path,
}

/// Why a run cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The mesh cannot be used.
    #[error(transparent)]
    Mesh(#[from] mesh::Error),
    /// The run cannot be measured.
    #[error(transparent)]
    Run(#[from] controller::Error),
    /// A name is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
    /// The run cannot be gone on with.
    #[error(transparent)]
    Resume(#[from] recovery::Error),
    /// Something is not fit, and nothing was begun.
    #[error("not fit to measure: {}", findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n  and: "))]
    Unfit {
        /// What.
        findings: Vec<Finding>,
    },
}

/// A specimen, ready to be measured and recorded.
struct Prepared {
    heights: HeightField,
    mesh: Mesh,
    record: SurfaceRecord,
    reflection_factor: f64,
    original: Option<(String, Format, Vec<u8>)>,
}

impl SimulatedRun<'_> {
    /// Measures all pairs, looked over by nobody; returns the run's file and how it ended. Where `stop` becomes true it
    /// ends with the pairs that it has.
    ///
    /// # Errors
    /// [`Error`]; a run that was begun leaves its `.partial` file.
    pub fn measure(&self, stop: &AtomicBool, progress: &mut dyn FnMut(usize)) -> Result<(PathBuf, RunEnd), Error> {
        let (control, mut done) = (Control::default(), 0);
        let mut observe = |event: Event<'_>| match event {
            Event::Pair(_) => control.stop.store(stop.load(Ordering::Relaxed), Ordering::Relaxed),
            Event::Attempt(m) if m.verdict() != Verdict::Repeated => {
                done += 1;
                progress(done);
            }
            _ => {}
        };
        let session = Session {
            control: &control,
            observe: &mut observe,
            tap: None,
            preflight: Preflight::Skip,
            checkpoint_every: None,
            pace: Pace::Fast,
        };
        let measured = self.begin(session, None)?;
        Ok((measured.path, measured.outcome.end))
    }

    /// Measures all pairs under somebody's eyes. A run that is stopped, or that breaks off, can be gone on with.
    ///
    /// # Errors
    /// [`Error`]; a run that was begun leaves its `.partial` file.
    pub fn supervised(&self, session: Session<'_>) -> Result<Measured, Error> {
        let plan = RunPlan { keep: self.keep, seed: self.seed, specimen: self.specimen.clone() };
        self.begin(session, Some(plan.to_metadata()))
    }

    fn begin(&self, session: Session<'_>, plan: Option<BTreeMap<String, String>>) -> Result<Measured, Error> {
        let prepared = self.prepare()?;
        let arms = Choreography::of(self.rig)?;
        let devices = prepared.devices(self.rig, self.start, self.seed, session.pace, arms.clone())?;
        let manifest = RunManifest {
            run_id: self.run_id()?,
            surface_id: self.surface.clone(),
            started: self.start,
            software: concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned(),
            rig: self.rig.name.clone(),
            origin: devices.origin,
        };
        let original = prepared.original.as_ref().map(|(name, format, bytes)| OriginalFile {
            name,
            media_type: format.media_type(),
            bytes,
        });
        let relief = RecordedRelief { heights: &prepared.heights, mesh: &prepared.mesh, original };
        let (surface, relief) = (&prepared.record, Some(relief));
        let start = RunStart { manifest: &manifest, rig: self.rig, surface, relief, plan };
        let path = self.path()?;
        let nothing = BTreeMap::new();
        let mut job = prepared.job(self.rig, self.folder, self.keep, &nothing, self.start, arms);
        if start.plan.is_none() {
            job.when_stopped = WhenStopped::Ended;
        }
        // What can be refused is refused before there is a file.
        let mut controller = RunController::new(self.rig, devices)?;
        fit(&job, &mut controller, session.preflight)?;
        let recorder = Recorder::create(&path, &start).map_err(controller::Error::from)?;
        Ok(job.measure(&mut controller, recorder, session)?)
    }

    /// The run's file.
    ///
    /// # Errors
    /// [`Error::Schema`] where the surface's name is too long for a run's.
    pub fn path(&self) -> Result<PathBuf, Error> {
        Ok(self.folder.join(format!("{}.mcap", self.run_id()?)))
    }

    fn run_id(&self) -> Result<RunId, Error> {
        Ok(RunId::compose(self.start, &self.surface, self.tag)?)
    }

    fn prepare(&self) -> Result<Prepared, Error> {
        let mut prepared = Prepared::of(self.specimen, self.rig)?;
        prepared.record.flat_reference = self.flat.clone();
        prepared.record.foam_reference = self.foam.clone();
        Ok(prepared)
    }
}

/// Goes on with a run that was stopped or broken off: what is safe in its file is not measured again.
///
/// # Errors
/// [`Error::Resume`] where that cannot be; the file is as it was.
pub fn resume(partial: &Path, session: Session<'_>) -> Result<Measured, Error> {
    let held = Held::read(partial)?;
    let reason = |reason: String| recovery::Error::NoPlan { path: partial.to_owned(), reason };
    let plan = RunPlan::from_metadata(&held.plan).map_err(reason)?;
    let prepared = Prepared::of(&plan.specimen, &held.rig)?;
    let now = Timestamp::now();
    let start = match held.manifest.origin {
        // Behind all that was recorded: the simulated clock runs ahead of ours.
        Origin::Simulated => now.max(held.last.plus_secs(TAKE_SECS)),
        _ if now < held.last => {
            let back_secs = (held.last.0 - now.0) as f64 / 1e9;
            return Err(controller::Error::Clock { before: held.last, now, back_secs }.into());
        }
        _ => now,
    };
    // The same noise twice would be no noise.
    let seed = plan.seed.wrapping_add(held.attempts.wrapping_add(1).wrapping_mul(0x9E37_79B9));
    let arms = Choreography::of(&held.rig)?;
    let devices = prepared.devices(&held.rig, start, seed, session.pace, arms.clone())?;
    let folder = folder_of(partial);
    let job = prepared.job(&held.rig, folder, plan.keep, &held.pairs, start, arms);
    let mut controller = RunController::new(&held.rig, devices)?;
    fit(&job, &mut controller, session.preflight)?;
    let (recorder, _) = Recorder::resume(partial)?;
    Ok(job.measure(&mut controller, recorder, session)?)
}

fn fit(job: &Job<'_>, controller: &mut RunController<'_>, preflight: Preflight) -> Result<(), Error> {
    if preflight == Preflight::Skip {
        return Ok(());
    }
    let findings = job.look_over(controller, job.rig.grid()?.pairs());
    if findings.is_empty() { Ok(()) } else { Err(Error::Unfit { findings }) }
}

impl Prepared {
    fn of(specimen: &Specimen, rig: &Rig) -> Result<Self, Error> {
        match specimen {
            Specimen::Relief(relief) => Ok(generated(relief)),
            Specimen::Mesh(path, side) => from_file(path, *side, rig),
        }
    }

    // Those that the rig file names; where it names none, the simulated ones.
    fn devices(
        &self,
        rig: &Rig,
        start: Timestamp,
        seed: u64,
        pace: Pace,
        arms: Option<Arc<Choreography>>,
    ) -> Result<Devices, Error> {
        if let Some(real) = drivers::open(rig).map_err(controller::Error::from)? {
            return Ok(real);
        }
        let reflection_factor = self.reflection_factor;
        let simulation = Simulation { rig, relief: &self.heights, reflection_factor, start, seed, arms };
        let devices = devices(&simulation).map_err(controller::Error::from)?;
        Ok(match pace {
            Pace::Fast => devices,
            Pace::Secs(secs) => paced(devices, secs),
        })
    }

    fn job<'a>(
        &'a self,
        rig: &'a Rig,
        folder: &'a Path,
        keep: Keep,
        before: &'a BTreeMap<u32, crate::recorder::Tried>,
        started: Timestamp,
        arms: Option<Arc<Choreography>>,
    ) -> Job<'a> {
        let shape = Some(Shape { heights: &self.heights, mesh: &self.mesh });
        let when_stopped = WhenStopped::Open;
        Job { rig, folder, shape, keep, before, started, arms, when_stopped }
    }
}

fn generated(relief: &Relief) -> Prepared {
    let material = relief.material();
    let mesh = Mesh::from_height_field(&relief.height_field(MESH_CELLS), BACK_MM);
    let heights = relief.height_field(FACETS);
    let facts = MeshFacts {
        file: echolake_schema::topics::MESH_ATTACHMENT.to_owned(),
        triangles: mesh.triangles.len() as u64,
        watertight: true,
        relief_mm: heights.extent_mm().map(f64::from),
    };
    let (macrostructure, microstructure) = match relief {
        Relief::Layered(wall) => (Some(wall.macrostructure().to_owned()), Some(wall.microstructure())),
        _ => (None, None),
    };
    Prepared {
        record: SurfaceRecord {
            typology: relief.typology().to_owned(),
            macrostructure,
            mesostructure: Some(relief.name().to_owned()),
            microstructure,
            material: Some(material.name.to_owned()),
            reflection_factor: Some(material.reflection_factor),
            parameters: relief.parameters().into(),
            mesh: Some(facts),
            ..SurfaceRecord::default()
        },
        heights,
        mesh,
        reflection_factor: material.reflection_factor,
        original: None,
    }
}

fn from_file(path: &Path, side: Side, rig: &Rig) -> Result<Prepared, Error> {
    let format = Format::of(path)?;
    let mesh = Mesh::read(path)?.seen_from(side).check(rig.panel.size_mm, rig.panel.depth_mm, path)?;
    let heights = mesh.to_height_field(FACETS, rig.panel.size_mm, rig.panel.depth_mm, path)?;
    let bytes = std::fs::read(path).map_err(|source| mesh::Error::Read { path: path.to_owned(), source })?;
    let name = path.file_name().map_or_else(|| "panel".to_owned(), |n| n.to_string_lossy().into_owned());
    // A coated print, as the paper's panels are.
    let material = Relief::Flat.material();
    let facts = MeshFacts {
        file: name.clone(),
        triangles: mesh.triangles.len() as u64,
        watertight: true,
        relief_mm: heights.extent_mm().map(f64::from),
    };
    Ok(Prepared {
        record: SurfaceRecord {
            typology: "mesh".to_owned(),
            material: Some(material.name.to_owned()),
            reflection_factor: Some(material.reflection_factor),
            // The attached file is the producer's, which shows its front.
            parameters: serde_json::json!({ "side": side.name() }),
            mesh: Some(facts),
            ..SurfaceRecord::default()
        },
        heights,
        mesh,
        reflection_factor: material.reflection_factor,
        original: Some((name, format, bytes)),
    })
}
