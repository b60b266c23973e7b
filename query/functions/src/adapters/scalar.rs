//! Adapter from a scalar function to DataFusion: shared planning, documentation and constants, one kernel call each.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::common::ScalarValue;
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, Documentation, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};

use super::arguments::{CallArguments, SampleElement, check_arguments, coerced_types, element_type};
use super::description::FunctionDescription;
use crate::standard::call_stop::check_stop;

/// A function of the values of one row. A null argument makes the answer null.
pub(crate) trait ScalarKernel: Send + Sync + 'static {
    /// Returns the function's description.
    fn description(&self) -> &'static FunctionDescription;

    /// Returns the type of its answer; the arguments' types are already checked.
    fn answer_type(&self, arguments: &[DataType]) -> DataType;

    /// Computes the answers for a batch; `T` is the element type of its first list, or f64.
    ///
    /// # Errors
    /// If a value is invalid; the error names its row.
    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef>;
}

/// Adapts a [`ScalarKernel`] to DataFusion's trait.
struct ScalarAdapter<F> {
    function: F,
    signature: Signature,
    documentation: Documentation,
}

/// Wraps the function for DataFusion.
pub(crate) fn wrap_scalar(function: impl ScalarKernel) -> ScalarUDF {
    let documentation = function.description().build_documentation();
    ScalarUDF::new_from_impl(ScalarAdapter {
        function,
        signature: Signature::user_defined(Volatility::Immutable),
        documentation,
    })
}

impl<F: ScalarKernel> ScalarUDFImpl for ScalarAdapter<F> {
    fn name(&self) -> &str {
        self.function.description().name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        Ok(coerced_types(self.function.description(), types))
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        check_arguments(self.function.description(), types)?;
        Ok(self.function.answer_type(types))
    }

    fn is_strict(&self) -> bool {
        true
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        check_stop()?;
        let constant = args.args.iter().all(|value| matches!(value, ColumnarValue::Scalar(_)));
        let rows = if constant { 1 } else { args.number_rows };
        let arguments = CallArguments::new(self.function.description(), &args.args, rows)?;
        let narrow =
            args.args.iter().find_map(|value| element_type(&value.data_type()).cloned()) == Some(DataType::Float32);
        let answer = if narrow {
            self.function.compute_answers::<f32>(&arguments)?
        } else {
            self.function.compute_answers::<f64>(&arguments)?
        };
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

/// Compares an adapter by its name: names are unique in an engine, and its plans never contain functions of another
/// one.
macro_rules! identify_by_name {
    ($adapter:ident, $kernel:ident) => {
        impl<F: $kernel> ::std::fmt::Debug for $adapter<F> {
            fn fmt(&self, f: &mut ::std::fmt::Formatter<'_>) -> ::std::fmt::Result {
                f.write_str(self.name())
            }
        }

        impl<F: $kernel> PartialEq for $adapter<F> {
            fn eq(&self, other: &Self) -> bool {
                self.name() == other.name()
            }
        }

        impl<F: $kernel> Eq for $adapter<F> {}

        impl<F: $kernel> ::std::hash::Hash for $adapter<F> {
            fn hash<H: ::std::hash::Hasher>(&self, state: &mut H) {
                self.name().hash(state);
            }
        }
    };
}

pub(crate) use identify_by_name;

identify_by_name!(ScalarAdapter, ScalarKernel);
