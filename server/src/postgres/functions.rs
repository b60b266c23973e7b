//! Functions that Postgres' clients call to learn about the server. Most have one answer here, since there are no
//! indexes and triggers to speak of.

use std::collections::HashMap;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, BooleanArray, Int32Array, StringArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Int32Type};
use datafusion::common::ScalarValue;
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{
    ColumnarValue, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature, Volatility,
};
use datafusion::prelude::create_udf;
use datafusion_pg_catalog::pg_catalog as pg;

use super::catalog::ROLE;
use super::fixed_tables::function_name;
use super::relations;
use super::settings::{SessionSettings, VERSION};
use super::text_functions;

/// Functions that are the same in all sessions.
pub(super) fn fixed() -> Vec<Arc<ScalarUDF>> {
    let mut all = vec![
        pg::create_current_database_udf(crate::service::CATALOG),
        pg::create_current_schema_udf(),
        pg::create_current_schemas_udf(),
        pg::create_pg_get_userbyid_udf(),
        pg::format_type::create_format_type_udf(),
        pg::create_session_user_udf(),
        pg::pg_get_expr_udf::create_pg_get_expr_udf(),
        pg::create_pg_get_partkeydef_udf(),
        pg::create_pg_relation_is_publishable_udf(),
        pg::create_pg_get_statisticsobjdef_columns_udf(),
        pg::create_pg_encoding_to_char_udf(),
        pg::create_pg_relation_size_udf(),
        pg::create_pg_total_relation_size_udf(),
        pg::create_pg_stat_get_numscans(),
        pg::create_pg_get_constraintdef(),
        pg::create_pg_get_partition_ancestors_udf(),
        pg::quote_ident_udf::create_quote_ident_udf(),
        pg::quote_ident_udf::create_parse_ident_udf(),
        pg::array_bounds_udf::create_array_upper_udf(),
        pg::array_bounds_udf::create_array_lower_udf(),
    ];
    let texts = [
        ("user", Some(ROLE.to_owned())),
        ("current_user", Some(ROLE.to_owned())),
        ("version", Some(format!("PostgreSQL {VERSION}"))),
        ("pg_client_encoding", Some("UTF8".to_owned())),
        ("getdatabaseencoding", Some("UTF8".to_owned())),
        ("pg_advisory_unlock_all", Some(String::new())),
        ("pg_describe_object", None),
        ("pg_get_function_sqlbody", None),
        ("pg_get_functiondef", None),
        ("pg_get_indexdef", None),
        ("pg_get_triggerdef", None),
        ("pg_get_ruledef", None),
        ("pg_get_serial_sequence", None),
        ("pg_get_partition_constraintdef", None),
        ("shobj_description", None),
        ("pg_tablespace_location", Some(String::new())),
        ("pg_relation_filepath", None),
        ("inet_server_addr", None),
        ("inet_client_addr", None),
    ];
    all.extend(texts.map(|(name, text)| ConstantAnswer::udf(name, ScalarValue::Utf8(text))));
    let visible = [
        "pg_function_is_visible",
        "pg_type_is_visible",
        "pg_operator_is_visible",
        "pg_opclass_is_visible",
        "pg_opfamily_is_visible",
        "pg_collation_is_visible",
        "pg_conversion_is_visible",
        "pg_statistics_obj_is_visible",
        "pg_ts_config_is_visible",
        "pg_ts_dict_is_visible",
        "pg_ts_parser_is_visible",
        "pg_ts_template_is_visible",
        "pg_has_role",
    ];
    all.extend(visible.map(|name| ConstantAnswer::udf(name, ScalarValue::Boolean(Some(true)))));
    let never = ["pg_is_in_recovery", "pg_is_other_temp_schema"];
    all.extend(never.map(|name| ConstantAnswer::udf(name, ScalarValue::Boolean(Some(false)))));
    let sizes = ["pg_table_size", "pg_indexes_size", "pg_database_size", "pg_tablespace_size"];
    all.extend(sizes.map(|name| ConstantAnswer::udf(name, ScalarValue::Int64(Some(0)))));
    all.push(ConstantAnswer::udf("pg_my_temp_schema", ScalarValue::Int32(Some(0))));
    all.push(ConstantAnswer::udf("pg_index_column_has_property", ScalarValue::Boolean(None)));
    // UTF8.
    all.push(ConstantAnswer::udf("pg_char_to_encoding", ScalarValue::Int32(Some(6))));
    all.push(ScalarUDF::new_from_impl(JsonObject::new()));
    all.extend(text_functions::all());
    all.into_iter().map(Arc::new).collect()
}

