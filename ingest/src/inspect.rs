//! A dry run of ingest on one run file: for tests of the reader against damaged files.

use std::sync::Arc;

use echolake_lake::Lake;
use echolake_schema::{RunId, SurfaceId};
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::Result;
use crate::files::Opened;
use crate::measure::Measurer;
use crate::pipeline::Cores;
use crate::run_content::RunContent;

/// The contents of a run's file.
#[derive(Debug, Clone, PartialEq)]
pub struct RunInspection {
    /// The run's id in the file.
    pub run: RunId,
    /// The surface's id in the file.
    pub surface: SurfaceId,
    /// Accepted measurements by pair.
    pub measurements: Vec<InspectedMeasurement>,
    /// Times of the ambient sensor's readings, ns since 1970, in file order.
    pub readings_ns: Vec<i64>,
    /// True if the file was closed and records how the run ended.
    pub whole: bool,
    /// Descriptions of what could not be read.
    pub damaged: Vec<String>,
}

/// An accepted measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct InspectedMeasurement {
    /// Pair.
    pub pair: u32,
    /// Attempt.
    pub attempt: u32,
    /// Response at the reference temperature, cropped to the rig's length.
    pub ir: Vec<f32>,
}

/// Reads a run's file as ingest does, and writes nothing.
///
/// # Errors
/// [`Error`](crate::Error) if ingest would refuse the whole file; the message names it.
pub async fn inspect(lake: &Lake, store: Arc<dyn ObjectStore>, path: &Path, name: &str) -> Result<RunInspection> {
    let opened = Opened { store, path: path.clone(), name: name.to_owned() };
    let content = RunContent::read(lake, &Arc::new(Measurer::new(lake)), &Cores::all()?, &opened).await?;
    let whole = content.is_whole();
    let inspected = content.accepted.into_iter().map(|(m, r)| InspectedMeasurement {
        pair: m.pair_id,
        attempt: m.attempt,
        ir: r.ir,
    });
    Ok(RunInspection {
        run: content.manifest.run_id,
        surface: content.manifest.surface_id,
        measurements: inspected.collect(),
        readings_ns: content.readings.iter().map(|r| r.0).collect(),
        whole,
        damaged: content.damaged,
    })
}
