//! Functions that Postgres' clients call to learn about the server. Most have one answer here, since there are no
//! indexes, triggers or comments to speak of.

use std::collections::HashMap;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, Int32Array, StringArray};
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
use super::settings::{SessionSettings, VERSION};

/// Functions that are the same in all sessions.
pub(super) fn fixed() -> Vec<Arc<ScalarUDF>> {
    let has = pg::has_privilege_udf::create_has_privilege_udf;
    let mut all = vec![
        pg::create_current_database_udf(crate::service::CATALOG),
        pg::create_current_schema_udf(),
        pg::create_current_schemas_udf(),
        pg::create_pg_get_userbyid_udf(),
        has("has_table_privilege"),
        has("has_schema_privilege"),
        has("has_database_privilege"),
        has("has_any_column_privilege"),
        pg::create_pg_table_is_visible(),
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
        ("version", Some(format!("PostgreSQL {VERSION}"))),
        ("pg_client_encoding", Some("UTF8".to_owned())),
        ("pg_get_function_result", Some(String::new())),
        ("pg_get_function_identity_arguments", Some(String::new())),
        ("pg_get_functiondef", None),
        ("pg_get_indexdef", None),
        ("pg_get_viewdef", None),
        ("pg_get_triggerdef", None),
        ("pg_get_ruledef", None),
        ("pg_get_serial_sequence", None),
        ("pg_get_partition_constraintdef", None),
        ("obj_description", None),
        ("col_description", None),
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
        "has_column_privilege",
        "has_function_privilege",
        "has_sequence_privilege",
        "has_type_privilege",
        "has_language_privilege",
        "pg_has_role",
    ];
    all.extend(visible.map(|name| ConstantAnswer::udf(name, ScalarValue::Boolean(Some(true)))));
    let never = ["pg_is_in_recovery", "pg_is_other_temp_schema"];
    all.extend(never.map(|name| ConstantAnswer::udf(name, ScalarValue::Boolean(Some(false)))));
    let sizes = ["pg_table_size", "pg_indexes_size", "pg_database_size", "pg_tablespace_size"];
    all.extend(sizes.map(|name| ConstantAnswer::udf(name, ScalarValue::Int64(Some(0)))));
    all.push(ConstantAnswer::udf("pg_my_temp_schema", ScalarValue::Int32(Some(0))));
    all.push(ConstantAnswer::udf("pg_backend_pid", ScalarValue::Int32(Some(0))));
    all.push(ScalarUDF::new_from_impl(JsonObject::new()));
    all.into_iter().map(Arc::new).collect()
}

/// `pg_get_function_arguments(oid)`: what the field's functions take, by their numbers; empty for all others.
pub(super) fn arguments(of: HashMap<i32, String>) -> Arc<ScalarUDF> {
    let find = move |args: &[ColumnarValue]| {
        let numbers = cast(&ColumnarValue::values_to_arrays(args)?[0], &DataType::Int32)?;
        let numbers = numbers.as_primitive::<Int32Type>().iter();
        let texts: StringArray = numbers.map(|n| n.map(|n| of.get(&n).map_or("", String::as_str))).collect();
        Ok(ColumnarValue::Array(Arc::new(texts)))
    };
    let name = "pg_get_function_arguments";
    Arc::new(create_udf(name, vec![DataType::Int32], DataType::Utf8, Volatility::Stable, Arc::new(find)))
}

/// `to_regtype(name)`: the number of a type; NULL if there is none.
pub(super) fn to_regtype(types: HashMap<String, i32>) -> Arc<ScalarUDF> {
    let find = move |args: &[ColumnarValue]| {
        let names = ColumnarValue::values_to_arrays(args)?;
        let number = |name: Option<&str>| name.and_then(|n| types.get(standard(n.trim())).copied());
        let numbers: Int32Array = names[0].as_string::<i32>().iter().map(number).collect();
        Ok(ColumnarValue::Array(Arc::new(numbers)))
    };
    Arc::new(create_udf("to_regtype", vec![DataType::Utf8], DataType::Int32, Volatility::Stable, Arc::new(find)))
}

// `pg_type` has the short names.
fn standard(name: &str) -> &str {
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

/// Functions of a session's settings.
pub(super) fn of_settings(settings: &Arc<SessionSettings>) -> Vec<Arc<ScalarUDF>> {
    let udf = |kind| Arc::new(ScalarUDF::new_from_impl(OfSettings::new(kind, settings.clone())));
    vec![udf(SettingFunction::Get), udf(SettingFunction::Set)]
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
