//! `t AT TIME ZONE 'zone'` as in PostgreSQL: of a time with a zone the time on the clocks of the other zone, without a
//! zone; of a time without a zone the moment at which the clocks of the zone show it.
//!
//! DataFusion's own is a cast: it keeps the moment of a time with a zone, and shows it in another one.

use std::sync::Arc;

use arrow::datatypes::{DataType, TimeUnit};
use datafusion::common::exec_err;
use datafusion::error::Result;
use datafusion::functions::datetime::to_local_time;
use datafusion::logical_expr::{
    ColumnarValue, Expr, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};
use datafusion::scalar::ScalarValue;

/// Name of the function into which `AT TIME ZONE` is rewritten.
pub const AT_TIME_ZONE: &str = "timezone_of";
/// The zone of all times that have one.
const UTC: &str = "UTC";

/// `timezone_of(t, 'zone')`.
#[derive(Debug, PartialEq, Eq, Hash)]
struct ZoneTime {
    local: Arc<ScalarUDF>,
    signature: Signature,
}

/// Returns the function for DataFusion.
pub fn zone_time() -> ScalarUDF {
    ScalarUDF::new_from_impl(ZoneTime {
        local: to_local_time(),
        signature: Signature::user_defined(Volatility::Immutable),
    })
}

impl ScalarUDFImpl for ZoneTime {
    fn name(&self) -> &str {
        AT_TIME_ZONE
    }

    fn schema_name(&self, args: &[Expr]) -> Result<String> {
        Ok(args.first().map_or_else(String::new, |time| time.schema_name().to_string()))
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        let [time, _] = types else { return exec_err!("AT TIME ZONE has a time and a zone") };
        let time = match time {
            DataType::Timestamp(..) => time.clone(),
            // As in PostgreSQL, a date is the moment of its first hour.
            DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View | DataType::Date32 | DataType::Null => {
                DataType::Timestamp(TimeUnit::Nanosecond, Some(UTC.into()))
            }
            other => {
                return exec_err!("AT TIME ZONE is of a time, not of {other}; hint: t::timestamptz AT TIME ZONE 'UTC'");
            }
        };
        Ok(vec![time, DataType::Utf8])
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        match &types[0] {
            DataType::Timestamp(unit, None) => Ok(DataType::Timestamp(*unit, Some(UTC.into()))),
            DataType::Timestamp(unit, Some(_)) => Ok(DataType::Timestamp(*unit, None)),
            other => exec_err!("AT TIME ZONE is of a time, not of {other}"),
        }
    }

    fn invoke_with_args(&self, mut args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let zone = match args.args.pop() {
            Some(ColumnarValue::Scalar(ScalarValue::Utf8(zone))) => zone,
            _ => return exec_err!("the zone of AT TIME ZONE is one text; hint: t AT TIME ZONE 'Europe/Berlin'"),
        };
        let Some(zone) = zone else {
            return Ok(ColumnarValue::Scalar(ScalarValue::try_from(args.return_field.data_type())?));
        };
        let Some(time) = args.args.pop() else { return exec_err!("AT TIME ZONE has a time and a zone") };
        let DataType::Timestamp(unit, given) = time.data_type() else {
            return exec_err!("AT TIME ZONE is of a time, not of {}", time.data_type());
        };
        let in_zone = time.cast_to(&DataType::Timestamp(unit, Some(zone.into())), None)?;
        match given {
            None => in_zone.cast_to(&DataType::Timestamp(unit, Some(UTC.into())), None),
            Some(_) => {
                args.args = vec![in_zone];
                self.local.invoke_with_args(args)
            }
        }
    }
}
