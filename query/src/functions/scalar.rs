//! One function of a row as DataFusion takes it: planning, documentation and constants for all, a kernel call for each.

use std::fmt::{self, Debug};
use std::hash::{Hash, Hasher};

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::common::ScalarValue;
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, Documentation, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};

use super::arguments::{Arguments, Element, check, coerced, element};
use super::description::Description;

/// A function of the values of one row. Null in any of them makes null.
pub(super) trait Scalar: Send + Sync + 'static {
    /// What it says of itself.
    fn description(&self) -> &'static Description;

    /// The type of its answer; the arguments' types are right.
    fn returns(&self, arguments: &[DataType]) -> DataType;

    /// Answers for a batch; `T` is the element of its first list, or f64.
    ///
    /// # Errors
    /// Where a value makes no sense, with its row.
    fn call<T: Element>(&self, arguments: &Arguments<'_>) -> Result<ArrayRef>;
}

/// A [`Scalar`] with what DataFusion asks of it.
struct Adapter<F> {
    function: F,
    signature: Signature,
    documentation: Documentation,
}

/// Makes it known to DataFusion.
pub(super) fn udf(function: impl Scalar) -> ScalarUDF {
    let documentation = function.description().documentation();
    ScalarUDF::new_from_impl(Adapter {
        function,
        signature: Signature::user_defined(Volatility::Immutable),
        documentation,
    })
}

impl<F: Scalar> ScalarUDFImpl for Adapter<F> {
    fn name(&self) -> &str {
        self.function.description().name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        Ok(coerced(self.function.description(), types))
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        check(self.function.description(), types)?;
        Ok(self.function.returns(types))
    }

    fn is_strict(&self) -> bool {
        true
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let constant = args.args.iter().all(|value| matches!(value, ColumnarValue::Scalar(_)));
        let rows = if constant { 1 } else { args.number_rows };
        let arguments = Arguments::new(self.function.description(), &args.args, rows)?;
        let narrow = args.args.iter().find_map(|value| element(&value.data_type()).cloned()) == Some(DataType::Float32);
        let answer =
            if narrow { self.function.call::<f32>(&arguments)? } else { self.function.call::<f64>(&arguments)? };
        Ok(if constant {
            ColumnarValue::Scalar(ScalarValue::try_from_array(&answer, 0)?)
        } else {
            ColumnarValue::Array(answer)
        })
    }

    fn documentation(&self) -> Option<&Documentation> {
        Some(&self.documentation)
    }
}

impl<F: Scalar> Debug for Adapter<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

// An engine has one function of a name, and its plans know no other engine's.
impl<F: Scalar> PartialEq for Adapter<F> {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl<F: Scalar> Eq for Adapter<F> {}

impl<F: Scalar> Hash for Adapter<F> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name().hash(state);
    }
}
