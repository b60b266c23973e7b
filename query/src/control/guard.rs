//! Functions that could make more of little input than memory holds, or compare for hours: each is asked beforehand.

use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray as _};
use arrow::compute::{cast, kernels::length::length};
use arrow::datatypes::{DataType, FieldRef, Float64Type, Int64Type, IntervalMonthDayNanoType};
use datafusion::common::{Result, ScalarValue, exec_err};
use datafusion::logical_expr::{
    ColumnarValue, Documentation, ExpressionPlacement, ReturnFieldArgs, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl,
    Signature,
};

/// Bytes that one call may make for one batch of rows, about a hundred thousand a row of a full one.
const MOST_BYTES: f64 = 256.0 * 1024.0 * 1024.0;
/// Steps that one call may take for one batch: a tenth of a second.
const MOST_STEPS: f64 = 1e8;
const DAY_NS: f64 = 86_400e9;
/// The shortest month, so that a series by months is not counted too short.
const MONTH_NS: f64 = 28.0 * DAY_NS;

/// How much a call makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Cost {
    /// `repeat(text, n)`, `array_repeat(value, n)`.
    Times,
    /// `lpad(text, n, fill)`, `rpad`, `array_resize(list, n)`.
    Padded,
    /// `range(start, stop, step)`, `generate_series`.
    Series,
    /// `replace(text, from, to)`.
    Replaced,
    /// `regexp_replace(text, pattern, to)`: a pattern may match everywhere, and `to` may repeat what it matched.
    Rewritten,
    /// `array_to_string(list, between)`.
    Joined,
    /// `concat(a, b, ...)`: it doubles where it is given its own result.
    Sum,
    /// `levenshtein(a, b)`.
    Product,
}

/// Functions of DataFusion that are asked, and how they are.
const GUARDED: [(&str, Cost); 15] = [
    ("repeat", Cost::Times),
    ("array_repeat", Cost::Times),
    ("lpad", Cost::Padded),
    ("rpad", Cost::Padded),
    ("array_resize", Cost::Padded),
    ("range", Cost::Series),
    ("generate_series", Cost::Series),
    ("replace", Cost::Replaced),
    ("regexp_replace", Cost::Rewritten),
    ("array_to_string", Cost::Joined),
    ("concat", Cost::Sum),
    ("concat_ws", Cost::Sum),
    ("array_concat", Cost::Sum),
    ("array_append", Cost::Sum),
    ("levenshtein", Cost::Product),
];

/// The same function, asked where it must be; None where it need not.
pub(crate) fn guarded(function: &Arc<ScalarUDF>) -> Option<Arc<ScalarUDF>> {
    let (_, cost) = GUARDED.iter().find(|(name, _)| *name == function.name())?;
    Some(Arc::new(ScalarUDF::new_from_impl(Guarded { inner: function.clone(), cost: *cost })))
}

#[derive(Debug, PartialEq, Eq, Hash)]
struct Guarded {
    inner: Arc<ScalarUDF>,
    cost: Cost,
}

// What is not passed on stays at its default: a simplification would put the unasked function back.
impl ScalarUDFImpl for Guarded {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn aliases(&self) -> &[String] {
        self.inner.aliases()
    }

    fn signature(&self) -> &Signature {
        self.inner.signature()
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        self.inner.return_type(types)
    }

    fn return_field_from_args(&self, args: ReturnFieldArgs) -> Result<FieldRef> {
        self.inner.return_field_from_args(args)
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        self.inner.coerce_types(types)
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.inner.documentation()
    }

    fn placement(&self, args: &[ExpressionPlacement]) -> ExpressionPlacement {
        self.inner.placement(args)
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let cost = self.cost.of(&args.args, args.number_rows)?;
        if self.cost == Cost::Product {
            if cost > MOST_STEPS {
                return exec_err!(
                    "{} would take {cost:.1e} steps, of {MOST_STEPS:.1e}; hint: shorter texts",
                    self.name()
                );
            }
        } else if cost > MOST_BYTES {
            let (mib, most) = (cost / 1048576.0, MOST_BYTES / 1048576.0);
            return exec_err!("{} would make {mib:.0} MiB at once, of {most:.0}; hint: smaller arguments", self.name());
        }
        self.inner.invoke_with_args(args)
    }
}

