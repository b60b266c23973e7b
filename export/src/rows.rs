//! Rows of one run, read directly from the files of a snapshot.

use arrow::array::{Array as _, AsArray as _};
use arrow::compute::concat_batches;
use arrow::datatypes::{ArrowPrimitiveType, Schema};
use arrow::record_batch::RecordBatch;
use echolake_lake::{DataFile, Lake, LakeSnapshot};
use echolake_schema::RunId;
use echolake_schema::tables::Table;
use futures::TryStreamExt as _;
use std::sync::Arc;

use crate::error::{Error, Result};

/// Reads the named columns of a run's rows in a table, in the table's order of columns.
pub(crate) async fn of_run(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    table: Table,
    run: &RunId,
    columns: &[&str],
) -> Result<RecordBatch> {
    let mut batches = Vec::new();
    for file in snapshot.files_of(table, run) {
        let rows = file.visible_parts().find(|(part, _)| part.run == *run).map_or(0..file.rows, |(_, rows)| rows);
        batches.extend(lake.read_rows(table, file, columns, rows).await?.try_collect::<Vec<_>>().await?);
    }
    concat_rows(lake, table, columns, &batches).map_err(|e| Error::damaged(format!("{}, run {run}", table.name()), e))
}

/// Reads the named columns of all rows of a file that readers see.
pub(crate) async fn of_file(lake: &Lake, table: Table, file: &DataFile, columns: &[&str]) -> Result<RecordBatch> {
    let mut batches = Vec::new();
    for range in file.visible_ranges() {
        batches.extend(lake.read_rows(table, file, columns, range).await?.try_collect::<Vec<_>>().await?);
    }
    concat_rows(lake, table, columns, &batches).map_err(|e| Error::damaged(&file.path, e))
}

fn concat_rows(
    lake: &Lake,
    table: Table,
    columns: &[&str],
    batches: &[RecordBatch],
) -> std::result::Result<RecordBatch, arrow::error::ArrowError> {
    let all = table.schema(lake.rig());
    let fields: Vec<_> = all.fields().iter().filter(|f| columns.contains(&f.name().as_str())).cloned().collect();
    concat_batches(&Arc::new(Schema::new(fields)), batches)
}

/// Returns the texts of a column without nulls; empty if the column is missing.
pub(crate) fn text_column<'a>(batch: &'a RecordBatch, column: &str) -> Vec<&'a str> {
    optional_texts(batch, column).into_iter().map(Option::unwrap_or_default).collect()
}

/// Returns the texts of a column.
pub(crate) fn optional_texts<'a>(batch: &'a RecordBatch, column: &str) -> Vec<Option<&'a str>> {
    let found = batch.column_by_name(column).and_then(|c| c.as_string_opt::<i32>());
    found.map(|array| array.iter().collect()).unwrap_or_default()
}

/// Returns the numbers of a column.
pub(crate) fn number_column<'a, T: ArrowPrimitiveType>(
    batch: &'a RecordBatch,
    column: &str,
) -> Result<&'a [T::Native]> {
    let found = batch.column_by_name(column).and_then(|c| c.as_primitive_opt::<T>());
    let found = found.filter(|array| array.null_count() == 0);
    found
        .map(|array| array.values().as_ref())
        .ok_or_else(|| Error::damaged(column, "the column is not as it should be"))
}
