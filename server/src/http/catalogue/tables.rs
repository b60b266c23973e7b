//! Tables: what can be asked, with units, and the Parquet files of their snapshot.

use arrow::datatypes::Field;
use echolake_schema::tables::{COMMENT, Table as Known, UNIT};
use serde::Serialize;

use super::asked::{Asked, missing};
use super::content::Content;
use crate::fault::Fault;

#[derive(Serialize)]
struct Table {
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

/// The tables and views.
pub(super) async fn tables(asked: Asked) -> Result<Content, Fault> {
    let table = |(name, schema): (_, arrow::datatypes::SchemaRef)| Table {
        name,
        columns: schema.fields().iter().map(|f| Column::of(f)).collect(),
    };
    Content::json(&asked.catalogue.service().tables().into_iter().map(table).collect::<Vec<_>>())
}

#[derive(Serialize)]
struct File<'a> {
    file: &'a str,
    bytes: u64,
    rows: Option<u64>,
}

/// The Parquet files of a table.
pub(super) async fn files(asked: Asked) -> Result<Content, Fault> {
    let files = asked.view.snapshot.files(table(asked.part("table"))?).iter();
    let file = |file: &'_ echolake_lake::DataFile| {
        let rows = Some(file.visible_rows());
        file.path.filename().map(|name| (name.to_owned(), file.bytes, rows))
    };
    let files: Vec<_> = files.filter_map(file).collect();
    let files = files.iter().map(|(file, bytes, rows)| File { file, bytes: *bytes, rows: *rows });
    Content::json(&files.collect::<Vec<_>>())
}

/// The table of a name.
pub(in super::super) fn table(name: &str) -> Result<Known, Fault> {
    Known::by_name(name).ok_or_else(|| missing(format!("table `{name}`"), "GET /api/v1/tables lists what there is"))
}
