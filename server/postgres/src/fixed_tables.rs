//! The tables of `datafusion-pg-catalog` that are the same in every database, with the types that Postgres gives their
//! columns: there they are a real database's rows, but functions are texts and so are lists.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, OnceLock};

use arrow::array::{Array as _, ArrayRef, AsArray as _, Int32Array, ListBuilder, RecordBatch, StringBuilder};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Int32Type, Schema};
use arrow_pg::datatypes::PG_OID_ALIAS_KEY;
use datafusion::catalog::{CatalogProviderList, MemoryCatalogProviderList, SchemaProvider as _};
use datafusion::error::{DataFusionError, Result};
use datafusion_pg_catalog::pg_catalog::context::EmptyContextProvider;
use datafusion_pg_catalog::pg_catalog::{PgCatalogSchemaProvider, PgCatalogStaticTables, PgCatalogTable};

use super::catalog_tables::find_fixed_number;

/// The alias of columns that name a function, and their text for no function.
const FUNCTION: &str = "regproc";
const NO_FUNCTION: &str = "-";
/// Tables whose rows in the library are about what is not here.
const WITHOUT_ROWS: [&str; 2] = ["pg_collation", "pg_constraint"];
/// Columns of lists, by the types of their elements.
static LISTS: [(DataType, &str); 3] = [
    (
        DataType::Utf8,
        "defaclacl evttags extcondition fdwacl fdwoptions ftoptions initprivs lanacl lomacl proacl proargmodes \
         proargnames proconfig setconfig spcacl spcoptions srvacl srvoptions stxkind subpublications typacl umoptions",
    ),
    (DataType::Int16, "confdelsetcols confkey conkey indkey indoption partattrs prattrs stxkeys tgattr"),
    (
        DataType::Int32,
        "conexclop conffeqop conpfeqop conppeqop extconfig indclass indcollation partclass partcollation polroles \
         proallargtypes proargtypes protrftypes",
    ),
];
/// Lists that are written with spaces and without brackets, and the key of a field's metadata that says so.
const VECTORS: [&str; 5] = ["indclass", "indcollation", "indkey", "indoption", "proargtypes"];
pub(super) const VECTOR_KEY: &str = "pg.list_with_spaces";

/// Names of functions by their numbers, which are the same in every database.
static FUNCTION_NAMES: OnceLock<HashMap<i32, String>> = OnceLock::new();

/// Returns the name of a function as Postgres writes the value of a column that names one.
pub(super) fn function_name(number: i32) -> Option<&'static str> {
    match number {
        0 => Some(NO_FUNCTION),
        number => FUNCTION_NAMES.get()?.get(&number).map(String::as_str),
    }
}

/// Reads numbers by names, as of types or functions. Of functions with one name it is the first.
///
/// # Errors
/// If the table has no such column.
pub(super) fn read_numbers(batches: &[RecordBatch], name: &str) -> Result<HashMap<String, i32>> {
    let mut numbers = HashMap::new();
    for batch in batches {
        let oids = cast(find_column(batch, "oid")?, &DataType::Int32)?;
        let names = cast(find_column(batch, name)?, &DataType::Utf8)?;
        for (name, oid) in names.as_string::<i32>().iter().zip(oids.as_primitive::<Int32Type>()) {
            if let (Some(name), Some(oid)) = (name, oid) {
                numbers.entry(name.to_owned()).or_insert(oid);
            }
        }
    }
    Ok(numbers)
}

/// Returns a column.
///
/// # Errors
/// If there is none of this name.
pub(super) fn find_column<'a>(batch: &'a RecordBatch, name: &str) -> Result<&'a ArrayRef> {
    batch.column_by_name(name).ok_or_else(|| DataFusionError::Internal(format!("a table without a column `{name}`")))
}

/// Reads the library's tables by their names; [`function_name`] knows these functions from then on.
///
/// # Errors
/// If a table of the library is not as expected.
pub(super) fn read_fixed_tables(
    library: Arc<PgCatalogStaticTables>,
    functions: &HashMap<String, i32>,
) -> Result<BTreeMap<String, Vec<RecordBatch>>> {
    FUNCTION_NAMES.get_or_init(|| functions.iter().map(|(name, number)| (*number, name.clone())).collect());
    let nothing: Arc<dyn CatalogProviderList> = Arc::new(MemoryCatalogProviderList::new());
    let library = PgCatalogSchemaProvider::try_new(nothing, library, EmptyContextProvider)?;
    let mut tables = BTreeMap::new();
    for name in library.table_names() {
        let batches = match library.build_table_by_name(&name)? {
            Some(PgCatalogTable::Static(table))
                if !table.data().is_empty() && !WITHOUT_ROWS.contains(&name.as_str()) =>
            {
                table.data().to_vec()
            }
            Some(table @ (PgCatalogTable::Static(_) | PgCatalogTable::Empty(_))) => {
                vec![RecordBatch::new_empty(table.schema())]
            }
            _ => continue,
        };
        let number = find_fixed_number(&name).unwrap_or_default();
        let typed = batches.iter().map(|batch| with_types(batch, number, functions));
        tables.insert(name, typed.collect::<Result<_>>()?);
    }
    Ok(tables)
}

