//! A specimen as a run needs it: heights for its devices, a mesh and facts for its file.

use std::path::{Path, PathBuf};

use echolake_schema::manifest::MeshFacts;
use echolake_schema::{Rig, SurfaceRecord};

use crate::material::SurfaceMaterial;
use crate::mesh::{self, BACK_MM, FACETS, Mesh, MeshFormat, PanelSide};
use crate::relief::{HeightField, PanelRelief};

/// A panel to be measured.
#[derive(Debug, Clone, PartialEq)]
pub enum PanelSpecimen {
    /// A generated relief.
    Relief(PanelRelief),
    /// A side of the mesh in a file, as a coated print.
    Mesh(PathBuf, PanelSide),
    /// A real panel whose geometry nobody gave.
    NoGeometry,
}

/// A specimen, ready to be measured and recorded.
pub struct PreparedPanel {
    /// None if nobody gave it.
    pub geometry: Option<PanelGeometry>,
    /// The surface as its table has it, without references.
    pub record: SurfaceRecord,
    original: Option<(String, MeshFormat, Vec<u8>)>,
}

/// Shape and material of a panel.
pub struct PanelGeometry {
    /// Heights of the relief, as simulations take them.
    pub heights: HeightField,
    /// The panel as a solid.
    pub mesh: Mesh,
    /// Material of its surface.
    pub material: SurfaceMaterial,
}

/// A file that is kept as it is.
pub struct OriginalFile<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its media type.
    pub media_type: &'a str,
    /// Its content.
    pub bytes: &'a [u8],
}

impl PreparedPanel {
    /// Generates the relief, or reads the mesh.
    ///
    /// # Errors
    /// The mesh cannot be used.
    pub fn new(specimen: &PanelSpecimen, rig: &Rig) -> Result<Self, mesh::Error> {
        match specimen {
            PanelSpecimen::Relief(relief) => Ok(from_relief(relief)),
            PanelSpecimen::Mesh(path, side) => from_file(path, *side, rig),
            PanelSpecimen::NoGeometry => Ok(Self { geometry: None, record: unknown_surface(), original: None }),
        }
    }

    /// The file that the mesh was read from.
    pub fn original_file(&self) -> Option<OriginalFile<'_>> {
        let (name, format, bytes) = self.original.as_ref()?;
        Some(OriginalFile { name, media_type: format.media_type(), bytes })
    }
}

fn unknown_surface() -> SurfaceRecord {
    SurfaceRecord { typology: "unknown".to_owned(), ..SurfaceRecord::default() }
}

fn from_relief(relief: &PanelRelief) -> PreparedPanel {
    let material = relief.material();
    let heights = relief.height_field(FACETS);
    let mesh = Mesh::from_height_field(&heights, BACK_MM);
    let facts = MeshFacts {
        file: echolake_schema::topics::MESH_ATTACHMENT.to_owned(),
        triangles: mesh.triangles.len() as u64,
        watertight: true,
        relief_mm: heights.extent_mm().map(f64::from),
    };
    let (macrostructure, microstructure) = match relief {
        PanelRelief::Layered(wall) => (Some(wall.macrostructure_name()), Some(wall.microstructure_text())),
        _ => (None, None),
    };
    PreparedPanel {
        record: SurfaceRecord {
            typology: relief.typology().to_owned(),
            macrostructure,
            mesostructure: Some(relief.name().to_owned()),
            microstructure,
            material: Some(material.name().to_owned()),
            reflection_factor: Some(material.reflection_factor()),
            parameters: relief.parameters().into(),
            mesh: Some(facts),
            ..SurfaceRecord::default()
        },
        geometry: Some(PanelGeometry { heights, mesh, material }),
        original: None,
    }
}

fn from_file(path: &Path, side: PanelSide, rig: &Rig) -> Result<PreparedPanel, mesh::Error> {
    let format = MeshFormat::from_path(path)?;
    let mesh = Mesh::from_file(path)?.seen_from(side).check_solid(rig.panel.size_mm, rig.panel.depth_mm, path)?;
    let heights = mesh.to_height_field(FACETS, rig.panel.size_mm, rig.panel.depth_mm, path)?;
    let bytes = std::fs::read(path).map_err(|source| mesh::Error::Read { path: path.to_owned(), source })?;
    let name = path.file_name().map_or_else(|| "panel".to_owned(), |n| n.to_string_lossy().into_owned());
    // A coated print, as the paper's panels are.
    let material = PanelRelief::Flat.material();
    let facts = MeshFacts {
        file: name.clone(),
        triangles: mesh.triangles.len() as u64,
        watertight: true,
        relief_mm: heights.extent_mm().map(f64::from),
    };
    Ok(PreparedPanel {
        record: SurfaceRecord {
            typology: "mesh".to_owned(),
            material: Some(material.name().to_owned()),
            reflection_factor: Some(material.reflection_factor()),
            // The attached file is the producer's, which shows its front.
            parameters: serde_json::json!({ "side": side.name() }),
            mesh: Some(facts),
            ..SurfaceRecord::default()
        },
        geometry: Some(PanelGeometry { heights, mesh, material }),
        original: Some((name, format, bytes)),
    })
}
