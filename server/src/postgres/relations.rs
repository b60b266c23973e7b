//! Tables of `pg_catalog` and `information_schema` about the lake's tables, with Postgres' columns and types. They are
//! made once: a lake's tables do not change while it is served.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use arrow::array::{ArrayRef, RecordBatch, new_null_array};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef, TimeUnit};
use arrow_pg::datatypes::{PG_CHAR_KEY, PG_OID_ALIAS_KEY, field_into_pg_type};
use datafusion::catalog::{MemTable, TableProvider};
use datafusion::common::ScalarValue;
use datafusion::error::Result;
use echolake_query::{SYSTEM_SCHEMA, table_meaning};
use echolake_schema::tables::{COMMENT, Table};
use pgwire::api::Type;

use super::catalog::ROLE;
use super::text_functions::CatalogComments;
use crate::service::{CATALOG, QueryService, SCHEMA};

/// Number of the schema `pg_catalog` in Postgres.
const PG_CATALOG: i32 = 11;
/// Number of the schema `public` in Postgres.
pub(super) const PUBLIC: i32 = 2200;
const INFORMATION_SCHEMA: i32 = 13_000;
/// Number of the only role in Postgres.
const OWNER: i32 = 10;
/// Number of the table `pg_class`, by which comments say that they are of a table.
const PG_CLASS: i32 = 1259;
/// First number that Postgres gives to tables of users.
const FIRST_TABLE: i32 = 16_384;
/// First number of the tables of `pg_catalog` whose numbers in Postgres are not fixed.
const FIRST_CATALOG_TABLE: i32 = 12_000;
/// Number of the schema of the system tables, and the first of these.
const SYSTEM: i32 = 26_000;
const FIRST_SYSTEM_TABLE: i32 = SYSTEM + 1;
const DATABASE: i32 = 5;

/// Tables of `pg_catalog` whose numbers clients know.
const FIXED: [(&str, i32); 12] = [
    ("pg_attrdef", 2604),
    ("pg_attribute", 1249),
    ("pg_authid", 1260),
    ("pg_class", PG_CLASS),
    ("pg_constraint", 2606),
    ("pg_database", 1262),
    ("pg_description", 2609),
    ("pg_index", 2610),
    ("pg_namespace", 2615),
    ("pg_proc", 1255),
    ("pg_trigger", 2620),
    ("pg_type", 1247),
];

