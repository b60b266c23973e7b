//! The tables of `datafusion-pg-catalog` that are the same in every database, with the types that Postgres gives their
//! columns: there they are a real database's rows, but functions are texts and so are lists.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, Int32Array, ListBuilder, RecordBatch, StringArray, StringBuilder,
};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Int32Type, Schema};
use arrow_pg::datatypes::PG_OID_ALIAS_KEY;
use datafusion::error::{DataFusionError, Result};
use datafusion_pg_catalog::pg_catalog::ArrowTable;

/// The alias of columns that name a function.
const FUNCTION: &str = "regproc";
/// Their text for no function.
const NONE: &str = "-";

/// Columns of lists, by the types of their elements.
const TEXT_LISTS: [&str; 22] = [
    "defaclacl",
    "evttags",
    "extcondition",
    "fdwacl",
    "fdwoptions",
    "ftoptions",
    "initprivs",
    "lanacl",
    "lomacl",
    "proacl",
    "proargmodes",
    "proargnames",
    "proconfig",
    "setconfig",
    "spcacl",
    "spcoptions",
    "srvacl",
    "srvoptions",
    "stxkind",
    "subpublications",
    "typacl",
    "umoptions",
];
const SMALL_LISTS: [&str; 9] =
    ["confdelsetcols", "confkey", "conkey", "indkey", "indoption", "partattrs", "prattrs", "stxkeys", "tgattr"];
const NUMBER_LISTS: [&str; 13] = [
    "conexclop",
    "conffeqop",
    "conpfeqop",
    "conppeqop",
    "extconfig",
    "indclass",
    "indcollation",
    "partclass",
    "partcollation",
    "polroles",
    "proallargtypes",
    "proargtypes",
    "protrftypes",
];

/// Lists that are written with spaces and without brackets, and the key of a field's metadata that says so.
const VECTORS: [&str; 5] = ["indclass", "indcollation", "indkey", "indoption", "proargtypes"];
pub(super) const VECTOR_KEY: &str = "pg.list_with_spaces";

/// Names of functions by their numbers, which are the same in every database.
static FUNCTION_NAMES: OnceLock<HashMap<i32, String>> = OnceLock::new();

/// The name of a function as Postgres writes the value of a column that names one.
pub(super) fn function_name(number: i32) -> Option<&'static str> {
    match number {
        0 => Some(NONE),
        number => FUNCTION_NAMES.get()?.get(&number).map(String::as_str),
    }
}

/// Has [`function_name`] know these functions.
pub(super) fn set_function_names(numbers: &HashMap<String, i32>) {
    FUNCTION_NAMES.get_or_init(|| numbers.iter().map(|(name, number)| (*number, name.clone())).collect());
}

/// Numbers by names, as of types or functions. Of functions with one name it is the first.
pub(super) fn numbers_of(table: &ArrowTable, name: &str) -> Result<HashMap<String, i32>> {
    let mut numbers = HashMap::new();
    for batch in table.data() {
        let oids = cast(column(batch, "oid")?, &DataType::Int32)?;
        let names = cast(column(batch, name)?, &DataType::Utf8)?;
        for (name, oid) in names.as_string::<i32>().iter().zip(oids.as_primitive::<Int32Type>()) {
            if let (Some(name), Some(oid)) = (name, oid) {
                numbers.entry(name.to_owned()).or_insert(oid);
            }
        }
    }
    Ok(numbers)
}

fn column<'a>(batch: &'a RecordBatch, name: &str) -> Result<&'a ArrayRef> {
    batch.column_by_name(name).ok_or_else(|| DataFusionError::Internal(format!("a table without a column `{name}`")))
}

/// The batch with Postgres' types, and with the columns that each of its tables has unseen.
pub(super) fn with_types(batch: &RecordBatch, table: i32, functions: &HashMap<String, i32>) -> Result<RecordBatch> {
    let mut fields = Vec::new();
    let mut columns = Vec::new();
    let own = batch.schema();
    for (field, column) in own.fields().iter().zip(batch.columns()) {
        let name = field.name().as_str();
        let is_text = *field.data_type() == DataType::Utf8;
        let names_function = is_text && field.metadata().get(PG_OID_ALIAS_KEY).is_some_and(|alias| alias == FUNCTION);
        let column = match name {
            _ if names_function => function_numbers(column, functions),
            _ if is_text && TEXT_LISTS.contains(&name) => lists(column),
            _ if is_text && SMALL_LISTS.contains(&name) => {
                cast(&lists(column), &DataType::new_list(DataType::Int16, true))?
            }
            _ if is_text && NUMBER_LISTS.contains(&name) => {
                cast(&lists(column), &DataType::new_list(DataType::Int32, true))?
            }
            _ => column.clone(),
        };
        let kind = column.data_type().clone();
        let mut metadata = field.metadata().clone();
        if VECTORS.contains(&name) {
            metadata.insert(VECTOR_KEY.to_owned(), String::new());
        }
        fields.push(Field::new(name, kind, field.is_nullable()).with_metadata(metadata));
        columns.push(column);
        // Its name before Postgres 17.
        if name == "colllocale" {
            fields.push(field.as_ref().clone().with_name("colliculocale"));
            columns.push(columns[columns.len() - 1].clone());
        }
    }
    for (name, value) in [("tableoid", table), ("xmin", 1)] {
        fields.push(Field::new(name, DataType::Int32, false));
        columns.push(Arc::new(Int32Array::from_value(value, batch.num_rows())));
    }
    Ok(RecordBatch::try_new(Arc::new(Schema::new(fields)), columns)?)
}

fn function_numbers(names: &ArrayRef, functions: &HashMap<String, i32>) -> ArrayRef {
    // A name may come with its schema and its arguments.
    let number = |name: &str| {
        let plain = name.split('(').next().unwrap_or(name);
        let plain = plain.rsplit('.').next().unwrap_or(plain);
        if plain == NONE { 0 } else { functions.get(plain).copied().unwrap_or(0) }
    };
    let numbers: Int32Array = names.as_string::<i32>().iter().map(|name| name.map(number)).collect();
    Arc::new(numbers)
}

// `{a,b}`, `['a', 'b']` and `1 2` are lists.
fn lists(texts: &ArrayRef) -> ArrayRef {
    let texts: &StringArray = texts.as_string();
    let mut lists = ListBuilder::new(StringBuilder::new());
    for text in texts {
        let Some(text) = text else {
            lists.append(false);
            continue;
        };
        let inner = text.trim_matches(['{', '}', '[', ']']);
        let items = inner.split([',', ' ']).map(|item| item.trim_matches('\'')).filter(|item| !item.is_empty());
        items.for_each(|item| lists.values().append_value(item));
        lists.append(true);
    }
    Arc::new(lists.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_are_numbers_and_lists_are_lists() {
        let alias = [(PG_OID_ALIAS_KEY.to_owned(), FUNCTION.to_owned())];
        let schema = Schema::new(vec![
            Field::new("typinput", DataType::Utf8, true).with_metadata(alias.into()),
            Field::new("indkey", DataType::Utf8, true),
            Field::new("proargnames", DataType::Utf8, true),
        ]);
        let texts = |values: Vec<Option<&str>>| -> ArrayRef { Arc::new(StringArray::from(values)) };
        let columns = vec![
            texts(vec![Some("boolin"), Some("-"), Some("pg_catalog.boolin(cstring)")]),
            texts(vec![Some("1 2"), None, Some("")]),
            texts(vec![Some("['a', 'b']"), Some("{c}"), None]),
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
