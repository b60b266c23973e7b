//! Tables of `pg_catalog` and `information_schema` that the server makes for Postgres' clients, by the definitions in
//! `catalog_tables.txt`. Those about the lake's tables are made once: they do not change while a lake is served.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, RecordBatch, StringArray, new_null_array};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, IntervalUnit, Schema, SchemaRef, TimeUnit};
use arrow_pg::datatypes::{PG_CHAR_KEY, PG_OID_ALIAS_KEY, field_into_pg_type};
use datafusion::error::Result;
use echolake_query::{SYSTEM_SCHEMA, table_meaning};
use echolake_schema::tables::{COMMENT, UNIT};
use echolake_service::{CATALOG, QueryService, SCHEMA};
use pgwire::api::Type;

use super::names::{OID, ROLE, long_type_name};

pub(super) const PG_CATALOG: &str = "pg_catalog";
pub(super) const INFORMATION_SCHEMA: &str = "information_schema";

const DEFINITIONS: &str = include_str!("catalog_tables.txt");
/// The source of what is a function in Postgres.
const CALL: &str = "call";

/// Number of the schema `public` in Postgres.
pub(super) const PUBLIC: i32 = 2200;
const INFORMATION: i32 = 13_000;
/// First number that Postgres gives to tables of users.
const FIRST_TABLE: i32 = 16_384;
/// First number of the tables of `pg_catalog` whose numbers in Postgres are not fixed.
const FIRST_CATALOG_TABLE: i32 = 12_000;
/// Number of the schema of the system tables, and the first of these.
const SYSTEM: i32 = 26_000;
const FIRST_SYSTEM_TABLE: i32 = SYSTEM + 1;
/// Numbers and names of the schemas.
pub(super) const SCHEMAS: [(i32, &str); 4] =
    [(11, PG_CATALOG), (PUBLIC, SCHEMA), (SYSTEM, SYSTEM_SCHEMA), (INFORMATION, INFORMATION_SCHEMA)];

/// Tables of `pg_catalog` whose numbers clients know.
const FIXED_NUMBERS: [(&str, i32); 12] = [
    ("pg_attrdef", 2604),
    ("pg_attribute", 1249),
    ("pg_authid", 1260),
    ("pg_class", 1259),
    ("pg_constraint", 2606),
    ("pg_database", 1262),
    ("pg_description", 2609),
    ("pg_index", 2610),
    ("pg_namespace", 2615),
    ("pg_proc", 1255),
    ("pg_trigger", 2620),
    ("pg_type", 1247),
];

/// Returns the number of a table of `pg_catalog`, if it is fixed.
pub(super) fn find_fixed_number(table: &str) -> Option<i32> {
    FIXED_NUMBERS.iter().find(|(known, _)| *known == table).map(|(_, number)| *number)
}

/// Returns whether a table is found without its schema: all but those of `information_schema` and `system`.
pub(super) fn is_searched(number: i32) -> bool {
    !(INFORMATION..FIRST_TABLE).contains(&number) && number < FIRST_SYSTEM_TABLE
}

/// The values of a row's source by their names.
pub(super) type RowValues = HashMap<&'static str, String>;
/// Comments by table and column; those of tables by column 0.
pub(super) type CatalogComments = HashMap<(i32, i32), String>;

/// The definition of a table.
#[derive(Debug)]
pub(super) struct TableDefinition {
    pub schema: &'static str,
    pub name: &'static str,
    /// What has a row in it.
    source: &'static str,
    columns: Vec<ColumnDefinition>,
}

#[derive(Debug)]
struct ColumnDefinition {
    field: Field,
    value: Option<&'static str>,
}

/// Reads all definitions.
pub(super) fn read_definitions() -> Vec<TableDefinition> {
    let mut definitions: Vec<TableDefinition> = Vec::new();
    for line in DEFINITIONS.lines().filter(|line| !line.starts_with('#')) {
        if let Some((table, source)) = line.split_once(" of ") {
            let (schema, name) = table.split_once('.').unwrap_or((PG_CATALOG, table));
            definitions.push(TableDefinition { schema, name, source, columns: Vec::new() });
        } else if let Some(definition) = definitions.last_mut() {
            definition.columns.extend(line.split_whitespace().map(ColumnDefinition::parse));
        }
    }
    definitions
}

impl TableDefinition {
    /// Returns whether its rows differ from session to session.
    pub fn is_of_session(&self) -> bool {
        ["setting", "session"].contains(&self.source)
    }

    /// Returns whether it is a function in Postgres.
    pub fn is_call(&self) -> bool {
        self.source == CALL
    }

