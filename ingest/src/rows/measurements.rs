//! Rows of table `measurements`.

use arrow::record_batch::RecordBatch;
use echolake_lake::{EncodedRows, FileEncoder};
use echolake_schema::messages::Measurement;
use echolake_schema::tables::Table;
use echolake_schema::{Grid, PairId, Rig};

use super::{RunKeys, finite_value};
use crate::error::Result;
use crate::reading::Response;

/// Number of list values per batch; each batch is encoded before the next one is built.
const LIST_VALUES: usize = 1 << 18;

/// Encodes one row per measurement, in the given order, which is by pair.
pub(crate) fn encode_measurements(
    rig: &Rig,
    grid: &Grid,
    keys: &RunKeys,
    accepted: &[(Measurement, Response)],
) -> Result<EncodedRows> {
    let rows_a_batch = (LIST_VALUES / rig.impulse_response.length).max(1);
    let mut encoder = FileEncoder::new(Table::Measurements, Table::Measurements.schema(rig));
    for part in accepted.chunks(rows_a_batch) {
        encoder.write_batch(&measurement_batch(rig, grid, keys, part)?)?;
    }
    Ok(encoder.finish_run()?)
}

fn measurement_batch(rig: &Rig, grid: &Grid, keys: &RunKeys, rows: &[(Measurement, Response)]) -> Result<RecordBatch> {
    let known = |value: f64| finite_value(value).map(|x| x as f32);
    let batch = keys
        .begin_rows(Table::Measurements, rig, rows.len())
        .push_pairs("", rows.iter().map(|(m, _)| grid.pair(PairId(m.pair_id))))
        .push_times("log_time", rows.iter().map(|(_, r)| r.log_time_ns))
        .push_ints("attempt", rows.iter().map(|(m, _)| m.attempt as i32))
        .push_texts("verdict", rows.iter().map(|(m, _)| m.verdict().label()))
        .push_texts("reasons", rows.iter().map(|(m, _)| m.reasons.join("; ")))
        .push_doubles("temperature_c", rows.iter().map(|(_, r)| r.air.temperature_c))
        .push_doubles("humidity_pct", rows.iter().map(|(m, _)| finite_value(m.humidity_pct)))
        .push_doubles("pressure_hpa", rows.iter().map(|(m, _)| finite_value(m.pressure_hpa)))
        .push_floats("outside_level_db", rows.iter().map(|(m, _)| known(m.outside_level_db)))
        .push_floats("snr_db", rows.iter().map(|(m, _)| known(m.snr_db)))
        .push_ints("clipped_samples", rows.iter().map(|(m, _)| m.clipped_samples as i32))
        .push_floats("arrival_error_us", rows.iter().map(|(m, _)| known(m.arrival_error_us)))
        .push_floats("clock_ratio_ppm", rows.iter().map(|(m, _)| m.clock_ratio_ppm.and_then(known)))
        .push_floats("repeat_difference_db", rows.iter().map(|(m, _)| m.repeat_difference_db.and_then(known)))
        .push_floats("microphone_residual_mm", rows.iter().map(|(m, _)| known(m.microphone_residual_mm)))
        .push_floats("speaker_residual_mm", rows.iter().map(|(m, _)| known(m.speaker_residual_mm)))
        .push_texts("source", rows.iter().map(|(_, r)| r.source.label()))
        .push_longs("chunk_offset", rows.iter().map(|(_, r)| r.chunk_offset as i64))
        .push_lists("ir", join_responses(rows))
        .push_optional_lists("measured_ir", rows.iter().map(|(_, r)| r.measured.as_deref()))
        .finish()?;
    Ok(batch)
}

/// Joins the samples of all responses, `[measurements x length]`.
pub(crate) fn join_responses(measured: &[(Measurement, Response)]) -> Vec<f32> {
    let mut samples = Vec::with_capacity(measured.iter().map(|(_, response)| response.ir.len()).sum());
    measured.iter().for_each(|(_, response)| samples.extend_from_slice(&response.ir));
    samples
}
