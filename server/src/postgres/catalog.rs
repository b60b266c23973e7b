//! The lake as `pg_catalog` shows it: one for all connections, so that the numbers of tables stay the same from one
//! question of a client to the next.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, Int32Array, RecordBatch, StringArray, UInt32Array};
use arrow::compute::{cast, take_record_batch};
use arrow::datatypes::{DataType, Field, FieldRef, Int32Type, TimeUnit};
use async_trait::async_trait;
use datafusion::catalog::information_schema::INFORMATION_SCHEMA;
use datafusion::catalog::{CatalogProviderList, MemTable, MemoryCatalogProviderList, SchemaProvider, TableProvider};
use datafusion::common::ScalarValue;
use datafusion::datasource::ViewTable;
use datafusion::error::DataFusionError;
use datafusion::execution::session_state::SessionStateBuilder;
use datafusion::logical_expr::planner::TypePlanner;
use datafusion::logical_expr::{LogicalPlanBuilder, ScalarUDF, lit};
use datafusion::prelude::SessionContext;
use datafusion::sql::sqlparser::ast::{ArrayElemTypeDef, DataType as SqlType, TimezoneInfo};
use datafusion_pg_catalog::pg_catalog::context::EmptyContextProvider;
use datafusion_pg_catalog::pg_catalog::generate_series_arg_coercion::CoerceIntArgsToBigInt;
use datafusion_pg_catalog::pg_catalog::oid_type_planner::PgOidTypePlanner;
use datafusion_pg_catalog::pg_catalog::{ArrowTable, PgCatalogSchemaProvider, PgCatalogStaticTables, PgCatalogTable};
use echolake_query::{ContextExtension, SqlFunction};

use super::fixed_tables::{numbers_of, set_function_names, with_types};
use super::functions::{self, CatalogNumbers};
use super::information::InformationSchema;
use super::relations::{self, CatalogRelations, NamedTables, long_name};
use super::settings::SessionSettings;
use crate::Error;
use crate::service::{CATALOG, QueryService};

const PG_CATALOG: &str = "pg_catalog";
/// The first number of the field's functions; Postgres keeps those below for itself, and tables have those from 16384.
const OWN_NUMBERS: i32 = 1_000_000;
/// The function of Postgres that the field's are like.
const LIKE: &str = "upper";
/// The type of the catalogue's numbers, and the name of the elements of their lists.
pub(super) const OID: &str = "oid";
const KEYWORDS: &str = "pg_get_keywords";
/// The only role; `pg_get_userbyid`, `session_user` and `user` say the same.
pub(super) const ROLE: &str = "postgres";

/// Tables and functions of `pg_catalog` that extend every session.
#[derive(Clone)]
pub(super) struct PgCatalog {
    tables: Arc<NamedTables>,
    information: Arc<NamedTables>,
    keywords: Arc<ArrowTable>,
    functions: Arc<Vec<Arc<ScalarUDF>>>,
}

impl PgCatalog {
    /// For a lake's tables, views and functions.
    pub(super) fn new(service: &QueryService) -> Result<Self, Error> {
        let own = service.functions();
        let fixed = Arc::new(PgCatalogStaticTables::try_new()?);
        let (types, procedures) = (numbers_of(&fixed.pg_type, "typname")?, numbers_of(&fixed.pg_proc, "proname")?);
        set_function_names(&procedures);
        let mut typed = fixed_tables(&fixed, &procedures)?;
        if let Some(batches) = typed.iter_mut().find(|(name, _)| name == "pg_proc").map(|(_, batches)| batches) {
            *batches = with_own(batches, &own)?;
        }
        let mut signatures = HashMap::new();
        for (_, batches) in typed.iter().filter(|(name, _)| name == "pg_proc") {
            signatures = signatures_of(batches, &types)?;
        }
        // What the field's functions return depends on what they are given.
        signatures.extend(own.iter().zip(OWN_NUMBERS..).map(|(f, n)| (n, (f.arguments().to_owned(), String::new()))));
        let schemas: Vec<_> = typed.iter().map(|(name, batches)| (name.clone(), batches[0].schema())).collect();
        let relations = CatalogRelations::new(service, &schemas);
        let descriptions = typed.iter().find(|(name, _)| name == "pg_description");
        let comments = descriptions.map(|(_, batches)| batches.clone()).unwrap_or_default();
        let mut all = NamedTables::new();
        for (name, batches) in typed {
            let table = MemTable::try_new(batches[0].schema(), vec![batches])?;
            all.insert(name, Arc::new(table));
        }
        all.insert("pg_timezone_names".to_owned(), only_utc()?);
        // Some are in place of the library's.
        all.extend(relations.catalog_tables(comments)?);
        let mut functions = functions::fixed();
        functions.extend(functions::lookups(CatalogNumbers {
            types,
            procedures,
            relations: relations.numbers(),
            schemas: relations::schemas().map(|(number, name)| (name.to_owned(), number)).into(),
            signatures,
            comments: relations.comments(),
            definitions: relations.definitions(),
        }));
        Ok(Self {
            tables: Arc::new(all),
            information: Arc::new(relations.information_tables()?),
            keywords: fixed.pg_get_keywords.clone(),
            functions: Arc::new(functions),
        })
    }