    fn arrow_schema(&self) -> SchemaRef {
        Arc::new(Schema::new(self.columns.iter().map(|column| column.field.clone()).collect::<Vec<_>>()))
    }

    /// Makes the rows.
    ///
    /// # Errors
    /// If a value is not of its column's type.
    pub fn make_rows(&self, sources: &[RowValues]) -> Result<RecordBatch> {
        let columns = self.columns.iter().map(|column| column.make_values(sources)).collect::<Result<_>>()?;
        Ok(RecordBatch::try_new(self.arrow_schema(), columns)?)
    }

    /// Makes the rows that a session of this number and these settings sees.
    ///
    /// # Errors
    /// As [`Self::make_rows`].
    pub fn make_session_rows(&self, pid: i32, settings: &[(&'static str, String)]) -> Result<RecordBatch> {
        if self.source == "setting" {
            let settings =
                settings.iter().map(|(name, value)| [("setting", (*name).to_owned()), ("value", value.clone())]);
            return self.make_rows(&settings.map(RowValues::from).collect::<Vec<_>>());
        }
        let application = settings.iter().find(|(name, _)| *name == "application_name");
        self.make_rows(&[RowValues::from([
            ("pid", pid.to_string()),
            ("application", application.map(|(_, value)| value.clone()).unwrap_or_default()),
            ("backend", "client backend".to_owned()),
        ])])
    }
}

impl ColumnDefinition {
    fn parse(column: &'static str) -> Self {
        let (column, value) = column.split_once('=').map_or((column, None), |(column, value)| (column, Some(value)));
        let (name, kind) = column.split_once(':').unwrap_or((column, "text"));
        let kind = kind.trim_end_matches('?');
        let data_type = match kind {
            "bool" => DataType::Boolean,
            "int2" => DataType::Int16,
            "int4" | OID => DataType::Int32,
            "int8" => DataType::Int64,
            "float4" => DataType::Float32,
            "interval" => DataType::Interval(IntervalUnit::MonthDayNano),
            "timestamptz" => DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into())),
            "text[]" => DataType::new_list(DataType::Utf8, true),
            _ => DataType::Utf8,
        };
        let metadata = match kind {
            "char" => HashMap::from([(PG_CHAR_KEY.to_owned(), kind.to_owned())]),
            OID => HashMap::from([(PG_OID_ALIAS_KEY.to_owned(), kind.to_owned())]),
            _ => HashMap::new(),
        };
        Self { field: Field::new(name, data_type, column.ends_with('?')).with_metadata(metadata), value }
    }

    fn make_values(&self, sources: &[RowValues]) -> Result<ArrayRef> {
        let kind = self.field.data_type();
        let texts: StringArray = sources.iter().map(|source| self.find_value(source)).collect();
        if texts.null_count() == sources.len() {
            return Ok(new_null_array(kind, sources.len()));
        }
        Ok(cast(&texts, kind)?)
    }

    fn find_value<'a>(&'a self, source: &'a RowValues) -> Option<&'a str> {
        let given = match self.value {
            Some("$role") => Some(ROLE),
            Some("$database") => Some(CATALOG),
            Some(value) => match value.strip_prefix('$') {
                Some(name) => source.get(name).map(String::as_str),
                None => Some(value),
            },
            None => None,
        };
        let usual = match self.field.data_type() {
            DataType::Utf8 => "",
            DataType::Boolean => "false",
            DataType::Interval(_) => "0 seconds",
            _ => "0",
        };
        given.or((!self.field.is_nullable()).then_some(usual))
    }
}

/// A table or view that the catalogue describes.
struct CatalogRelation {
    number: i32,
    namespace: (i32, &'static str),
    name: String,
    schema: SchemaRef,
    is_view: bool,
    /// The SQL of a view of the lake.
    definition: Option<String>,
}

/// All tables and views.
pub(super) struct CatalogRelations(Vec<CatalogRelation>);

impl CatalogRelations {
    /// Of the lake's tables and views, the system tables, those of the definitions, and the fixed ones of `pg_catalog`.
    pub fn new(service: &QueryService, definitions: &[TableDefinition], fixed: Vec<(String, SchemaRef)>) -> Self {
        let mut views = service.view_definitions();
        let mut relations = Vec::new();
        for (number, (name, schema)) in (FIRST_TABLE..).zip(service.lake_tables()) {
            let table = CatalogRelation::new(number, SCHEMA, name.to_owned(), schema);
            relations.push(CatalogRelation {
                is_view: views.contains_key(name),
                definition: views.remove(name),
                ..table
            });
        }
        for (number, (name, schema)) in (FIRST_SYSTEM_TABLE..).zip(service.system_tables()) {
            relations.push(CatalogRelation::new(number, SYSTEM_SCHEMA, name.to_owned(), schema));
        }
        let made = definitions.iter().filter(|table| !table.is_call());
        let made = made.map(|table| (table.schema, table.name.to_owned(), table.arrow_schema()));
        let fixed = fixed.into_iter().map(|(name, schema)| (PG_CATALOG, name, schema));
        let mut next = FIRST_CATALOG_TABLE;
        let mut next_view = INFORMATION + 1;
        for (namespace, name, schema) in made.chain(fixed) {
            let is_view = namespace == INFORMATION_SCHEMA;
            let counter = if is_view { &mut next_view } else { &mut next };
            let number = find_fixed_number(&name).unwrap_or(*counter);
            *counter += 1;
            relations.push(CatalogRelation { is_view, ..CatalogRelation::new(number, namespace, name, schema) });
        }
        Self(relations)
    }

