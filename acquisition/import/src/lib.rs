//! Import of existing measurements as runs: WAV files listed in a manifest, responses of REW, the published GIR data
//! set, SOFA files, and HDF5 files by a mapping.

mod batch;
mod gir;
mod hdf5;
mod hdf5_file;
mod hdf5_mapping;
mod positions;
mod response;
mod rew;
mod sofa;
mod take_repeats;
mod take_summary;
mod wav;
mod wav_file;
mod wav_layout;
mod wav_manifest;
mod wav_search;

use std::path::{Path, PathBuf};

use echolake_acquisition::run::recorder::random_tag;
use echolake_schema::manifest::{Origin, RunManifest};
use echolake_schema::{ErrorCause, ProjectName, Rig, RunId, SurfaceId, SurfaceRecord, Timestamp};

pub use gir::{GIR_IR_LEN, import_gir};
pub use hdf5::{check_hdf5, import_hdf5};
pub use rew::{check_rew, import_rew};
pub use sofa::{check_sofa, import_sofa};
pub use wav::{check_wav, import_wav, sampling_rate_of};
pub use wav_file::DryWav;
pub use wav_manifest::{ManifestColumns, scale_of_manifest};

/// Interval between the beginnings of runs whose files have no times, s: as they would be measured.
const RUN_SECS: f64 = 36_600.0;

/// A run made of imported files.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportedRun {
    /// Its file.
    pub path: PathBuf,
    /// Its name.
    pub run_id: RunId,
    /// Its surface.
    pub surface: SurfaceId,
    /// Measurements in it.
    pub measurements: usize,
    /// Takes that were rejected: they get no rows in the tables.
    pub rejected: usize,
    /// Faults of the imported files, as texts; they were imported all the same.
    pub warnings: Vec<String>,
    /// What the takes have in common: clocks, distortion.
    pub notes: Vec<String>,
}

/// Settings of an import.
#[derive(Debug, Clone, Copy)]
pub struct ImportOptions<'a> {
    /// Time of measurements without one.
    pub started: Timestamp,
    /// Folder of the runs' files.
    pub folder: &'a Path,
    /// The project that all runs belong to.
    pub project: Option<&'a ProjectName>,
}

impl ImportOptions<'_> {
    /// Makes the record of a surface that nothing else is known of.
    fn surface_record(&self, typology: &str) -> SurfaceRecord {
        let project = self.project.cloned();
        SurfaceRecord { typology: typology.to_owned(), project, ..SurfaceRecord::default() }
    }
}

/// An error that refuses an import. Nothing of it is left behind.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The system refused.
    #[error("cannot read `{}`: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: ErrorCause,
    },
    /// The manifest has a wrong header.
    #[error(
        "manifest `{}`: {what}; hint: the columns are {}",
        path.display(), columns.join(", ")
    )]
    Header {
        /// The manifest.
        path: PathBuf,
        /// The fault.
        what: String,
        /// The columns that it may have.
        columns: &'static [&'static str],
    },
    /// A row of the manifest is wrong.
    #[error("manifest `{}`, line {line}, column `{column}`: {what}", path.display())]
    Row {
        /// The manifest.
        path: PathBuf,
        /// The line, 1 the header's.
        line: u64,
        /// The column.
        column: &'static str,
        /// The fault, with expected and actual value.
        what: String,
    },
    /// The content of a file is wrong.
    #[error("`{}`: {place}: {actual}, expected {expected}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The array, variable or line.
        place: String,
        /// The actual content.
        actual: String,
        /// The expected content.
        expected: String,
    },
    /// A WAV file cannot be read.
    #[error("{fault}")]
    WavFile {
        /// The file, and its fault.
        fault: String,
    },
    /// The run cannot be recorded.
    #[error(transparent)]
    Record(#[from] echolake_acquisition::run::recorder::Error),
    /// The rig's settings make no plan.
    #[error("rig `{rig}` does not fit: {cause}")]
    Plan {
        /// The rig.
        rig: String,
        /// The cause.
        #[source]
        cause: echolake_dsp::Error,
    },
    /// A name or rig is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
}

fn content_error(
    path: &Path,
    place: impl Into<String>,
    actual: impl Into<String>,
    expected: impl Into<String>,
) -> Error {
    Error::Content { path: path.to_owned(), place: place.into(), actual: actual.into(), expected: expected.into() }
}

/// Makes the manifest of an imported run.
fn make_manifest(origin: Origin, surface: &SurfaceId, rig: &Rig, started: Timestamp) -> Result<RunManifest, Error> {
    Ok(RunManifest {
        run_id: RunId::compose(started, surface, random_tag())?,
        surface_id: surface.clone(),
        started,
        software: concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned(),
        rig: rig.name.clone(),
        origin,
    })
}
