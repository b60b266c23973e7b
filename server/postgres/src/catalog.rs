//! The lake as `pg_catalog` and `information_schema` show it: one for all connections, so that the numbers of tables
//! stay the same from one question of a client to the next.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Weak};

use arrow::array::{ArrayRef, AsArray as _, Int32Array, RecordBatch, StringArray, UInt32Array};
use arrow::compute::{cast, take_record_batch};
use arrow::datatypes::{DataType, Field, FieldRef, Int32Type, TimeUnit};
use async_trait::async_trait;
use datafusion::catalog::information_schema::InformationSchemaProvider;
use datafusion::catalog::{CatalogProviderList, MemTable, SchemaProvider, TableFunction, TableProvider};
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::session_state::SessionStateBuilder;
use datafusion::logical_expr::ScalarUDF;
use datafusion::logical_expr::planner::TypePlanner;
use datafusion::prelude::SessionContext;
use datafusion::sql::sqlparser::ast::{ArrayElemTypeDef, DataType as SqlType, TimezoneInfo};
use datafusion_pg_catalog::pg_catalog::PgCatalogStaticTables;
use datafusion_pg_catalog::pg_catalog::generate_series_arg_coercion::CoerceIntArgsToBigInt;
use datafusion_pg_catalog::pg_catalog::oid_type_planner::PgOidTypePlanner;
use echolake_query::{ContextExtension, SqlFunction};
use echolake_service::{CATALOG, Error, QueryService};

use super::catalog_statement::EmptyRelations;
use super::catalog_tables::{
    CatalogRelations, INFORMATION_SCHEMA, PG_CATALOG, PUBLIC, SCHEMAS, TableDefinition, read_definitions,
};
use super::fixed_tables::{find_column, read_fixed_tables, read_numbers};
use super::functions::{self, CatalogNumbers};
use super::names::{OID, long_type_name};
use super::settings::SessionSettings;

/// The first number of the field's functions; Postgres keeps those below for itself, and tables have those from 16384.
const OWN_NUMBERS: i32 = 1_000_000;
/// The function of Postgres that the field's are like.
const LIKE: &str = "upper";
/// A function that gives rows, which is read as a table.
const KEYWORDS: &str = "pg_get_keywords";
/// The function that gives the rows of [`SETTINGS`], which is read as that table.
const SETTINGS_CALL: &str = "pg_show_all_settings";
const SETTINGS: &str = "pg_settings";

/// Tables by name.
type NamedTables = BTreeMap<String, Arc<dyn TableProvider>>;

/// Tables and functions of `pg_catalog` that extend every session.
#[derive(Clone)]
pub(super) struct PgCatalog {
    tables: Arc<NamedTables>,
    information: Arc<NamedTables>,
    session_tables: Arc<Vec<TableDefinition>>,
    functions: Arc<Vec<Arc<ScalarUDF>>>,
    empty: Arc<EmptyRelations>,
}

impl PgCatalog {
    /// For a lake's tables, views and functions.
    pub fn new(service: &QueryService) -> Result<Self, Error> {
        let own_functions = service.own_functions();
        let library = Arc::new(PgCatalogStaticTables::try_new()?);
        let types = read_numbers(library.pg_type.data(), "typname")?;
        let procedures = read_numbers(library.pg_proc.data(), "proname")?;
        let mut batches = read_fixed_tables(library.clone(), &procedures)?;
        let definitions = read_definitions();
        batches.retain(|name, _| definitions.iter().all(|made| made.name != name.as_str()));
        let mut signatures = HashMap::new();
        if let Some(functions) = batches.get_mut("pg_proc") {
            signatures = read_signatures(functions, &types)?;
            add_functions(functions, &own_functions)?;
        }
        // What the field's functions return depends on what they are given.
        let own_signatures = own_functions.iter().map(|f| (f.argument_list().to_owned(), String::new()));
        signatures.extend((OWN_NUMBERS..).zip(own_signatures));
        let fixed = batches.iter().map(|(name, batches)| (name.clone(), batches[0].schema())).collect();
        let relations = CatalogRelations::new(service, &definitions, fixed);
        batches.insert(KEYWORDS.to_owned(), library.pg_get_keywords.data().to_vec());
        let mut empty = EmptyRelations::default();
        empty.calls.extend([KEYWORDS, SETTINGS_CALL].map(str::to_owned));
        let mut information = NamedTables::new();
        for made in definitions.iter().filter(|made| !made.is_of_session()) {
            let rows = relations.make_rows(made)?;
            if made.is_call() {
                empty.calls.insert(made.name.to_owned());
            }
            if made.schema == INFORMATION_SCHEMA {
                information.insert(made.name.to_owned(), memory_table(vec![rows])?);
            } else {
                batches.insert(made.name.to_owned(), vec![rows]);
            }
        }
        let mut tables = NamedTables::new();
        for (name, batches) in batches {
            empty.add_table(&name, &batches);
            tables.insert(name, memory_table(batches)?);
        }
        let mut functions = functions::fixed_functions();
        functions.extend(functions::lookup_functions(CatalogNumbers {
            types,
            procedures,
            relations: relations.table_numbers(),
            schemas: SCHEMAS.map(|(number, name)| (name.to_owned(), number)).into(),
            signatures,
            comments: relations.all_comments(),
            definitions: relations.view_definitions(),
        }));
        Ok(Self {
            tables: Arc::new(tables),
            information: Arc::new(information),
            session_tables: Arc::new(definitions.into_iter().filter(TableDefinition::is_of_session).collect()),
            functions: Arc::new(functions),
            empty: Arc::new(empty),
        })
    }

