//! Tables: what can be asked, with units, and the Parquet files of their snapshot.

use arrow::datatypes::Field;
use echolake_schema::tables::{COMMENT, Table, UNIT};
use serde::Serialize;

use super::asked::{CatalogueRequest, missing};
use super::content::AnswerContent;
use crate::fault::RequestFault;

#[derive(Serialize)]
struct TableDescription {
    name: &'static str,
    columns: Vec<ColumnDescription>,
}

#[derive(Serialize)]
struct ColumnDescription {
    name: String,
    #[serde(rename = "type")]
    kind: String,
    nullable: bool,
    unit: Option<String>,
    comment: Option<String>,
}

impl ColumnDescription {
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
pub(super) async fn tables(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let table = |(name, schema): (_, arrow::datatypes::SchemaRef)| TableDescription {
        name,
        columns: schema.fields().iter().map(|f| ColumnDescription::of(f)).collect(),
    };
    AnswerContent::json(&asked.catalogue.service().tables().into_iter().map(table).collect::<Vec<_>>())
}

#[derive(Serialize)]
struct TableFile<'a> {
    file: &'a str,
    bytes: u64,
    rows: Option<u64>,
}

/// The Parquet files of a table.
pub(super) async fn files(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let files = asked.view.snapshot.files(table(asked.part("table"))?).iter();
    let file = |file: &'_ echolake_lake::DataFile| {
        let rows = Some(file.visible_rows());
        file.path.filename().map(|name| (name.to_owned(), file.bytes, rows))
    };
    let files: Vec<_> = files.filter_map(file).collect();
    let files = files.iter().map(|(file, bytes, rows)| TableFile { file, bytes: *bytes, rows: *rows });
    AnswerContent::json(&files.collect::<Vec<_>>())
}

/// The table of a name.
pub(in super::super) fn table(name: &str) -> Result<Table, RequestFault> {
    Table::by_name(name).ok_or_else(|| missing(format!("table `{name}`"), "GET /api/v1/tables lists what there is"))
}