// The batch with Postgres' types, and with the columns that each of its tables has unseen.
fn with_types(batch: &RecordBatch, table: i32, functions: &HashMap<String, i32>) -> Result<RecordBatch> {
    let mut fields = Vec::new();
    let mut columns = Vec::new();
    for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
        let name = field.name().as_str();
        let column = match field.metadata().get(PG_OID_ALIAS_KEY) {
            _ if *field.data_type() != DataType::Utf8 => column.clone(),
            Some(alias) if alias == FUNCTION => function_numbers(column, functions),
            _ => match LISTS.iter().find(|(_, names)| names.split(' ').any(|known| known == name)) {
                Some((element, _)) => cast(&read_lists(column), &DataType::new_list(element.clone(), true))?,
                None => column.clone(),
            },
        };
        let mut metadata = field.metadata().clone();
        if VECTORS.contains(&name) {
            metadata.insert(VECTOR_KEY.to_owned(), String::new());
        }
        let field = Field::new(name, column.data_type().clone(), field.is_nullable()).with_metadata(metadata);
        // Its name before Postgres 17.
        if name == "colllocale" {
            fields.push(field.clone().with_name("colliculocale"));
            columns.push(column.clone());
        }
        fields.push(field);
        columns.push(column);
    }
    for (name, value) in [("tableoid", table), ("xmin", 1)] {
        fields.push(Field::new(name, DataType::Int32, false));
        columns.push(Arc::new(Int32Array::from_value(value, batch.num_rows())));
    }
    Ok(RecordBatch::try_new(Arc::new(Schema::new(fields)), columns)?)
}

fn function_numbers(names: &ArrayRef, functions: &HashMap<String, i32>) -> ArrayRef {
    let numbers: Int32Array =
        names.as_string::<i32>().iter().map(|name| name.map(|n| find_number(n, functions))).collect();
    Arc::new(numbers)
}

// A name may come with its schema and its arguments.
fn find_number(name: &str, functions: &HashMap<String, i32>) -> i32 {
    let plain = name.split('(').next().unwrap_or(name);
    functions.get(plain.rsplit('.').next().unwrap_or(plain)).copied().unwrap_or(0)
}

// `{a,b}`, `['a', 'b']` and `1 2` are lists.
fn read_lists(texts: &ArrayRef) -> ArrayRef {
    let mut lists = ListBuilder::new(StringBuilder::new());
    for text in texts.as_string::<i32>() {
        let inner = text.unwrap_or_default().trim_matches(['{', '}', '[', ']']);
        let items = inner.split([',', ' ']).map(|item| item.trim_matches('\'')).filter(|item| !item.is_empty());
        items.for_each(|item| lists.values().append_value(item));
        lists.append(text.is_some());
    }
    Arc::new(lists.finish())
}

#[cfg(test)]
mod tests {
    use arrow::array::StringArray;

    use super::*;

    #[test]
    fn functions_are_numbers_and_lists_are_lists() {
        let alias = [(PG_OID_ALIAS_KEY.to_owned(), FUNCTION.to_owned())];
        let schema = Schema::new(vec![
            Field::new("typinput", DataType::Utf8, true).with_metadata(alias.into()),
            Field::new("indkey", DataType::Utf8, true),
            Field::new("proargnames", DataType::Utf8, true),
        ]);
        let columns: Vec<ArrayRef> = vec![
            Arc::new(StringArray::from(vec!["boolin", "-", "pg_catalog.boolin(cstring)"])),
            Arc::new(StringArray::from(vec![Some("1 2"), None, Some("")])),
            Arc::new(StringArray::from(vec![Some("['a', 'b']"), Some("{c}"), None])),
        ];
        let batch = RecordBatch::try_new(Arc::new(schema), columns).expect("a batch");
        let typed = with_types(&batch, 1247, &HashMap::from([("boolin".to_owned(), 1242)])).expect("types");
        let numbers = typed.column(0).as_primitive::<Int32Type>();
        assert_eq!(numbers.values(), &[1242, 0, 1242]);
        let shown = arrow::util::pretty::pretty_format_columns("x", &typed.columns()[1..3]).expect("text").to_string();
        assert!(shown.contains("[1, 2]") && shown.contains("[a, b]") && shown.contains("[c]"), "{shown}");
        assert_eq!(typed.schema().field(1).data_type(), &DataType::new_list(DataType::Int16, true));
        assert_eq!(typed.column_by_name("tableoid").expect("unseen").as_primitive::<Int32Type>().value(0), 1247);
    }
}
