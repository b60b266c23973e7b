//! The lake as `pg_catalog` shows it: one for all connections, so that the numbers of tables stay the same from one
//! question of a client to the next.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, Int32Array, RecordBatch, StringArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Int32Type, Schema, SchemaRef};
use async_trait::async_trait;
use datafusion::catalog::information_schema::INFORMATION_SCHEMA;
use datafusion::catalog::{MemTable, SchemaProvider, TableProvider};
use datafusion::common::ScalarValue;
use datafusion::datasource::{TableType, ViewTable, provider_as_source};
use datafusion::error::DataFusionError;
use datafusion::execution::session_state::SessionStateBuilder;
use datafusion::functions_nested::string::string_to_array_udf;
use datafusion::logical_expr::{Expr, LogicalPlanBuilder, ScalarUDF, cast as cast_to, ident, lit};
use datafusion::prelude::SessionContext;
use datafusion_pg_catalog::pg_catalog::catalog_info::CatalogInfo;
use datafusion_pg_catalog::pg_catalog::context::{PgCatalogContextProvider, Role};
use datafusion_pg_catalog::pg_catalog::generate_series_arg_coercion::CoerceIntArgsToBigInt;
use datafusion_pg_catalog::pg_catalog::oid_type_planner::PgOidTypePlanner;
use datafusion_pg_catalog::pg_catalog::{ArrowTable, PgCatalogSchemaProvider, PgCatalogStaticTables};
use echolake_query::{ContextExtension, SqlFunction};

use super::functions;
use super::information::InformationSchema;
use super::rewrite::OWN_TABLES;
use super::settings::SessionSettings;
use crate::Error;
use crate::service::{CATALOG, SCHEMA};

const PG_CATALOG: &str = "pg_catalog";
/// The first number of the field's functions; Postgres keeps those below for itself, and tables have those from 16384.
const OWN_NUMBERS: i32 = 1_000_000;
const OWN_NUMBER: &str = "own_number";
const OWN_NAME: &str = "own_name";
const OWN_SCHEMA: &str = "own_schema";
/// The function of Postgres that the field's are like.
const LIKE: &str = "upper";
const KEYWORDS: &str = "pg_get_keywords";
/// The only role; `pg_get_userbyid`, `session_user` and `user` say the same.
pub(super) const ROLE: &str = "postgres";

/// Tables and functions of `pg_catalog` that extend every session.
#[derive(Clone)]
pub(super) struct PgCatalog {
    schema: Arc<dyn SchemaProvider>,
    keywords: Arc<ArrowTable>,
    functions: Arc<Vec<Arc<ScalarUDF>>>,
}

