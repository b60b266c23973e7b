//! Functions that Postgres' clients call to learn about the server. Most have one answer here, since there are no
//! indexes and triggers to speak of.

use std::collections::HashMap;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, BooleanArray, Int32Array, StringArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Int64Type};
use arrow_pg::datatypes::into_pg_type;
use datafusion::common::ScalarValue;
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{
    ColumnarValue, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature, Volatility,
};
use datafusion_pg_catalog::pg_catalog as pg;

use super::catalog_tables::{CatalogComments, is_searched};
use super::fixed_tables::function_name;
use super::names::{ROLE, long_type_name, short_type_name};
use super::settings::{SessionSettings, VERSION};

/// Functions that return a text, or NULL.
const TEXTS: [(&str, Option<&str>); 18] = [
    ("user", Some(ROLE)),
    ("current_user", Some(ROLE)),
    ("pg_client_encoding", Some("UTF8")),
    ("getdatabaseencoding", Some("UTF8")),
    ("pg_advisory_unlock_all", Some("")),
    ("pg_describe_object", None),
    ("pg_get_function_sqlbody", None),
    ("pg_get_functiondef", None),
    ("pg_get_indexdef", None),
    ("pg_get_triggerdef", None),
    ("pg_get_ruledef", None),
    ("pg_get_serial_sequence", None),
    ("pg_get_partition_constraintdef", None),
    ("shobj_description", None),
    ("pg_tablespace_location", Some("")),
    ("pg_relation_filepath", None),
    ("inet_server_addr", None),
    ("inet_client_addr", None),
];
/// Functions that return true, false, and 0.
const TRUE: &str = "pg_function_is_visible pg_type_is_visible pg_operator_is_visible pg_opclass_is_visible \
     pg_opfamily_is_visible pg_collation_is_visible pg_conversion_is_visible pg_statistics_obj_is_visible \
     pg_ts_config_is_visible pg_ts_dict_is_visible pg_ts_parser_is_visible pg_ts_template_is_visible pg_has_role";
const FALSE: &str = "pg_is_in_recovery pg_is_other_temp_schema";
const SIZES: &str = "pg_table_size pg_indexes_size pg_database_size pg_tablespace_size";
/// Functions that return whether somebody may do something: what reading clients may do, whatever their role.
const PRIVILEGES: &str = "has_table_privilege has_schema_privilege has_database_privilege has_any_column_privilege \
     has_column_privilege has_function_privilege has_sequence_privilege has_type_privilege has_language_privilege";
const ALLOWED: [&str; 7] = ["SELECT", "USAGE", "CONNECT", "EXECUTE", "TEMP", "TEMPORARY", "MEMBER"];
/// The number of UTF8.
const ENCODING: i32 = 6;

type AnswerFunction = dyn Fn(&[ArrayRef], usize) -> Result<ArrayRef> + Send + Sync;

/// A function of any arguments.
struct CatalogFunction {
    name: &'static str,
    signature: Signature,
    kind: DataType,
    answer: Arc<AnswerFunction>,
}

impl CatalogFunction {
    fn make_udf(
        name: &'static str,
        kind: DataType,
        volatility: Volatility,
        answer: impl Fn(&[ArrayRef], usize) -> Result<ArrayRef> + Send + Sync + 'static,
    ) -> Arc<ScalarUDF> {
        let any = vec![TypeSignature::Nullary, TypeSignature::VariadicAny];
        let signature = Signature::one_of(any, volatility);
        Arc::new(ScalarUDF::new_from_impl(Self { name, signature, kind, answer: Arc::new(answer) }))
    }
}

impl fmt::Debug for CatalogFunction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("CatalogFunction").field("name", &self.name).finish_non_exhaustive()
    }
}

// A name is one function.
impl PartialEq for CatalogFunction {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl Eq for CatalogFunction {}

impl Hash for CatalogFunction {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name.hash(state);
    }
}

impl ScalarUDFImpl for CatalogFunction {
    fn name(&self) -> &str {
        self.name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, _: &[DataType]) -> Result<DataType> {
        Ok(self.kind.clone())
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let columns = args.args.iter().map(|v| v.to_array(args.number_rows)).collect::<Result<Vec<_>>>()?;
        Ok(ColumnarValue::Array((self.answer)(&columns, args.number_rows)?))
    }
}

fn constant_function(name: &'static str, answer: ScalarValue) -> Arc<ScalarUDF> {
    CatalogFunction::make_udf(name, answer.data_type(), Volatility::Stable, move |_, rows| {
        answer.to_array_of_size(rows)
    })
}