/// Tables of `pg_catalog`: name, and columns with their types. A question mark is for a column that may be NULL, and is
/// unless a row says otherwise; the others are 0, false or empty.
const CATALOG_TABLES: [(&str, &str); 19] = [
    (
        "pg_class",
        "oid:oid relname:name relnamespace:regnamespace reltype:oid reloftype:oid relowner:oid relam:oid relfilenode:oid \
         reltablespace:oid relpages:int4 reltuples:float4 relallvisible:int4 reltoastrelid:oid relhasindex:bool \
         relisshared:bool relpersistence:char relkind:char relnatts:int2 relchecks:int2 relhasrules:bool \
         relhastriggers:bool relhassubclass:bool relrowsecurity:bool relforcerowsecurity:bool relispopulated:bool \
         relreplident:char relispartition:bool relrewrite:oid relfrozenxid:int4 relminmxid:int4 relacl:text[]? \
         reloptions:text[]? relpartbound:text? relhasoids:bool tableoid:oid xmin:int4",
    ),
    (
        "pg_attribute",
        "attrelid:oid attname:name atttypid:oid attlen:int2 attnum:int2 attcacheoff:int4 atttypmod:int4 attndims:int2 \
         attbyval:bool attalign:char attstorage:char attcompression:char attnotnull:bool atthasdef:bool \
         atthasmissing:bool attidentity:char attgenerated:char attisdropped:bool attislocal:bool attinhcount:int2 \
         attcollation:oid attstattarget:int4? attacl:text[]? attoptions:text[]? attfdwoptions:text[]? \
         attmissingval:text[]? tableoid:oid xmin:int4",
    ),
    ("pg_namespace", "oid:oid nspname:name nspowner:oid nspacl:text[]? tableoid:oid xmin:int4"),
    (
        "pg_database",
        "oid:oid datname:name datdba:oid encoding:int4 datlocprovider:char datistemplate:bool datallowconn:bool \
         dathasloginevt:bool datconnlimit:int4 datfrozenxid:int4 datminmxid:int4 dattablespace:oid datcollate:text \
         datctype:text datlocale:text? daticulocale:text? daticurules:text? datcollversion:text? datacl:text[]? \
         datlastsysoid:oid",
    ),
    ("pg_description", "objoid:oid classoid:oid objsubid:int4 description:text"),
    (
        "pg_tables",
        "schemaname:name tablename:name tableowner:name tablespace:name? hasindexes:bool hasrules:bool hastriggers:bool \
         rowsecurity:bool",
    ),
    ("pg_views", "schemaname:name viewname:name viewowner:name definition:text?"),
    (
        "pg_roles",
        "rolname:name rolsuper:bool rolinherit:bool rolcreaterole:bool rolcreatedb:bool rolcanlogin:bool \
         rolreplication:bool rolconnlimit:int4 rolpassword:text? rolvaliduntil:timestamptz? rolbypassrls:bool \
         rolconfig:text[]? oid:oid",
    ),
    (
        "pg_user",
        "usename:name usesysid:oid usecreatedb:bool usesuper:bool userepl:bool usebypassrls:bool passwd:text? \
         valuntil:timestamptz? useconfig:text[]?",
    ),
    ("pg_group", "groname:name grosysid:oid grolist:text[]?"),
    ("pg_indexes", "schemaname:name tablename:name indexname:name tablespace:name? indexdef:text"),
    (
        "pg_sequences",
        "schemaname:name sequencename:name sequenceowner:name data_type:oid start_value:int8 min_value:int8 \
         max_value:int8 increment_by:int8 cycle:bool cache_size:int8 last_value:int8?",
    ),
    ("pg_locks", "locktype:text database:oid relation:oid pid:int4 mode:text granted:bool"),
    ("pg_user_mappings", "umid:oid srvid:oid srvname:name umuser:oid usename:name umoptions:text[]?"),
    ("pg_ts_config_map", "mapcfg:oid maptokentype:int4 mapseqno:int4 mapdict:oid"),
    (
        "pg_shadow",
        "usename:name usesysid:oid usecreatedb:bool usesuper:bool userepl:bool usebypassrls:bool passwd:text?",
    ),
    ("pg_stat_gssapi", "pid:int4 gss_authenticated:bool principal:text? encrypted:bool credentials_delegated:bool"),
    ("pg_stat_ssl", "pid:int4 ssl:bool version:text? cipher:text? bits:int4?"),
    (
        "pg_policies",
        "schemaname:name tablename:name policyname:name permissive:text roles:text[]? cmd:text qual:text? \
         with_check:text?",
    ),
];

/// Tables of `pg_catalog` that differ from session to session.
pub(super) const SESSION_TABLES: [(&str, &str); 2] = [
    (
        "pg_settings",
        "name:text setting:text unit:text? category:text short_desc:text extra_desc:text? context:text vartype:text \
         source:text min_val:text? max_val:text? enumvals:text[]? boot_val:text? reset_val:text? sourcefile:text? \
         sourceline:int4? pending_restart:bool",
    ),
    (
        "pg_stat_activity",
        "datid:oid datname:name pid:int4 leader_pid:int4? usesysid:oid usename:name application_name:text client_addr:text? \
         client_hostname:text? client_port:int4? backend_start:timestamptz? xact_start:timestamptz? \
         query_start:timestamptz? state_change:timestamptz? wait_event_type:text? wait_event:text? state:text \
         backend_xid:int4? backend_xmin:int4? query_id:int8? query:text backend_type:text",
    ),
];