/// What the catalogue's numbers stand for.
pub(super) struct CatalogNumbers {
    pub(super) types: HashMap<String, i32>,
    pub(super) procedures: HashMap<String, i32>,
    pub(super) relations: HashMap<String, i32>,
    pub(super) schemas: HashMap<String, i32>,
    /// Arguments and results of functions.
    pub(super) signatures: HashMap<i32, (String, String)>,
    /// Comments by table and column; those of tables by column 0.
    pub(super) comments: HashMap<(i32, i32), String>,
    /// Definitions of views.
    pub(super) definitions: HashMap<i32, String>,
}

/// Functions that look something up in the catalogue: NULL if it is not there.
pub(super) fn lookups(numbers: CatalogNumbers) -> Vec<Arc<ScalarUDF>> {
    let CatalogNumbers { types, procedures, relations, schemas, signatures, comments, definitions } = numbers;
    let (signatures, comments) = (Arc::new(signatures), Arc::new(comments));
    let arguments = |name| {
        let signatures = signatures.clone();
        text_of_number(name, move |number| Some(signatures.get(&number).map_or("", |(args, _)| args).to_owned()))
    };
    let results = signatures.clone();
    let tables = comments.clone();
    vec![
        text_of_number("function_name", |number| function_name(number).map(str::to_owned)),
        number_of_name("to_regtype", move |name| types.get(short_type_name(name)).copied()),
        number_of_name("to_regproc", move |name| procedures.get(name.split('(').next().unwrap_or(name)).copied()),
        number_of_name("to_regclass", move |name| relations.get(name).copied()),
        number_of_name("to_regnamespace", move |name| schemas.get(name).copied()),
        arguments("pg_get_function_arguments"),
        arguments("pg_get_function_identity_arguments"),
        text_of_number("pg_get_function_result", move |number| {
            Some(results.get(&number).map_or("", |(_, result)| result).to_owned())
        }),
        Arc::new(create_udf(
            "pg_table_is_visible",
            vec![DataType::Int32],
            DataType::Boolean,
            Volatility::Stable,
            Arc::new(|args: &[ColumnarValue]| {
                let numbers = cast(&ColumnarValue::values_to_arrays(args)?[0], &DataType::Int32)?;
                let visible = numbers.as_primitive::<Int32Type>().iter().map(|n| n.map(relations::is_searched));
                Ok(ColumnarValue::Array(Arc::new(visible.collect::<BooleanArray>())))
            }),
        )),
        Arc::new(text_functions::view_definition("pg_get_viewdef", definitions)),
        Arc::new(text_functions::comment_of_table("obj_description", tables)),
        Arc::new(text_functions::comment_of_column("col_description", comments)),
    ]
}

// A name as clients write it, with or without quotes and the schema that Postgres always searches.
fn number_of_name(name: &'static str, find: impl Fn(&str) -> Option<i32> + Send + Sync + 'static) -> Arc<ScalarUDF> {
    let find = move |args: &[ColumnarValue]| {
        let names = cast(&ColumnarValue::values_to_arrays(args)?[0], &DataType::Utf8)?;
        let number = |name: Option<&str>| {
            let name = name?.trim().replace('"', "");
            name.parse().ok().or_else(|| find(name.strip_prefix("pg_catalog.").unwrap_or(&name)))
        };
        let numbers: Int32Array = names.as_string::<i32>().iter().map(number).collect();
        Ok(ColumnarValue::Array(Arc::new(numbers)))
    };
    Arc::new(create_udf(name, vec![DataType::Utf8], DataType::Int32, Volatility::Stable, Arc::new(find)))
}