    /// Returns what has no rows.
    pub fn empty_relations(&self) -> &EmptyRelations {
        &self.empty
    }

    /// Makes what extends the session of this number and these settings.
    pub fn session_extension(&self, pid: i32, settings: &Arc<SessionSettings>) -> ContextExtension {
        let catalog = self.clone();
        let own = functions::of_session(pid, settings);
        let schema = Arc::new(CatalogSchema {
            tables: self.tables.clone(),
            session_tables: self.session_tables.clone(),
            pid,
            settings: settings.clone(),
        });
        Arc::new(move |context| catalog.register_in(context, schema.clone(), &own))
    }

    fn register_in(
        &self,
        context: &SessionContext,
        schema: Arc<dyn SchemaProvider>,
        own: &[Arc<ScalarUDF>],
    ) -> Result<()> {
        let missing = || DataFusionError::Internal(format!("no catalogue `{CATALOG}`"));
        let lake = context.catalog(CATALOG).ok_or_else(missing)?;
        lake.register_schema(PG_CATALOG, schema)?;
        for function in self.functions.iter().chain(own) {
            context.register_udf(function.as_ref().clone());
        }
        // Types such as regclass are known to this planner of types.
        let state = context.state();
        let information = InformationSchema {
            own: self.information.clone(),
            catalogs: Arc::downgrade(state.catalog_list()),
            functions: state.table_functions().clone(),
        };
        lake.register_schema(INFORMATION_SCHEMA, Arc::new(information))?;
        let mut extended =
            SessionStateBuilder::new_from_existing(state).with_type_planner(Arc::new(PostgresTypePlanner)).build();
        // If this is on, DataFusion's own takes precedence over the one that is registered.
        extended.config_mut().options_mut().catalog.information_schema = false;
        *context.state_ref().write() = extended;
        CoerceIntArgsToBigInt::widen(context);
        Ok(())
    }
}

fn memory_table(batches: Vec<RecordBatch>) -> Result<Arc<dyn TableProvider>> {
    let missing = || DataFusionError::Internal("a table without a schema".to_owned());
    let schema = batches.first().ok_or_else(missing)?.schema();
    Ok(Arc::new(MemTable::try_new(schema, vec![batches])?))
}

/// `pg_catalog` of a session. Nothing can be added to it.
#[derive(Debug)]
struct CatalogSchema {
    /// Those of all sessions.
    tables: Arc<NamedTables>,
    session_tables: Arc<Vec<TableDefinition>>,
    pid: i32,
    settings: Arc<SessionSettings>,
}