/// Tables of `information_schema`, as above.
const INFORMATION_TABLES: [(&str, &str); 18] = [
    (
        "tables",
        "table_catalog:name table_schema:name table_name:name table_type:text self_referencing_column_name:name? \
         reference_generation:text? user_defined_type_catalog:name? user_defined_type_schema:name? \
         user_defined_type_name:name? is_insertable_into:text is_typed:text commit_action:text?",
    ),
    (
        "columns",
        "table_catalog:name table_schema:name table_name:name column_name:name ordinal_position:int4 column_default:text? \
         is_nullable:text data_type:text character_maximum_length:int4? character_octet_length:int4? \
         numeric_precision:int4? numeric_precision_radix:int4? numeric_scale:int4? datetime_precision:int4? \
         interval_type:text? interval_precision:int4? character_set_catalog:name? character_set_schema:name? \
         character_set_name:name? collation_catalog:name? collation_schema:name? collation_name:name? \
         domain_catalog:name? domain_schema:name? domain_name:name? udt_catalog:name udt_schema:name udt_name:name \
         scope_catalog:name? scope_schema:name? scope_name:name? maximum_cardinality:int4? dtd_identifier:name \
         is_self_referencing:text is_identity:text identity_generation:text? identity_start:text? \
         identity_increment:text? identity_maximum:text? identity_minimum:text? identity_cycle:text \
         is_generated:text generation_expression:text? is_updatable:text",
    ),
    (
        "views",
        "table_catalog:name table_schema:name table_name:name view_definition:text? check_option:text is_updatable:text \
         is_insertable_into:text is_trigger_updatable:text is_trigger_deletable:text is_trigger_insertable_into:text",
    ),
    (
        "table_privileges",
        "grantor:name grantee:name table_catalog:name table_schema:name table_name:name privilege_type:text \
         is_grantable:text with_hierarchy:text",
    ),
    (
        "role_table_grants",
        "grantor:name grantee:name table_catalog:name table_schema:name table_name:name privilege_type:text \
         is_grantable:text with_hierarchy:text",
    ),
    (
        "character_sets",
        "character_set_catalog:name? character_set_schema:name? character_set_name:name character_repertoire:name \
         form_of_use:name default_collate_catalog:name? default_collate_schema:name? default_collate_name:name?",
    ),
    (
        "table_constraints",
        "constraint_catalog:name constraint_schema:name constraint_name:name table_catalog:name table_schema:name \
         table_name:name constraint_type:text is_deferrable:text initially_deferred:text enforced:text \
         nulls_distinct:text?",
    ),
    (
        "key_column_usage",
        "constraint_catalog:name constraint_schema:name constraint_name:name table_catalog:name table_schema:name \
         table_name:name column_name:name ordinal_position:int4 position_in_unique_constraint:int4?",
    ),
    (
        "constraint_column_usage",
        "table_catalog:name table_schema:name table_name:name column_name:name constraint_catalog:name \
         constraint_schema:name constraint_name:name",
    ),
    (
        "constraint_table_usage",
        "table_catalog:name table_schema:name table_name:name constraint_catalog:name constraint_schema:name \
         constraint_name:name",
    ),
    (
        "referential_constraints",
        "constraint_catalog:name constraint_schema:name constraint_name:name unique_constraint_catalog:name \
         unique_constraint_schema:name unique_constraint_name:name match_option:text update_rule:text delete_rule:text",
    ),
    ("check_constraints", "constraint_catalog:name constraint_schema:name constraint_name:name check_clause:text"),
    (
        "sequences",
        "sequence_catalog:name sequence_schema:name sequence_name:name data_type:text numeric_precision:int4 \
         numeric_precision_radix:int4 numeric_scale:int4 start_value:text minimum_value:text maximum_value:text \
         increment:text cycle_option:text",
    ),
    (
        "triggers",
        "trigger_catalog:name trigger_schema:name trigger_name:name event_manipulation:text event_object_catalog:name \
         event_object_schema:name event_object_table:name action_order:int4 action_condition:text? \
         action_statement:text action_orientation:text action_timing:text created:timestamptz?",
    ),
    ("domains", "domain_catalog:name domain_schema:name domain_name:name data_type:text udt_name:name"),
    (
        "element_types",
        "object_catalog:name object_schema:name object_name:name object_type:text collection_type_identifier:name \
         data_type:text udt_catalog:name udt_schema:name udt_name:name dtd_identifier:name",
    ),
    (
        "column_privileges",
        "grantor:name grantee:name table_catalog:name table_schema:name table_name:name column_name:name \
         privilege_type:text is_grantable:text",
    ),
    ("enabled_roles", "role_name:name"),
];

/// The number of a table of `pg_catalog`, if it is fixed.
pub(super) fn number_of(table: &str) -> Option<i32> {
    FIXED.iter().find(|(known, _)| *known == table).map(|(_, number)| *number)
}

/// True for a table that is found without its schema: all but those of `information_schema` and `system`.
pub(super) fn is_searched(number: i32) -> bool {
    !(INFORMATION_SCHEMA..FIRST_TABLE).contains(&number) && number < FIRST_SYSTEM_TABLE
}

