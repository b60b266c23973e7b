//! Limits of DataFusion's functions that make much of little, for processes whose memory is limited: each call tells
//! from its arguments how many bytes it would return for a batch of rows, or how long it would take, before it begins.
//! Joins and aggregations are counted by the memory pool; one call of a function allocates between two looks at it.

use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::datatypes::{DataType, FieldRef};
use datafusion::common::config::ConfigOptions;
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::expr::ScalarFunction;
use datafusion::logical_expr::interval_arithmetic::Interval;
use datafusion::logical_expr::simplify::{ExprSimplifyResult, SimplifyContext};
use datafusion::logical_expr::sort_properties::{ExprProperties, SortProperties};
use datafusion::logical_expr::{
    ColumnarValue, Documentation, Expr, ReturnFieldArgs, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature,
};

use super::call_size::CallSize;
use super::call_stop::{check_stop, count_planned_bytes};

/// Bytes that a call may return for a batch of rows.
const MOST_BYTES: f64 = (32 << 20) as f64;
/// The same for what joins its arguments: texts, and lists, of which a row may be a recording.
const MOST_TEXT_BYTES: f64 = (64 << 20) as f64;
const MOST_LIST_BYTES: f64 = (256 << 20) as f64;
/// Comparisons of two characters in a call: a tenth of a second.
const MOST_COMPARISONS: f64 = 1e8;
/// Formats that a call may try on texts.
const MOST_FORMATS: f64 = 5e5;
/// Regular expressions that a call may compile.
const MOST_PATTERNS: f64 = 100.0;
/// Elements of a type with a fixed number of them, or bytes.
const MOST_FIXED: i32 = 1 << 20;

/// What limits a function.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum CallLimit {
    /// `repeat(text, times)`.
    Repeat,
    /// `lpad(text, length, ...)`.
    Pad,
    /// `range(start, stop, step)`.
    Series,
    /// `array_repeat(element, times)`.
    RepeatElement,
    /// `array_resize(list, length, element)`.
    Resize,
    /// `replace(text, from, to)`.
    ReplaceText,
    /// `regexp_replace(text, pattern, to, flags)`.
    ReplacePattern,
    /// `array_replace_all(list, from, to)`.
    ReplaceElements,
    /// `array_to_string(list, separator)`.
    JoinElements,
    /// `string_to_array(text, separator)`.
    SplitText,
    /// Texts side by side.
    JoinTexts,
    /// Lists side by side.
    JoinLists,
    /// `levenshtein(text, text)`.
    Compare,
    /// `to_timestamp(text, format, ...)`.
    TryFormats,
    /// A regular expression, the second argument.
    Pattern,
    /// A type, the second argument.
    NamedType,
    /// Time in proportion to its arguments: it is not begun after the statement's end.
    EndOnly,
}

/// The functions, by the names of DataFusion.
const LIMITS: &[(CallLimit, &[&str])] = &[
    (CallLimit::Repeat, &["repeat"]),
    (CallLimit::Pad, &["lpad", "rpad"]),
    (CallLimit::Series, &["range", "generate_series"]),
    (CallLimit::RepeatElement, &["array_repeat"]),
    (CallLimit::Resize, &["array_resize"]),
    (CallLimit::ReplaceText, &["replace"]),
    (CallLimit::ReplacePattern, &["regexp_replace"]),
    (CallLimit::ReplaceElements, &["array_replace", "array_replace_n", "array_replace_all"]),
    (CallLimit::JoinElements, &["array_to_string"]),
    (CallLimit::SplitText, &["string_to_array"]),
    (CallLimit::JoinTexts, &["concat", "concat_ws"]),
    (CallLimit::JoinLists, &["array_concat", "array_append", "array_prepend"]),
    (CallLimit::Compare, &["levenshtein"]),
    (
        CallLimit::TryFormats,
        &[
            "to_timestamp",
            "to_timestamp_seconds",
            "to_timestamp_millis",
            "to_timestamp_micros",
            "to_timestamp_nanos",
            "to_date",
            "to_time",
            "to_unixtime",
        ],
    ),
    (CallLimit::Pattern, &["regexp_like", "regexp_match", "regexp_count", "regexp_instr"]),
    (CallLimit::NamedType, &["arrow_cast", "arrow_try_cast"]),
    (
        CallLimit::EndOnly,
        &[
            "array_distinct",
            "array_except",
            "array_has",
            "array_has_all",
            "array_has_any",
            "array_intersect",
            "array_max",
            "array_min",
            "array_position",
            "array_positions",
            "array_remove",
            "array_remove_all",
            "array_remove_n",
            "array_reverse",
            "array_slice",
            "array_sort",
            "array_union",
            "find_in_set",
            "initcap",
            "lower",
            "overlay",
            "reverse",
            "split_part",
            "strpos",
            "substr",
            "substr_index",
            "translate",
            "upper",
        ],
    ),
];

