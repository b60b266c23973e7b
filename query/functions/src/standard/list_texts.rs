//! Casts of lists and structs to text, and conditions of joins, which end with their statement: a batch of responses is
//! more than a hundred megabytes of text, and one look at all pairs of two tables takes minutes.

use std::sync::Arc;

use arrow::array::{ArrayRef, new_empty_array};
use arrow::compute::concat;
use arrow::datatypes::DataType;
use datafusion::common::utils::take_function_args;
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, Expr, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};

use super::call_stop::check_stop;

/// Rows that are written between two looks at the statement's end.
const TEXT_ROWS: usize = 64;

/// A function that ends with its statement; it takes one argument.
#[derive(Debug, PartialEq, Eq, Hash)]
enum EndingFunction {
    /// Lists and structs as texts.
    Text(Signature),
    /// The same value.
    Condition(Signature),
}

/// Returns the function that writes a list or a struct as a text, as a cast does.
pub fn list_text() -> Arc<ScalarUDF> {
    Arc::new(ScalarUDF::new_from_impl(EndingFunction::Text(Signature::any(1, Volatility::Immutable))))
}

/// Returns the function whose result is its argument, a condition.
pub fn ending_condition() -> Arc<ScalarUDF> {
    Arc::new(ScalarUDF::new_from_impl(EndingFunction::Condition(Signature::any(1, Volatility::Immutable))))
}

impl ScalarUDFImpl for EndingFunction {
    fn name(&self) -> &str {
        match self {
            Self::Text(_) => "list_text",
            Self::Condition(_) => "ending_condition",
        }
    }

    // As that of a cast: that of its argument.
    fn schema_name(&self, args: &[Expr]) -> Result<String> {
        let [value] = take_function_args(self.name(), args)?;
        Ok(value.schema_name().to_string())
    }

    fn signature(&self) -> &Signature {
        let (Self::Text(signature) | Self::Condition(signature)) = self;
        signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let [value] = take_function_args(self.name(), types)?;
        Ok(match self {
            Self::Text(_) => DataType::Utf8View,
            Self::Condition(_) => value.clone(),
        })
    }

    fn is_strict(&self) -> bool {
        true
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        check_stop()?;
        let [value] = take_function_args(self.name(), args.args)?;
        match (self, value) {
            (Self::Condition(_), value) => Ok(value),
            (Self::Text(_), ColumnarValue::Array(lists)) => Ok(ColumnarValue::Array(write_lists(&lists)?)),
            (Self::Text(_), value) => value.cast_to(&DataType::Utf8View, None),
        }
    }
}

fn write_lists(lists: &ArrayRef) -> Result<ArrayRef> {
    let mut texts = Vec::with_capacity(lists.len().div_ceil(TEXT_ROWS));
    for first in (0..lists.len()).step_by(TEXT_ROWS) {
        check_stop()?;
        let slice = ColumnarValue::Array(lists.slice(first, TEXT_ROWS.min(lists.len() - first)));
        texts.push(slice.cast_to(&DataType::Utf8View, None)?.into_array(TEXT_ROWS)?);
    }
    let texts: Vec<_> = texts.iter().map(AsRef::as_ref).collect();
    match texts.is_empty() {
        true => Ok(new_empty_array(&DataType::Utf8View)),
        false => Ok(concat(&texts)?),
    }
}