/// Comments of the lake's tables and views.
const COMMENTS: [(&str, &str); 16] = [
    ("augmented", "One row per measurement and symmetry: transformed geometry, samples, transformed height map"),
    ("catalogue", "One row per surface: its description and its measurements"),
    ("environment", "One row per reading of the ambient sensor"),
    ("events", "One row per line of a run's log"),
    ("heightmaps", "One row per surface and symmetry"),
    ("ir", "One row per measurement: geometry and samples"),
    ("measurements", "One row per accepted measurement, with its impulse response"),
    ("nce", "One row per measurement: its reflected response and its cumulative energy curves"),
    ("pairs", "One row per pair"),
    ("points", "One row per grid point"),
    ("runs", "One row per run; readers see only the rows of runs that it names"),
    ("surface_stats", "One row per surface and band"),
    ("surfaces", "One row per run, with its record of the surface"),
    ("tnce", "One row per measurement: its energies"),
    ("tnce_d4", "One row per measurement and symmetry: energies with transformed positions"),
    ("tnce_db", "One row per measurement: TNCE in dB, with geometry"),
];

/// The values of a row that differ from what its columns have by themselves.
type RowValues = Vec<(&'static str, ScalarValue)>;

/// Tables by name.
pub(super) type NamedTables = BTreeMap<String, Arc<dyn TableProvider>>;

/// A table or view of which the catalogue tells.
struct CatalogRelation {
    number: i32,
    namespace: (i32, &'static str),
    name: String,
    schema: SchemaRef,
    is_view: bool,
    is_own: bool,
    /// The SQL of a view of the lake.
    definition: Option<String>,
}

/// What the catalogue tells of a lake's tables.
pub(super) struct CatalogRelations {
    relations: Vec<CatalogRelation>,
}

impl CatalogRelations {
    /// Of the lake's tables and views, the system tables, and those of `pg_catalog` that are not in this file.
    pub(super) fn new(service: &QueryService, fixed: &[(String, SchemaRef)]) -> Self {
        let mut definitions = service.view_definitions();
        let own = (FIRST_TABLE..).zip(service.tables()).map(|(number, (name, schema))| CatalogRelation {
            number,
            namespace: (PUBLIC, SCHEMA),
            name: name.to_owned(),
            schema,
            is_view: Table::by_name(name).is_none(),
            is_own: true,
            definition: definitions.remove(name),
        });
        let system =
            (FIRST_SYSTEM_TABLE..).zip(service.system_tables()).map(|(number, (name, schema))| CatalogRelation {
                number,
                namespace: (SYSTEM, SYSTEM_SCHEMA),
                name: name.to_owned(),
                schema,
                is_view: false,
                is_own: true,
                definition: None,
            });
        let here = CATALOG_TABLES
            .iter()
            .chain(&SESSION_TABLES)
            .map(|(name, columns)| ((*name).to_owned(), schema_of(columns)));
        let missing = |(name, _): &&(String, SchemaRef)| CATALOG_TABLES.iter().all(|(own, _)| own != name);
        let catalog = here.chain(fixed.iter().filter(missing).cloned());
        let of_catalog = (FIRST_CATALOG_TABLE..).zip(catalog).map(|(number, (name, schema))| CatalogRelation {
            number: number_of(&name).unwrap_or(number),
            namespace: (PG_CATALOG, "pg_catalog"),
            name,
            schema,
            is_view: false,
            is_own: false,
            definition: None,
        });
        let of_information =
            (INFORMATION_SCHEMA + 1..).zip(INFORMATION_TABLES).map(|(number, (name, columns))| CatalogRelation {
                number,
                namespace: (INFORMATION_SCHEMA, "information_schema"),
                name: name.to_owned(),
                schema: schema_of(columns),
                is_view: true,
                is_own: false,
                definition: None,
            });
        Self { relations: own.chain(system).chain(of_catalog).chain(of_information).collect() }
    }

    /// Definitions of views by their numbers.
    pub(super) fn definitions(&self) -> HashMap<i32, String> {
        self.relations.iter().filter_map(|of| Some((of.number, of.definition.clone()?))).collect()
    }

    /// Numbers of tables by name, and by schema and name.
    pub(super) fn numbers(&self) -> HashMap<String, i32> {
        let both = |of: &CatalogRelation| {
            let alone = (of.namespace.0 != SYSTEM).then(|| (of.name.clone(), of.number));
            [(format!("{}.{}", of.namespace.1, of.name), of.number)].into_iter().chain(alone)
        };
        // A name without a schema is the lake's, then that of `pg_catalog`.
        self.relations.iter().rev().flat_map(both).collect()
    }

    /// Comments by the numbers of their table and column; those of tables by column 0.
    pub(super) fn comments(&self) -> CatalogComments {
        let of_column = |(of, at, field): (&CatalogRelation, i16, &Arc<Field>)| {
            Some(((of.number, i32::from(at)), field.metadata().get(COMMENT)?.clone()))
        };
        let of_table = |of: &CatalogRelation| {
            let known = COMMENTS.iter().find(|(name, _)| of.namespace.0 == PUBLIC && *name == of.name);
            let of_system = || table_meaning(&format!("{}.{}", of.namespace.1, of.name));
            let comment = known.map(|(_, comment)| *comment).or_else(of_system)?;
            Some(((of.number, 0), comment.to_owned()))
        };
        self.fields().filter_map(of_column).chain(self.relations.iter().filter_map(of_table)).collect()
    }

    /// The tables of `pg_catalog` in this file; comments follow those that Postgres has.
    pub(super) fn catalog_tables(&self, comments: Vec<RecordBatch>) -> Result<NamedTables> {
        let mut comments = Some(comments);
        let table = |(name, columns): &(&str, &str)| {
            let rows = match *name {
                "pg_class" => self.relations.iter().map(class_row).collect(),
                "pg_attribute" => self.fields().map(|(of, at, field)| attribute_row(of, at, field)).collect(),
                "pg_namespace" => namespaces(),
                "pg_database" => vec![database()],
                "pg_description" => self.comments().iter().map(comment_row).collect(),
                "pg_tables" => self.relations.iter().filter(|of| !of.is_view).map(table_row).collect(),
                "pg_views" => self.relations.iter().filter(|of| of.is_view).map(view_row).collect(),
                "pg_roles" => vec![role("rolname", "oid")],
                "pg_user" => vec![role("usename", "usesysid")],
                _ => Vec::new(),
            };
            let mut batches = vec![batch_of(columns, &rows)?];
            if *name == "pg_description" {
                for batch in comments.take().into_iter().flatten() {
                    batches.push(like(&batches[0].schema(), &batch)?);
                }
            }
            provider((*name).to_owned(), batches)
        };
        CATALOG_TABLES.iter().map(table).collect()
    }

    /// The tables of `information_schema`.
    pub(super) fn information_tables(&self) -> Result<NamedTables> {
        let table = |(name, columns): &(&str, &str)| {
            let rows = match *name {
                "tables" => self.relations.iter().map(listed_table).collect(),
                "columns" => self.fields().map(|(of, at, field)| listed_column(of, at, field)).collect(),
                "views" => self.relations.iter().filter(|of| of.is_view).map(listed_view).collect(),
                "table_privileges" | "role_table_grants" => {
                    self.relations.iter().filter(|of| of.is_own).map(listed_privilege).collect()
                }
                "character_sets" => vec![vec![
                    ("character_set_name", text("UTF8")),
                    ("character_repertoire", text("UCS")),
                    ("form_of_use", text("UTF8")),
                    ("default_collate_catalog", text(CATALOG)),
                    ("default_collate_schema", text("pg_catalog")),
                    ("default_collate_name", text("C")),
                ]],
                "enabled_roles" => vec![vec![("role_name", text(ROLE))]],
                _ => Vec::new(),
            };
            provider((*name).to_owned(), vec![batch_of(columns, &rows)?])
        };
        INFORMATION_TABLES.iter().map(table).collect()
    }

    // Each column with its table and its position from 1. A column that cannot be sent is left out.
    fn fields(&self) -> impl Iterator<Item = (&CatalogRelation, i16, &Arc<Field>)> {
        let of = |relation| (1..).zip(CatalogRelation::fields(relation)).map(move |(at, field)| (relation, at, field));
        self.relations.iter().flat_map(of)
    }
}

impl CatalogRelation {
    fn fields(&self) -> impl Iterator<Item = &Arc<Field>> {
        self.schema.fields().iter()
    }
}

/// A table of the session of this number and these settings, if it is one of [`SESSION_TABLES`].
pub(super) fn session_table(
    name: &str,
    pid: i32,
    settings: &[(&'static str, String)],
) -> Result<Option<Arc<dyn TableProvider>>> {
    let Some((_, columns)) = SESSION_TABLES.iter().find(|(known, _)| *known == name) else { return Ok(None) };
    let setting =
        |name: &str| settings.iter().find(|(known, _)| *known == name).map_or("", |(_, value)| value.as_str());
    let rows = match name {
        "pg_settings" => settings.iter().map(|(name, value)| setting_row(name, value)).collect(),
        _ => vec![vec![
            ("datid", number(DATABASE)),
            ("datname", text(CATALOG)),
            ("pid", number(pid)),
            ("usesysid", number(OWNER)),
            ("usename", text(ROLE)),
            ("application_name", text(setting("application_name"))),
            ("state", text("active")),
            ("backend_type", text("client backend")),
        ]],
    };
    Ok(Some(provider(name.to_owned(), vec![batch_of(columns, &rows)?])?.1))
}

fn setting_row(name: &str, value: &str) -> RowValues {
    vec![
        ("name", text(name)),
        ("setting", text(value)),
        ("context", text("user")),
        ("vartype", text("string")),
        ("source", text("default")),
        ("reset_val", text(value)),
    ]
}

fn provider(name: String, batches: Vec<RecordBatch>) -> Result<(String, Arc<dyn TableProvider>)> {
    let schema = batches[0].schema();
    Ok((name, Arc::new(MemTable::try_new(schema, vec![batches])?)))
}

fn text(text: &str) -> ScalarValue {
    ScalarValue::Utf8(Some(text.to_owned()))
}

fn number(number: i32) -> ScalarValue {
    ScalarValue::Int32(Some(number))
}

fn small(number: i16) -> ScalarValue {
    ScalarValue::Int16(Some(number))
}

fn yes() -> ScalarValue {
    ScalarValue::Boolean(Some(true))
}

fn class_row(of: &CatalogRelation) -> RowValues {
    vec![
        ("oid", number(of.number)),
        ("relname", text(&of.name)),
        ("relnamespace", number(of.namespace.0)),
        ("relowner", number(OWNER)),
        ("relam", number(if of.is_view { 0 } else { 2 })),
        ("reltuples", ScalarValue::Float32(Some(-1.0))),
        ("relpersistence", text("p")),
        ("relkind", text(if of.is_view { "v" } else { "r" })),
        ("relnatts", small(of.schema.fields().len() as i16)),
        ("relhasrules", ScalarValue::Boolean(Some(of.is_view))),
        ("relispopulated", yes()),
        ("relreplident", text("n")),
        ("tableoid", number(PG_CLASS)),
        ("xmin", number(1)),
    ]
}

// A list of lists has no type of Postgres' and is a text there.
fn type_of(field: &Arc<Field>) -> Type {
    field_into_pg_type(field).ok().filter(|kind| *kind != Type::UNKNOWN).unwrap_or(Type::TEXT)
}

fn attribute_row(of: &CatalogRelation, at: i16, field: &Arc<Field>) -> RowValues {
    let kind = type_of(field);
    // Bytes of a value, if they are fixed, its alignment, and what cannot leave its row.
    let (length, alignment) = match kind {
        Type::BOOL | Type::CHAR => (1, "c"),
        Type::INT2 => (2, "s"),
        Type::INT4 | Type::FLOAT4 | Type::DATE => (4, "i"),
        Type::INT8 | Type::FLOAT8 | Type::TIMESTAMP | Type::TIMESTAMPTZ | Type::TIME => (8, "d"),
        _ if field.metadata().contains_key(PG_OID_ALIAS_KEY) => (4, "i"),
        _ => (-1, "i"),
    };
    let is_list = matches!(field.data_type(), DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(..));
    vec![
        ("attrelid", number(of.number)),
        ("attname", text(field.name())),
        ("atttypid", number(kind.oid() as i32)),
        ("attlen", small(length)),
        ("attnum", small(at)),
        ("attcacheoff", number(-1)),
        ("atttypmod", number(-1)),
        ("attndims", small(i16::from(is_list))),
        ("attbyval", ScalarValue::Boolean(Some(length > 0))),
        ("attalign", text(alignment)),
        ("attstorage", text(if length > 0 { "p" } else { "x" })),
        ("attnotnull", ScalarValue::Boolean(Some(!field.is_nullable()))),
        ("attislocal", yes()),
        ("attcollation", number(if kind == Type::TEXT { 100 } else { 0 })),
        ("xmin", number(1)),
    ]
}

fn comment_row((place, comment): (&(i32, i32), &String)) -> RowValues {
    vec![
        ("objoid", number(place.0)),
        ("classoid", number(PG_CLASS)),
        ("objsubid", number(place.1)),
        ("description", text(comment)),
    ]
}

/// Numbers and names of the schemas.
pub(super) fn schemas() -> [(i32, &'static str); 4] {
    [(PG_CATALOG, "pg_catalog"), (PUBLIC, SCHEMA), (SYSTEM, SYSTEM_SCHEMA), (INFORMATION_SCHEMA, "information_schema")]
}

fn namespaces() -> Vec<RowValues> {
    let row = |(oid, name)| {
        vec![("oid", number(oid)), ("nspname", text(name)), ("nspowner", number(OWNER)), ("xmin", number(1))]
    };
    schemas().into_iter().map(row).collect()
}

fn database() -> RowValues {
    vec![
        ("oid", number(DATABASE)),
        ("datname", text(CATALOG)),
        ("datdba", number(OWNER)),
        // UTF8.
        ("encoding", number(6)),
        ("datlocprovider", text("c")),
        ("datallowconn", yes()),
        ("datconnlimit", number(-1)),
        ("dattablespace", number(1663)),
        ("datcollate", text("C")),
        ("datctype", text("C")),
    ]
}

fn role(name: &'static str, oid: &'static str) -> RowValues {
    let mut row = vec![(name, text(ROLE)), (oid, number(OWNER))];
    if name == "rolname" {
        row.extend([("rolinherit", yes()), ("rolcanlogin", yes()), ("rolconnlimit", number(-1))]);
    }
    row
}

fn table_row(of: &CatalogRelation) -> RowValues {
    vec![("schemaname", text(of.namespace.1)), ("tablename", text(&of.name)), ("tableowner", text(ROLE))]
}

fn view_row(of: &CatalogRelation) -> RowValues {
    vec![
        ("schemaname", text(of.namespace.1)),
        ("viewname", text(&of.name)),
        ("viewowner", text(ROLE)),
        ("definition", ScalarValue::Utf8(of.definition.clone())),
    ]
}

fn place(of: &CatalogRelation) -> RowValues {
    vec![("table_catalog", text(CATALOG)), ("table_schema", text(of.namespace.1)), ("table_name", text(&of.name))]
}

fn listed_table(of: &CatalogRelation) -> RowValues {
    let kind = if of.is_view { "VIEW" } else { "BASE TABLE" };
    let rest = [("table_type", text(kind)), ("is_insertable_into", text("NO")), ("is_typed", text("NO"))];
    place(of).into_iter().chain(rest).collect()
}

fn listed_view(of: &CatalogRelation) -> RowValues {
    let flags = [
        "is_updatable",
        "is_insertable_into",
        "is_trigger_updatable",
        "is_trigger_deletable",
        "is_trigger_insertable_into",
    ];
    let rest = flags
        .map(|flag| (flag, text("NO")))
        .into_iter()
        .chain([("check_option", text("NONE")), ("view_definition", ScalarValue::Utf8(of.definition.clone()))]);
    place(of).into_iter().chain(rest).collect()
}

fn listed_privilege(of: &CatalogRelation) -> RowValues {
    let rest = [
        ("grantor", text(ROLE)),
        ("grantee", text(ROLE)),
        ("privilege_type", text("SELECT")),
        ("is_grantable", text("NO")),
        ("with_hierarchy", text("YES")),
    ];
    place(of).into_iter().chain(rest).collect()
}

fn listed_column(of: &CatalogRelation, at: i16, field: &Arc<Field>) -> RowValues {
    let kind = type_of(field);
    let no = || text("NO");
    let mut row = place(of);
    row.extend([
        ("column_name", text(field.name())),
        ("ordinal_position", number(i32::from(at))),
        ("is_nullable", text(if field.is_nullable() { "YES" } else { "NO" })),
        ("data_type", text(name_of(&kind))),
        ("udt_catalog", text(CATALOG)),
        ("udt_schema", text("pg_catalog")),
        ("udt_name", text(kind.name())),
        ("dtd_identifier", text(&at.to_string())),
        ("is_self_referencing", no()),
        ("is_identity", no()),
        ("identity_cycle", no()),
        ("is_generated", text("NEVER")),
        ("is_updatable", no()),
    ]);
    // Digits in the base, the base, and digits after the point.
    let precision = match kind {
        Type::INT2 => Some((16, 2, Some(0))),
        Type::INT4 => Some((32, 2, Some(0))),
        Type::INT8 => Some((64, 2, Some(0))),
        Type::FLOAT4 => Some((24, 2, None)),
        Type::FLOAT8 => Some((53, 2, None)),
        _ => None,
    };
    if let Some((digits, base, scale)) = precision {
        row.extend([("numeric_precision", number(digits)), ("numeric_precision_radix", number(base))]);
        row.extend(scale.map(|scale| ("numeric_scale", number(scale))));
    }
    match kind {
        Type::DATE => row.push(("datetime_precision", number(0))),
        Type::TIMESTAMP | Type::TIMESTAMPTZ | Type::TIME => row.push(("datetime_precision", number(6))),
        Type::TEXT => row.push(("character_octet_length", number(1 << 30))),
        _ => {}
    }
    row
}

/// A type's name in `information_schema`.
fn name_of(kind: &Type) -> &str {
    // Postgres writes a type of arrays so.
    if kind.name().starts_with('_') { "ARRAY" } else { long_name(kind.name()) }
}

/// A type's name as SQL writes it, from its name in `pg_type`.
pub(super) fn long_name(short: &str) -> &str {
    match short {
        "bool" => "boolean",
        "int2" => "smallint",
        "int4" => "integer",
        "int8" => "bigint",
        "float4" => "real",
        "float8" => "double precision",
        "timestamp" => "timestamp without time zone",
        "timestamptz" => "timestamp with time zone",
        "time" => "time without time zone",
        "varchar" => "character varying",
        "char" => "\"char\"",
        other => other,
    }
}

fn schema_of(columns: &str) -> SchemaRef {
    Arc::new(Schema::new(columns.split_whitespace().map(field_of).collect::<Vec<_>>()))
}

fn field_of(column: &str) -> Field {
    let (name, kind) = column.split_once(':').unwrap_or((column, "text"));
    let nullable = kind.ends_with('?');
    let kind = kind.trim_end_matches('?');
    let tagged = |data_type, key: &str, value: &str| {
        Field::new(name, data_type, nullable).with_metadata([(key.to_owned(), value.to_owned())].into())
    };
    let data_type = match kind {
        "bool" => DataType::Boolean,
        "int2" => DataType::Int16,
        "int4" => DataType::Int32,
        "int8" => DataType::Int64,
        "float4" => DataType::Float32,
        "timestamptz" => DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into())),
        "text[]" => DataType::new_list(DataType::Utf8, true),
        "char" => return tagged(DataType::Utf8, PG_CHAR_KEY, "char"),
        "oid" | "regnamespace" => return tagged(DataType::Int32, PG_OID_ALIAS_KEY, "oid"),
        _ => DataType::Utf8,
    };
    Field::new(name, data_type, nullable)
}

fn batch_of(columns: &str, rows: &[RowValues]) -> Result<RecordBatch> {
    let schema = schema_of(columns);
    let column = |field: &Arc<Field>| -> Result<ArrayRef> {
        let usual = match (field.is_nullable(), field.data_type()) {
            (false, DataType::Utf8) => text(""),
            (false, kind) => ScalarValue::new_zero(kind).unwrap_or(ScalarValue::Boolean(Some(false))),
            (true, kind) => ScalarValue::try_from(kind)?,
        };
        if rows.is_empty() {
            return Ok(new_null_array(field.data_type(), 0));
        }
        let value = |row: &RowValues| {
            row.iter().find(|(name, _)| name == field.name()).map_or_else(|| usual.clone(), |(_, value)| value.clone())
        };
        ScalarValue::iter_to_array(rows.iter().map(value))
    };
    let arrays = schema.fields().iter().map(column).collect::<Result<Vec<_>>>()?;
    Ok(RecordBatch::try_new(schema, arrays)?)
}

// The same rows with these fields.
fn like(schema: &SchemaRef, batch: &RecordBatch) -> Result<RecordBatch> {
    let column = |field: &Arc<Field>| {
        let rows = batch.column_by_name(field.name()).cloned();
        let rows = rows.unwrap_or_else(|| new_null_array(field.data_type(), batch.num_rows()));
        Ok(arrow::compute::cast(&rows, field.data_type())?)
    };
    let columns = schema.fields().iter().map(column).collect::<Result<Vec<_>>>()?;
    Ok(RecordBatch::try_new(schema.clone(), columns)?)
}

#[cfg(test)]
mod tests {
    use super::*;

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
            assert_eq!(name_of(&type_of(&field)), expected, "{field}");
        }
    }
}