    /// Returns definitions of views by their numbers.
    pub fn view_definitions(&self) -> HashMap<i32, String> {
        self.0.iter().filter_map(|of| Some((of.number, of.definition.clone()?))).collect()
    }

    /// Returns numbers of tables by name, and by schema and name.
    pub fn table_numbers(&self) -> HashMap<String, i32> {
        let mut numbers = HashMap::new();
        // A name without a schema is the lake's, then that of `pg_catalog`.
        for of in self.0.iter().rev() {
            numbers.insert(format!("{}.{}", of.namespace.1, of.name), of.number);
            if of.namespace.0 != SYSTEM {
                numbers.insert(of.name.clone(), of.number);
            }
        }
        numbers
    }

    /// Returns comments of the lake's tables and their columns.
    pub fn all_comments(&self) -> CatalogComments {
        let mut comments = CatalogComments::new();
        for of in self.0.iter().filter(|of| of.is_own()) {
            let name = if of.namespace.0 == PUBLIC { of.name.clone() } else { format!("{SYSTEM_SCHEMA}.{}", of.name) };
            comments.extend(table_meaning(&name).map(|meaning| ((of.number, 0), meaning.to_owned())));
            for (position, field) in (1..).zip(of.schema.fields()) {
                comments.extend(column_comment(field).map(|text| ((of.number, position), text)));
            }
        }
        comments
    }

    /// Makes the rows of a definition.
    ///
    /// # Errors
    /// As [`TableDefinition::make_rows`].
    pub fn make_rows(&self, definition: &TableDefinition) -> Result<RecordBatch> {
        let all = self.0.iter();
        let sources: Vec<RowValues> = match definition.source {
            "relation" => all.map(CatalogRelation::row_values).collect(),
            "table" => all.filter(|of| !of.is_view).map(CatalogRelation::row_values).collect(),
            "view" => all.filter(|of| of.is_view).map(CatalogRelation::row_values).collect(),
            "own" => all.filter(|of| of.is_own()).map(CatalogRelation::row_values).collect(),
            "column" => all.flat_map(CatalogRelation::column_values).collect(),
            "schema" => SCHEMAS
                .map(|(number, name)| {
                    RowValues::from([("schema_number", number.to_string()), ("schema", name.to_owned())])
                })
                .into(),
            "comment" => self.all_comments().into_iter().map(comment_values).collect(),
            "server" => vec![RowValues::new()],
            _ => Vec::new(),
        };
        definition.make_rows(&sources)
    }
}

// psql has no column for units, so that they are in the description.
fn column_comment(field: &Field) -> Option<String> {
    let comment = field.metadata().get(COMMENT)?;
    let unit = field.metadata().get(UNIT).filter(|unit| !matches!(unit.as_str(), "" | "1"));
    Some(unit.map_or_else(|| comment.clone(), |unit| format!("{comment} [{unit}]")))
}

fn comment_values(((number, position), comment): ((i32, i32), String)) -> RowValues {
    RowValues::from([("number", number.to_string()), ("position", position.to_string()), ("comment", comment)])
}

impl CatalogRelation {
    fn new(number: i32, schema_name: &'static str, name: String, schema: SchemaRef) -> Self {
        let schema_number = SCHEMAS.iter().find(|(_, known)| *known == schema_name).map_or(0, |(number, _)| *number);
        Self { number, namespace: (schema_number, schema_name), name, schema, is_view: false, definition: None }
    }

    // Of the lake or the server itself, not of the catalogue.
    fn is_own(&self) -> bool {
        [PUBLIC, SYSTEM].contains(&self.namespace.0)
    }

