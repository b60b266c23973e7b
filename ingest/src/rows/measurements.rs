//! Rows of table `measurements`.

use arrow::record_batch::RecordBatch;
use echolake_lake::{EncodedFile, FileEncoder};
use echolake_schema::messages::Measurement;
use echolake_schema::tables::Table;
use echolake_schema::{Grid, PairId, Rig};

use super::{RowColumns, RunKeys};
use crate::CODE_VERSION;
use crate::error::Result;
use crate::measure::Response;

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
    let pair = |m: &Measurement| grid.pair(PairId(m.pair_id));
    let known = |value: f64| super::columns::finite(value);
    let mut columns = RowColumns::of_run(Table::Measurements, rows.len(), keys);
    columns
        .ints(rows.iter().map(|(m, _)| Some(m.pair_id as i32)))
        .ints(rows.iter().map(|(m, _)| pair(m).map(|p| p.microphone.0 as i32)))
        .ints(rows.iter().map(|(m, _)| pair(m).map(|p| p.speaker.0 as i32)))
        .times(rows.iter().map(|(_, r)| r.log_time_ns))
        .ints(rows.iter().map(|(m, _)| Some(m.attempt as i32)))
        .texts(rows.iter().map(|(m, _)| Some(m.verdict().label())))
        .texts(rows.iter().map(|(m, _)| Some(m.reasons.join("; "))))
        .doubles(rows.iter().map(|(_, r)| Some(r.temperature_c)))
        .doubles(rows.iter().map(|(m, _)| known(m.humidity_pct)))
        .doubles(rows.iter().map(|(m, _)| known(m.pressure_hpa)))
        .floats(rows.iter().map(|(m, _)| known(m.outside_level_db).map(|x| x as f32)))
        .floats(rows.iter().map(|(m, _)| known(m.snr_db).map(|x| x as f32)))
        .ints(rows.iter().map(|(m, _)| Some(m.clipped_samples as i32)))
        .floats(rows.iter().map(|(m, _)| known(m.arrival_error_us).map(|x| x as f32)))
        .floats(rows.iter().map(|(m, _)| known(m.microphone_residual_mm).map(|x| x as f32)))
        .floats(rows.iter().map(|(m, _)| known(m.speaker_residual_mm).map(|x| x as f32)))
        .texts(rows.iter().map(|(_, r)| Some(r.source.label())))
        .longs(rows.iter().map(|(_, r)| Some(r.chunk_offset as i64)))
        .lists(rows.iter().flat_map(|(_, r)| r.ir.iter().copied()).collect())
        .same(CODE_VERSION);
    columns.finish(rig)
}
