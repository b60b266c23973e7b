//! One run of the simulated rig, from a relief or a mesh to a closed MCAP file.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use echolake_schema::manifest::{MeshFacts, Origin, RunEnd, RunManifest};
use echolake_schema::{Rig, RunId, SurfaceId, SurfaceRecord, Timestamp};

use crate::controller::{self, Keep, RunController, RunOptions};
use crate::drivers;
use crate::mesh::{self, Format, Mesh};
use crate::recorder::{OriginalFile, Recorder, Relief as RecordedRelief, RunStart};
use crate::relief::{HeightField, Relief};
use crate::rigs::simulated::{FACETS, Simulation, devices};
use crate::robots::Choreography;

/// Cells along each side of the recorded panel mesh.
pub(crate) const MESH_CELLS: usize = 117;
/// The back of a generated panel, mm.
pub(crate) const BACK_MM: f32 = -30.0;
/// Pairs between two checkpoints; a simulated run that is lost is made again.
const CHECKPOINT_EVERY: usize = 200;

/// What is measured.
#[derive(Debug, Clone)]
pub enum Specimen {
    /// A generated relief.
    Relief(Relief),
    /// Somebody's mesh, of coated print.
    Mesh(PathBuf),
}

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
    /// Measures all pairs; returns the run's file and how it ended.
    ///
    /// # Errors
    /// [`Error`]; a run that was begun leaves its `.partial` file.
    pub fn measure(&self, stop: &AtomicBool, progress: &mut dyn FnMut(usize)) -> Result<(PathBuf, RunEnd), Error> {
        let prepared = self.prepare()?;
        let arms = Choreography::of(self.rig)?;
        let simulation = Simulation {
            rig: self.rig,
            relief: &prepared.heights,
            reflection_factor: prepared.reflection_factor,
            start: self.start,
            seed: self.seed,
            arms: arms.clone(),
        };
        let real = drivers::open(self.rig).map_err(controller::Error::from)?;
        let devices = match real {
            Some(real) => real,
            None => devices(&simulation).map_err(controller::Error::from)?,
        };
        let (origin, checkpoint_every) = (devices.origin, checkpoint_every(devices.origin));
        let manifest = RunManifest {
            run_id: self.run_id()?,
            surface_id: self.surface.clone(),
            started: self.start,
            software: concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned(),
            rig: self.rig.name.clone(),
            origin,
        };
        let original = prepared.original.as_ref().map(|(name, format, bytes)| OriginalFile {
            name,
            media_type: format.media_type(),
            bytes,
        });
        let relief = RecordedRelief { heights: &prepared.heights, mesh: &prepared.mesh, original };
        let start = RunStart { manifest: &manifest, rig: self.rig, surface: &prepared.record, relief: Some(relief) };
        let path = self.path()?;
        // What can be refused is refused before there is a file.
        let mut controller = RunController::new(self.rig, devices)?;
        let options = RunOptions { keep: self.keep, checkpoint_every };
        let grid = self.rig.grid()?;
        let mut recorder = Recorder::create(&path, &start).map_err(controller::Error::from)?;
        let mut pairs = grid.pairs().to_vec();
        if let Some(arms) = &arms {
            let shown = recorder.arms(self.start, arms.cell(), name_of(origin));
            shown.map_err(controller::Error::from)?;
            arms.sort(&mut pairs);
        }
        let end = controller.run(&mut recorder, &pairs, options, stop, progress)?;
        Ok((recorder.finish(&end).map_err(controller::Error::from)?, end))
    }

    /// The run's file.
    ///
    /// # Errors
    /// [`Error::Schema`] where the surface's name is too long for a run's.
    pub fn path(&self) -> Result<PathBuf, Error> {
        Ok(self.folder.join(format!("{}.mcap", self.run_id()?)))
    }

    fn run_id(&self) -> Result<RunId, Error> {
        let tag = (self.seed ^ (self.seed >> 16) ^ (self.seed >> 32)) as u16;
        Ok(RunId::compose(self.start, &self.surface, tag)?)
    }

    fn prepare(&self) -> Result<Prepared, Error> {
        let mut prepared = match self.specimen {
            Specimen::Relief(relief) => generated(relief),
            Specimen::Mesh(path) => from_file(path, self.rig)?,
        };
        prepared.record.flat_reference = self.flat.clone();
        prepared.record.foam_reference = self.foam.clone();
        Ok(prepared)
    }
}

// A measured pair is 12 s of a rig's time.
fn checkpoint_every(origin: Origin) -> usize {
    match origin {
        Origin::Simulated => CHECKPOINT_EVERY,
        _ => 1,
    }
}

fn name_of(origin: Origin) -> &'static str {
    match origin {
        Origin::Simulated => "simulated_rig",
        _ => "rig",
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

fn from_file(path: &Path, rig: &Rig) -> Result<Prepared, Error> {
    let format = Format::of(path)?;
    let mesh = Mesh::read(path)?.check(rig.panel.size_mm, rig.panel.depth_mm, path)?;
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
            mesh: Some(facts),
            ..SurfaceRecord::default()
        },
        heights,
        mesh,
        reflection_factor: material.reflection_factor,
        original: Some((name, format, bytes)),
    })
}