impl Cost {
    fn of(self, args: &[ColumnarValue], rows: usize) -> Result<f64> {
        let size = |at: usize| args.get(at).map_or(Ok(Values::One(0.0)), sizes);
        let number = |at: usize| args.get(at).map_or(Ok(Values::One(1.0)), numbers);
        // Arguments that are all constant make one value, not one a row.
        let rows = if args.iter().all(|a| matches!(a, ColumnarValue::Scalar(_))) { 1 } else { rows };
        let sum = |f: &dyn Fn(usize) -> f64| (0..rows).map(|row| f(row).max(0.0)).sum();
        Ok(match self {
            Self::Times => {
                let (size, number) = (size(0)?, number(1)?);
                sum(&|row| size.at(row) * number.at(row))
            }
            Self::Padded => {
                let number = number(1)?;
                sum(&|row| number.at(row) * 8.0)
            }
            Self::Series => {
                let (start, stop) =
                    if args.len() == 1 { (Values::One(0.0), number(0)?) } else { (number(0)?, number(1)?) };
                let step = number(2)?;
                sum(&|row| 8.0 * ((stop.at(row) - start.at(row)) / step.at(row)).abs())
            }
            Self::Replaced => {
                let (text, from, to) = (size(0)?, size(1)?, size(2)?);
                sum(&|row| text.at(row) + text.at(row) / from.at(row).max(1.0) * to.at(row))
            }
            Self::Rewritten => {
                let (text, to) = (size(0)?, size(2)?);
                sum(&|row| (text.at(row) + 1.0) * (to.at(row) + 1.0))
            }
            Self::Joined => {
                let (list, between) = (size(0)?, size(1)?);
                sum(&|row| list.at(row) * (between.at(row) + 8.0))
            }
            Self::Sum => {
                let all = args.iter().map(sizes).collect::<Result<Vec<_>>>()?;
                sum(&|row| all.iter().map(|values| values.at(row)).sum())
            }
            Self::Product => {
                let (a, b) = (size(0)?, size(1)?);
                sum(&|row| a.at(row) * b.at(row))
            }
        })
    }
}

/// A number a row, or one for all.
enum Values {
    One(f64),
    Each(ArrayRef),
}

impl Values {
    fn at(&self, row: usize) -> f64 {
        match self {
            Self::One(value) => *value,
            Self::Each(values) => {
                let values = values.as_primitive::<Float64Type>();
                if row < values.len() && values.is_valid(row) { values.value(row) } else { 0.0 }
            }
        }
    }
}

// Bytes of texts, elements of lists (eight bytes each), eight bytes of all else.
fn sizes(value: &ColumnarValue) -> Result<Values> {
    let kind = value.data_type();
    let width = match kind {
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => 1.0,
        DataType::Binary | DataType::LargeBinary | DataType::BinaryView => 1.0,
        DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(..) => 8.0,
        _ => return Ok(Values::One(8.0)),
    };
    let one = matches!(value, ColumnarValue::Scalar(_));
    let lengths = length(&value.to_array(1)?)?;
    let lengths = cast(&lengths, &DataType::Float64)?;
    let scaled: ArrayRef = Arc::new(lengths.as_primitive::<Float64Type>().unary::<_, Float64Type>(|n| n * width));
    let values = Values::Each(scaled);
    Ok(if one { Values::One(values.at(0)) } else { values })
}

// Times are nanoseconds, and so are intervals.
fn numbers(value: &ColumnarValue) -> Result<Values> {
    let array = match value {
        ColumnarValue::Scalar(ScalarValue::Null) => return Ok(Values::One(0.0)),
        scalar => scalar.to_array(1)?,
    };
    let numbers: ArrayRef = match array.data_type() {
        DataType::Interval(_) => {
            let kind = DataType::Interval(arrow::datatypes::IntervalUnit::MonthDayNano);
            let intervals = cast(&array, &kind)?;
            let ns = |i: arrow::datatypes::IntervalMonthDayNano| {
                f64::from(i.months) * MONTH_NS + f64::from(i.days) * DAY_NS + i.nanoseconds as f64
            };
            Arc::new(intervals.as_primitive::<IntervalMonthDayNanoType>().unary::<_, Float64Type>(ns))
        }
        DataType::Date32 => {
            let days = cast(&cast(&array, &DataType::Int32)?, &DataType::Float64)?;
            Arc::new(days.as_primitive::<Float64Type>().unary::<_, Float64Type>(|d| d * DAY_NS))
        }
        DataType::Timestamp(unit, zone) => {
            use arrow::datatypes::TimeUnit;
            let scale = match unit {
                TimeUnit::Second => 1e9,
                TimeUnit::Millisecond => 1e6,
                TimeUnit::Microsecond => 1e3,
                TimeUnit::Nanosecond => 1.0,
            };
            let plain = cast(&cast(&array, &DataType::Timestamp(*unit, zone.clone()))?, &DataType::Int64)?;
            Arc::new(plain.as_primitive::<Int64Type>().unary::<_, Float64Type>(|t| t as f64 * scale))
        }
        kind if kind.is_numeric() => cast(&array, &DataType::Float64)?,
        _ => return Ok(Values::One(0.0)),
    };
    let one = matches!(value, ColumnarValue::Scalar(_));
    let values = Values::Each(numbers);
    Ok(if one { Values::One(values.at(0)) } else { values })
}
