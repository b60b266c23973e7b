//! The tables of what users add to a lake.

use std::sync::Arc;

use arrow_schema::{DataType, Field};

use super::column::{Column, LIST_CHILD};
use crate::Rig;

fn seen_version() -> Column {
    let comment = "Version of the lake that the author saw; of an author whose token has projects, the newest that \
                   added a run of theirs";
    Column::long("lake_version", "", comment).or_null()
}

fn project_column(of: &str) -> Column {
    Column::text("project", &format!("Project of {of}, whose tokens see the row; null if it has none")).or_null()
}

/// The columns of `annotations`: one row per annotation.
pub(super) fn annotation_columns() -> Vec<Column> {
    let pairs = DataType::List(Arc::new(Field::new(LIST_CHILD, DataType::Int32, false)));
    vec![
        Column::text("surface_id", "Surface of the run"),
        Column::text("run_id", "Run that is meant"),
        project_column("the run"),
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
    ]
}

/// The columns of `predictions`: one row per model, version of the model, surface, project and pair.
pub(super) fn prediction_columns(bands: &[String]) -> Vec<Column> {
    let values = predicted_names(bands).into_iter().map(|name| {
        Column::double(name, "1", "Prediction of the column of this name in tnce, linear; null if it was not predicted")
            .or_null()
    });
    let keys = [
        Column::text("surface_id", "Surface"),
        Column::text("run_id", "Newest run of the surface that the author saw"),
        project_column("the surface's runs that are meant"),
        Column::text("model", "Name of the model"),
        Column::text("model_version", "Version of the model"),
        Column::int("pair_id", "", "Pair of grid points"),
    ];
    let origin = [
        Column::text("author", "Client who sent it, as the server knows it"),
        Column::time("predicted", "Time at which the server took it"),
        seen_version(),
    ];
    keys.into_iter().chain(values).chain(origin).collect()
}

/// The columns of `tnce` that models predict.
pub fn predicted_columns(rig: &Rig) -> Vec<String> {
    predicted_names(&rig.band_names())
}

fn predicted_names(bands: &[String]) -> Vec<String> {
    let over_total = bands.iter().map(|band| format!("tnce_{band}")).chain(["tnce_total".to_owned()]);
    over_total.chain(bands.iter().map(|band| format!("tnce_band_{band}"))).collect()
}
