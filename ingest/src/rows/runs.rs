//! The row of table `runs`, and its update when references arrive.

use std::sync::Arc;

use arrow::array::{ArrayRef, StringArray};
use arrow::record_batch::RecordBatch;
use echolake_lake::Lake;
use echolake_schema::tables::Table;

use super::{RowColumns, RunKeys};
use crate::CODE_VERSION;
use crate::error::{Error, Result};
use crate::run_content::RunContent;

/// The columns of a run's row about its references.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct RunReferences {
    /// Description of missing references; empty if none is missing.
    pub(crate) missing: String,
    pub(crate) derivation: Option<String>,
    pub(crate) flat_version: Option<String>,
    pub(crate) foam_version: Option<String>,
}

/// State of a run with all of its rows.
const COMPLETE: &str = "complete";
/// State of a run whose references are missing.
const WAITING: &str = "waiting";
/// State of a run whose file was cut off or is damaged.
const PARTIAL: &str = "partial";

/// Builds the row of a newly ingested run.
pub(crate) fn row(
    lake: &Lake,
    keys: &RunKeys,
    content: &RunContent,
    run_derivation: &str,
    references: &RunReferences,
) -> Result<RecordBatch> {
    let ended = content.end.map_or(content.last_time_ns.max(content.manifest.started.0), |e| e.ended.0);
    let partial = !content.is_whole() || !content.damaged.is_empty();
    let state = if partial { PARTIAL } else { state(references) };
    let mut columns = RowColumns::of_run(Table::Runs, 1, keys);
    columns
        .text(Some(state))
        .text(Some(&references.missing))
        .text(Some(content.manifest.origin.label()))
        .text(Some(&content.manifest.rig))
        .times([content.manifest.started.0])
        .times([ended])
        .longs([Some(content.accepted.len() as i64)])
        .longs([Some(content.rejected as i64)])
        .longs([Some(content.attempts as i64)])
        .longs([Some(content.damaged.len() as i64)]);
    for of in [
        |(m, _): &(echolake_schema::messages::Measurement, _)| m.temperature_c,
        |(m, _): &(echolake_schema::messages::Measurement, _)| m.humidity_pct,
        |(m, _): &(echolake_schema::messages::Measurement, _)| m.pressure_hpa,
    ] {
        let values = || content.accepted.iter().map(of).filter(|x: &f64| x.is_finite());
        columns.floats([values().reduce(f64::min).map(|x| x as f32)]);
        columns.floats([values().reduce(f64::max).map(|x| x as f32)]);
    }
    columns
        .text(Some(Lake::run_path(&keys.surface, &keys.run).as_ref()))
        .longs([Some(content.integrity.bytes as i64)])
        .text(Some(&content.integrity.sha256))
        .text(Some(&content.manifest.software))
        .text(Some(run_derivation))
        .text(references.derivation.as_deref())
        .text(references.flat_version.as_deref())
        .text(references.foam_version.as_deref())
        .text(Some(CODE_VERSION));
    columns.finish(lake.rig())
}

/// Returns a run's row with other references.
pub(crate) fn with_references(row: &RecordBatch, references: &RunReferences) -> Result<RecordBatch> {
    let was_partial = text_of(row, "state").as_deref() == Some(PARTIAL);
    let mut columns = row.columns().to_vec();
    for (name, value) in [
        ("state", Some(if was_partial { PARTIAL } else { state(references) })),
        ("missing", Some(references.missing.as_str())),
        ("reference_derivation", references.derivation.as_deref()),
        ("flat_version", references.flat_version.as_deref()),
        ("foam_version", references.foam_version.as_deref()),
        ("code_version", Some(CODE_VERSION)),
    ] {
        let index = row.schema().index_of(name).map_err(damaged)?;
        let array: ArrayRef = Arc::new(StringArray::from(vec![value]));
        columns[index] = array;
    }
    RecordBatch::try_new(row.schema(), columns).map_err(damaged)
}

/// Returns a text of the row.
pub(crate) fn text_of(row: &RecordBatch, column: &str) -> Option<String> {
    use arrow::array::{Array as _, AsArray as _};
    let array = row.column_by_name(column)?.as_string_opt::<i32>()?;
    (array.len() == 1 && array.is_valid(0)).then(|| array.value(0).to_owned())
}

fn state(references: &RunReferences) -> &'static str {
    if references.missing.is_empty() { COMPLETE } else { WAITING }
}

fn damaged(error: arrow::error::ArrowError) -> Error {
    Error::DataFile { file: "tables/runs".into(), reason: error.to_string() }
}
