//! Functions of Postgres that make texts for people, and those that tell what something is.

use std::collections::HashMap;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray as _, BooleanArray, Int32Array, ListArray, RecordBatch, StringArray, StructArray,
    UInt32Array, new_null_array,
};
use arrow::buffer::OffsetBuffer;
use arrow::compute::{cast, take};
use arrow::datatypes::{DataType, Field, Fields, Int32Type, Int64Type};
use arrow_pg::datatypes::into_pg_type;
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{
    ColumnarValue, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature, Volatility,
};

use super::relations::long_name;

/// Comments by table and column; those of tables by column 0.
pub(super) type CatalogComments = HashMap<(i32, i32), String>;

/// What reading clients may do; everything else is refused, whatever their role.
const ALLOWED: [&str; 7] = ["SELECT", "USAGE", "CONNECT", "EXECUTE", "TEMP", "TEMPORARY", "MEMBER"];
const PRIVILEGES: [&str; 9] = [
    "has_table_privilege",
    "has_schema_privilege",
    "has_database_privilege",
    "has_any_column_privilege",
    "has_column_privilege",
    "has_function_privilege",
    "has_sequence_privilege",
    "has_type_privilege",
    "has_language_privilege",
];

type AnswerFunction = dyn Fn(&[ArrayRef], usize) -> Result<ArrayRef> + Send + Sync;
type AnswerType = dyn Fn(&[DataType]) -> DataType + Send + Sync;

/// A function of any arguments.
struct AnyFunction {
    name: &'static str,
    signature: Signature,
    kind: Arc<AnswerType>,
    answer: Arc<AnswerFunction>,
}

impl AnyFunction {
    fn udf(
        name: &'static str,
        kind: impl Fn(&[DataType]) -> DataType + Send + Sync + 'static,
        answer: impl Fn(&[ArrayRef], usize) -> Result<ArrayRef> + Send + Sync + 'static,
    ) -> ScalarUDF {
        let signature = Signature::one_of(vec![TypeSignature::VariadicAny], Volatility::Stable);
        ScalarUDF::new_from_impl(Self { name, signature, kind: Arc::new(kind), answer: Arc::new(answer) })
    }
}

impl fmt::Debug for AnyFunction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AnyFunction").field("name", &self.name).finish_non_exhaustive()
    }
}

// A name is one function.
impl PartialEq for AnyFunction {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl Eq for AnyFunction {}

impl Hash for AnyFunction {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name.hash(state);
    }
}

impl ScalarUDFImpl for AnyFunction {
    fn name(&self) -> &str {
        self.name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, kinds: &[DataType]) -> Result<DataType> {
        Ok((self.kind)(kinds))
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let columns = args.args.iter().map(|v| v.to_array(args.number_rows)).collect::<Result<Vec<_>>>()?;
        Ok(ColumnarValue::Array((self.answer)(&columns, args.number_rows)?))
    }
}

/// Those that are the same in all sessions and lakes.
pub(super) fn all() -> Vec<ScalarUDF> {
    let text = |_: &[DataType]| DataType::Utf8;
    let mut all = vec![
        AnyFunction::udf("format", text, format_texts),
        AnyFunction::udf("pg_size_pretty", text, |args, _| {
            let sizes = cast(first(args)?, &DataType::Int64)?;
            let pretty = sizes.as_primitive::<Int64Type>().iter().map(|size| size.map(pretty_size));
            Ok(Arc::new(pretty.collect::<StringArray>()))
        }),
        AnyFunction::udf("quote_literal", text, |args, _| {
            let texts = cast(first(args)?, &DataType::Utf8)?;
            let quoted = texts.as_string::<i32>().iter().map(|text| text.map(quote_literal));
            Ok(Arc::new(quoted.collect::<StringArray>()))
        }),
        AnyFunction::udf("pg_typeof", text, |args, rows| {
            let name = type_name(first(args)?.data_type());
            Ok(Arc::new(StringArray::from_iter_values(std::iter::repeat_n(name, rows))))
        }),
        AnyFunction::udf("like_escape", text, |args, rows| {
            let [pattern, escape] = args else { return Err(missing("like_escape", "a pattern and a character")) };
            let (patterns, escapes) = (cast(pattern, &DataType::Utf8)?, cast(escape, &DataType::Utf8)?);
            let (patterns, escapes) = (patterns.as_string::<i32>(), escapes.as_string::<i32>());
            let one = |row| valid(patterns, row).zip(valid(escapes, row)).map(|(p, e)| escape_pattern(p, e));
            Ok(Arc::new((0..rows).map(one).collect::<StringArray>()))
        }),
        AnyFunction::udf("single_value", element_type, |args, _| single_values(first(args)?)),
        AnyFunction::udf("_pg_expandarray", expanded_type, |args, _| expand_list(first(args)?)),
    ];
    let truth = |_: &[DataType]| DataType::Boolean;
    all.extend(PRIVILEGES.map(|name| AnyFunction::udf(name, truth, may_read)));
    all
}