fn text_of_number(name: &'static str, find: impl Fn(i32) -> Option<String> + Send + Sync + 'static) -> Arc<ScalarUDF> {
    let find = move |args: &[ColumnarValue]| {
        let numbers = cast(&ColumnarValue::values_to_arrays(args)?[0], &DataType::Int32)?;
        let texts: StringArray = numbers.as_primitive::<Int32Type>().iter().map(|n| n.and_then(&find)).collect();
        Ok(ColumnarValue::Array(Arc::new(texts)))
    };
    Arc::new(create_udf(name, vec![DataType::Int32], DataType::Utf8, Volatility::Stable, Arc::new(find)))
}

/// The short name of a type, as `pg_type` has it.
pub(super) fn short_type_name(name: &str) -> &str {
    match name {
        "boolean" => "bool",
        "smallint" => "int2",
        "integer" | "int" => "int4",
        "bigint" => "int8",
        "real" => "float4",
        "double precision" => "float8",
        "character varying" => "varchar",
        "decimal" => "numeric",
        "timestamp without time zone" => "timestamp",
        "timestamp with time zone" => "timestamptz",
        other => other,
    }
}

/// Functions of the session of this number and these settings.
pub(super) fn of_session(pid: i32, settings: &Arc<SessionSettings>) -> Vec<Arc<ScalarUDF>> {
    let udf = |kind| Arc::new(ScalarUDF::new_from_impl(OfSettings::new(kind, settings.clone())));
    let number = ConstantAnswer::udf("pg_backend_pid", ScalarValue::Int32(Some(pid)));
    vec![udf(SettingFunction::Get), udf(SettingFunction::Set), Arc::new(number)]
}

/// A function with one answer, whatever it is given.
#[derive(Debug, PartialEq, Eq, Hash)]
struct ConstantAnswer {
    name: &'static str,
    signature: Signature,
    answer: ScalarValue,
}

impl ConstantAnswer {
    fn udf(name: &'static str, answer: ScalarValue) -> ScalarUDF {
        let any = vec![TypeSignature::Nullary, TypeSignature::VariadicAny];
        ScalarUDF::new_from_impl(Self { name, signature: Signature::one_of(any, Volatility::Stable), answer })
    }
}

impl ScalarUDFImpl for ConstantAnswer {
    fn name(&self) -> &str {
        self.name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, _: &[DataType]) -> Result<DataType> {
        Ok(self.answer.data_type())
    }

    fn invoke_with_args(&self, _: ScalarFunctionArgs) -> Result<ColumnarValue> {
        Ok(ColumnarValue::Scalar(self.answer.clone()))
    }
}

/// `json_build_object(key, value, ...)`, as a text.
#[derive(Debug, PartialEq, Eq, Hash)]
struct JsonObject(Signature);

impl JsonObject {
    fn new() -> Self {
        let any = vec![TypeSignature::Nullary, TypeSignature::VariadicAny];
        Self(Signature::one_of(any, Volatility::Immutable))
    }
}

impl ScalarUDFImpl for JsonObject {
    fn name(&self) -> &str {
        "json_build_object"
    }

    fn signature(&self) -> &Signature {
        &self.0
    }

    fn return_type(&self, _: &[DataType]) -> Result<DataType> {
        Ok(DataType::Utf8)
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let columns = args.args.iter().map(|v| v.to_array(args.number_rows)).collect::<Result<Vec<_>>>()?;
        let object = |row: usize| {
            let mut object = serde_json::Map::new();
            for pair in columns.chunks(2) {
                let [key, value] = pair else {
                    return Err(DataFusionError::Execution("json_build_object needs a value for each key".to_owned()));
                };
                let key = ScalarValue::try_from_array(key, row)?.to_string();
                let value = ScalarValue::try_from_array(value, row)?;
                object.insert(key, json(&value));
            }
            Ok(serde_json::Value::Object(object).to_string())
        };
        let objects = (0..args.number_rows).map(object).collect::<Result<Vec<_>>>()?;
        Ok(ColumnarValue::Array(Arc::new(StringArray::from(objects))))
    }
}

