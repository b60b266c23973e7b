//! `range` and `generate_series` to `array_length(x) + 1`: lengths are unsigned, and the sum of an unsigned and a
//! signed integer is a decimal without places, which DataFusion's own functions refuse.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field};
use datafusion::error::{DataFusionError, Result};
use datafusion::functions_nested::range::{gen_series_udf, range_udf};
use datafusion::logical_expr::type_coercion::functions::fields_with_udf;
use datafusion::logical_expr::{
    ColumnarValue, Documentation, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};

/// DataFusion's function, and the same for decimals that are whole numbers.
#[derive(Debug, PartialEq, Eq, Hash)]
struct WholeNumberRange {
    own: Arc<ScalarUDF>,
    signature: Signature,
}

/// Returns the functions for DataFusion.
pub fn whole_number_ranges() -> [ScalarUDF; 2] {
    [range_udf(), gen_series_udf()].map(|own| {
        ScalarUDF::new_from_impl(WholeNumberRange { own, signature: Signature::user_defined(Volatility::Immutable) })
    })
}

impl ScalarUDFImpl for WholeNumberRange {
    fn name(&self) -> &str {
        self.own.name()
    }

    fn aliases(&self) -> &[String] {
        self.own.aliases()
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        let whole = types.iter().map(|kind| match kind {
            DataType::Decimal128(_, 0) => DataType::Int64,
            other => other.clone(),
        });
        let fields: Vec<_> = whole.map(|kind| Arc::new(Field::new("argument", kind, true))).collect();
        let coerced = fields_with_udf(&fields, self.own.as_ref()).map_err(|_| {
            let name = self.name();
            let given = types.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            DataFusionError::Plan(format!(
                "`{name}` takes whole numbers, or two dates or times and an interval, not {given}; hint: \
                 {name}(1, 10), {name}(t, t + INTERVAL '1 day', INTERVAL '1 hour')"
            ))
        })?;
        Ok(coerced.iter().map(|field| field.data_type().clone()).collect())
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        self.own.return_type(types)
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        self.own.invoke_with_args(args)
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.own.documentation()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sum_of_a_length_and_a_number_is_a_bound() {
        let range = &whole_number_ranges()[0];
        let bounds = range.coerce_types(&[DataType::Int64, DataType::Decimal128(20, 0)]).expect("whole numbers");
        assert_eq!(bounds, [DataType::Int64, DataType::Int64]);
        let error = range.coerce_types(&[DataType::Int64, DataType::Decimal128(3, 1)]).expect_err("no whole number");
        assert!(error.to_string().contains("takes whole numbers"), "{error}");
    }
}