/// Returns the limited forms of those functions that `find` knows.
pub fn limited_functions(find: impl Fn(&str) -> Option<Arc<ScalarUDF>>) -> Vec<ScalarUDF> {
    let named = LIMITS.iter().flat_map(|(limit, names)| names.iter().map(|name| (*limit, *name)));
    let known = named.filter_map(|(limit, name)| Some(LimitedFunction { own: find(name)?, limit }));
    known.map(ScalarUDF::new_from_impl).collect()
}

/// A function with its limit.
#[derive(Debug, Clone)]
struct LimitedFunction {
    own: Arc<ScalarUDF>,
    limit: CallLimit,
}

impl PartialEq for LimitedFunction {
    fn eq(&self, other: &Self) -> bool {
        self.own == other.own
    }
}

impl Eq for LimitedFunction {}

impl Hash for LimitedFunction {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.own.hash(state);
    }
}

impl LimitedFunction {
    fn inner(&self) -> &dyn ScalarUDFImpl {
        self.own.inner().as_ref()
    }

    fn check_call(&self, args: &ScalarFunctionArgs) -> Result<()> {
        check_stop()?;
        let call = CallSize::new(&args.args, args.number_rows);
        match self.limit {
            CallLimit::Repeat => self.check_bytes(call.sum(|row| call.bytes(0, row) * call.number(1, row)), MOST_BYTES),
            CallLimit::Pad => self.check_bytes(call.sum(|row| call.number(1, row)), MOST_BYTES),
            CallLimit::Series => self.check_bytes(call.sum(|row| call.series_length(row) * 8.0), MOST_BYTES),
            CallLimit::RepeatElement => {
                self.check_bytes(call.sum(|row| call.bytes(0, row).max(1.0) * call.number(1, row)), MOST_BYTES)
            }
            CallLimit::Resize => {
                self.check_bytes(call.sum(|row| call.bytes(2, row).max(1.0) * call.number(1, row)), MOST_BYTES)
            }
            CallLimit::ReplaceText => {
                let bytes = |row| call.bytes(0, row) / call.bytes(1, row).max(1.0) * call.bytes(2, row);
                self.check_bytes(call.sum(bytes), MOST_BYTES)
            }
            CallLimit::ReplacePattern => {
                self.check_patterns(&call)?;
                // Without flags only the first match is replaced.
                let matches = |row| if args.args.len() > 3 { call.bytes(0, row) + 1.0 } else { 1.0 };
                self.check_bytes(call.sum(|row| matches(row) * call.bytes(2, row)), MOST_BYTES)
            }
            CallLimit::ReplaceElements => {
                self.check_bytes(call.sum(|row| call.length(0, row) * call.bytes(2, row)), MOST_BYTES)
            }
            CallLimit::JoinElements => {
                let bytes = |row| call.bytes(0, row) * 4.0 + call.length(0, row) * call.bytes(1, row);
                self.check_bytes(call.sum(bytes), MOST_BYTES)
            }
            CallLimit::SplitText => self.check_bytes(call.sum(|row| call.bytes(0, row) * 8.0), MOST_TEXT_BYTES),
            CallLimit::JoinTexts => self.check_bytes(call.total_bytes(), MOST_TEXT_BYTES),
            CallLimit::JoinLists => self.check_bytes(call.total_bytes(), MOST_LIST_BYTES),
            CallLimit::Compare => {
                let comparisons = call.sum(|row| call.bytes(0, row) * call.bytes(1, row));
                self.check_number(comparisons, MOST_COMPARISONS, "comparisons of characters")
            }
            CallLimit::TryFormats => {
                let formats = args.args.len().saturating_sub(1) * args.number_rows;
                self.check_number(formats as f64, MOST_FORMATS, "formats of texts to try")
            }
            CallLimit::Pattern => self.check_patterns(&call),
            CallLimit::NamedType => check_fixed_type(args.return_type()),
            CallLimit::EndOnly => Ok(()),
        }
    }

    fn check_bytes(&self, bytes: f64, most: f64) -> Result<()> {
        check_result_bytes(self.name(), bytes, most)
    }

    fn check_patterns(&self, call: &CallSize) -> Result<()> {
        self.check_number(call.count_texts(1), MOST_PATTERNS, "regular expressions")
    }

    fn check_number(&self, number: f64, most: f64, what: &str) -> Result<()> {
        match number <= most {
            true => Ok(()),
            false => Err(DataFusionError::Execution(format!(
                "`{}` would have {number} {what} for a batch of rows, {most} at most are allowed; hint: shorter values, \
                 or fewer rows",
                self.name()
            ))),
        }
    }
}

