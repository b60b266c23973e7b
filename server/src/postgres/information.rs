//! `information_schema` with Postgres' names of types, by which clients choose kinds of columns. Over the other protocols
//! it has Arrow's.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use arrow::array::{AsArray as _, StringArray};
use arrow::compute::cast;
use arrow::datatypes::DataType;
use arrow_pg::datatypes::into_pg_type;
use async_trait::async_trait;
use datafusion::catalog::information_schema::InformationSchemaProvider;
use datafusion::catalog::{CatalogProviderList, SchemaProvider, TableFunction, TableProvider};
use datafusion::error::Result;
use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::{ColumnarValue, Volatility, ident};
use datafusion::prelude::create_udf;
use pgwire::api::Type;

use super::catalog::view;

const COLUMNS: &str = "columns";
const TYPE: &str = "data_type";

/// DataFusion's, of a query's catalogues.
#[derive(Debug)]
pub(super) struct InformationSchema {
    /// Of which one holds this.
    catalogs: Weak<dyn CatalogProviderList>,
    functions: HashMap<String, Arc<TableFunction>>,
}

impl InformationSchema {
    /// For queries that begin in this state.
    pub(super) fn of(state: &SessionState) -> Self {
        Self { catalogs: Arc::downgrade(state.catalog_list()), functions: state.table_functions().clone() }
    }

    fn inner(&self) -> Option<InformationSchemaProvider> {
        let catalogs = self.catalogs.upgrade()?;
        Some(InformationSchemaProvider::new(catalogs).with_table_functions(self.functions.clone()))
    }
}

#[async_trait]
impl SchemaProvider for InformationSchema {
    fn table_names(&self) -> Vec<String> {
        self.inner().map(|inner| inner.table_names()).unwrap_or_default()
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>> {
        let Some(inner) = self.inner() else { return Ok(None) };
        match (name, inner.table(name).await?) {
            (COLUMNS, Some(table)) => Ok(Some(with_names(table)?)),
            (_, table) => Ok(table),
        }
    }

    fn table_exist(&self, name: &str) -> bool {
        self.inner().is_some_and(|inner| inner.table_exist(name))
    }
}

fn with_names(table: Arc<dyn TableProvider>) -> Result<Arc<dyn TableProvider>> {
    let (text, own) = (DataType::Utf8, table.schema());
    let name = create_udf("type_name", vec![text.clone()], text, Volatility::Immutable, Arc::new(names));
    let columns = own.fields().iter().map(|field| match field.name().as_str() {
        TYPE => name.call(vec![ident(TYPE)]).alias(TYPE),
        other => ident(other),
    });
    view(COLUMNS, table, columns)
}

fn names(args: &[ColumnarValue]) -> Result<ColumnarValue> {
    let kinds = cast(&ColumnarValue::values_to_arrays(args)?[0], &DataType::Utf8)?;
    let names: StringArray = kinds.as_string::<i32>().iter().map(|kind| kind.map(name)).collect();
    Ok(ColumnarValue::Array(Arc::new(names)))
}

// A type's name in `information_schema` of Postgres. What cannot be sent there keeps Arrow's.
fn name(arrow: &str) -> String {
    let kind = arrow.parse::<DataType>().ok().and_then(|kind| into_pg_type(&kind).ok());
    let name = match &kind {
        None => arrow,
        Some(Type::BOOL) => "boolean",
        Some(Type::INT2) => "smallint",
        Some(Type::INT4) => "integer",
        Some(Type::INT8) => "bigint",
        Some(Type::FLOAT4) => "real",
        Some(Type::FLOAT8) => "double precision",
        Some(Type::TIMESTAMP) => "timestamp without time zone",
        Some(Type::TIMESTAMPTZ) => "timestamp with time zone",
        Some(Type::TIME) => "time without time zone",
        // Postgres writes a type of arrays so.
        Some(list) if list.name().starts_with('_') => "ARRAY",
        Some(other) => other.name(),
    };
    name.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_of_the_lake_have_names_of_postgres() {
        let list = |kind: DataType| DataType::new_list(kind, false);
        for (kind, expected) in [
            (DataType::Utf8, "text"),
            (DataType::Boolean, "boolean"),
            (DataType::Int16, "smallint"),
            (DataType::Int32, "integer"),
            (DataType::Int64, "bigint"),
            (DataType::UInt64, "numeric"),
            (DataType::Float32, "real"),
            (DataType::Float64, "double precision"),
            (DataType::Binary, "bytea"),
            (list(DataType::Float32), "ARRAY"),
            (list(list(DataType::Float32)), "List(non-null List(non-null Float32))"),
        ] {
            assert_eq!(name(&kind.to_string()), expected, "{kind}");
        }
        assert_eq!(name("Timestamp(µs, \"UTC\")"), "timestamp with time zone");
        assert_eq!(name("Timestamp(ms)"), "timestamp without time zone");
        assert_eq!(name("List(non-null Float32, field: 'element')"), "ARRAY");
    }
}
