//! Rows of tables `environment` and `events`.

use arrow::record_batch::RecordBatch;
use echolake_schema::Rig;
use echolake_schema::messages::AmbientSample;
use echolake_schema::tables::Table;

use super::RunKeys;
use crate::error::Result;
use crate::reading::Event;

/// Builds one row per reading.
pub(crate) fn environment_rows(rig: &Rig, keys: &RunKeys, readings: &[(i64, AmbientSample)]) -> Result<RecordBatch> {
    let rows = keys
        .begin_rows(Table::Environment, rig, readings.len())
        .push_times("log_time", readings.iter().map(|r| r.0))
        .push_doubles("temperature_c", readings.iter().map(|r| r.1.temperature_c))
        .push_doubles("humidity_pct", readings.iter().map(|r| r.1.humidity_pct))
        .push_doubles("pressure_hpa", readings.iter().map(|r| r.1.pressure_hpa))
        .push_floats("outside_level_db", readings.iter().map(|r| r.1.outside_level_db as f32))
        .finish()?;
    Ok(rows)
}

/// Builds one row per log line.
pub(crate) fn event_rows(rig: &Rig, keys: &RunKeys, events: &[(i64, Event)]) -> Result<RecordBatch> {
    let rows = keys
        .begin_rows(Table::Events, rig, events.len())
        .push_times("log_time", events.iter().map(|e| e.0))
        .push_texts("level", events.iter().map(|e| e.1.level_name()))
        .push_texts("name", events.iter().map(|e| &e.1.name))
        .push_texts("message", events.iter().map(|e| &e.1.message))
        .finish()?;
    Ok(rows)
}