#[async_trait]
impl SchemaProvider for CatalogSchema {
    fn table_names(&self) -> Vec<String> {
        let own = self.session_tables.iter().map(|table| table.name.to_owned());
        self.tables.keys().cloned().chain(own).collect()
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>> {
        let name = if name == SETTINGS_CALL { SETTINGS } else { name };
        if let Some(table) = self.session_tables.iter().find(|table| table.name == name) {
            return memory_table(vec![table.make_session_rows(self.pid, &self.settings.all_values())?]).map(Some);
        }
        Ok(self.tables.get(name).cloned())
    }

    fn table_exist(&self, name: &str) -> bool {
        name == SETTINGS_CALL
            || self.tables.contains_key(name)
            || self.session_tables.iter().any(|table| table.name == name)
    }
}

/// `information_schema` as Postgres has it, by whose types clients choose kinds of columns, and DataFusion's tables
/// that are not in it. Over the other protocols it is DataFusion's, with Arrow's types.
#[derive(Debug)]
struct InformationSchema {
    own: Arc<NamedTables>,
    /// Of which one holds this.
    catalogs: Weak<dyn CatalogProviderList>,
    functions: HashMap<String, Arc<TableFunction>>,
}

impl InformationSchema {
    fn other_tables(&self) -> Option<InformationSchemaProvider> {
        let catalogs = self.catalogs.upgrade()?;
        Some(InformationSchemaProvider::new(catalogs).with_table_functions(self.functions.clone()))
    }
}

#[async_trait]
impl SchemaProvider for InformationSchema {
    fn table_names(&self) -> Vec<String> {
        let mut names: Vec<_> = self.other_tables().map(|others| others.table_names()).unwrap_or_default();
        names.retain(|name| !self.own.contains_key(name));
        names.extend(self.own.keys().cloned());
        names
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>> {
        match (self.own.get(name), self.other_tables()) {
            (Some(own), _) => Ok(Some(own.clone())),
            (None, Some(others)) => others.table(name).await,
            (None, None) => Ok(None),
        }
    }

    fn table_exist(&self, name: &str) -> bool {
        self.own.contains_key(name) || self.other_tables().is_some_and(|others| others.table_exist(name))
    }
}

/// Types that Postgres' clients name, beside those of `datafusion-pg-catalog`.
#[derive(Debug)]
struct PostgresTypePlanner;

impl TypePlanner for PostgresTypePlanner {
    fn plan_type_field(&self, kind: &SqlType) -> Result<Option<FieldRef>> {
        let own = match kind {
            // The only time zone.
            SqlType::Timestamp(_, TimezoneInfo::Tz | TimezoneInfo::WithTimeZone) => {
                DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into()))
            }
            SqlType::Custom(name, arguments) if arguments.is_empty() && name.to_string() == "name" => DataType::Utf8,
            SqlType::Array(ArrayElemTypeDef::SquareBracket(element, _)) if element.to_string().ends_with(OID) => {
                DataType::List(Arc::new(Field::new(OID, DataType::Int32, true)))
            }
            _ => return PgOidTypePlanner.plan_type_field(kind),
        };
        Ok(Some(Arc::new(Field::new("", own, true))))
    }
}

// Arguments and results of functions by their numbers, as clients show them.
fn read_signatures(functions: &[RecordBatch], types: &HashMap<String, i32>) -> Result<HashMap<i32, (String, String)>> {
    let names: HashMap<i32, String> = types.iter().map(|(name, number)| (*number, long_type_name(name))).collect();
    let mut signatures = HashMap::new();
    for batch in functions {
        let numbers = cast(find_column(batch, "oid")?, &DataType::Int32)?;
        let results = cast(find_column(batch, "prorettype")?, &DataType::Int32)?;
        let arguments = find_column(batch, "proargtypes")?.as_list::<i32>();
        for row in 0..batch.num_rows() {
            let given = arguments.value(row);
            let given = given.as_primitive::<Int32Type>().values().iter();
            let given: Vec<_> = given.map(|kind| names.get(kind).map_or("", String::as_str)).collect();
            let result = names.get(&results.as_primitive::<Int32Type>().value(row)).cloned().unwrap_or_default();
            signatures.insert(numbers.as_primitive::<Int32Type>().value(row), (given.join(", "), result));
        }
    }
    Ok(signatures)
}

// The field's functions beside Postgres' own: in the lake's schema, and else like one of those.
fn add_functions(batches: &mut Vec<RecordBatch>, own: &[SqlFunction]) -> Result<()> {
    for batch in batches.clone() {
        let names = cast(find_column(&batch, "proname")?, &DataType::Utf8)?;
        let Some(row) = names.as_string::<i32>().iter().position(|name| name == Some(LIKE)) else { continue };
        let like = take_record_batch(&batch, &UInt32Array::from_value(row as u32, own.len()))?;
        let mut columns = Vec::new();
        for (field, like) in batch.schema().fields().iter().zip(like.columns()) {
            let values: ArrayRef = match field.name().as_str() {
                "oid" => Arc::new(Int32Array::from_iter_values((OWN_NUMBERS..).take(own.len()))),
                "proname" => Arc::new(StringArray::from_iter_values(own.iter().map(|f| &f.name))),
                "pronamespace" => Arc::new(Int32Array::from_value(PUBLIC, own.len())),
                _ => like.clone(),
            };
            columns.push(cast(&values, field.data_type())?);
        }
        batches.push(RecordBatch::try_new(batch.schema(), columns)?);
        break;
    }
    Ok(())
}