// A function of a text; NULL of NULL.
fn text_of_text(name: &'static str, find: impl Fn(&str) -> String + Send + Sync + 'static) -> Arc<ScalarUDF> {
    CatalogFunction::make_udf(name, DataType::Utf8, Volatility::Stable, move |args, _| {
        let texts = text_argument(name, args, 0)?;
        Ok(Arc::new(texts.iter().map(|text| text.map(&find)).collect::<StringArray>()))
    })
}

fn number_of_name(name: &'static str, find: impl Fn(&str) -> Option<i32> + Send + Sync + 'static) -> Arc<ScalarUDF> {
    CatalogFunction::make_udf(name, DataType::Int32, Volatility::Stable, move |args, _| {
        let names = text_argument(name, args, 0)?;
        Ok(Arc::new(names.iter().map(|name| find_number(name?, &find)).collect::<Int32Array>()))
    })
}

// A name as clients write it, with or without quotes and the schema that Postgres always searches; or a number.
fn find_number(name: &str, find: impl Fn(&str) -> Option<i32>) -> Option<i32> {
    let name = name.trim().replace('"', "");
    name.parse().ok().or_else(|| find(name.strip_prefix("pg_catalog.").unwrap_or(&name)))
}

fn text_of_number(name: &'static str, find: impl Fn(i32) -> Option<String> + Send + Sync + 'static) -> Arc<ScalarUDF> {
    CatalogFunction::make_udf(name, DataType::Utf8, Volatility::Stable, move |args, _| {
        let numbers = number_argument(name, args, 0)?;
        Ok(Arc::new(numbers.iter().map(|number| find(number?)).collect::<StringArray>()))
    })
}

fn argument_at<'a>(function: &str, args: &'a [ArrayRef], at: usize) -> Result<&'a ArrayRef> {
    let missing = || DataFusionError::Execution(format!("{function} needs {} arguments at least", at + 1));
    args.get(at).ok_or_else(missing)
}

fn text_argument(function: &str, args: &[ArrayRef], at: usize) -> Result<StringArray> {
    Ok(cast(argument_at(function, args, at)?, &DataType::Utf8)?.as_string().clone())
}

fn number_argument(function: &str, args: &[ArrayRef], at: usize) -> Result<Int32Array> {
    Ok(cast(argument_at(function, args, at)?, &DataType::Int32)?.as_primitive().clone())
}

fn text_at(texts: &StringArray, row: usize) -> Option<&str> {
    texts.is_valid(row).then(|| texts.value(row))
}

