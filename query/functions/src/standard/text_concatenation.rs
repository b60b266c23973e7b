//! `a || b` of texts as a function, with the limit of one.

use std::sync::Arc;

use arrow::compute::kernels::concat_elements::concat_elements_dyn;
use arrow::datatypes::{DataType, Field, FieldRef};
use datafusion::common::ScalarValue;
use datafusion::common::utils::take_function_args;
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, Expr, ReturnFieldArgs, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};

use super::call_limits::check_text_bytes;
use super::call_size::CallSize;
use super::call_stop::check_stop;

/// The function that takes the operator's place; both texts have the same type.
#[derive(Debug, PartialEq, Eq, Hash)]
struct TextConcatenation(Signature);

/// Returns the function.
pub fn text_concatenation() -> Arc<ScalarUDF> {
    Arc::new(ScalarUDF::new_from_impl(TextConcatenation(Signature::any(2, Volatility::Immutable))))
}

impl ScalarUDFImpl for TextConcatenation {
    fn name(&self) -> &str {
        "concat_texts"
    }

    fn schema_name(&self, args: &[Expr]) -> Result<String> {
        let [left, right] = take_function_args(self.name(), args)?;
        Ok(format!("{} || {}", left.schema_name(), right.schema_name()))
    }

    fn signature(&self) -> &Signature {
        &self.0
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let [left, _] = take_function_args(self.name(), types)?;
        Ok(left.clone())
    }

    // As the operator's: a union that has it declares no nulls that are not there.
    fn return_field_from_args(&self, args: ReturnFieldArgs) -> Result<FieldRef> {
        let [left, right] = take_function_args(self.name(), args.arg_fields)?;
        let is_nullable = left.is_nullable() || right.is_nullable();
        Ok(Arc::new(Field::new(self.name(), left.data_type().clone(), is_nullable)))
    }

    fn is_strict(&self) -> bool {
        true
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        check_stop()?;
        check_text_bytes("||", CallSize::new(&args.args, args.number_rows).total_bytes())?;
        let is_constant = args.args.iter().all(|value| matches!(value, ColumnarValue::Scalar(_)));
        let rows = if is_constant { 1 } else { args.number_rows };
        let [left, right] = take_function_args(self.name(), args.args)?;
        let texts = concat_elements_dyn(&left.into_array(rows)?, &right.into_array(rows)?)?;
        match is_constant {
            true => Ok(ColumnarValue::Scalar(ScalarValue::try_from_array(&texts, 0)?)),
            false => Ok(ColumnarValue::Array(texts)),
        }
    }
}