fn json(value: &ScalarValue) -> serde_json::Value {
    if value.is_null() {
        return serde_json::Value::Null;
    }
    let text = value.to_string();
    match value.data_type() {
        DataType::Boolean => serde_json::Value::Bool(text == "true"),
        kind if kind.is_numeric() => serde_json::from_str(&text).unwrap_or(serde_json::Value::String(text)),
        _ => serde_json::Value::String(text),
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum SettingFunction {
    Get,
    Set,
}

/// `current_setting(name [, missing_ok])` and `set_config(name, value, is_local)`, within what SET may.
#[derive(Debug)]
struct OfSettings {
    kind: SettingFunction,
    signature: Signature,
    settings: Arc<SessionSettings>,
}

impl PartialEq for OfSettings {
    fn eq(&self, other: &Self) -> bool {
        self.kind == other.kind && Arc::ptr_eq(&self.settings, &other.settings)
    }
}

impl Eq for OfSettings {}

impl Hash for OfSettings {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.kind.hash(state);
    }
}

impl OfSettings {
    fn new(kind: SettingFunction, settings: Arc<SessionSettings>) -> Self {
        use DataType::{Boolean, Utf8};
        let signature = match kind {
            SettingFunction::Get => Signature::one_of(
                vec![TypeSignature::Exact(vec![Utf8]), TypeSignature::Exact(vec![Utf8, Boolean])],
                Volatility::Stable,
            ),
            SettingFunction::Set => Signature::exact(vec![Utf8, Utf8, Boolean], Volatility::Volatile),
        };
        Self { kind, signature, settings }
    }

    fn one(&self, name: &str, value: Option<&str>, missing_ok: bool) -> Result<Option<String>> {
        let wrong = |e: crate::fault::RequestFault| DataFusionError::Execution(e.to_string());
        if let (SettingFunction::Set, Some(value)) = (self.kind, value) {
            self.settings.set(name, value).map_err(wrong)?;
        }
        match self.settings.get(name) {
            Ok(value) => Ok(Some(value)),
            Err(_) if missing_ok => Ok(None),
            Err(fault) => Err(wrong(fault)),
        }
    }
}

impl ScalarUDFImpl for OfSettings {
    fn name(&self) -> &str {
        match self.kind {
            SettingFunction::Get => "current_setting",
            SettingFunction::Set => "set_config",
        }
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, _: &[DataType]) -> Result<DataType> {
        Ok(DataType::Utf8)
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let columns = ColumnarValue::values_to_arrays(&args.args)?;
        let texts = |column: &ArrayRef| cast(column, &DataType::Utf8);
        let names = texts(&columns[0])?;
        let names = names.as_string::<i32>();
        let second = columns.get(1);
        let values = match (self.kind, second) {
            (SettingFunction::Set, Some(column)) => Some(texts(column)?),
            _ => None,
        };
        let missing_ok = match (self.kind, second) {
            (SettingFunction::Get, Some(column)) => Some(column.as_boolean()),
            _ => None,
        };
        let answers = (0..names.len()).map(|row| {
            if names.is_null(row) {
                return Ok(None);
            }
            let value = values.as_ref().map(|v| v.as_string::<i32>()).filter(|v| v.is_valid(row)).map(|v| v.value(row));
            self.one(names.value(row), value, missing_ok.is_some_and(|m| m.is_valid(row) && m.value(row)))
        });
        let answers = answers.collect::<Result<Vec<_>>>()?;
        if let [one] = &answers[..] {
            return Ok(ColumnarValue::Scalar(ScalarValue::Utf8(one.clone())));
        }
        Ok(ColumnarValue::Array(Arc::new(StringArray::from(answers))))
    }
}
