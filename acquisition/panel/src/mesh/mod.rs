//! Meshes of panels: made from height fields, read from and written to GLB and STL.

mod error;
mod glb;
mod solid;
mod stl;

pub use error::Error;

use std::path::Path;

/// Largest mesh file that is read: ten times the published panels'.
const LARGEST_FILE: u64 = 1 << 30;

/// Facets along each side of heights, as the simulated rig measures and a run's mesh shows them: 2.14 mm, a quarter of
/// the wavelength at 40 kHz.
pub const FACETS: usize = 274;
/// The back of a panel with one side, mm.
pub const BACK_MM: f32 = -30.0;

/// Triangles over shared vertices, in mm; x and y along the panel, z up from it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// Positions, mm.
    pub vertices_mm: Vec<[f32; 3]>,
    /// Corners of each triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// A side of a panel, which is turned over about its y axis to see its back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PanelSide {
    /// The upper one in its mesh.
    Front,
    /// The lower one.
    Back,
}

impl PanelSide {
    /// Its name in arguments and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Front => "front",
            Self::Back => "back",
        }
    }

    /// The side of a name.
    pub fn parse(name: &str) -> Option<Self> {
        [Self::Front, Self::Back].into_iter().find(|side| side.name() == name)
    }
}

/// A file format, chosen by the file's extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// glTF 2.0, binary.
    Glb,
    /// Stereolithography, binary or text.
    Stl,
}

impl MeshFormat {
    /// Returns the format of a path's extension.
    ///
    /// # Errors
    /// [`Error::Format`], which lists the formats.
    pub fn from_path(path: &Path) -> Result<Self, Error> {
        let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        match extension.as_deref() {
            Some("glb") => Ok(Self::Glb),
            Some("stl") => Ok(Self::Stl),
            _ => Err(Error::Format { path: path.to_owned() }),
        }
    }

    /// Its media type.
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Glb => "model/gltf-binary",
            Self::Stl => "model/stl",
        }
    }
}

impl Mesh {
    /// Reads a file.
    ///
    /// # Errors
    /// [`Error`], naming the file and the place in it.
    pub fn from_file(path: &Path) -> Result<Self, Error> {
        let format = MeshFormat::from_path(path)?;
        let failed = |source| Error::Read { path: path.to_owned(), source };
        let meta = std::fs::metadata(path).map_err(failed)?;
        if !meta.is_file() {
            return Err(failed(std::io::Error::new(std::io::ErrorKind::InvalidInput, "it is no plain file")));
        }
        let size = meta.len();
        if size > LARGEST_FILE {
            let place = "the file".to_owned();
            let actual = format!("{size} bytes");
            return Err(Error::Syntax { path: path.to_owned(), place, actual, expected: "up to 1 GiB" });
        }
        Self::from_bytes(format, &std::fs::read(path).map_err(failed)?, path)
    }

    /// Reads a file's bytes; `path` is for messages.
    ///
    /// # Errors
    /// As [`Mesh::from_file`].
    pub fn from_bytes(format: MeshFormat, bytes: &[u8], path: &Path) -> Result<Self, Error> {
        match format {
            MeshFormat::Glb => glb::parse(bytes, path),
            MeshFormat::Stl => stl::parse_stl(bytes, path),
        }
    }

    /// The bytes of a file.
    pub fn to_bytes(&self, format: MeshFormat) -> Vec<u8> {
        match format {
            MeshFormat::Glb => glb::write_glb(self),
            MeshFormat::Stl => stl::write_stl(self),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relief::PanelRelief;

    const READ: [MeshFormat; 2] = [MeshFormat::Glb, MeshFormat::Stl];

    fn small() -> Mesh {
        Mesh::from_height_field(&PanelRelief::by_name("macrostructure").expect("a relief").height_field(4), -20.0)
    }

    fn parse(format: MeshFormat, bytes: &[u8]) -> Result<Mesh, Error> {
        Mesh::from_bytes(format, bytes, Path::new("panel"))
    }

    #[test]
    fn what_is_written_is_read() {
        let mesh = small();
        for format in READ {
            let again = parse(format, &mesh.to_bytes(format)).expect("its own file").to_welded();
            assert_eq!(again.triangles.len(), mesh.triangles.len(), "{format:?}");
            assert!((again.volume_mm3() / mesh.volume_mm3() - 1.0).abs() < 1e-5, "{format:?}");
            assert_eq!(again.check_solid(585.0, 40.0, Path::new("panel")).map(drop), Ok(()), "{format:?}");
        }
    }

    #[test]
    fn every_truncation_is_refused() {
        let mesh = small();
        for format in READ {
            let bytes = mesh.to_bytes(format);
            for end in 0..bytes.len() {
                assert!(parse(format, &bytes[..end]).is_err(), "{format:?}: {end} of {}", bytes.len());
            }
        }
    }

    mod slow {
        use super::*;

        #[test]
        fn flipped_bytes_do_not_panic() {
            let mesh = small();
            for format in READ {
                let bytes = mesh.to_bytes(format);
                let mut state = 1u64;
                for _ in 0..3_000 {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    let mut broken = bytes.clone();
                    let at = (state >> 33) as usize % broken.len();
                    broken[at] ^= (state >> 20) as u8 | 1;
                    if let Ok(mesh) = parse(format, &broken) {
                        let _ = mesh.check_solid(585.0, 40.0, Path::new("panel"));
                    }
                }
            }
        }
    }
}
