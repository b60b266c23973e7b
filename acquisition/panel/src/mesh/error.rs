//! Errors of a mesh or its file.

use std::io;
use std::path::PathBuf;

/// A mesh that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The system refused.
    #[error("cannot read mesh `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The extension names no known format.
    #[error(
        "`{}` is no mesh file that is known; hint: .glb or .stl, which Blender, MeshLab and trimesh export",
        path.display()
    )]
    Format {
        /// The file.
        path: PathBuf,
    },
    /// The file is damaged, or of a kind that is not read.
    #[error("mesh `{}`: {place} has {actual}, expected {expected}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Place in the file.
        place: String,
        /// Actual content.
        actual: String,
        /// Expected content.
        expected: &'static str,
    },
    /// The mesh has no triangle.
    #[error("mesh `{}` is empty: it has no triangles", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The mesh has edges with one triangle only.
    #[error(
        "mesh `{}` is open: {edges} edges have no second triangle, the first at {place:?} mm; hint: export a closed \
         solid",
        path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Number of edges.
        edges: usize,
        /// One end of one of them.
        place: [f32; 3],
    },
    /// The mesh is larger than the rig's panel.
    #[error(
        "mesh `{}` is {actual}, larger than the panel: expected {expected}; hint: lengths are in mm (GLB: metres)",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size.
        actual: String,
        /// The panel's.
        expected: String,
    },
}

impl PartialEq for Error {
    fn eq(&self, other: &Self) -> bool {
        self.to_string() == other.to_string()
    }
}