/// `pg_get_viewdef(view [, pretty])`.
pub(super) fn view_definition(name: &'static str, definitions: HashMap<i32, String>) -> ScalarUDF {
    AnyFunction::udf(
        name,
        |_| DataType::Utf8,
        move |args, _| {
            let views = cast(first(args)?, &DataType::Int32)?;
            let one = |view: Option<i32>| definitions.get(&view?);
            Ok(Arc::new(views.as_primitive::<Int32Type>().iter().map(one).collect::<StringArray>()))
        },
    )
}

/// `obj_description(table [, catalogue])`.
pub(super) fn comment_of_table(name: &'static str, comments: Arc<CatalogComments>) -> ScalarUDF {
    AnyFunction::udf(
        name,
        |_| DataType::Utf8,
        move |args, rows| {
            let tables = cast(first(args)?, &DataType::Int32)?;
            let tables = tables.as_primitive::<Int32Type>();
            let one = |row| tables.is_valid(row).then(|| comments.get(&(tables.value(row), 0)).cloned()).flatten();
            Ok(Arc::new((0..rows).map(one).collect::<StringArray>()))
        },
    )
}

/// `col_description(table, column)`.
pub(super) fn comment_of_column(name: &'static str, comments: Arc<CatalogComments>) -> ScalarUDF {
    AnyFunction::udf(
        name,
        |_| DataType::Utf8,
        move |args, rows| {
            let [table, column] = args else { return Err(missing(name, "a table and a column")) };
            let (tables, columns) = (cast(table, &DataType::Int32)?, cast(column, &DataType::Int32)?);
            let (tables, columns) = (tables.as_primitive::<Int32Type>(), columns.as_primitive::<Int32Type>());
            let known = |row: usize| tables.is_valid(row) && columns.is_valid(row);
            let one = |row| comments.get(&(tables.value(row), columns.value(row))).cloned();
            Ok(Arc::new((0..rows).map(|row| known(row).then(|| one(row)).flatten()).collect::<StringArray>()))
        },
    )
}

fn missing(function: &str, what: &str) -> DataFusionError {
    DataFusionError::Execution(format!("{function} needs {what}"))
}

fn first(args: &[ArrayRef]) -> Result<&ArrayRef> {
    args.first().ok_or_else(|| missing("the function", "an argument"))
}

fn valid(texts: &StringArray, row: usize) -> Option<&str> {
    texts.is_valid(row).then(|| texts.value(row))
}

// True if all that is asked only reads.
fn may_read(args: &[ArrayRef], rows: usize) -> Result<ArrayRef> {
    let last = args.last().ok_or_else(|| missing("the function", "a privilege"))?;
    let asked = cast(last, &DataType::Utf8)?;
    let asked = asked.as_string::<i32>();
    let reads = |asked: &str| {
        let mut kinds = asked.split(',').map(|kind| kind.trim().to_ascii_uppercase());
        // One of them is enough, as in Postgres.
        kinds.any(|kind| ALLOWED.contains(&kind.as_str()))
    };
    Ok(Arc::new((0..rows).map(|row| valid(asked, row).map(reads)).collect::<BooleanArray>()))
}

/// A type's name as `format_type` gives it.
fn type_name(kind: &DataType) -> String {
    match into_pg_type(kind) {
        Ok(kind) => match kind.name().strip_prefix('_') {
            Some(element) => format!("{}[]", long_name(element)),
            None => long_name(kind.name()).to_owned(),
        },
        Err(_) => kind.to_string(),
    }
}

