//! Tables: what can be asked, with units, and the Parquet files of their snapshot.

use arrow::datatypes::{Field, SchemaRef};
use axum::Extension;
use echolake_schema::tables::{COMMENT, Table, UNIT};
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::PathParams;
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, missing_item};

/// A table or view.
#[derive(Serialize, ToSchema)]
#[schema(as = Table)]
struct TableDescription {
    name: String,
    columns: Vec<ColumnDescription>,
}

/// A column.
#[derive(Serialize, ToSchema)]
#[schema(as = Column)]
pub(crate) struct ColumnDescription {
    name: String,
    /// As Arrow writes it.
    #[serde(rename = "type")]
    kind: String,
    nullable: bool,
    unit: Option<String>,
    comment: Option<String>,
}

impl ColumnDescription {
    /// The column of a field.
    pub fn from_field(field: &Field) -> Self {
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

/// Tables, columns, units, meanings; for completion.
///
/// Functions: select distinct routine_name from information_schema.routines
#[utoipa::path(
    get,
    path = "/api/v1/tables",
    tag = "sql",
    responses((status = 200, description = "OK", body = Vec<TableDescription>)),
    extensions(("x-sql" = json!(["the tables' own schemas"])))
)]
pub(super) async fn tables(Extension(request): Extension<CatalogueRequest>) -> EndpointAnswer {
    let table = |(name, schema): (String, SchemaRef)| TableDescription {
        name,
        columns: schema.fields().iter().map(|f| ColumnDescription::from_field(f)).collect(),
    };
    Ok(AnswerContent::encode_json(
        &request.catalogue.service().all_tables().into_iter().map(table).collect::<Vec<_>>(),
    )?)
}

/// The path of a table.
#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(super) struct TablePath {
    table: String,
}

/// A Parquet file.
#[derive(Serialize, ToSchema)]
struct TableFile<'a> {
    file: &'a str,
    bytes: u64,
    rows: Option<u64>,
}

/// The Parquet files of a table's snapshot; `GET /api/v1/files` counts the rows that are in none of them.
#[utoipa::path(
    get,
    path = "/api/v1/tables/{table}",
    tag = "files",
    params(TablePath),
    responses((status = 200, description = "OK", body = Vec<TableFile>)),
    extensions(("x-sql" = json!(["the commit log"])))
)]
pub(super) async fn table_files(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<TablePath>,
) -> EndpointAnswer {
    let table = find_table(&path.table)?;
    request.view.snapshot.check_table(table).map_err(|fault| RequestFault::Query(fault.into()))?;
    let files = request.view.snapshot.readable_files(table);
    let file = |file: &'_ echolake_lake::DataFile| {
        let rows = Some(file.visible_rows());
        file.path.filename().map(|name| (name.to_owned(), file.bytes, rows))
    };
    let files: Vec<_> = files.filter_map(file).collect();
    let files = files.iter().map(|(file, bytes, rows)| TableFile { file, bytes: *bytes, rows: *rows });
    Ok(AnswerContent::encode_json(&files.collect::<Vec<_>>())?)
}

/// The table of a name.
pub(crate) fn find_table(name: &str) -> Result<Table, RequestFault> {
    Table::by_name(name)
        .ok_or_else(|| missing_item(format!("table `{name}`"), "GET /api/v1/tables lists what there is"))
}