    /// For the session of this number and these settings.
    pub(super) fn extend(&self, pid: i32, settings: &Arc<SessionSettings>) -> ContextExtension {
        let (pg, own) = (self.clone(), functions::of_session(pid, settings));
        let schema: Arc<dyn SchemaProvider> =
            Arc::new(CatalogSchema { tables: self.tables.clone(), pid, settings: settings.clone() });
        Arc::new(move |context| pg.register(context, schema.clone(), &own))
    }

    fn register(
        &self,
        context: &SessionContext,
        schema: Arc<dyn SchemaProvider>,
        own: &[Arc<ScalarUDF>],
    ) -> Result<(), DataFusionError> {
        let catalog = context.catalog(CATALOG);
        let missing = || DataFusionError::Internal(format!("no catalogue `{CATALOG}`"));
        let lake = catalog.ok_or_else(missing)?;
        lake.register_schema(PG_CATALOG, schema)?;
        for function in self.functions.iter().chain(own) {
            context.register_udf(function.as_ref().clone());
        }
        context.register_udtf(KEYWORDS, self.keywords.clone());
        // Types such as regclass are known to this planner of types.
        let (state, known) = (context.state_ref(), context.state());
        let information = InformationSchema::new(self.information.clone(), &known);
        lake.register_schema(INFORMATION_SCHEMA, Arc::new(information))?;
        let mut extended =
            SessionStateBuilder::new_from_existing(known).with_type_planner(Arc::new(PostgresTypePlanner)).build();
        // If this is on, DataFusion's own takes precedence over the one that is registered.
        extended.config_mut().options_mut().catalog.information_schema = false;
        *state.write() = extended;
        CoerceIntArgsToBigInt::widen(context);
        Ok(())
    }
}

// Nothing can be added to it.
#[derive(Debug)]
struct CatalogSchema {
    /// Those of all sessions.
    tables: Arc<NamedTables>,
    pid: i32,
    settings: Arc<SessionSettings>,
}

#[async_trait]
impl SchemaProvider for CatalogSchema {
    fn table_names(&self) -> Vec<String> {
        let own = relations::SESSION_TABLES.iter().map(|(name, _)| (*name).to_owned());
        self.tables.keys().cloned().chain(own).collect()
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>, DataFusionError> {
        match self.tables.get(name) {
            Some(table) => Ok(Some(table.clone())),
            None => relations::session_table(name, self.pid, &self.settings.all()),
        }
    }

    fn table_exist(&self, name: &str) -> bool {
        self.tables.contains_key(name) || relations::SESSION_TABLES.iter().any(|(own, _)| *own == name)
    }
}

/// Types that Postgres' clients name, beside those of `datafusion-pg-catalog`.
#[derive(Debug)]
struct PostgresTypePlanner;

impl TypePlanner for PostgresTypePlanner {
    fn plan_type_field(&self, kind: &SqlType) -> Result<Option<FieldRef>, DataFusionError> {
        let own = match kind {
            // The only time zone.
            SqlType::Timestamp(_, TimezoneInfo::Tz | TimezoneInfo::WithTimeZone) => {
                Some(DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into())))
            }
            SqlType::Custom(name, arguments) if arguments.is_empty() && name.to_string() == "name" => {
                Some(DataType::Utf8)
            }
            SqlType::Array(ArrayElemTypeDef::SquareBracket(element, _)) if element.to_string().ends_with(OID) => {
                Some(DataType::List(Arc::new(Field::new(OID, DataType::Int32, true))))
            }
            _ => None,
        };
        match own {
            Some(own) => Ok(Some(Arc::new(Field::new("", own, true)))),
            None => PgOidTypePlanner.plan_type_field(kind),
        }
    }
}

type TypedTables = Vec<(String, Vec<RecordBatch>)>;

