//! Floats of one bit pattern for all that are equal: one NaN, and zero without a sign.

use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _};
use arrow::datatypes::{ArrowPrimitiveType, DataType, Field, FieldRef, Float32Type, Float64Type};
use datafusion::common::utils::{normalize_float_zero, take_function_args};
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, Expr, ReturnFieldArgs, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};
use datafusion::scalar::ScalarValue;

/// The equal floats that are made the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FloatForm {
    /// All NaNs are the positive one, which is the greatest float in Arrow's order, as in PostgreSQL.
    OneNan,
    /// -0.0 is 0.0, and NaNs are one, too.
    OneZero,
}

/// A function that returns its argument, a float, in a form. In results it has the name of its argument.
#[derive(Debug, PartialEq, Eq, Hash)]
pub struct UnifiedFloat {
    form: FloatForm,
    /// Type of its argument and result, if it is known beforehand: that of a long sum is not asked for from its
    /// beginning at each of its parts.
    kind: Option<DataType>,
    signature: Signature,
}

/// Returns the functions for floats of any type, by whose names a plan of another process is understood.
pub fn unified_floats() -> [ScalarUDF; 2] {
    [FloatForm::OneNan, FloatForm::OneZero].map(|form| UnifiedFloat::from_form(form, None))
}

impl UnifiedFloat {
    /// Returns the function for floats of a type.
    pub fn new_function(form: FloatForm, kind: DataType) -> ScalarUDF {
        Self::from_form(form, Some(kind))
    }

    fn from_form(form: FloatForm, kind: Option<DataType>) -> ScalarUDF {
        ScalarUDF::new_from_impl(Self { form, kind, signature: Signature::any(1, Volatility::Immutable) })
    }

    /// Returns its form.
    pub fn float_form(&self) -> FloatForm {
        self.form
    }

    /// Returns the type of its argument and result, if it was made for one.
    pub fn float_type(&self) -> Option<&DataType> {
        self.kind.as_ref()
    }

    fn unify_array(&self, values: &ArrayRef) -> ArrayRef {
        let unified = unify_nans(values);
        if self.form == FloatForm::OneZero { normalize_float_zero(&unified) } else { unified }
    }
}

impl ScalarUDFImpl for UnifiedFloat {
    fn name(&self) -> &str {
        match self.form {
            FloatForm::OneNan => "one_nan",
            FloatForm::OneZero => "one_zero",
        }
    }

    fn schema_name(&self, args: &[Expr]) -> Result<String> {
        let [value] = take_function_args(self.name(), args)?;
        Ok(value.schema_name().to_string())
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let [kind] = take_function_args(self.name(), types)?;
        Ok(self.kind.as_ref().unwrap_or(kind).clone())
    }

    fn return_field_from_args(&self, args: ReturnFieldArgs) -> Result<FieldRef> {
        let [value] = take_function_args(self.name(), args.arg_fields)?;
        let kind = self.kind.as_ref().unwrap_or(value.data_type());
        Ok(Arc::new(Field::new(self.name(), kind.clone(), value.is_nullable())))
    }

    fn is_strict(&self) -> bool {
        true
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let [value] = take_function_args(self.name(), args.args)?;
        Ok(match value {
            ColumnarValue::Array(values) => ColumnarValue::Array(self.unify_array(&values)),
            ColumnarValue::Scalar(value) => {
                let unified = self.unify_array(&value.to_array()?);
                ColumnarValue::Scalar(ScalarValue::try_from_array(&unified, 0)?)
            }
        })
    }
}

/// Returns floats with one NaN, whose sign depends on the processor else. Values without a NaN are not copied: that
/// costs one pass over them.
pub(super) fn unify_nans(values: &ArrayRef) -> ArrayRef {
    match values.data_type() {
        DataType::Float32 => replace_nans::<Float32Type>(values, f32::is_nan, f32::NAN),
        DataType::Float64 => replace_nans::<Float64Type>(values, f64::is_nan, f64::NAN),
        _ => values.clone(),
    }
}

fn replace_nans<T: ArrowPrimitiveType>(
    values: &ArrayRef,
    is_nan: impl Fn(T::Native) -> bool,
    nan: T::Native,
) -> ArrayRef {
    let floats = values.as_primitive::<T>();
    match floats.values().iter().fold(false, |found, x| found | is_nan(*x)) {
        true => Arc::new(floats.unary::<_, T>(|x| if is_nan(x) { nan } else { x })),
        false => values.clone(),
    }
}
