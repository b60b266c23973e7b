//! Height maps of a training set: one row per surface and symmetry, joined by both.

use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, StringArray};
use arrow::compute::filter_record_batch;
use arrow::datatypes::{DataType, Schema, SchemaRef};
use arrow::record_batch::RecordBatch;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::tables::Table;

use super::SplitPart;
use super::columns::{described_field, list_type};
use super::measurements::fixed_lists;
use super::surfaces::TrainingSurface;
use crate::error::{Error, Result};
use crate::rows;

/// The schema of the files of height maps.
pub(super) fn height_map_schema() -> Result<SchemaRef> {
    Ok(Arc::new(Schema::new(vec![
        described_field("surface_id", DataType::Utf8, "", "The surface"),
        described_field("symmetry", DataType::Utf8, "", "What the map is turned by, as the measurements' column says"),
        described_field("split", DataType::Utf8, "", "train, validation or test"),
        described_field("group", DataType::Utf8, "", "Physical panel"),
        described_field("size_mm", DataType::Float32, "mm", "Edge of the square"),
        described_field(
            "heights_mm",
            list_type(Table::HEIGHTMAP_CELLS * Table::HEIGHTMAP_CELLS)?,
            "mm",
            "Mean height of each cell: 128 rows along y, each of 128 along x, both ascending",
        ),
    ])))
}

/// Reads a surface's height maps under these symmetries; None if it has none.
pub(super) async fn read_height_maps(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    surface: &TrainingSurface,
    part: SplitPart,
    symmetries: &[&str],
) -> Result<Option<RecordBatch>> {
    let columns = ["symmetry", "size_mm", "heights_mm"];
    for run in surface.runs.iter().rev() {
        let batch = rows::of_run(lake, snapshot, Table::Heightmaps, &run.visible.run, &columns).await?;
        let wanted = rows::text_column(&batch, "symmetry").into_iter().map(|s| Some(symmetries.contains(&s))).collect();
        let failed = |e: arrow::error::ArrowError| Error::damaged(format!("heightmaps, {}", surface.id), e);
        let batch = filter_record_batch(&batch, &wanted).map_err(failed)?;
        if batch.num_rows() > 0 {
            return arranged_batch(surface, part, &batch).map_err(failed).map(Some);
        }
    }
    Ok(None)
}

fn arranged_batch(
    surface: &TrainingSurface,
    part: SplitPart,
    batch: &RecordBatch,
) -> std::result::Result<RecordBatch, arrow::error::ArrowError> {
    let schema = height_map_schema().map_err(|e| arrow::error::ArrowError::SchemaError(e.to_string()))?;
    let count = batch.num_rows();
    let same = |text: &str| -> ArrayRef { Arc::new(StringArray::from_iter_values(std::iter::repeat_n(text, count))) };
    let lists = batch.column(2).as_list::<i32>();
    let from = lists.value_offsets()[0] as usize;
    let to = lists.value_offsets()[lists.len()] as usize;
    let heights = fixed_lists(lists.values().slice(from, to - from), schema.field(5).data_type())?;
    let columns = vec![
        same(surface.id.as_str()),
        batch.column(0).clone(),
        same(part.name()),
        same(surface.id.panel()),
        batch.column(1).clone(),
        heights,
    ];
    RecordBatch::try_new(schema, columns)
}
