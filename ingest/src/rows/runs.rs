//! The row of table `runs`, and its update when references arrive.

use arrow::record_batch::RecordBatch;
use echolake_lake::{BatchBuilder, Lake};
use echolake_schema::messages::Measurement;
use echolake_schema::tables::Table;
use echolake_schema::{ProjectName, Rig};

use super::RunKeys;
use crate::error::Result;
use crate::reading::RunContent;

/// The columns of a run's row about its references.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct RunReferences {
    /// Description of missing references; empty if none is missing.
    pub missing: String,
    pub derivation: Option<String>,
    pub flat_version: Option<String>,
    pub foam_version: Option<String>,
}

/// State of a run with all of its rows.
const COMPLETE: &str = "complete";
/// State of a run whose references are missing.
const WAITING: &str = "waiting";
/// State of a run whose file was cut off or is damaged.
const PARTIAL: &str = "partial";

/// Builds the row of a newly ingested run.
pub(crate) fn new_run_row(
    lake: &Lake,
    keys: &RunKeys,
    content: &RunContent,
    run_derivation: &str,
    references: &RunReferences,
) -> Result<RecordBatch> {
    let ended = content.end.map_or(content.last_time_ns.max(content.manifest.started.0), |e| e.ended.0);
    let partial = !content.is_whole() || !content.damaged.is_empty();
    let mut columns = keys.begin_rows(Table::Runs, lake.rig(), 1);
    for (lowest, highest, of) in [
        ("temperature_min_c", "temperature_max_c", (|m| m.temperature_c) as fn(&Measurement) -> f64),
        ("humidity_min_pct", "humidity_max_pct", |m| m.humidity_pct),
        ("pressure_min_hpa", "pressure_max_hpa", |m| m.pressure_hpa),
    ] {
        let values = || content.accepted.iter().map(|(m, _)| of(m)).filter(|x| x.is_finite());
        columns.push_floats(lowest, [values().reduce(f64::min).map(|x| x as f32)]);
        columns.push_floats(highest, [values().reduce(f64::max).map(|x| x as f32)]);
    }
    columns
        .fill_text("origin", content.manifest.origin.label())
        .fill_text("project", content.surface.project.as_ref().map(ProjectName::as_str))
        .fill_text("rig", content.manifest.rig.as_str())
        .push_times("started", [content.manifest.started.0])
        .push_times("ended", [ended])
        .push_longs("measurements", [content.accepted.len() as i64])
        .push_longs("rejected", [content.rejected as i64])
        .push_longs("attempts", [content.attempts as i64])
        .push_longs("damaged", [content.damaged.len() as i64])
        .push_texts("file", [Lake::run_path(&keys.surface, &keys.run)])
        .push_longs("file_bytes", [content.integrity.bytes as i64])
        .fill_text("file_sha256", content.integrity.sha256.as_str())
        .fill_text("recorded_by", content.manifest.software.as_str())
        .fill_text("run_derivation", run_derivation);
    Ok(push_references(&mut columns, partial, references).finish()?)
}

/// Returns a run's row with other references.
pub(crate) fn with_references(
    rig: &Rig,
    keys: &RunKeys,
    row: &RecordBatch,
    references: &RunReferences,
) -> Result<RecordBatch> {
    let partial = text_of(row, "state").as_deref() == Some(PARTIAL);
    let mut columns = keys.begin_rows(Table::Runs, rig, 1);
    Ok(push_references(&mut columns, partial, references).take_rest(row).finish()?)
}

fn push_references<'a>(
    columns: &'a mut BatchBuilder,
    partial: bool,
    references: &RunReferences,
) -> &'a mut BatchBuilder {
    let state = match partial {
        true => PARTIAL,
        false if references.missing.is_empty() => COMPLETE,
        false => WAITING,
    };
    columns
        .fill_text("state", state)
        .fill_text("missing", references.missing.as_str())
        .fill_text("reference_derivation", references.derivation.as_deref())
        .fill_text("flat_version", references.flat_version.as_deref())
        .fill_text("foam_version", references.foam_version.as_deref())
}

/// Returns a text of the row.
pub(crate) fn text_of(row: &RecordBatch, column: &str) -> Option<String> {
    use arrow::array::{Array as _, AsArray as _};
    let array = row.column_by_name(column)?.as_string_opt::<i32>()?;
    (array.len() == 1 && array.is_valid(0)).then(|| array.value(0).to_owned())
}

/// Returns a whole number of the row.
pub(crate) fn number_of(row: &RecordBatch, column: &str) -> Option<i64> {
    use arrow::array::{Array as _, AsArray as _};
    let array = row.column_by_name(column)?.as_primitive_opt::<arrow::datatypes::Int64Type>()?;
    (array.len() == 1 && array.is_valid(0)).then(|| array.value(0))
}
