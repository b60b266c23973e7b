//! `GET /api/v1/tables`: what can be asked, with units.

use arrow::datatypes::Field;
use axum::Json;
use axum::extract::State;
use echolake_schema::tables::{COMMENT, UNIT};
use serde::Serialize;

use super::guard::MayQuery;
use crate::service::Service;

/// A table.
#[derive(Serialize)]
pub(super) struct Table {
    name: &'static str,
    columns: Vec<Column>,
}

#[derive(Serialize)]
struct Column {
    name: String,
    #[serde(rename = "type")]
    kind: String,
    nullable: bool,
    unit: Option<String>,
    comment: Option<String>,
}

impl Column {
    fn of(field: &Field) -> Self {
        let metadata = |key: &str| field.metadata().get(key).filter(|text| !text.is_empty()).cloned();
        Self {
            name: field.name().clone(),
            kind: field.data_type().to_string(),
            nullable: field.is_nullable(),
            unit: metadata(UNIT),
            comment: metadata(COMMENT),
        }
    }
}

/// The tables.
pub(super) async fn get(State(service): State<Service>, _: MayQuery) -> Json<Vec<Table>> {
    let table = |(name, schema): (_, arrow::datatypes::SchemaRef)| Table {
        name,
        columns: schema.fields().iter().map(|f| Column::of(f)).collect(),
    };
    Json(service.tables().into_iter().map(table).collect())
}
