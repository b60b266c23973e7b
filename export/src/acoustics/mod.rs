//! Formats that acousticians exchange: SOFA and npz of a surface's responses, WAV of its recordings, materials.

mod listening;
mod materials;
mod npz;
mod sofa;
mod wav;

use std::path::Path;

use arrow::array::{AsArray as _, BooleanArray};
use arrow::compute::filter_record_batch;
use arrow::datatypes::{Float32Type, Float64Type, Int32Type, Int64Type};
use arrow::error::ArrowError;
use arrow::record_batch::RecordBatch;
use echolake_lake::{Lake, LakeSnapshot, VisibleRun};
use echolake_schema::SurfaceId;
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::tables::Table;

use crate::error::{Error, Result};
use crate::output::{PendingFolder, WrittenFile};
use crate::rows;
pub use listening::{DryRecording, ListenedResponse, SoundLevel, write_sounds};
pub use materials::{MaterialBand, MaterialFormat, format_materials};
pub use wav::write_wav;

/// The responses of one run, in the order of their pairs.
struct SurfaceResponses {
    run: VisibleRun,
    pairs: Vec<u32>,
    log_time_ns: Vec<i64>,
    celsius: Vec<f64>,
    /// `[pairs x length]`
    samples: Vec<f32>,
    length: usize,
}

/// File format of a surface's responses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResponseFormat {
    /// AES69 SOFA, convention SingleRoomSRIR 1.0: one file per surface.
    Sofa,
    /// NumPy archives in the layout of the GIR data set, which `import gir` reads.
    Npz,
}

/// Writes the responses of each surface's newest run into a new folder; an empty list of surfaces means all of them.
/// Measurements that the last verdict rejects are left out.
/// `progress` is called with the number of surfaces done and their total.
///
/// # Errors
/// [`Error::Unknown`] for a surface that the lake does not have, and others; nothing is left behind.
pub async fn write_responses(
    lake: &Lake,
    folder: &Path,
    format: ResponseFormat,
    surfaces: &[SurfaceId],
    progress: &mut (dyn FnMut(usize, usize) + Send),
) -> Result<Vec<WrittenFile>> {
    let snapshot = lake.whole_snapshot().await?;
    let rejected = lake.read_rejections(&snapshot).await?;
    let runs = newest_runs(&snapshot, surfaces, &rejected)?;
    let pending = PendingFolder::create(folder)?;
    let mut files = Vec::new();
    for (done, run) in runs.iter().enumerate() {
        let responses = SurfaceResponses::read_run(lake, &snapshot, run, &rejected).await?;
        match format {
            ResponseFormat::Sofa => files.push(sofa::write_sofa(lake, &responses, &pending)?),
            ResponseFormat::Npz => files.extend(npz::write_npz(lake, &snapshot, &responses, &pending).await?),
        }
        progress(done + 1, runs.len());
    }
    if format == ResponseFormat::Npz {
        files.extend(npz::write_descriptions(lake, &snapshot, &runs, &pending).await?);
    }
    pending.publish()?;
    Ok(files)
}

/// Creates a SOFA file at `path`, of rows of a run's measurements with the columns [`SOFA_COLUMNS`].
///
/// # Errors
/// [`Error::Damaged`] if a response is not of the rig's length, and others.
pub fn write_sofa_file(lake: &Lake, run: &VisibleRun, rows: &RecordBatch, path: &Path) -> Result<()> {
    let responses = SurfaceResponses::from_rows(lake, run, rows)?;
    sofa::create_sofa(path, lake, &responses).map_err(|e| Error::write(path, e))
}

/// The columns of `measurements` that a SOFA file is made of.
pub const SOFA_COLUMNS: [&str; 4] = ["pair_id", "log_time_ns", "temperature_c", "ir"];

// The newest run of each surface that is not rejected, sorted by surface id.
fn newest_runs(
    snapshot: &LakeSnapshot,
    surfaces: &[SurfaceId],
    rejected: &RejectedMeasurements,
) -> Result<Vec<VisibleRun>> {
    let mut newest: std::collections::BTreeMap<&SurfaceId, &VisibleRun> = std::collections::BTreeMap::new();
    let accepted = snapshot.runs().filter(|run| !rejected.is_run_rejected(run.run.as_str()));
    newest.extend(accepted.map(|run| (&run.surface, run)));
    if let Some(unknown) = surfaces.iter().find(|s| !newest.contains_key(s)) {
        let known = newest.keys().take(20).map(|s| s.as_str()).collect::<Vec<_>>().join(", ");
        return Err(Error::Unknown { kind: "surface", name: unknown.to_string(), known });
    }
    if newest.is_empty() {
        return Err(Error::Nothing { reason: "the lake has no accepted runs; hint: `echolake ingest`".into() });
    }
    newest.retain(|surface, _| surfaces.is_empty() || surfaces.contains(surface));
    Ok(newest.into_values().cloned().collect())
}

impl SurfaceResponses {
    async fn read_run(
        lake: &Lake,
        snapshot: &LakeSnapshot,
        run: &VisibleRun,
        rejected: &RejectedMeasurements,
    ) -> Result<Self> {
        let batch = rows::of_run(lake, snapshot, Table::Measurements, &run.run, &SOFA_COLUMNS).await?;
        let pairs = rows::number_column::<Int32Type>(&batch, "pair_id")?.iter();
        let is_kept = |pair: &i32| !rejected.is_rejected(run.run.as_str(), pair.cast_unsigned());
        let kept: BooleanArray = pairs.map(|pair| Some(is_kept(pair))).collect();
        let damaged = |e: ArrowError| Error::damaged(format!("measurements, run {}", run.run), e);
        Self::from_rows(lake, run, &filter_record_batch(&batch, &kept).map_err(damaged)?)
    }

    fn from_rows(lake: &Lake, run: &VisibleRun, batch: &RecordBatch) -> Result<Self> {
        let damaged = |reason: String| Error::damaged(format!("measurements, run {}", run.run), reason);
        let ids = rows::number_column::<Int32Type>(batch, "pair_id")?;
        let times = rows::number_column::<Int64Type>(batch, "log_time_ns")?;
        let temperatures = rows::number_column::<Float64Type>(batch, "temperature_c")?;
        let lists = batch.column_by_name("ir").and_then(|c| c.as_list_opt::<i32>());
        let lists = lists.ok_or_else(|| damaged("no `ir`".into()))?;
        let values = lists.values().as_primitive::<Float32Type>().values();
        let length = lake.rig().impulse_response.length;
        let mut order: Vec<usize> = (0..ids.len()).collect();
        order.sort_by_key(|row| ids[*row]);
        let mut samples = Vec::with_capacity(ids.len() * length);
        for row in &order {
            let from = lists.value_offsets()[*row] as usize;
            let to = lists.value_offsets()[row + 1] as usize;
            if to - from != length {
                return Err(damaged(format!("a response has {} samples, expected {length}", to - from)));
            }
            samples.extend_from_slice(&values[from..to]);
        }
        let pairs: Vec<u32> = order.iter().map(|row| u32::try_from(ids[*row]).unwrap_or(u32::MAX)).collect();
        if let Some(pair) = pairs.iter().find(|p| **p as usize >= lake.grid().pairs().len()) {
            return Err(damaged(format!("pair {pair}, which the rig does not have")));
        }
        Ok(Self {
            run: run.clone(),
            pairs,
            log_time_ns: order.iter().map(|row| times[*row]).collect(),
            celsius: order.iter().map(|row| temperatures[*row]).collect(),
            samples,
            length,
        })
    }
}
