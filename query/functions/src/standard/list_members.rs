//! `array_has`, false if no value of the list is equal, as in DuckDB, and `x = ANY (list)`, null then if one is null, as
//! in PostgreSQL. DataFusion has one function for both: null if it becomes `IN`, of a list that is written out, else
//! false.

use std::sync::Arc;

use arrow::array::{Array, AsArray as _, BooleanArray};
use arrow::datatypes::DataType;
use datafusion::error::Result;
use datafusion::functions_nested::array_has::array_has_udf;
use datafusion::logical_expr::simplify::{ExprSimplifyResult, SimplifyContext};
use datafusion::logical_expr::{
    ColumnarValue, Documentation, Expr, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature,
};
use datafusion::scalar::ScalarValue;

/// Name of the function that `x = ANY (list)` becomes: its arguments are the list and x.
pub const ANY_EQUAL: &str = "any_equal";

/// DataFusion's `array_has` with the answer that is meant.
#[derive(Debug, PartialEq, Eq, Hash)]
struct ListMembership {
    own: Arc<ScalarUDF>,
    meaning: NullMeaning,
}

/// The meaning of a null in the list.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum NullMeaning {
    /// No value that is equal.
    Unequal,
    /// A value that may be equal.
    Unknown,
}

/// Returns `array_has` and [`ANY_EQUAL`] for DataFusion.
pub fn list_membership() -> [ScalarUDF; 2] {
    [NullMeaning::Unequal, NullMeaning::Unknown]
        .map(|meaning| ScalarUDF::new_from_impl(ListMembership { own: array_has_udf(), meaning }))
}

impl ScalarUDFImpl for ListMembership {
    fn name(&self) -> &str {
        if self.meaning == NullMeaning::Unknown { ANY_EQUAL } else { self.own.name() }
    }

    fn aliases(&self) -> &[String] {
        if self.meaning == NullMeaning::Unknown { &[] } else { self.own.aliases() }
    }

    fn signature(&self) -> &Signature {
        self.own.signature()
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        self.own.return_type(types)
    }

    // It becomes `IN`, which knows nulls as unknown values.
    fn simplify(&self, args: Vec<Expr>, context: &SimplifyContext) -> Result<ExprSimplifyResult> {
        let has_no_null = match args.first() {
            Some(Expr::Literal(ScalarValue::List(list), _)) => list.values().null_count() == 0,
            Some(Expr::Literal(ScalarValue::LargeList(list), _)) => list.values().null_count() == 0,
            _ => false,
        };
        match self.meaning == NullMeaning::Unknown || has_no_null {
            true => self.own.simplify(args, context),
            false => Ok(ExprSimplifyResult::Original(args)),
        }
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let rows = args.number_rows;
        let lists = args.args.first().cloned().unwrap_or(ColumnarValue::Scalar(ScalarValue::Null));
        let found = self.own.invoke_with_args(args)?;
        if self.meaning == NullMeaning::Unequal {
            return Ok(found);
        }
        let found = found.into_array(rows)?;
        let lists = lists.into_array(rows)?;
        let nulls: Vec<bool> = match lists.data_type() {
            DataType::List(_) => lists.as_list::<i32>().iter().map(|list| list.is_some_and(has_null)).collect(),
            DataType::LargeList(_) => lists.as_list::<i64>().iter().map(|list| list.is_some_and(has_null)).collect(),
            _ => vec![false; rows],
        };
        let known = |(found, has_null): (Option<bool>, bool)| found.filter(|found| *found || !has_null);
        let known: BooleanArray = found.as_boolean().iter().zip(nulls).map(known).collect();
        Ok(ColumnarValue::Array(Arc::new(known)))
    }

    fn documentation(&self) -> Option<&Documentation> {
        (self.meaning == NullMeaning::Unequal).then(|| self.own.documentation()).flatten()
    }
}

fn has_null(list: impl Array) -> bool {
    list.null_count() > 0
}