// Rounds half up, and changes to a larger unit from 10240 of one.
fn pretty_size(size: i64) -> String {
    const LIMIT: i64 = 10 * 1024;
    if size.unsigned_abs() < LIMIT.unsigned_abs() {
        return format!("{size} bytes");
    }
    let mut halves = size / 512;
    let mut units = ["kB", "MB", "GB", "TB", "PB"].into_iter().peekable();
    while let Some(unit) = units.next() {
        if halves.abs() < 2 * LIMIT - 1 || units.peek().is_none() {
            return format!("{} {unit}", (halves + halves.signum()) / 2);
        }
        halves /= 1024;
    }
    format!("{size} bytes")
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
    let texts = args.iter().map(|a| Ok(cast(a, &DataType::Utf8)?)).collect::<Result<Vec<_>>>()?;
    let Some((pattern, values)) = texts.split_first() else { return Err(missing("format", "a pattern")) };
    let values: Vec<_> = values.iter().map(|value| value.as_string::<i32>()).collect();
    let one = |row: usize| -> Result<Option<String>> {
        let Some(pattern) = valid(pattern.as_string(), row) else { return Ok(None) };
        let values: Vec<_> = values.iter().map(|value| valid(value, row)).collect();
        format_text(pattern, &values).map(Some)
    };
    let formatted = (0..rows).map(one).collect::<Result<Vec<_>>>()?;
    Ok(Arc::new(StringArray::from(formatted)))
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

fn element_type(kinds: &[DataType]) -> DataType {
    match kinds.first() {
        Some(DataType::List(element)) => element.data_type().clone(),
        _ => DataType::Null,
    }
}

// The one element of each list, NULL of none: the value of a subquery whose rows these are.
fn single_values(lists: &ArrayRef) -> Result<ArrayRef> {
    let Some(lists) = lists.as_list_opt::<i32>() else { return Ok(new_null_array(&DataType::Null, lists.len())) };
    let place = |row: usize| match lists.is_valid(row).then(|| lists.value_length(row)) {
        None | Some(0) => Ok(None),
        Some(1) => Ok(Some(lists.value_offsets()[row] as u32)),
        Some(_) => Err(DataFusionError::Execution("more than one row of a subquery that is a value".to_owned())),
    };
    let places = (0..lists.len()).map(place).collect::<Result<UInt32Array>>()?;
    Ok(take(lists.values(), &places, None)?)
}

// Of a list, the pairs of each element `x` and its place `n`.
fn pairs_of(element: &DataType) -> Fields {
    vec![Field::new("x", element.clone(), true), Field::new("n", DataType::Int32, true)].into()
}

fn expanded_type(kinds: &[DataType]) -> DataType {
    DataType::new_list(DataType::Struct(pairs_of(&element_type(kinds))), true)
}

fn expand_list(lists: &ArrayRef) -> Result<ArrayRef> {
    let Some(lists) = lists.as_list_opt::<i32>() else { return Err(missing("_pg_expandarray", "a list")) };
    let rows: Vec<_> = lists.iter().map(|list| list.map_or(0, |list| list.len())).collect();
    let places: Int32Array = rows.iter().flat_map(|rows| 1..=*rows as i32).collect();
    let parts: Vec<ArrayRef> = lists.iter().flatten().collect();
    let parts: Vec<&dyn Array> = parts.iter().map(AsRef::as_ref).collect();
    let elements = match parts.is_empty() {
        true => arrow::array::new_empty_array(&lists.value_type()),
        false => arrow::compute::concat(&parts)?,
    };
    let pairs = RecordBatch::try_new(
        Arc::new(arrow::datatypes::Schema::new(pairs_of(&lists.value_type()))),
        vec![elements, Arc::new(places)],
    )?;
    let pairs: ArrayRef = Arc::new(StructArray::from(pairs));
    let field = Field::new_list_field(pairs.data_type().clone(), true);
    let offsets = OffsetBuffer::from_lengths(rows);
    Ok(Arc::new(ListArray::try_new(Arc::new(field), offsets, pairs, None)?))
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
        let asked: ArrayRef = Arc::new(StringArray::from(vec!["SELECT", "insert", "CREATE", "UPDATE, SELECT"]));
        let answers = may_read(&[asked], 4).expect("answers");
        let answers: Vec<_> = answers.as_boolean().iter().flatten().collect();
        assert_eq!(answers, [true, false, false, true]);
    }

    #[test]
    fn types_have_their_names() {
        assert_eq!(type_name(&DataType::Int32), "integer");
        assert_eq!(type_name(&DataType::new_list(DataType::Float32, true)), "real[]");
    }
}
