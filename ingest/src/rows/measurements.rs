//! Rows of table `measurements`.

use arrow::record_batch::RecordBatch;
use echolake_lake::{EncodedFile, FileEncoder};
use echolake_schema::messages::Measurement;
use echolake_schema::tables::Table;
use echolake_schema::{Grid, PairId, Rig};

use super::{RunKeys, finite};
use crate::error::Result;
use crate::reading::Response;

/// Number of list values per batch; each batch is encoded before the next one is built.
const LIST_VALUES: usize = 1 << 18;

/// Encodes one row per measurement, in the given order, which is by pair.
pub(crate) fn encode(
    rig: &Rig,
    grid: &Grid,
    keys: &RunKeys,
    accepted: &[(Measurement, Response)],
) -> Result<EncodedFile> {
    let rows_a_batch = (LIST_VALUES / rig.impulse_response.length).max(1);
    let mut encoder = FileEncoder::new(Table::Measurements, Table::Measurements.schema(rig));
    for part in accepted.chunks(rows_a_batch) {
        encoder.write(&batch(rig, grid, keys, part)?)?;
    }
    Ok(encoder.finish()?)
}

fn batch(rig: &Rig, grid: &Grid, keys: &RunKeys, rows: &[(Measurement, Response)]) -> Result<RecordBatch> {
    let known = |value: f64| finite(value).map(|x| x as f32);
    let batch = keys
        .begin_rows(Table::Measurements, rig, rows.len())
        .pairs("", rows.iter().map(|(m, _)| grid.pair(PairId(m.pair_id))))
        .times("log_time", rows.iter().map(|(_, r)| r.log_time_ns))
        .ints("attempt", rows.iter().map(|(m, _)| m.attempt as i32))
        .texts("verdict", rows.iter().map(|(m, _)| m.verdict().label()))
        .texts("reasons", rows.iter().map(|(m, _)| m.reasons.join("; ")))
        .doubles("temperature_c", rows.iter().map(|(_, r)| r.temperature_c))
        .doubles("humidity_pct", rows.iter().map(|(m, _)| finite(m.humidity_pct)))
        .doubles("pressure_hpa", rows.iter().map(|(m, _)| finite(m.pressure_hpa)))
        .floats("outside_level_db", rows.iter().map(|(m, _)| known(m.outside_level_db)))
        .floats("snr_db", rows.iter().map(|(m, _)| known(m.snr_db)))
        .ints("clipped_samples", rows.iter().map(|(m, _)| m.clipped_samples as i32))
        .floats("arrival_error_us", rows.iter().map(|(m, _)| known(m.arrival_error_us)))
        .floats("microphone_residual_mm", rows.iter().map(|(m, _)| known(m.microphone_residual_mm)))
        .floats("speaker_residual_mm", rows.iter().map(|(m, _)| known(m.speaker_residual_mm)))
        .texts("source", rows.iter().map(|(_, r)| r.source.label()))
        .longs("chunk_offset", rows.iter().map(|(_, r)| r.chunk_offset as i64))
        .lists("ir", rows.iter().flat_map(|(_, r)| r.ir.iter().copied()).collect())
        .finish()?;
    Ok(batch)
}