    fn row_values(&self) -> RowValues {
        let mut values = RowValues::from([
            ("number", self.number.to_string()),
            ("table", self.name.clone()),
            ("schema_number", self.namespace.0.to_string()),
            ("schema", self.namespace.1.to_owned()),
            ("columns", self.schema.fields().len().to_string()),
            ("is_view", self.is_view.to_string()),
            ("kind", if self.is_view { "v" } else { "r" }.to_owned()),
            ("access", if self.is_view { "0" } else { "2" }.to_owned()),
            ("table_type", if self.is_view { "VIEW" } else { "BASE TABLE" }.to_owned()),
        ]);
        values.extend(self.definition.clone().map(|definition| ("definition", definition)));
        values
    }

    fn column_values(&self) -> Vec<RowValues> {
        (1..).zip(self.schema.fields()).map(|(position, field)| self.values_of_column(position, field)).collect()
    }

    fn values_of_column(&self, position: i32, field: &Arc<Field>) -> RowValues {
        let kind = find_type(field);
        // Bytes of a value, if they are fixed, and its alignment.
        let (length, alignment) = match kind {
            Type::BOOL | Type::CHAR => (1, "c"),
            Type::INT2 => (2, "s"),
            Type::INT4 | Type::FLOAT4 | Type::DATE => (4, "i"),
            Type::INT8 | Type::FLOAT8 | Type::TIMESTAMP | Type::TIMESTAMPTZ | Type::TIME => (8, "d"),
            _ if field.metadata().contains_key(PG_OID_ALIAS_KEY) => (4, "i"),
            _ => (-1, "i"),
        };
        let is_list =
            matches!(field.data_type(), DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(..));
        let is_nullable = field.is_nullable();
        let mut values = self.row_values();
        values.extend([
            ("column", field.name().clone()),
            ("position", position.to_string()),
            ("type_number", kind.oid().to_string()),
            ("type", column_type_name(&kind)),
            ("short_type", kind.name().to_owned()),
            ("length", length.to_string()),
            ("alignment", alignment.to_owned()),
            ("is_short", (length > 0).to_string()),
            ("storage", if length > 0 { "p" } else { "x" }.to_owned()),
            ("dimensions", i32::from(is_list).to_string()),
            ("is_required", (!is_nullable).to_string()),
            ("is_nullable", if is_nullable { "YES" } else { "NO" }.to_owned()),
            ("collation", if kind == Type::TEXT { "100" } else { "0" }.to_owned()),
        ]);
        // Digits before and after the point.
        let numbers: &[(&'static str, &str)] = match kind {
            Type::INT2 => &[("digits", "16"), ("radix", "2"), ("scale", "0")],
            Type::INT4 => &[("digits", "32"), ("radix", "2"), ("scale", "0")],
            Type::INT8 => &[("digits", "64"), ("radix", "2"), ("scale", "0")],
            Type::FLOAT4 => &[("digits", "24"), ("radix", "2")],
            Type::FLOAT8 => &[("digits", "53"), ("radix", "2")],
            Type::DATE => &[("time_digits", "0")],
            Type::TIMESTAMP | Type::TIMESTAMPTZ | Type::TIME => &[("time_digits", "6")],
            Type::TEXT => &[("octets", "1073741824")],
            _ => &[],
        };
        values.extend(numbers.iter().map(|(name, number)| (*name, (*number).to_owned())));
        values
    }
}

// A list of lists has no type of Postgres' and is a text there.
fn find_type(field: &Arc<Field>) -> Type {
    field_into_pg_type(field).ok().filter(|kind| *kind != Type::UNKNOWN).unwrap_or(Type::TEXT)
}

// As `information_schema` has it.
fn column_type_name(kind: &Type) -> String {
    if kind.name().starts_with('_') { "ARRAY".to_owned() } else { long_type_name(kind.name()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn definitions_are_whole() {
        let sources = [RowValues::new()];
        for definition in read_definitions() {
            assert!(!definition.columns.is_empty(), "{} has no columns", definition.name);
            let rows = definition.make_rows(&sources).unwrap_or_else(|error| panic!("{}: {error}", definition.name));
            assert_eq!(rows.num_rows(), 1);
            assert_eq!(definition.make_rows(&[]).expect("no rows").num_rows(), 0);
        }
    }

    #[test]
    fn types_of_the_lake_have_names_of_postgres() {
        let list = |kind: DataType| DataType::new_list(kind, false);
        let zoned = DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into()));
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
            (list(list(DataType::Float32)), "text"),
            (zoned, "timestamp with time zone"),
            (DataType::Timestamp(TimeUnit::Millisecond, None), "timestamp without time zone"),
        ] {
            let field = Arc::new(Field::new("x", kind, true));
            assert_eq!(column_type_name(&find_type(&field)), expected, "{field}");
        }
    }
}