/// Checks the bytes of texts that an operator or a function joins.
///
/// # Errors
/// They are more than the limit, which the error names.
pub(super) fn check_text_bytes(name: &str, bytes: f64) -> Result<()> {
    check_result_bytes(name, bytes, MOST_TEXT_BYTES)
}

fn check_result_bytes(name: &str, bytes: f64, most: f64) -> Result<()> {
    let mib = |bytes: f64| (bytes / f64::from(1 << 20)).ceil();
    match bytes <= most {
        true => Ok(()),
        false => Err(DataFusionError::Execution(format!(
            "`{name}` would return {} MiB for a batch of rows, {} MiB at most are allowed; hint: shorter values, or a \
             subquery in FROM that makes rows one after the other, as generate_series(1, 10) does",
            mib(bytes),
            mib(most)
        ))),
    }
}

/// Checks that a value of this type is no huge one in itself.
///
/// # Errors
/// The type has more elements or bytes than the limit.
pub fn check_fixed_type(kind: &DataType) -> Result<()> {
    match kind {
        DataType::FixedSizeList(_, length) | DataType::FixedSizeBinary(length) if *length > MOST_FIXED => {
            Err(DataFusionError::Execution(format!(
                "a value of the type {kind} has {length} elements, {MOST_FIXED} at most are allowed"
            )))
        }
        DataType::FixedSizeList(field, _) | DataType::List(field) | DataType::LargeList(field) => {
            check_fixed_type(field.data_type())
        }
        DataType::Struct(fields) => fields.iter().try_for_each(|field| check_fixed_type(field.data_type())),
        _ => Ok(()),
    }
}

impl ScalarUDFImpl for LimitedFunction {
    fn name(&self) -> &str {
        self.own.name()
    }

    fn aliases(&self) -> &[String] {
        self.own.aliases()
    }

    fn schema_name(&self, args: &[Expr]) -> Result<String> {
        self.own.schema_name(args)
    }

    fn signature(&self) -> &Signature {
        self.own.signature()
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        self.inner().return_type(types)
    }

    fn with_updated_config(&self, config: &ConfigOptions) -> Option<ScalarUDF> {
        let own = Arc::new(self.inner().with_updated_config(config)?);
        Some(ScalarUDF::new_from_impl(Self { own, limit: self.limit }))
    }

    fn return_field_from_args(&self, args: ReturnFieldArgs) -> Result<FieldRef> {
        let field = self.inner().return_field_from_args(args)?;
        check_fixed_type(field.data_type())?;
        Ok(field)
    }

    fn is_strict(&self) -> bool {
        self.inner().is_strict()
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        self.check_call(&args)?;
        let returned = self.own.invoke_with_args(args)?;
        if let ColumnarValue::Scalar(value) = &returned {
            count_planned_bytes(value.size())?;
        }
        Ok(returned)
    }

    // DataFusion's own form of the call has this limit, too. An operator has none, so that a call with many regular
    // expressions does not become one.
    fn simplify(&self, args: Vec<Expr>, info: &SimplifyContext) -> Result<ExprSimplifyResult> {
        if self.limit == CallLimit::Pattern && !matches!(args.get(1), Some(Expr::Literal(..))) {
            return Ok(ExprSimplifyResult::Original(args));
        }
        Ok(match self.inner().simplify(args, info)? {
            ExprSimplifyResult::Simplified(Expr::ScalarFunction(call)) if call.func.name() == self.name() => {
                let own = ScalarUDF::new_from_impl(self.clone());
                ExprSimplifyResult::Simplified(Expr::ScalarFunction(ScalarFunction::new_udf(own.into(), call.args)))
            }
            other => other,
        })
    }

    fn short_circuits(&self) -> bool {
        self.inner().short_circuits()
    }

    fn conditional_arguments<'a>(&self, args: &'a [Expr]) -> Option<(Vec<&'a Expr>, Vec<&'a Expr>)> {
        self.inner().conditional_arguments(args)
    }

    fn evaluate_bounds(&self, input: &[&Interval]) -> Result<Interval> {
        self.inner().evaluate_bounds(input)
    }

    fn propagate_constraints(&self, interval: &Interval, inputs: &[&Interval]) -> Result<Option<Vec<Interval>>> {
        self.inner().propagate_constraints(interval, inputs)
    }

    fn output_ordering(&self, inputs: &[ExprProperties]) -> Result<SortProperties> {
        self.inner().output_ordering(inputs)
    }

    fn preserves_lex_ordering(&self, inputs: &[ExprProperties]) -> Result<bool> {
        self.inner().preserves_lex_ordering(inputs)
    }

    fn strictly_order_preserving(&self, inputs: &[ExprProperties]) -> Result<bool> {
        self.inner().strictly_order_preserving(inputs)
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        self.inner().coerce_types(types)
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.inner().documentation()
    }
}
