//! Rows of tables `environment` and `events`.

use arrow::record_batch::RecordBatch;
use echolake_schema::Rig;
use echolake_schema::messages::AmbientSample;
use echolake_schema::tables::Table;

use super::{RowColumns, RunKeys};
use crate::CODE_VERSION;
use crate::error::Result;
use crate::measure::Event;

/// Builds one row per reading.
pub(crate) fn environment(rig: &Rig, keys: &RunKeys, readings: &[(i64, AmbientSample)]) -> Result<RecordBatch> {
    let mut columns = RowColumns::of_run(Table::Environment, readings.len(), keys);
    columns
        .times(readings.iter().map(|r| r.0))
        .doubles(readings.iter().map(|r| Some(r.1.temperature_c)))
        .doubles(readings.iter().map(|r| Some(r.1.humidity_pct)))
        .doubles(readings.iter().map(|r| Some(r.1.pressure_hpa)))
        .floats(readings.iter().map(|r| Some(r.1.outside_level_db as f32)))
        .same(CODE_VERSION);
    columns.finish(rig)
}

/// Builds one row per log line.
pub(crate) fn events(rig: &Rig, keys: &RunKeys, events: &[(i64, Event)]) -> Result<RecordBatch> {
    let mut columns = RowColumns::of_run(Table::Events, events.len(), keys);
    columns
        .times(events.iter().map(|e| e.0))
        .texts(events.iter().map(|e| Some(e.1.level_name())))
        .texts(events.iter().map(|e| Some(&e.1.name)))
        .texts(events.iter().map(|e| Some(&e.1.message)))
        .same(CODE_VERSION);
    columns.finish(rig)
}