impl PgCatalog {
    /// For a lake of these tables, and the field's functions.
    pub(super) fn new(tables: Vec<(&'static str, SchemaRef)>, own: Vec<SqlFunction>) -> Result<Self, Error> {
        let fixed = Arc::new(PgCatalogStaticTables::try_new()?);
        let keywords = fixed.pg_get_keywords.clone();
        let names = TableNames(Arc::new(tables.into_iter().collect()));
        let mut functions = functions::fixed();
        functions.push(functions::to_regtype(type_numbers(&fixed.pg_type)?));
        let of_own = own.iter().zip(OWN_NUMBERS..).map(|(f, n)| (n, f.arguments().to_owned())).collect();
        functions.push(functions::arguments(of_own));
        let own = own_functions(&own)?;
        let schema =
            Arc::new(ExtendedSchema { inner: PgCatalogSchemaProvider::try_new(names, fixed, RoleProvider)?, own });
        Ok(Self { schema, keywords, functions: Arc::new(functions) })
    }

    /// For a session of these settings.
    pub(super) fn extend(&self, settings: &Arc<SessionSettings>) -> ContextExtension {
        let (pg, own) = (self.clone(), functions::of_settings(settings));
        Arc::new(move |context| pg.register(context, &own))
    }

    fn register(&self, context: &SessionContext, own: &[Arc<ScalarUDF>]) -> Result<(), DataFusionError> {
        let catalog = context.catalog(CATALOG);
        let missing = || DataFusionError::Internal(format!("no catalogue `{CATALOG}`"));
        let lake = catalog.ok_or_else(missing)?;
        lake.register_schema(PG_CATALOG, self.schema.clone())?;
        for function in self.functions.iter().chain(own) {
            context.register_udf(function.as_ref().clone());
        }
        context.register_udtf(KEYWORDS, self.keywords.clone());
        // Types such as regclass are known to this planner of types.
        let (state, known) = (context.state_ref(), context.state());
        lake.register_schema(INFORMATION_SCHEMA, Arc::new(InformationSchema::of(&known)))?;
        let mut extended =
            SessionStateBuilder::new_from_existing(known).with_type_planner(Arc::new(PgOidTypePlanner)).build();
        // If this is on, DataFusion's own takes precedence over the one that is registered.
        extended.config_mut().options_mut().catalog.information_schema = false;
        *state.write() = extended;
        CoerceIntArgsToBigInt::widen(context);
        Ok(())
    }
}

fn type_numbers(types: &ArrowTable) -> Result<HashMap<String, i32>, DataFusionError> {
    let mut numbers = HashMap::new();
    for batch in types.data() {
        let column = |name: &str, kind: &DataType| {
            let missing = || DataFusionError::Internal(format!("pg_type has no column `{name}`"));
            Ok::<_, DataFusionError>(cast(batch.column_by_name(name).ok_or_else(missing)?, kind)?)
        };
        let (oids, names) = (column("oid", &DataType::Int32)?, column("typname", &DataType::Utf8)?);
        let names = names.as_string::<i32>().iter().flatten().map(str::to_owned);
        numbers.extend(names.zip(oids.as_primitive::<Int32Type>().values().iter().copied()));
    }
    Ok(numbers)
}

// The tables of `datafusion-pg-catalog`, and what clients miss in them.
#[derive(Debug)]
struct ExtendedSchema<S> {
    inner: S,
    /// Number and name of the field's functions.
    own: Arc<dyn TableProvider>,
}

#[async_trait]
impl<S: SchemaProvider> SchemaProvider for ExtendedSchema<S> {
    fn table_names(&self) -> Vec<String> {
        let mut names = self.inner.table_names();
        names.extend(OWN_TABLES.map(str::to_owned));
        names
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>, DataFusionError> {
        match (name, self.inner.table(name).await?) {
            ("pg_indexes", _) => Ok(Some(no_indexes()?)),
            ("pg_timezone_names", _) => Ok(Some(only_utc()?)),
            ("pg_index", Some(table)) => Ok(Some(with_vectors(name, table)?)),
            ("pg_class", Some(table)) => Ok(Some(with_nothing(name, table, &["relacl", "reloptions"])?)),
            ("pg_attribute", Some(table)) => Ok(Some(with_nothing(name, table, &["attacl"])?)),
            ("pg_proc", Some(table)) => match self.inner.table("pg_namespace").await? {
                Some(schemas) => Ok(Some(with_own(table, schemas, self.own.clone())?)),
                None => Ok(Some(table)),
            },
            (_, table) => Ok(table),
        }
    }

    fn table_exist(&self, name: &str) -> bool {
        OWN_TABLES.contains(&name) || self.inner.table_exist(name)
    }
}

fn no_indexes() -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let names = ["schemaname", "tablename", "indexname", "tablespace", "indexdef"];
    let fields = names.map(|name| Field::new(name, DataType::Utf8, true));
    let schema = Arc::new(Schema::new(fields.to_vec()));
    Ok(Arc::new(MemTable::try_new(schema, vec![Vec::new()])?))
}

// Sessions may set another zone, which changes nothing.
fn only_utc() -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let offset = ScalarValue::new_interval_mdn(0, 0, 0);
    let columns = [("name", lit("UTC")), ("abbrev", lit("UTC")), ("utc_offset", lit(offset)), ("is_dst", lit(false))];
    let plan = LogicalPlanBuilder::empty(true).project(columns.map(|(name, value)| value.alias(name)))?.build()?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}

fn own_functions(functions: &[SqlFunction]) -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let numbers: ArrayRef = Arc::new(Int32Array::from_iter_values(OWN_NUMBERS..OWN_NUMBERS + functions.len() as i32));
    let names: ArrayRef = Arc::new(StringArray::from_iter_values(functions.iter().map(|f| &f.name)));
    let rows = RecordBatch::try_from_iter([(OWN_NUMBER, numbers), (OWN_NAME, names)])?;
    Ok(Arc::new(MemTable::try_new(rows.schema(), vec![vec![rows]])?))
}