// What the library has of each table that is the same in every database.
fn fixed_tables(
    fixed: &Arc<PgCatalogStaticTables>,
    functions: &HashMap<String, i32>,
) -> Result<TypedTables, DataFusionError> {
    let nothing: Arc<dyn CatalogProviderList> = Arc::new(MemoryCatalogProviderList::new());
    let library = PgCatalogSchemaProvider::try_new(nothing, fixed.clone(), EmptyContextProvider)?;
    let mut tables = Vec::new();
    for name in library.table_names() {
        let batches = match library.build_table_by_name(&name)? {
            // What its rows are about has no constraints here.
            Some(PgCatalogTable::Static(table)) if table.data().is_empty() || name == "pg_constraint" => {
                vec![RecordBatch::new_empty(table.schema())]
            }
            Some(PgCatalogTable::Static(table)) => table.data().to_vec(),
            Some(PgCatalogTable::Empty(table)) => vec![RecordBatch::new_empty(table.schema())],
            _ => continue,
        };
        let number = relations::number_of(&name).unwrap_or_default();
        let typed = batches.iter().map(|batch| with_types(batch, number, functions));
        tables.push((name, typed.collect::<Result<_, _>>()?));
    }
    Ok(tables)
}

// Arguments and results of functions by their numbers, as clients show them.
fn signatures_of(
    functions: &[RecordBatch],
    types: &HashMap<String, i32>,
) -> Result<HashMap<i32, (String, String)>, DataFusionError> {
    let names: HashMap<i32, &str> = types.iter().map(|(name, number)| (*number, name.as_str())).collect();
    let name = |number: i32| {
        let short = names.get(&number).copied().unwrap_or_default();
        match short.strip_prefix('_') {
            Some(element) => format!("{}[]", long_name(element)),
            None => long_name(short).to_owned(),
        }
    };
    let mut signatures = HashMap::new();
    for batch in functions {
        let missing = |name: &str| DataFusionError::Internal(format!("pg_proc has no column `{name}`"));
        let column = |name: &str| batch.column_by_name(name).ok_or_else(|| missing(name));
        let (numbers, results) =
            (cast(column("oid")?, &DataType::Int32)?, cast(column("prorettype")?, &DataType::Int32)?);
        let arguments = column("proargtypes")?.as_list_opt::<i32>().ok_or_else(|| missing("proargtypes"))?;
        let (numbers, results) = (numbers.as_primitive::<Int32Type>(), results.as_primitive::<Int32Type>());
        for row in 0..batch.num_rows() {
            let given = arguments.value(row);
            let given: Vec<_> = given.as_primitive::<Int32Type>().values().iter().map(|kind| name(*kind)).collect();
            signatures.insert(numbers.value(row), (given.join(", "), name(results.value(row))));
        }
    }
    Ok(signatures)
}

// Sessions may set another zone, which changes nothing.
fn only_utc() -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let offset = ScalarValue::new_interval_mdn(0, 0, 0);
    let columns = [("name", lit("UTC")), ("abbrev", lit("UTC")), ("utc_offset", lit(offset)), ("is_dst", lit(false))];
    let plan = LogicalPlanBuilder::empty(true).project(columns.map(|(name, value)| value.alias(name)))?.build()?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}

// The field's functions beside Postgres' own: in the lake's schema, and else like one of those.
fn with_own(functions: &[RecordBatch], own: &[SqlFunction]) -> Result<Vec<RecordBatch>, DataFusionError> {
    let mut batches = functions.to_vec();
    for batch in functions {
        let missing = || DataFusionError::Internal("pg_proc has no names".to_owned());
        let names = cast(batch.column_by_name("proname").ok_or_else(missing)?, &DataType::Utf8)?;
        let Some(row) = names.as_string::<i32>().iter().position(|name| name == Some(LIKE)) else { continue };
        let rows = UInt32Array::from_value(row as u32, own.len());
        let like = take_record_batch(batch, &rows)?;
        let numbers = || Int32Array::from_iter_values(OWN_NUMBERS..OWN_NUMBERS + own.len() as i32);
        let column = |field: &FieldRef, like: &ArrayRef| -> Result<ArrayRef, DataFusionError> {
            let own: ArrayRef = match field.name().as_str() {
                "oid" => Arc::new(numbers()),
                "proname" => Arc::new(StringArray::from_iter_values(own.iter().map(|f| &f.name))),
                "pronamespace" => Arc::new(Int32Array::from_value(relations::PUBLIC, own.len())),
                _ => return Ok(like.clone()),
            };
            Ok(cast(&own, field.data_type())?)
        };
        let fields = batch.schema();
        let columns = fields.fields().iter().zip(like.columns()).map(|(field, like)| column(field, like));
        batches.push(RecordBatch::try_new(batch.schema(), columns.collect::<Result<_, _>>()?)?);
        break;
    }
    Ok(batches)
}
