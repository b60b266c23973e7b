//! `octet_length` of bytes as well as of texts: DataFusion's own refuses bytes.

use std::sync::Arc;

use arrow::compute::kernels::length::length;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use datafusion::functions::string::octet_length;
use datafusion::logical_expr::{
    ColumnarValue, Documentation, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature, Volatility,
};

/// DataFusion's function, and the same for bytes.
#[derive(Debug, PartialEq, Eq, Hash)]
struct OctetLength {
    of_texts: Arc<ScalarUDF>,
    signature: Signature,
}

/// Returns the function for DataFusion.
pub fn octet_length_of_bytes() -> ScalarUDF {
    let of_texts = octet_length();
    let bytes = [DataType::Binary, DataType::LargeBinary, DataType::BinaryView].map(|kind| vec![kind]);
    let exact = bytes.into_iter().map(TypeSignature::Exact);
    let any = std::iter::once(of_texts.signature().type_signature.clone()).chain(exact).collect();
    let signature = Signature::one_of(any, Volatility::Immutable);
    ScalarUDF::new_from_impl(OctetLength { of_texts, signature })
}

fn is_bytes(kind: &DataType) -> bool {
    matches!(kind, DataType::Binary | DataType::LargeBinary | DataType::BinaryView)
}

impl ScalarUDFImpl for OctetLength {
    fn name(&self) -> &str {
        self.of_texts.name()
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        match types {
            [DataType::LargeBinary] => Ok(DataType::Int64),
            [kind] if is_bytes(kind) => Ok(DataType::Int32),
            _ => self.of_texts.return_type(types),
        }
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        match args.args.as_slice() {
            [value] if is_bytes(&value.data_type()) => {
                let array = value.to_array(args.number_rows)?;
                Ok(ColumnarValue::Array(length(&array)?))
            }
            _ => self.of_texts.invoke_with_args(args),
        }
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.of_texts.documentation()
    }
}
