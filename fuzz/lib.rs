//! What targets and seeds share: a rig of three points, and folders in which imports find their files.

mod seeds;

use std::io::Cursor;
use std::path::{Path, PathBuf};

use echolake_import::ImportOptions;
use echolake_schema::{Rig, Timestamp};
use ndarray::{Array1, Array2};
use ndarray_npy::NpzWriter;

pub use seeds::{run_of_wav, write_seeds_on_request};

/// Samples of responses.
pub const LENGTH: usize = 400;
/// Points of the rig, mm.
pub const POINTS_MM: [[f64; 3]; 3] = [[0.0, 0.0, 124.0], [150.0, 0.0, 124.0], [0.0, 150.0, 304.0]];
/// Time at which imports begin.
pub const STARTED: Timestamp = Timestamp(1_767_600_000_000_000_000);
/// Rows of a WAV import, whose recordings are the two channels of one file.
pub const WAV_MANIFEST: &str = "surface,recording,loopback,microphone,speaker,temperature_c\n\
                                a,input.wav,input.wav#2,0/0/0,0/1/0,20\n";
/// Rows of an import of REW's text.
pub const REW_MANIFEST: &str = "surface,response,microphone,speaker,temperature_c,timing_offset_ms\n\
                                a,input.txt,0/0/0,0/1/0,20,0.25\n";
/// The mapping of the HDF5 target.
pub const MAPPING: &str = "file = \"input.h5\"\nsurfaces = [\"a\"]\ntemperature = 20.0\n\
                           sampling_rate = { dataset = \"ir\", attribute = \"fs\" }\n\
                           [responses]\ndataset = \"ir\"\ndimensions = [\"speaker\", \"microphone\", \"sample\"]\n\
                           [microphones]\ndataset = \"microphones\"\nunits = \"metre\"\n\
                           [speakers]\ndataset = \"speakers\"\nunits = \"mm\"\n";

/// Returns a rig of three points and thus three pairs.
///
/// # Panics
/// The text is no rig.
pub fn three_points() -> Rig {
    let text = format!("impulse_response.length = 200\ngrid.points_mm = {POINTS_MM:?}\n");
    Rig::from_toml(&text).expect("a rig")
}

/// Returns a surface of the GIR data set, of the rig's three pairs.
///
/// # Panics
/// It cannot be written.
pub fn gir_surface() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut npz = NpzWriter::new(&mut bytes);
    let matrix = Array2::from_shape_fn((3, LENGTH), |(row, n)| (row * LENGTH + n) as f32 / 1e4);
    npz.add_array("matrix", &matrix).expect("written");
    npz.add_array("temperatures", &Array1::from(vec![20.0, 21.0, 22.0])).expect("written");
    npz.finish().expect("written");
    bytes.into_inner()
}

/// A folder in memory, with one for the runs in it.
pub struct ImportFolder {
    root: tempfile::TempDir,
    inbox: PathBuf,
}

impl ImportFolder {
    /// Makes it.
    ///
    /// # Panics
    /// The system refuses.
    pub fn new() -> Self {
        let root = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a folder");
        let inbox = root.path().join("inbox");
        std::fs::create_dir(&inbox).expect("a folder");
        Self { root, inbox }
    }

    /// Writes one of its files, and returns its path.
    ///
    /// # Panics
    /// The system refuses.
    pub fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.root.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        path
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        self.root.path()
    }

    /// Settings of an import into it.
    pub fn options(&self) -> ImportOptions<'_> {
        ImportOptions { started: STARTED, folder: &self.inbox, project: None }
    }

    /// Removes the runs of an import, and says how many files there were.
    ///
    /// # Panics
    /// The system refuses.
    pub fn clear(&self) -> usize {
        let entries = std::fs::read_dir(&self.inbox).expect("a folder").flatten();
        entries.map(|entry| std::fs::remove_file(entry.path()).expect("removed")).count()
    }
}

impl Default for ImportFolder {
    fn default() -> Self {
        Self::new()
    }
}