/// Makes the functions that are the same in all sessions.
pub(super) fn fixed_functions() -> Vec<Arc<ScalarUDF>> {
    let of_library = [
        pg::create_current_database_udf(echolake_service::CATALOG),
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
    let mut all: Vec<_> = of_library.into_iter().map(Arc::new).collect();
    all.extend(TEXTS.map(|(name, text)| constant_function(name, ScalarValue::Utf8(text.map(str::to_owned)))));
    all.extend(TRUE.split(' ').map(|name| constant_function(name, ScalarValue::Boolean(Some(true)))));
    all.extend(FALSE.split(' ').map(|name| constant_function(name, ScalarValue::Boolean(Some(false)))));
    all.extend(SIZES.split(' ').map(|name| constant_function(name, ScalarValue::Int64(Some(0)))));
    for name in PRIVILEGES.split(' ') {
        all.push(CatalogFunction::make_udf(name, DataType::Boolean, Volatility::Stable, move |args, _| {
            let asked = text_argument(name, args, args.len().saturating_sub(1))?;
            Ok(Arc::new(asked.iter().map(|asked| asked.map(may_do)).collect::<BooleanArray>()))
        }));
    }
    all.extend([
        constant_function("version", ScalarValue::Utf8(Some(format!("PostgreSQL {VERSION}")))),
        constant_function("pg_my_temp_schema", ScalarValue::Int32(Some(0))),
        constant_function("pg_index_column_has_property", ScalarValue::Boolean(None)),
        constant_function("pg_char_to_encoding", ScalarValue::Int32(Some(ENCODING))),
        text_of_text("quote_literal", quote_literal),
        text_of_number("function_name", |number| function_name(number).map(str::to_owned)),
        CatalogFunction::make_udf("pg_size_pretty", DataType::Utf8, Volatility::Stable, |args, _| {
            let sizes = cast(argument_at("pg_size_pretty", args, 0)?, &DataType::Int64)?;
            let pretty = sizes.as_primitive::<Int64Type>().iter().map(|size| size.map(pretty_size));
            Ok(Arc::new(pretty.collect::<StringArray>()))
        }),
        CatalogFunction::make_udf("pg_typeof", DataType::Utf8, Volatility::Stable, |args, rows| {
            let name = type_name(argument_at("pg_typeof", args, 0)?.data_type());
            Ok(Arc::new(StringArray::from_iter_values(std::iter::repeat_n(name, rows))))
        }),
        CatalogFunction::make_udf("like_escape", DataType::Utf8, Volatility::Stable, |args, _| {
            let patterns = text_argument("like_escape", args, 0)?;
            let escapes = text_argument("like_escape", args, 1)?;
            let pairs = patterns.iter().zip(&escapes).map(|(pattern, escape)| pattern.zip(escape));
            Ok(Arc::new(pairs.map(|pair| pair.map(|(p, e)| escape_pattern(p, e))).collect::<StringArray>()))
        }),
        CatalogFunction::make_udf("format", DataType::Utf8, Volatility::Stable, format_texts),
        CatalogFunction::make_udf("json_build_object", DataType::Utf8, Volatility::Stable, |args, rows| {
            let objects: Vec<_> = (0..rows).map(|row| json_object(args, row)).collect::<Result<_>>()?;
            Ok(Arc::new(StringArray::from(objects)))
        }),
    ]);
    all
}

/// What the catalogue's numbers stand for.
pub(super) struct CatalogNumbers {
    pub types: HashMap<String, i32>,
    pub procedures: HashMap<String, i32>,
    pub relations: HashMap<String, i32>,
    pub schemas: HashMap<String, i32>,
    /// Arguments and results of functions.
    pub signatures: HashMap<i32, (String, String)>,
    pub comments: CatalogComments,
    /// Definitions of views.
    pub definitions: HashMap<i32, String>,
}

/// Makes the functions that look something up in the catalogue: NULL if it is not there.
pub(super) fn lookup_functions(numbers: CatalogNumbers) -> Vec<Arc<ScalarUDF>> {
    let CatalogNumbers { types, procedures, relations, schemas, signatures, comments, definitions } = numbers;
    let signatures = Arc::new(signatures);
    let results = signatures.clone();
    let identities = signatures.clone();
    let comments = Arc::new(comments);
    let table_comments = comments.clone();
    vec![
        number_of_name("to_regtype", move |name| types.get(short_type_name(name)).copied()),
        number_of_name("to_regproc", move |name| procedures.get(name.split('(').next().unwrap_or(name)).copied()),
        number_of_name("to_regclass", move |name| relations.get(name).copied()),
        number_of_name("to_regnamespace", move |name| schemas.get(name).copied()),
        text_of_number("pg_get_function_arguments", move |number| Some(find_signature(&signatures, number).0)),
        text_of_number("pg_get_function_identity_arguments", move |number| Some(find_signature(&identities, number).0)),
        text_of_number("pg_get_function_result", move |number| Some(find_signature(&results, number).1)),
        text_of_number("pg_get_viewdef", move |view| definitions.get(&view).cloned()),
        text_of_number("obj_description", move |table| table_comments.get(&(table, 0)).cloned()),
        CatalogFunction::make_udf("col_description", DataType::Utf8, Volatility::Stable, move |args, _| {
            let tables = number_argument("col_description", args, 0)?;
            let columns = number_argument("col_description", args, 1)?;
            let places = tables.iter().zip(&columns);
            let found = places.map(|(table, column)| comments.get(&(table?, column?)).cloned());
            Ok(Arc::new(found.collect::<StringArray>()))
        }),
        CatalogFunction::make_udf("pg_table_is_visible", DataType::Boolean, Volatility::Stable, |args, _| {
            let tables = number_argument("pg_table_is_visible", args, 0)?;
            Ok(Arc::new(tables.iter().map(|table| table.map(is_searched)).collect::<BooleanArray>()))
        }),
    ]
}

fn find_signature(signatures: &HashMap<i32, (String, String)>, number: i32) -> (String, String) {
    signatures.get(&number).cloned().unwrap_or_default()
}

/// Makes the functions of the session of this number and these settings.
pub(super) fn of_session(pid: i32, settings: &Arc<SessionSettings>) -> Vec<Arc<ScalarUDF>> {
    let own = settings.clone();
    let current = settings.clone();
    vec![
        constant_function("pg_backend_pid", ScalarValue::Int32(Some(pid))),
        CatalogFunction::make_udf("current_setting", DataType::Utf8, Volatility::Stable, move |args, rows| {
            let names = text_argument("current_setting", args, 0)?;
            let missing_ok = match args.get(1) {
                Some(column) => cast(column, &DataType::Boolean)?.as_boolean().clone(),
                None => vec![false; rows].into(),
            };
            let found =
                names.iter().zip(&missing_ok).map(|(name, missing_ok)| match name.map(|name| current.get(name)) {
                    Some(Err(_)) if missing_ok == Some(true) => Ok(None),
                    value => value.transpose().map_err(|fault| DataFusionError::Execution(fault.to_string())),
                });
            Ok(Arc::new(found.collect::<Result<StringArray>>()?))
        }),
        CatalogFunction::make_udf("set_config", DataType::Utf8, Volatility::Volatile, move |args, _| {
            let names = text_argument("set_config", args, 0)?;
            let values = text_argument("set_config", args, 1)?;
            let found = names.iter().zip(&values).map(|(name, value)| {
                let Some(name) = name else { return Ok(None) };
                let set = value.map_or(Ok(()), |value| own.set_value(name, value));
                let value = set.and_then(|()| own.get(name));
                value.map(Some).map_err(|fault| DataFusionError::Execution(fault.to_string()))
            });
            Ok(Arc::new(found.collect::<Result<StringArray>>()?))
        }),
    ]
}

// Of several privileges one is enough, as in Postgres.
fn may_do(asked: &str) -> bool {
    asked.split(',').any(|kind| ALLOWED.contains(&kind.trim().to_ascii_uppercase().as_str()))
}

/// A type's name as `format_type` gives it.
fn type_name(kind: &DataType) -> String {
    into_pg_type(kind).map_or_else(|_| kind.to_string(), |kind| long_type_name(kind.name()))
}

// A JSON object of keys and values in turns.
fn json_object(args: &[ArrayRef], row: usize) -> Result<String> {
    let mut object = serde_json::Map::new();
    for pair in args.chunks(2) {
        let [key, value] = pair else {
            return Err(DataFusionError::Execution("json_build_object needs a value for each key".to_owned()));
        };
        let value = ScalarValue::try_from_array(value, row)?;
        let text = value.to_string();
        let json = match value.data_type() {
            _ if value.is_null() => serde_json::Value::Null,
            DataType::Boolean => serde_json::Value::Bool(text == "true"),
            kind if kind.is_numeric() => serde_json::from_str(&text).unwrap_or(serde_json::Value::String(text)),
            _ => serde_json::Value::String(text),
        };
        object.insert(ScalarValue::try_from_array(key, row)?.to_string(), json);
    }
    Ok(serde_json::Value::Object(object).to_string())
}

// Rounds half up, and changes to a larger unit from 10240 of one.
fn pretty_size(size: i64) -> String {
    const LIMIT: i64 = 10 * 1024;
    if size.unsigned_abs() < LIMIT.unsigned_abs() {
        return format!("{size} bytes");
    }
    let mut halves = size / 512;
    for unit in ["kB", "MB", "GB", "TB"] {
        if halves.abs() < 2 * LIMIT - 1 {
            return format!("{} {unit}", (halves + halves.signum()) / 2);
        }
        halves /= 1024;
    }
    format!("{} PB", (halves + halves.signum()) / 2)
}

// A pattern of LIKE whose own escape character becomes the backslash.
fn escape_pattern(pattern: &str, escape: &str) -> String {
    let escape = escape.chars().next();
    let mut escaped = String::with_capacity(pattern.len());
    let mut characters = pattern.chars();
    while let Some(character) = characters.next() {
        if Some(character) == escape {
            escaped.push('\\');
            escaped.extend(characters.next());
        } else {
            // Without the escape character a backslash is itself.
            if character == '\\' {
                escaped.push('\\');
            }
            escaped.push(character);
        }
    }
    escaped
}

fn format_texts(args: &[ArrayRef], rows: usize) -> Result<ArrayRef> {
    let pattern = text_argument("format", args, 0)?;
    let values: Vec<_> = (1..args.len()).map(|at| text_argument("format", args, at)).collect::<Result<_>>()?;
    let one = |row: usize| -> Result<Option<String>> {
        let Some(pattern) = text_at(&pattern, row) else { return Ok(None) };
        let values: Vec<_> = values.iter().map(|value| text_at(value, row)).collect();
        format_text(pattern, &values).map(Some)
    };
    Ok(Arc::new((0..rows).map(one).collect::<Result<StringArray>>()?))
}

// `%s` is a text, `%I` a name, `%L` a literal, `%2$s` the second value as a text.
fn format_text(pattern: &str, values: &[Option<&str>]) -> Result<String> {
    let wrong = |what: &str| DataFusionError::Execution(format!("format: {what} in `{pattern}`"));
    let mut formatted = String::new();
    let mut rest = pattern;
    let mut next = 0;
    while let Some((before, after)) = rest.split_once('%') {
        formatted.push_str(before);
        if let Some(after) = after.strip_prefix('%') {
            formatted.push('%');
            rest = after;
            continue;
        }
        let digits = after.len() - after.trim_start_matches(|c: char| c.is_ascii_digit()).len();
        let (number, after) = match after[digits..].strip_prefix('$') {
            Some(rest) => (after[..digits].parse::<usize>().ok(), rest),
            None => (None, after),
        };
        let at = number.map_or(next, |number| number.saturating_sub(1));
        next = at + 1;
        let value = *values.get(at).ok_or_else(|| wrong("too few values"))?;
        match after.chars().next() {
            Some('s') => formatted.push_str(value.unwrap_or_default()),
            Some('I') => formatted.push_str(&quote_name(value.ok_or_else(|| wrong("a name that is NULL"))?)),
            Some('L') => match value {
                Some(value) => formatted.push_str(&quote_literal(value)),
                None => formatted.push_str("NULL"),
            },
            _ => return Err(wrong("only %s, %I and %L are known")),
        }
        rest = &after[1..];
    }
    formatted.push_str(rest);
    Ok(formatted)
}

// With a backslash it is a literal of its own kind.
fn quote_literal(text: &str) -> String {
    let quoted = text.replace('\'', "''");
    if text.contains('\\') { format!("E'{}'", quoted.replace('\\', "\\\\")) } else { format!("'{quoted}'") }
}

fn quote_name(name: &str) -> String {
    let plain = |c: char| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit();
    let is_plain = name.chars().all(plain) && !name.starts_with(|c: char| c.is_ascii_digit()) && !name.is_empty();
    if is_plain { name.to_owned() } else { format!("\"{}\"", name.replace('"', "\"\"")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_as_in_postgres() {
        for (size, expected) in [
            (0, "0 bytes"),
            (10_239, "10239 bytes"),
            (10_240, "10 kB"),
            (20_480, "20 kB"),
            (10_485_247, "10239 kB"),
            (10_485_760, "10 MB"),
            (-20_480, "-20 kB"),
            (123_456_789_012, "115 GB"),
            (i64::MIN, "-8192 PB"),
        ] {
            assert_eq!(pretty_size(size), expected);
        }
    }

    #[test]
    fn patterns_keep_their_meaning() {
        for (pattern, escape, expected) in
            [("pg/_%", "/", r"pg\_%"), ("a//b", "/", r"a\/b"), (r"a\b", "/", r"a\\b"), ("a%", "", "a%")]
        {
            assert_eq!(escape_pattern(pattern, escape), expected);
        }
    }

    #[test]
    fn texts_are_formatted() {
        let values = [Some("a"), Some("b c"), None];
        for (pattern, expected) in
            [("%s-%I", "a-\"b c\""), ("%2$L %1$I %%", "'b c' a %"), ("%3$L%3$s", "NULL"), ("none", "none")]
        {
            assert_eq!(format_text(pattern, &values).expect(pattern), expected);
        }
        assert!(format_text("%4$s", &values).is_err() && format_text("%x", &values).is_err());
    }

    #[test]
    fn literals_are_quoted() {
        for (text, expected) in [("a", "'a'"), ("it's", "'it''s'"), (r"a\b", r"E'a\\b'")] {
            assert_eq!(quote_literal(text), expected);
        }
    }

    #[test]
    fn nobody_may_write() {
        let answers = ["SELECT", "insert", "CREATE", "UPDATE, SELECT"].map(may_do);
        assert_eq!(answers, [true, false, false, true]);
    }

    #[test]
    fn types_have_their_names() {
        assert_eq!(type_name(&DataType::Int32), "integer");
        assert_eq!(type_name(&DataType::new_list(DataType::Float32, true)), "real[]");
    }
}