// The field's functions beside Postgres' own: in the lake's schema, and else like one of those.
fn with_own(
    functions: Arc<dyn TableProvider>,
    schemas: Arc<dyn TableProvider>,
    own: Arc<dyn TableProvider>,
) -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let scan = |name: &str, table: &Arc<dyn TableProvider>| {
        LogicalPlanBuilder::scan(name, provider_as_source(table.clone()), None)
    };
    let schema = scan("schemas", &schemas)?
        .filter(ident("nspname").eq(lit(SCHEMA)))?
        .project([ident("oid").alias(OWN_SCHEMA)])?
        .build()?;
    let own = scan("own", &own)?.build()?;
    let column = |name: &str, kind: &DataType| match name {
        "oid" => cast_to(ident(OWN_NUMBER), kind.clone()).alias(name),
        "proname" => cast_to(ident(OWN_NAME), kind.clone()).alias(name),
        "pronamespace" => cast_to(ident(OWN_SCHEMA), kind.clone()).alias(name),
        _ => ident(name),
    };
    let columns: Vec<_> = functions.schema().fields().iter().map(|f| column(f.name(), f.data_type())).collect();
    let like = scan("pg_proc", &functions)?.filter(ident("proname").eq(lit(LIKE)))?.limit(0, Some(1))?;
    let own = like.cross_join(schema)?.cross_join(own)?.project(columns)?.build()?;
    let plan = scan("pg_proc", &functions)?.union(own)?.build()?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}

// Neither tables nor columns have rights or options of their own; clients know these as lists.
fn with_nothing(
    name: &str,
    table: Arc<dyn TableProvider>,
    lists: &[&str],
) -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let nothing = ScalarValue::new_null_list(DataType::Utf8, true, 1);
    let own = table.schema();
    let kept = own.fields().iter().filter(|f| !lists.contains(&f.name().as_str())).map(|f| ident(f.name()));
    let lists = lists.iter().map(|list| lit(nothing.clone()).alias(*list));
    view(name, table, kept.chain(lists))
}

// Postgres' vectors of numbers are texts there, with spaces between the numbers; clients unnest them.
fn with_vectors(name: &str, table: Arc<dyn TableProvider>) -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let own = table.schema();
    let columns = own.fields().iter().map(|field| {
        let numbers = match field.name().as_str() {
            "indkey" | "indoption" => DataType::Int16,
            "indclass" | "indcollation" => DataType::Int32,
            _ => return ident(field.name()),
        };
        let words = string_to_array_udf().call(vec![ident(field.name()), lit(" ")]);
        cast_to(words, DataType::new_list(numbers, true)).alias(field.name())
    });
    view(name, table, columns)
}

/// These columns of a table, in its place.
pub(super) fn view(
    name: &str,
    table: Arc<dyn TableProvider>,
    columns: impl IntoIterator<Item = Expr>,
) -> Result<Arc<dyn TableProvider>, DataFusionError> {
    let plan = LogicalPlanBuilder::scan(name, provider_as_source(table), None)?.project(columns)?.build()?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}

// The lake's tables by name.
#[derive(Debug, Clone)]
struct TableNames(Arc<BTreeMap<&'static str, SchemaRef>>);

impl TableNames {
    fn find(&self, catalog: &str, schema: &str, table: &str) -> Option<&SchemaRef> {
        (catalog == CATALOG && schema == SCHEMA).then(|| self.0.get(table)).flatten()
    }
}

#[async_trait]
impl CatalogInfo for TableNames {
    async fn catalog_names(&self) -> Result<Vec<String>, DataFusionError> {
        Ok(vec![CATALOG.to_owned()])
    }

    async fn schema_names(&self, catalog: &str) -> Result<Option<Vec<String>>, DataFusionError> {
        let all = || [SCHEMA, PG_CATALOG, "information_schema"].map(str::to_owned).to_vec();
        Ok((catalog == CATALOG).then(all))
    }

    async fn table_names(&self, catalog: &str, schema: &str) -> Result<Option<Vec<String>>, DataFusionError> {
        let is_lake = catalog == CATALOG && schema == SCHEMA;
        Ok(Some(if is_lake { self.0.keys().map(|name| (*name).to_owned()).collect() } else { Vec::new() }))
    }

    async fn table_schema(
        &self,
        catalog: &str,
        schema: &str,
        table: &str,
    ) -> Result<Option<SchemaRef>, DataFusionError> {
        Ok(self.find(catalog, schema, table).cloned())
    }

    async fn table_type(&self, catalog: &str, schema: &str, table: &str) -> Result<Option<TableType>, DataFusionError> {
        Ok(self.find(catalog, schema, table).map(|_| TableType::Base))
    }
}

#[derive(Debug, Clone)]
struct RoleProvider;

#[async_trait]
impl PgCatalogContextProvider for RoleProvider {
    async fn roles(&self) -> Vec<String> {
        vec![ROLE.to_owned()]
    }

    async fn role(&self, name: &str) -> Option<Role> {
        (name == ROLE).then(|| Role {
            name: ROLE.to_owned(),
            is_superuser: false,
            can_login: true,
            can_create_db: false,
            can_create_role: false,
            can_create_user: false,
            can_replication: false,
            grants: Vec::new(),
            inherited_roles: Vec::new(),
        })
    }
}
