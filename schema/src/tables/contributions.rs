//! The tables of what users add to a lake.

use std::sync::Arc;

use arrow_schema::{DataType, Field, Schema, SchemaRef};

use super::column::{Column, LIST_CHILD};
use crate::Rig;

fn schema_of(columns: Vec<Column>) -> SchemaRef {
    Arc::new(Schema::new(columns.into_iter().map(Column::into_field).collect::<Vec<_>>()))
}

fn seen_version() -> Column {
    Column::long("lake_version", "", "Version of the lake that the author saw; null for tokens of projects").or_null()
}

/// The columns of `annotations`: one row per annotation.
pub fn annotation_schema() -> SchemaRef {
    let pairs = DataType::List(Arc::new(Field::new(LIST_CHILD, DataType::Int32, false)));
    schema_of(vec![
        Column::text("surface_id", "Surface of the run"),
        Column::text("run_id", "Run that is meant"),
        Column::new("pair_ids", pairs, "", "Pairs whose measurements are meant; null: the whole run").or_null(),
        Column::text("kind", "label, verdict or note"),
        Column::text(
            "value",
            "The label; accepted or rejected, of which the last on a measurement counts; empty for a note",
        ),
        Column::text("comment", "Reason or note"),
        Column::text("author", "Client who made it, as the server knows it"),
        Column::time("annotated", "Time at which the server took it"),
        seen_version(),
        Column::text("annotation_id", "Its name among those on the run; the same annotation sent again is stored once"),
    ])
}

/// The columns of `predictions`: one row per model, version of the model, surface and pair.
pub fn prediction_schema(rig: &Rig) -> SchemaRef {
    let values = predicted_columns(rig).into_iter().map(|name| {
        Column::double(name, "1", "Prediction of the column of this name in tnce, linear; null if it was not predicted")
            .or_null()
    });
    let keys = [
        Column::text("model", "Name of the model"),
        Column::text("model_version", "Version of the model"),
        Column::text("surface_id", "Surface"),
        Column::int("pair_id", "", "Pair of grid points"),
    ];
    let origin = [
        Column::text("author", "Client who sent it, as the server knows it"),
        Column::time("predicted", "Time at which the server took it"),
        seen_version(),
    ];
    schema_of(keys.into_iter().chain(values).chain(origin).collect())
}

/// The columns of `tnce` that models predict.
pub fn predicted_columns(rig: &Rig) -> Vec<String> {
    let bands = rig.band_names();
    let over_total = bands.iter().map(|band| format!("tnce_{band}")).chain(["tnce_total".to_owned()]);
    over_total.chain(bands.iter().map(|band| format!("tnce_band_{band}"))).collect()
}
